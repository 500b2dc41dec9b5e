"""One run: a method moves a source policy to a target; its learning curve comes back as rows."""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable, Collection
from typing import Any

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms import RPO, RPTO, RTO

MakeEnv = Callable[[], gym.Env]
ALGORITHMS = {"rpo": RPO, "rto": RTO, "rpto": RPTO}
METHODS = ("zero-shot", "sac", "sac-warm", *ALGORITHMS)
#: Evaluation environments are seeded apart from both worlds.
EVALUATION_SEED = 50_000


def evaluate(model: SAC, env: VecEnv, n_episodes: int, seed: int) -> float:
    """Mean return of the deterministic policy over ``n_episodes``, one in each environment of ``env``."""
    env.seed(EVALUATION_SEED + seed)
    returns, _ = evaluate_policy(model, env, n_eval_episodes=n_episodes, deterministic=True, warn=False)
    return float(returns)  # type: ignore[arg-type]


class LearningCurve(BaseCallback):
    """Evaluates the deterministic policy every so many target steps, in an environment of its own.

    :param make_target: makes an evaluation environment
    :param every: target steps between evaluations, or the steps at which they are made
    :param n_episodes: episodes of an evaluation
    :param seed: of the evaluation's initial states
    :param read: further values of a row, read off the model (an estimated parameter, say)
    """

    def __init__(
        self,
        make_target: MakeEnv,
        every: int | Collection[int],
        n_episodes: int = 10,
        seed: int = 0,
        read: Callable[[Any], dict[str, Any]] | None = None,
    ) -> None:
        super().__init__()
        self.env = make_vec_env(make_target, n_envs=n_episodes)
        self.every, self.n_episodes, self.seed = every, n_episodes, seed
        self.read = read
        self.rows: list[dict[str, Any]] = []
        self._spent = 0.0  # seconds of training, without the evaluations
        self._since = 0.0

    def evaluate(self, model: SAC, steps: int) -> None:
        """Add a row."""
        row = {
            "steps": steps,
            "return": evaluate(model, self.env, self.n_episodes, self.seed),
            "updates": model._n_updates - self._updates_at_start,
            "source_steps": getattr(model, "source_timesteps", 0),
            "seconds": round(self._spent, 2),
        }
        self.rows.append({**row, **(self.read(model) if self.read else {})})

    def _on_training_start(self) -> None:
        self._updates_at_start = self.model._n_updates
        self.evaluate(self.model, 0)  # type: ignore[arg-type]
        self._since = time.perf_counter()

    def _on_step(self) -> bool:
        steps, every = self.num_timesteps, self.every
        if steps % every == 0 if isinstance(every, int) else steps in every:
            self._spent += time.perf_counter() - self._since
            self.evaluate(self.model, self.num_timesteps)  # type: ignore[arg-type]
            self._since = time.perf_counter()
        return True


def transfer(
    method: str,
    source_model: str,
    make_source: MakeEnv,
    make_target: MakeEnv,
    budget: int,
    *,
    every: int | Collection[int],
    seed: int = 0,
    n_episodes: int = 10,
    n_source_envs: int = 1,
    source_data: str | None = None,
    read: Callable[[Any], dict[str, Any]] | None = None,
    **kwargs: Any,
) -> list[dict[str, Any]]:
    """Run one method once.

    :param method: one of :data:`METHODS`
    :param source_model: zip of the SAC that was trained in the source
    :param make_source: makes the source environment
    :param make_target: makes the target
    :param budget: target steps
    :param every: target steps between evaluations, or the steps at which they are made
    :param seed: of the run
    :param n_episodes: episodes of an evaluation
    :param n_source_envs: source environments that step side by side
    :param source_data: transitions of the source, for phi_0 (RTO, RPTO)
    :param read: further values of a row
    :param kwargs: constructor arguments of the method
    :return: one row an evaluation: method, seed, steps, return, updates, source_steps, seconds
    """
    if method not in METHODS:
        raise ValueError(f"method={method!r} does not exist; choose one of {METHODS}")
    curve = LearningCurve(make_target, every, n_episodes, seed, read)
    model: SAC
    if method in ALGORITHMS:
        source = make_vec_env(make_source, n_envs=n_source_envs)
        if method != "rpo":
            kwargs["source_data"] = source_data
        model = ALGORITHMS[method].from_source(source_model, source, make_target(), seed=seed, device="cpu", **kwargs)
    elif method == "sac":
        model = SAC("MlpPolicy", make_target(), seed=seed, device="cpu", **kwargs)
    else:
        model = fine_tuned_sac(source_model, make_target(), seed, **kwargs)
    if method == "zero-shot":
        curve._updates_at_start = model._n_updates
        curve.evaluate(model, 0)
    else:
        model.learn(budget, callback=curve)
    curve.env.close()
    return [{"method": method, "seed": seed, **row} for row in curve.rows]


def fine_tuned_sac(source_model: str | pathlib.Path, target: gym.Env, seed: int, **settings: Any) -> SAC:
    """SAC-warm: the source's SAC, ready to go on in the target from its first step, with an empty replay buffer.

    :param source_model: zip of the SAC that was trained in the source
    :param target: the target
    :param seed: of the run
    :param settings: attributes to change, e.g. ``gradient_steps``
    """
    model = SAC.load(source_model, env=target, device="cpu", **settings)
    model.set_random_seed(seed)
    model.learning_starts = 0
    return model
