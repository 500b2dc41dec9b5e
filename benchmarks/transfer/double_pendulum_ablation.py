"""What matters for the ensemble on the double pendulum: one setting changed at a time, five seeds each.

python -m benchmarks transfer double_pendulum     # about ten minutes on two cores, after transfer_double_pendulum.py
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from tqdm import tqdm

from benchmarks import RESULTS
from examples.transfer_double_pendulum import source, source_policy, target
from sb3_rpto.baselines.transfer import transfer
from sb3_rpto.evaluation.statistics import summarise

SMALL: dict[str, Any] = {"dynamics_kwargs": {"hidden": (128, 128, 128)}}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default preset": ("rpto", SMALL),
    "fits every 50 steps": ("rpto", {**SMALL, "model_train_freq": 50}),
    "a quarter of real data": ("rpto", {**SMALL, "real_ratio": 0.25}),
    "no RTO weight": ("rpto", {**SMALL, "weighting": None}),
    "20 updates": ("rpto", {**SMALL, "gradient_steps": 20}),
    "samples, not means": ("rpto", {"dynamics_kwargs": {**SMALL["dynamics_kwargs"], "noise": True}}),
    "RPO, the real source": ("rpo", {}),
    "SAC-warm": ("sac-warm", {}),
}
SEEDS = range(10, 15)


def run(job: tuple[str, int]) -> list[dict[str, Any]]:
    variant, seed = job
    th.set_num_threads(1)
    method, settings = VARIANTS[variant]
    model, data = source_policy(Path("runs/double_pendulum"), seed=0)
    rows = transfer(
        *(method, str(model), source, target, 300),
        every=50,
        seed=seed,
        source_data=str(data),
        **settings,
    )
    return [{"variant": variant, **row} for row in rows]


def main(arguments: Sequence[str] | None = None) -> None:
    out = RESULTS / "double_pendulum"
    Path("runs/double_pendulum").mkdir(parents=True, exist_ok=True)
    source_policy(Path("runs/double_pendulum"), seed=0)
    jobs = [(variant, seed) for variant in VARIANTS for seed in SEEDS]
    with ProcessPoolExecutor(2) as pool:
        rows = [row for rows in tqdm(pool.map(run, jobs), total=len(jobs)) for row in rows]
    frame = pd.DataFrame(rows)
    frame.round(3).to_csv(out / "ablation.csv", index=False)
    table = summarise(frame[frame.steps > 0].groupby(["variant", "seed"], as_index=False)["return"].mean(), ["variant"])
    print("mean return over the evaluations at 50 to 300 target steps, IQM over seeds and 95 % interval")
    print(table.round(0).to_string(index=False))
    print(summarise(frame[frame.steps == 300], ["variant"]).round(0).to_string(index=False))
