"""Domain randomisation: one policy for all the machines that the declared numbers may make, without a target step."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_rpto.baselines.sac_variants import fine_tuned_sac
from sb3_rpto.effects import declare
from sb3_rpto.effects.walker_reset import StandingEnv
from sb3_rpto.evaluation.learning_curve import MakeEnv
from sb3_rpto.files import write_json

#: What a closed loop may spend in its corrected simulator, so that the two can be compared: updates, source steps for
#: each, and steps of the source's policy before the first.
UPDATES, SOURCE_STEPS, FILL = 40_000, 8, 16_000
#: Evaluations in sources of which no two are alike, and episodes of one: the best policy is kept.
CHECKS, EPISODES = 20, 25


class RandomisedEnv(StandingEnv):
    """A source whose declared numbers are drawn anew for each episode, uniformly around what they are.

    :param env: a gymnasium MuJoCo environment
    :param declared: names, as :func:`sb3_rpto.effects.declare` takes them
    :param spread: largest change, as a share of the value
    """

    def __init__(self, env: gym.Env, declared: Sequence[str], spread: float) -> None:
        self._nominal, self._spread = declare(env.unwrapped.model, declared), spread  # type: ignore[attr-defined]
        self._draws = np.random.default_rng()
        super().__init__(env, self._nominal)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of another machine; a seed decides on this and on those of the following episodes."""
        if seed is not None:
            self._draws = np.random.default_rng(seed)
        factors = self._draws.uniform(1 - self._spread, 1 + self._spread, len(self._nominal))
        self.set_effects([e.with_values(factor * e.values) for e, factor in zip(self._nominal, factors)])
        return super().reset(seed=seed, options=options)


def randomised_agent(
    source_model: str, make_source: MakeEnv, declared: Sequence[str], spread: float, seed: int, path: Path
) -> dict[str, float]:
    """The source's SAC, trained on in randomised sources; made once and kept.

    :param source_model: zip of the SAC that was trained in the source
    :param make_source: makes the source
    :param declared: names of the numbers to draw
    :param spread: as of :class:`RandomisedEnv`
    :param seed: of the run
    :param path: of the zip that is made; what it cost is beside it
    :return: updates, source_steps (evaluations are not among them) and seconds
    """
    cost = path.with_suffix(".json")
    if path.exists():
        return dict(json.loads(cost.read_text(encoding="utf-8")))
    th.set_num_threads(1)
    path.parent.mkdir(parents=True, exist_ok=True)
    began, make = time.perf_counter(), partial(_randomised, make_source, tuple(declared), spread)
    model = fine_tuned_sac(source_model, make_vec_env(make, n_envs=SOURCE_STEPS, seed=seed), seed, gradient_steps=0)
    model.learn(FILL)
    model.gradient_steps, before = 1, model._n_updates
    with tempfile.TemporaryDirectory(dir=path.parent) as kept:
        check = EvalCallback(
            make_vec_env(make, n_envs=EPISODES, seed=10_000 + seed),
            n_eval_episodes=EPISODES,
            eval_freq=max(UPDATES // CHECKS, 1),
            best_model_save_path=kept,
            verbose=0,
        )
        model.learn(UPDATES * SOURCE_STEPS, callback=check, reset_num_timesteps=False)
        spent: dict[str, float] = {"updates": model._n_updates - before, "source_steps": model.num_timesteps}
        spent["seconds"] = round(time.perf_counter() - began, 2)
        write_json(cost, spent)
        os.replace(Path(kept) / "best_model.zip", path)  # last: its presence says that both are there
    return spent


def _randomised(make_source: MakeEnv, declared: Sequence[str], spread: float) -> gym.Env:
    return RandomisedEnv(make_source(), declared, spread)
