"""Trace what the declared models of three real machines lack, and write tables and figures.

    python -m benchmarks machines --only servo

The recordings are not part of the project: docs/real-machines.md says where they come from. Each machine's parameters
and effects are chosen on its training runs alone; the test runs and the other distribution only judge them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

from benchmarks.machines.machines import MACHINES, Machine, find_measured
from benchmarks.runner import Result, Row, Study
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.shooting.prediction_errors import MOST, HorizonError, horizon_errors, predictions
from sb3_rpto.sysid.shooting.windows import cut

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def rows(data: str, model: str, errors: list[HorizonError]) -> list[Row]:
    """One row for each horizon and joint, in rad."""
    return [
        {
            "data": data,
            "model": model,
            "horizon": e.horizon,
            "joint": joint,
            **{key: round(float(getattr(e, key)[j]), 5) for key in ("rmse", "low", "high", "mae")},
            "windows": e.windows,
        }
        for e in errors
        for j, joint in enumerate(e.joints)
    ]


def study(machine: Machine, out: Path, seed: int) -> tuple[list[Row], Row]:
    """Trace one machine: error rows and what was found."""
    began = time.perf_counter()
    report = trace(machine.xml, machine.data, machine.declared, seed=seed)
    seconds = time.perf_counter() - began
    report.save(out / machine.name)
    models = (("declared", report.before), ("corrected", report.after), ("noise floor", report.floor))
    found = [row for model, errors in models for row in rows("test", model, errors)]
    if machine.other is not None:
        for label, values in (("declared", report.values_before), ("corrected", report.values_after)):
            errors = horizon_errors(report.simulation, values, machine.other, report.sigma, seed)
            found += rows("other", label, errors)
    found += homed(machine, report, seed)
    found += side_by_side(machine, report)
    draw(machine, report)
    keys = ("verdict", "declared", "effects", "zeros", "adequacy_before", "adequacy_after")
    kept = {key: report.to_json()[key] for key in keys}
    return found, {**kept, "seconds": round(seconds), "runs": report.runs, "horizon": report.horizon}


def halves(data: Measurements) -> tuple[Measurements, Measurements]:
    """The first and the second half of each run."""
    first = [e.part_of(slice(len(e) // 2), e.after_gap) for e in data.episodes]
    second = [e.part_of(slice(len(e) // 2, None), True) for e in data.episodes]
    return replace(data, episodes=first), replace(data, episodes=second)


def homed(machine: Machine, report: Report, seed: int) -> list[Row]:
    """Errors on the second halves of runs whose encoders' zeros the corrected model tells from the first halves."""
    found: list[Row] = []
    for what, data in (("test", report.data), ("other", machine.other)):
        if data is None or report.zeros is None:
            continue
        first, second = halves(data)
        models = (
            ("declared", report.values_before, second),
            ("corrected", report.values_after, second),
            ("corrected, homed", report.values_after, report.zeros_of(first).taken_off(second)),
        )
        for label, values, runs in models:
            errors = horizon_errors(report.simulation, values, runs, report.sigma, seed)
            found += rows(f"{what}, second half", label, errors)
    return found


def side_by_side(machine: Machine, report: Report, horizon: float = 0.5, phases: int = 10) -> list[Row]:
    """Errors of predictions that lie side by side, by where the first of a run begins: what that choice decides."""
    found: list[Row] = []
    for what, data in (("test", report.data), ("other", machine.other)):
        if data is None:
            continue
        joints = tuple(c for c in data.columns.qpos if c not in data.unobserved)
        for start in np.arange(phases) * horizon / phases:
            parts = [
                e.part_of(slice(int(np.searchsorted(e.time, e.time[0] + start - 1e-9)), None), e.after_gap)
                for e in data.episodes
            ]
            windows = cut(report.simulation.model, replace(data, episodes=parts), report.sigma, horizon, MOST)
            for label, values in (("declared", report.values_before), ("corrected", report.values_after)):
                _, difference, usable = predictions(report.simulation, values, windows)
                error = np.abs(difference[usable])
                rmse, none = np.sqrt((error**2).mean(axis=0)), np.full(len(joints), np.nan)
                pooled = HorizonError(horizon, joints, rmse, none, none, error.mean(axis=0), len(windows))
                found += rows(f"{what}, side by side from {start:.2f} s", label, [pooled])
    return found


def draw(machine: Machine, report: Report, horizon: float = 1.0) -> None:
    """Measured and predicted positions of a typical test window, and of a typical other one."""
    sets: list[tuple[str, Measurements]] = [("test run", report.data)]
    if machine.other is not None:
        sets.append(("other distribution", machine.other))
    joints = [c for c in report.data.columns.qpos if c not in report.data.unobserved]
    figure, axes = plt.subplots(
        len(joints), len(sets), figsize=(5 * len(sets), 2.6 * len(joints)), squeeze=False, layout="constrained"
    )
    for column, (title, data) in enumerate(sets):
        windows = cut(report.simulation.model, data, report.sigma, horizon, 60)
        before, difference, _ = predictions(report.simulation, report.values_before, windows)
        after, _, _ = predictions(report.simulation, report.values_after, windows)
        errors = np.sqrt((difference**2).mean(axis=(1, 2)))
        # The window whose error before is the median: neither the best nor the worst for show.
        w = int(np.argsort(errors)[len(errors) // 2])
        usable = windows.usable[w]
        seconds = windows.at[w][usable] * report.simulation.model.opt.timestep
        for row, joint in enumerate(joints):
            ax = axes[row, column]
            ax.plot(seconds, windows.measured[w][usable][:, row], color="black", label="measured")
            ax.plot(seconds, before[w][usable][:, row], color="#d55e00", linestyle="--", label="declared model")
            ax.plot(seconds, after[w][usable][:, row], color="#0072b2", label="corrected model")
            ax.set(xlabel="time in the window [s]", ylabel=f"{joint} [rad]", title=title if row == 0 else "")
    axes[0, 0].legend(fontsize=8)
    Path("docs/images").mkdir(parents=True, exist_ok=True)
    figure.savefig(f"docs/images/{machine.name}.png", dpi=110)
    plt.close(figure)


@dataclass(frozen=True)
class Job:
    """The trace of a machine."""

    machine: str
    seed: int


def run(job: Job, folder: Path) -> Result:
    """Trace one machine: error rows, and what was found.

    :param job: which
    :param folder: of the reports
    """
    measured = find_measured()
    assert measured is not None  # as prepared
    machine = MACHINES[job.machine](measured)
    rows, found = study(machine, folder, job.seed)
    return {"rows": rows, "found": {"licence": machine.licence, "source": machine.source, **found}}


def _prepare(asked: argparse.Namespace) -> None:
    if find_measured() is None:
        raise FileNotFoundError(
            "the recordings are not here; set RPTO_MEASURED to their folder (docs/real-machines.md)"
        )


def summary(rows: Sequence[Row]) -> str:
    """Errors at half a second."""
    table = pd.DataFrame(rows)
    shown = table[(table["horizon"] == 0.5) & table["data"].isin(["test", "other"])]
    return shown[["machine", "data", "model", "joint", "rmse", "low", "high"]].to_string(index=False)


main = Study(
    "machines",
    "machines",
    __doc__,
    jobs=lambda asked: [Job(name, asked.seed) for name in MACHINES],
    run=run,
    summary=summary,
    options=lambda parser: parser.add_argument("--seed", type=int, default=0),
    prepare=_prepare,
).main
