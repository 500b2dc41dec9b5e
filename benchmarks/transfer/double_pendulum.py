"""What matters for the ensemble on the double pendulum with half the motor: one setting is changed at a time."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.runner import Row, Study
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


@dataclass(frozen=True)
class Job:
    """One run of a variant."""

    variant: str
    seed: int


def run(job: Job, folder: Path) -> list[Row]:
    """The learning curve of a run.

    :param job: which
    :param folder: of the source policy
    """
    method, settings = VARIANTS[job.variant]
    model, data = source_policy(folder, seed=0)
    given = {"every": 50, "seed": job.seed, "source_data": str(data), **settings}
    return transfer(method, str(model), source, target, 300, **given)


def summary(rows: Sequence[Row]) -> str:
    """Means over the evaluations, and the last ones."""
    table = pd.DataFrame(rows)
    means = table[table.steps > 0].groupby(["variant", "seed"], as_index=False)["return"].mean()
    parts = {"mean over 50 to 300 target steps": means, "at 300 target steps": table[table.steps == 300]}
    texts = [
        f"{words}\n{summarise(part, ['variant']).round(0).to_string(index=False)}" for words, part in parts.items()
    ]
    return "\n\n".join(texts)


def _prepare(asked: argparse.Namespace) -> None:
    source_policy(asked.runs, seed=0)


main = Study(
    "transfer double_pendulum",
    "double_pendulum_ablation",
    __doc__,
    jobs=lambda asked: [Job(variant, seed) for variant in VARIANTS for seed in SEEDS],
    run=run,
    summary=summary,
    prepare=_prepare,
).main
