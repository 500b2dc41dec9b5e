"""Nine robots of gymnasium, seven effects, none, and gusts: what do 300 transitions of random actions say?

    python -m benchmarks tracing robots
    python -m benchmarks tracing robots --robots Ant-v5 Reacher-v5 --kinds nothing coulomb_friction

Lengths, masses or dampings are declared and off by up to a fifth; of the effect, at a joint or actuator that is drawn,
nobody is told, and gusts on a joint are no effect of the library. No robot has a policy: it acts at random. Finished
traces are kept in --runs, the table goes to --out.
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
from benchmarks.tracing.robots import CAUSES, ROBOTS, Job, fits, run
from sb3_rpto.evaluation.provenance import machine, versions
from sb3_rpto.files import write_json


def main(arguments: Sequence[str] | None = None) -> None:
    """Trace what has no result yet, then write the table of what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--kinds", nargs="+", default=list(CAUSES), choices=CAUSES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--workers", type=int, default=2, help="traces side by side")
    parser.add_argument("--runs", type=Path, default=Path("runs/trace_robots"), help="where single traces are kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "trace_robots")
    a = parser.parse_args(arguments)
    for folder in (a.runs, a.out):
        folder.mkdir(parents=True, exist_ok=True)
    # Kind by kind, so that an unfinished table is a fair sample.
    jobs = [Job(robot, kind, seed) for seed, kind, robot in product(a.seeds, a.kinds, a.robots)]
    jobs = [job for job in jobs if fits(job)]
    with ProcessPoolExecutor(a.workers) as pool:
        rows = list(tqdm(pool.map(partial(run, folder=a.runs), jobs), total=len(jobs), desc="traces"))
    table = pd.DataFrame(rows)
    table.to_csv(a.out / "traces.csv", index=False, float_format="%.4g")
    manifest = {
        "command": "python -m benchmarks tracing robots",
        "settings": {"robots": a.robots, "kinds": a.kinds, "seeds": a.seeds},
        "versions": versions(),
        **machine(),
    }
    write_json(a.out / "manifest.json", manifest)
    shown = ["robot", "what", "verdict", "named_effects", "true_effects_off", "R_before", "R_after", "seconds"]
    print(table[shown].to_string(index=False))
