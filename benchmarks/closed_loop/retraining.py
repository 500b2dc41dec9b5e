"""What judging policies in the simulator is worth where nothing is to be gained: the double pendulum is its own target.

The policy balances already, and D_source begins with what it sees while it does. Counted are the episodes of 40 in
which it falls after it has learned on, with policies judged in the simulator (algorithms/closed_loop) and without.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from benchmarks.closed_loop.study import TASKS, make_source, make_target, source_agent
from benchmarks.runner import Row, Study
from sb3_rpto import RPTO
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop
from sb3_rpto.evaluation.learning_curve import EVALUATION_SEED

TASK, SHIFT, SEEDS = "double-pendulum", "none", range(3)
BUDGET, EVERY, EPISODES, WHOLE = 1_000, 250, 40, 1_000


@dataclass(frozen=True)
class Job:
    """One run, learned on to each number of target steps in turn."""

    rehearsals: bool
    seed: int


def run(job: Job, folder: Path) -> list[Row]:
    """Falls and returns of a run.

    :param job: which
    :param folder: of source agents
    """
    agent, _ = source_agent(TASK, folder)
    target = make_vec_env(partial(make_target, TASK, SHIFT, 0), n_envs=20)
    judged = (
        nullcontext() if job.rehearsals else mock.patch.object(ClosedLoop, "can_evaluate_policies", return_value=False)
    )
    with judged:
        model = RPTO.from_source(
            *(agent, make_source(TASK), make_target(TASK, SHIFT, 0)),
            dynamics="physical",
            declared=list(TASKS[TASK].declared),
            close_loop=True,
            seed=job.seed,
        )
        rows = []
        for steps in range(0, BUDGET + 1, EVERY):
            if steps:
                model.learn(EVERY, reset_num_timesteps=False)
            target.seed(EVALUATION_SEED)
            returns, lengths = evaluate_policy(
                model, target, n_eval_episodes=EPISODES, deterministic=True, return_episode_rewards=True, warn=False
            )
            row = {"steps": steps, "return": np.mean(returns), "falls": int(np.sum(np.less(lengths, WHOLE)))}
            spent = {"updates": model.n_updates, "source_steps": model.source_timesteps}
            rows.append({**row, "episodes": EPISODES, **spent})
    return rows


def summary(rows: Sequence[Row]) -> str:
    """Falls and least returns by target steps."""
    table = pd.DataFrame(rows)
    return str(
        table.pivot_table(index="rehearsals", columns="steps", values=["falls", "return"], aggfunc=["sum", "min"])
    )


main = Study(
    "closed_loop retraining",
    "closed_loop_retraining",
    __doc__,
    jobs=lambda asked: [Job(judged, seed) for judged, seed in product((True, False), SEEDS)],
    run=run,
    summary=summary,
    prepare=lambda asked: source_agent(TASK, asked.runs),
).main
