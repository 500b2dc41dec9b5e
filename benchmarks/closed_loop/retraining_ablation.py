"""What rehearsals are worth where nothing is to be gained: the double pendulum's source is its target, three seeds.

python -m benchmarks closed_loop retraining     # half an hour on two cores

The policy balances already, and D_source begins with what it sees while it does. Counted are the episodes of 40 in
which it falls after it has learned on, with policies evaluated in the simulator before they act, and without.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.closed_loop.study import TASKS, make_source, make_target, source_agent
from sb3_rpto import RPTO
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop
from sb3_rpto.evaluation.learning_curve import EVALUATION_SEED

TASK, SHIFT, SEEDS = "double-pendulum", "none", range(3)
BUDGET, EVERY, EPISODES, WHOLE = 1_000, 250, 40, 1_000
RUNS = Path("runs/closed_loop")


def run(job: tuple[bool, int]) -> list[dict[str, Any]]:
    """One run, learned on to each number of target steps in turn."""
    rehearsed, seed = job
    th.set_num_threads(1)
    agent, _ = source_agent(TASK, RUNS)
    target = make_vec_env(partial(make_target, TASK, SHIFT, 0), n_envs=20)
    judged = nullcontext() if rehearsed else mock.patch.object(ClosedLoop, "can_evaluate_policies", return_value=False)
    with judged:
        model = RPTO.from_source(
            *(agent, make_source(TASK), make_target(TASK, SHIFT, 0)),
            dynamics="physical",
            declared=list(TASKS[TASK].declared),
            close_loop=True,
            seed=seed,
        )
        rows = []
        for steps in range(0, BUDGET + 1, EVERY):
            if steps:
                model.learn(EVERY, reset_num_timesteps=False)
            target.seed(EVALUATION_SEED)
            returns, lengths = evaluate_policy(
                model, target, n_eval_episodes=EPISODES, deterministic=True, return_episode_rewards=True, warn=False
            )
            rows.append(
                {
                    **{"rehearsals": rehearsed, "seed": seed, "steps": steps, "return": np.mean(returns)},
                    **{"falls": int(np.sum(np.less(lengths, WHOLE))), "episodes": EPISODES},
                    **{"updates": model.n_updates, "source_steps": model.source_timesteps},
                }
            )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all, write the table and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--workers", type=int, default=2, help="runs side by side")
    parser.add_argument("--out", type=Path, default=RESULTS / "double_pendulum")
    parsed = parser.parse_args(arguments)
    RUNS.mkdir(parents=True, exist_ok=True)
    source_agent(TASK, RUNS)
    jobs = list(product((True, False), SEEDS))
    with ProcessPoolExecutor(parsed.workers) as pool:
        frame = pd.DataFrame([row for rows in tqdm(pool.map(run, jobs), total=len(jobs)) for row in rows])
    frame.round(1).to_csv(parsed.out / "rehearsals.csv", index=False)
    print(frame.pivot_table(index="rehearsals", columns="steps", values=["falls", "return"], aggfunc=["sum", "min"]))
