"""What 200 transitions of a target say about what its simulator lacks: traces of targets whose truth is known.

    python -m benchmarks tracing targets --tasks cheetah --targets 0 1 2 3 4 5
    python -m benchmarks tracing targets --tasks hopper --targets 0 --noise 0.001
    python -m benchmarks tracing targets --tasks double-pendulum --targets 0 1 2 --sensors 0.001 0.005
    python -m benchmarks tracing targets --tasks hopper --targets 0 1 --nothing-declared

The targets are those of benchmarks/closed_loop, by number, so that ones can be taken that nothing was tuned on.
The source's policy acts in each for 200 steps, as at the beginning of a transfer; no policy learns. With --noise it is
ten runs of at most 100 steps, of which a log shows positions alone, with that noise, at about 100 Hz. With --sensors it
is the 200 steps, observed with that noise, which the trace is told. With --nothing-declared the trace is not told which
numbers may differ either. Finished traces are kept in --runs, the table goes to --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.closed_loop import study as study
from benchmarks.tracing.first_trace import CAUSES, Job, run
from sb3_rpto.evaluation.provenance import machine, versions
from sb3_rpto.files import write_json


def main(arguments: Sequence[str] | None = None) -> None:
    """Trace what is missing, then write the table of what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(study.TASKS), choices=list(study.TASKS))
    parser.add_argument("--shifts", nargs="+", default=list(study.SHIFTS), choices=CAUSES)
    parser.add_argument("--targets", nargs="+", type=int, default=list(range(6)))
    parser.add_argument("--noise", type=float, default=0.0, help="of a log's positions in rad or m (default: exact)")
    parser.add_argument("--sensors", nargs="+", type=float, default=[0.0], help="noise of observed positions")
    parser.add_argument("--nothing-declared", action="store_true", help="tell the trace of no number that may differ")
    parser.add_argument("--workers", type=int, default=2, help="traces side by side")
    parser.add_argument("--runs", type=Path, default=Path("runs/trace_targets"), help="where single traces are kept")
    parser.add_argument("--out", type=Path, help="where the table goes")
    a = parser.parse_args(arguments)
    name = "trace_logs" if a.noise else "trace_sensors" if any(a.sensors) else "trace_targets"
    a.out = a.out or RESULTS / (name + "_nothing_declared" * a.nothing_declared)
    for folder in (a.runs, a.out):
        folder.mkdir(parents=True, exist_ok=True)
    for task in a.tasks:
        study.source_agent(task, a.runs)
    # Target by target, so that an unfinished table is a fair sample.
    places = product(a.targets, a.sensors, a.tasks, a.shifts)
    told = not a.nothing_declared
    jobs = [Job(task, shift, i, i if noisy else 0, a.noise, noisy, told) for i, noisy, task, shift in places]
    with ProcessPoolExecutor(a.workers) as pool:
        rows = list(tqdm(pool.map(partial(run, folder=a.runs), jobs), total=len(jobs), desc="traces"))
    table = pd.DataFrame(rows).sort_values(["task", "sensors", "shift", "target"])
    table.to_csv(a.out / "traces.csv", index=False, float_format="%.4g")
    manifest = {
        "command": "python -m benchmarks tracing targets",
        "settings": {
            "tasks": a.tasks,
            "shifts": a.shifts,
            "targets": a.targets,
            "noise": a.noise,
            "sensors": a.sensors,
            "nothing declared": a.nothing_declared,
        },
        "versions": versions(),
        **machine(),
    }
    write_json(a.out / "manifest.json", manifest)
    print(table.drop(columns=["seed", "declared_worst"]).to_string(index=False))
