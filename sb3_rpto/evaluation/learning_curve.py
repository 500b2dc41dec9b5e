"""A learning curve: returns of the deterministic policy against target steps, in environments of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms.normalisation import share_normalisation

MakeEnv = Callable[[], gym.Env]
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
    :param after_update: evaluate when the update that follows the step is over, as a method must be that learns from
        many steps at once
    """

    def __init__(
        self,
        make_target: MakeEnv,
        every: int | Collection[int],
        n_episodes: int = 10,
        seed: int = 0,
        read: Callable[[Any], dict[str, Any]] | None = None,
        after_update: bool = False,
    ) -> None:
        super().__init__()
        self.env = make_vec_env(make_target, n_envs=n_episodes)
        self.every, self.n_episodes, self.seed = every, n_episodes, seed
        self.read, self.after_update = read, after_update
        self.rows: list[dict[str, Any]] = []
        #: source steps beside those that the model counts itself
        self.source_steps = 0
        self._spent = 0.0  # seconds of training, without the evaluations
        self._since = 0.0
        self._due: int | None = None  # steps of an evaluation that waits for the update

    def evaluate(self, model: SAC, steps: int) -> None:
        """Add a row."""
        row = {
            "steps": steps,
            "return": evaluate(model, self._as_seen_by(model), self.n_episodes, self.seed),
            "updates": model._n_updates - self._updates_at_start,
            "source_steps": self.source_steps + getattr(model, "source_timesteps", 0),
            "seconds": round(self._spent, 2),
        }
        self.rows.append({**row, **(self.read(model) if self.read else {})})

    def _as_seen_by(self, model: SAC) -> VecEnv:
        """The evaluation environment with the statistics by which the model sees observations."""
        return share_normalisation(self.env, model.get_env())

    def begin(self, model: SAC) -> None:
        """The row of the policy as it comes, before the first target step."""
        self._updates_at_start = model._n_updates
        self.evaluate(model, 0)
        self._since = time.perf_counter()

    def finish(self, model: SAC, steps: int) -> None:
        """The last row is that of another model, which was made after the last of ``steps`` target steps."""
        if self.rows[-1]["steps"] == steps:
            del self.rows[-1]
        self._pause_and_evaluate(model, steps)

    def _pause_and_evaluate(self, model: SAC, steps: int) -> None:
        self._spent += time.perf_counter() - self._since
        self.evaluate(model, steps)
        self._since = time.perf_counter()

    def _on_training_start(self) -> None:
        self.begin(self.model)  # type: ignore[arg-type]

    def _on_rollout_start(self) -> None:
        self._evaluate_due()

    def _on_step(self) -> bool:
        self._evaluate_due()
        steps, every = self.num_timesteps, self.every
        if steps % every == 0 if isinstance(every, int) else steps in every:
            self._due = steps
            if not self._waits(steps):
                self._evaluate_due()
        return True

    def _waits(self, steps: int) -> bool:
        """Whether the evaluation at this step is made when the update that follows is over."""
        return self.after_update

    def _on_training_end(self) -> None:
        self._evaluate_due()

    def _evaluate_due(self) -> None:
        if self._due is not None:
            steps, self._due = self._due, None
            self._pause_and_evaluate(self.model, steps)  # type: ignore[arg-type]
