"""What closing the loop is worth, on four simulated robots with shifted targets.

    python -m benchmarks closed_loop --quick      # one task, one seed, 250 target steps: shows that it works
    python -m benchmarks closed_loop              # five seeds, resumable; days on two cores, so see --help

Targets differ from their source by numbers that are declared (lengths, masses, friction by up to 20 %), by these and
an effect that nobody declared, or not at all; two fixed targets each. Compared are the source policy as it is, SAC
fine-tuned in the target, RPTO with networks, RPTO with the simulator's numbers, the same with the loop closed, and a
policy of randomised sources, fine-tuned; an oracle that trained 100,000 steps in the target says what could be reached.
Tables, figure and manifest go to benchmarks/results/closed_loop.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.closed_loop import study as study
from benchmarks.transfer.plots import learning_curves
from sb3_rpto.evaluation.provenance import machine, versions
from sb3_rpto.files import write_json

PLACE = ["task", "shift", "target", "method"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, then write the tables of all that is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one task, one seed, few steps: shows that it works")
    parser.add_argument("--tasks", nargs="+", default=list(study.TASKS), choices=list(study.TASKS))
    parser.add_argument("--shifts", nargs="+", default=list(study.SHIFTS), choices=study.SHIFTS)
    parser.add_argument("--methods", nargs="+", default=list(study.METHODS), choices=list(study.METHODS))
    parser.add_argument("--targets", nargs="+", type=int, default=list(study.TARGETS), choices=study.TARGETS)
    parser.add_argument("--seeds", type=int, default=5, help="how many (default: 5); 0: only write the tables")
    parser.add_argument("--sensors", type=float, default=0.0, help="noise of the target's positions in rad or m")
    parser.add_argument("--budget", type=int, help="most target steps of a run (default: the study's)")
    parser.add_argument("--no-oracle", action="store_true", help="leave the oracles out")
    parser.add_argument("--workers", type=int, default=2, help="runs side by side")
    parser.add_argument("--runs", type=Path, help="where single runs are kept (runs/closed_loop)")
    parser.add_argument("--out", type=Path, help="where the tables go")
    a = parser.parse_args(arguments)
    name = f"closed_loop_sensors_{a.sensors:g}" if a.sensors else "closed_loop"
    a.runs, episodes = a.runs or Path("runs") / name, study.EPISODES
    if a.quick:
        a.tasks, a.shifts, a.targets, a.seeds, a.no_oracle = ["double-pendulum"], ["undeclared"], [0], 1, True
        a.methods, a.runs, episodes = ["zero-shot", "RPTO-physical, closed loop"], a.runs / "quick", 2
        a.budget = a.budget or 250
    out = a.out or (a.runs if a.quick else RESULTS / name)
    for folder in (a.runs, out):
        folder.mkdir(parents=True, exist_ok=True)

    # Tables and figure are always of all runs in the folder: "--seeds 0" writes them and runs nothing.
    todo = [
        job for job in study.jobs(a.tasks, a.shifts, a.targets, range(a.seeds), a.sensors) if job.method in a.methods
    ]
    for task in dict.fromkeys(job.task for job in todo):
        study.source_agent(task, a.runs)
    with ProcessPoolExecutor(a.workers) as pool:
        places = [(job.task, job.shift, job.target) for job in todo]
        bests = [] if a.no_oracle else [pool.submit(study.oracle, *p, a.runs) for p in dict.fromkeys(places)]
        futures = [pool.submit(study.run, job, a.runs, a.budget, episodes) for job in todo]
        for future in tqdm([*bests, *futures], desc="runs"):
            future.result()

    rows, oracles = study.collected(a.runs, a.sensors), study.oracles(a.runs)
    if rows.empty:
        parser.error(f"--runs: {a.runs} holds no run; ask for some by --seeds")
    rows.to_csv(out / "runs.csv", index=False)
    tables = {"summary": study.summary(rows, oracles), "steps_to_90": study.steps_to_oracle(rows, oracles)}
    if oracles:
        best = [dict(zip(("task", "shift", "target", "return"), (*p, r))) for p, r in oracles.items()]
        tables["oracles"] = pd.DataFrame(best)
    for name, table in tables.items():
        table.round(4).to_csv(out / f"{name}.csv", index=False)
    manifest = {
        "command": " ".join(["python -m benchmarks closed_loop", *map(shlex.quote, sys.argv[1:])]),
        "episodes": episodes,
        "budget": a.budget,
        "sensors": a.sensors,
        "oracle steps": study.ORACLE_STEPS,
        "seeds run": {" ".join(map(str, p)): sorted(set(map(int, r["seed"]))) for p, r in rows.groupby(PLACE)},
        "targets": study.fingerprint(),
        "versions": versions(),
        **machine(),
    }
    write_json(out / "manifest.json", manifest)
    draw(tables["summary"], oracles, out / "returns.png")
    print(tables["summary"].to_string(index=False))
    print(f"tables: {out}")


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
