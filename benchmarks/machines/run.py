"""Trace what the declared models of three real machines lack, and write tables and figures.

python -m benchmarks machines --out runs/machines

The recordings are not part of the project: docs/real-machines.md says where they come from. Each machine's parameters
and effects are chosen on its training runs alone; the test runs and the other distribution only judge them.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

from benchmarks.machines.machines import MACHINES, Machine, find_measured
from sb3_rpto.evaluation import provenance
from sb3_rpto.files import write_json
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.shooting.prediction_errors import MOST, HorizonError, horizon_errors, predictions
from sb3_rpto.sysid.shooting.windows import cut

matplotlib.use("Agg")
import matplotlib.pyplot as plt

RESULTS = Path("benchmarks/results/machines")


def rows(name: str, data: str, model: str, errors: list[HorizonError]) -> list[dict[str, object]]:
    """One row for each horizon and joint, in rad."""
    return [
        {
            "machine": name,
            "data": data,
            "model": model,
            "horizon": e.horizon,
            "joint": joint,
            **{key: f"{getattr(e, key)[j]:.5f}" for key in ("rmse", "low", "high", "mae")},
            "windows": e.windows,
        }
        for e in errors
        for j, joint in enumerate(e.joints)
    ]


def study(machine: Machine, out: Path, seed: int) -> tuple[list[dict[str, object]], dict[str, object]]:
    """Trace one machine: error rows and what was found."""
    began = time.perf_counter()
    report = trace(machine.xml, machine.data, machine.declared, seed=seed)
    seconds = time.perf_counter() - began
    report.save(out / machine.name)
    print(f"\n===== {machine.name}, {seconds:.0f} s\n{report}")
    models = (("declared", report.before), ("corrected", report.after), ("noise floor", report.floor))
    found = [row for model, errors in models for row in rows(machine.name, "test", model, errors)]
    if machine.other is not None:
        for label, values in (("declared", report.values_before), ("corrected", report.values_after)):
            errors = horizon_errors(report.simulation, values, machine.other, report.sigma, seed)
            found += rows(machine.name, "other", label, errors)
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


def homed(machine: Machine, report: Report, seed: int) -> list[dict[str, object]]:
    """Errors on the second halves of runs whose encoders' zeros the corrected model tells from the first halves."""
    found: list[dict[str, object]] = []
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
            found += rows(machine.name, f"{what}, second half", label, errors)
    return found


def side_by_side(machine: Machine, report: Report, horizon: float = 0.5, phases: int = 10) -> list[dict[str, object]]:
    """Errors of predictions that lie side by side, by where the first of a run begins: what that choice decides."""
    found: list[dict[str, object]] = []
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
                found += rows(machine.name, f"{what}, side by side from {start:.2f} s", label, [pooled])
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


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/machines"), help="folder of the reports")
    parser.add_argument("--only", choices=sorted(MACHINES), action="append", help="some machines; default: all")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    folder = find_measured()
    if folder is None:
        parser.error("the recordings are not here; set RPTO_MEASURED to their folder (docs/real-machines.md)")
    commit = provenance.commit()  # before results of this run make the tree another than the commit's
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name in asked.only or MACHINES:
        errors, found = study(MACHINES[name](folder), asked.out, asked.seed)
        with (RESULTS / f"{name}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(errors[0]))
            writer.writeheader()
            writer.writerows(errors)
        manifest = {
            "command": f"python -m benchmarks machines --only {name} --seed {asked.seed}",
            "commit": commit,
            "versions": provenance.versions(),
            **provenance.machine(),
            "licence": MACHINES[name](folder).licence,
            "source": MACHINES[name](folder).source,
            **found,
        }
        write_json(RESULTS / f"{name}.json", manifest)
