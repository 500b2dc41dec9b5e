"""What closing the loop is worth, on four simulated robots with shifted targets.

    python -m benchmarks closed_loop --quick      # one task, one seed, 250 target steps: shows that it works
    python -m benchmarks closed_loop              # five seeds, resumable; days on two cores, so choose
    python -m benchmarks closed_loop report benchmarks/results/closed_loop.csv

Targets differ from their source by numbers that are declared (lengths, masses, friction by up to 20 %), by these and
an effect that nobody declared, or not at all; two fixed targets each. Compared are the source policy as it is, SAC
fine-tuned in the target, RPTO with networks, RPTO with the simulator's numbers, the same with the loop closed, and a
policy of randomised sources, fine-tuned; an oracle that trained 100,000 steps in the target says what could be reached.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.closed_loop import study as study
from benchmarks.runner import chosen, manifest, parser_of, read_table, run_jobs, said, write_table
from benchmarks.transfer.plots import learning_curves
from sb3_rpto.files import write_json

PLACE = ["task", "shift", "target", "method"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, then write the table of all that is there.

    :param arguments: without the study's name; default: those of the process
    :return: exit code, 1 where runs failed
    """
    parser = parser_of("closed_loop", __doc__, "closed_loop")
    parser.add_argument("--quick", action="store_true", help="one task, one seed, few steps: shows that it works")
    parser.add_argument("--tasks", nargs="+", default=list(study.TASKS), choices=list(study.TASKS))
    parser.add_argument("--shifts", nargs="+", default=list(study.SHIFTS), choices=study.SHIFTS)
    parser.add_argument("--methods", nargs="+", default=list(study.METHODS), choices=list(study.METHODS))
    parser.add_argument("--targets", nargs="+", type=int, default=list(study.TARGETS), choices=study.TARGETS)
    parser.add_argument("--seeds", type=int, default=5, help="how many (default: 5); 0: only write the table")
    parser.add_argument("--sensors", type=float, default=0.0, help="noise of the target's positions in rad or m")
    parser.add_argument("--budget", type=int, help="most target steps of a run (default: the study's)")
    parser.add_argument("--no-oracle", action="store_true", help="leave the oracles out")
    a = parser.parse_args(arguments)
    episodes = study.EPISODES
    if a.quick:
        a.tasks, a.shifts, a.targets, a.seeds, a.no_oracle = ["double-pendulum"], ["undeclared"], [0], 1, True
        a.methods, a.runs, episodes = ["zero-shot", "RPTO-physical, closed loop"], a.runs / "quick", 2
        a.budget = a.budget or 250
    settings = {"sensors": a.sensors, "budget": a.budget, "episodes": episodes}
    listed = study.jobs(a.tasks, a.shifts, a.targets, range(a.seeds), **settings)
    listed = [job for job in listed if job.method in a.methods]
    places = [] if a.no_oracle else list(dict.fromkeys((job.task, job.shift, job.target) for job in listed))
    listed = [*(study.Job(*place, study.ORACLE, 0) for place in places), *listed]
    listed = chosen(listed, a.only) if listed else listed
    if a.list:
        print(*(job.name for job in listed), sep="\n")
        return 0
    a.runs.mkdir(parents=True, exist_ok=True)
    for task in dict.fromkeys(job.task for job in listed):
        study.source_agent(task, a.runs)
    how: dict[str, Any] = {"workers": a.workers, "backend": a.backend, "fresh": a.fresh}
    work = partial(study.run, folder=a.runs)
    results = run_jobs(work, listed, a.runs / "runs", **how, current=study.long_enough)
    rows = study.collected(a.runs / "runs", a.sensors)  # the table is always of all runs in the folder
    if rows.empty:
        parser.error(f"--runs: {a.runs} holds no finished run; ask for some by --seeds")
    out = a.out or a.runs / "table"
    write_table(out.with_name(f"{out.name}.csv"), rows.to_dict("records"))
    made = manifest(
        f"python -m benchmarks closed_loop {shlex.join(sys.argv[1:] if arguments is None else arguments)}".strip(),
        rows.to_dict("records"),
        **settings,
        oracle_steps=study.ORACLE_STEPS,
        seeds={" ".join(map(str, p)): sorted(set(map(int, r["seed"]))) for p, r in rows.groupby(PLACE)},
        targets=study.fingerprint(),
    )
    write_json(out.with_name(f"{out.name}.json"), made)
    print(report(rows, out.with_name(f"{out.name}.png")))
    return said(results, out)


def report_table(arguments: Sequence[str] | None = None) -> int:
    """Print what a table says, and draw its figure beside it.

    :param arguments: default: those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks closed_loop report", description=report_table.__doc__)
    parser.add_argument("table", metavar="TABLE", type=Path, help="CSV file")
    parser.add_argument("--form", default="", help="of the closed loop, where the table has several")
    asked = parser.parse_args(arguments)
    rows = pd.DataFrame(read_table(asked.table))
    if "form" in rows:
        rows = rows[(rows["form"].fillna("") == asked.form) | (rows["method"] == study.ORACLE)]
    print(report(rows, asked.table.with_suffix(".png")))
    return 0


def report(rows: pd.DataFrame, figure: Path) -> str:
    """Returns and costs, the steps to 90 % of the oracle, and the figure.

    :param rows: of the table
    :param figure: path of the picture
    """
    oracles = study.oracles(rows)
    summary = study.summary(rows, oracles)
    draw(summary, oracles, figure)
    tables = [summary.round(4), study.steps_to_oracle(rows, oracles)]
    return "\n\n".join(table.to_string(index=False) for table in tables)


def draw(summary: pd.DataFrame, oracles: dict[tuple[str, str, int], float], path: Path) -> None:
    """Returns against target steps, a panel for each task and shift; the oracle's is the mean of its targets."""
    lines = summary.rename(columns={"shift": "target", "method": "label", "iqm": "return"})
    lines = lines.rename(columns={"low": "return_low", "high": "return_high"})
    lines = lines[lines["label"] != "zero-shot"]
    every = lines.groupby(["task", "target", "label"])["runs"].transform("max")
    lines = lines[lines["runs"] == every]  # a curve is of the same runs from end to end
    best = pd.Series(oracles, dtype=float)
    places = best.groupby(level=[0, 1]).mean().items() if len(best) else ()
    references = {f"{task}_{shift}": {"oracle": value} for (task, shift), value in places}
    labels = [method for method in study.METHODS if (lines["label"] == method).any()]
    figure = learning_curves(lines, references, labels, [m for m in labels if m.startswith("RPTO")], path)
    for axis in figure.axes:
        axis.set_xscale("symlog", linthresh=250)
        axis.set_xlim(left=0)
        axis.ticklabel_format(axis="y", useOffset=False)
    figure.savefig(path, dpi=120)
