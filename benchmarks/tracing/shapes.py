"""Effects with a parameter of shape, at five values of it: is each named, with its values?

    python -m benchmarks tracing shapes
    python -m benchmarks tracing shapes --kinds payload --noises 0 --alone

Two machines, exact transitions and logs with 1 mrad of noise, with only the effect's kind offered and with the whole
library. Finished traces are kept in --runs, the table goes to --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.tracing.shape_sweep import MACHINE, NOISES, SHAPES, jobs, run
from sb3_rpto.evaluation.provenance import machine, versions
from sb3_rpto.files import write_json


def main(arguments: Sequence[str] | None = None) -> None:
    """Trace what has no result yet, then write the table of what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--machines", nargs="+", default=list(MACHINE), choices=list(MACHINE))
    parser.add_argument("--kinds", nargs="+", default=list(SHAPES), choices=list(SHAPES))
    parser.add_argument("--noises", nargs="+", type=float, default=list(NOISES))
    library = parser.add_mutually_exclusive_group()
    library.add_argument("--alone", action="store_true", help="only with the effect's kind offered")
    library.add_argument("--whole", action="store_true", help="only with the whole library offered")
    parser.add_argument("--workers", type=int, default=2, help="traces side by side")
    parser.add_argument("--runs", type=Path, default=Path("runs/trace_shapes"), help="where single traces are kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "trace_shapes")
    a = parser.parse_args(arguments)
    for folder in (a.runs, a.out):
        folder.mkdir(parents=True, exist_ok=True)
    offered = (True,) if a.alone else (False,) if a.whole else (True, False)
    todo = jobs(a.machines, a.kinds, a.noises, offered)
    with ProcessPoolExecutor(a.workers) as pool:
        rows = list(tqdm(pool.map(partial(run, folder=a.runs), todo), total=len(todo), desc="traces"))
    table = pd.DataFrame(rows)
    table.to_csv(a.out / "traces.csv", index=False, float_format="%.4g")
    write_json(
        a.out / "manifest.json", {"command": "python -m benchmarks tracing shapes", "versions": versions(), **machine()}
    )
    print(table.groupby(["kind", "noise", "alone"])[["alone_named", "right"]].sum().to_string())
