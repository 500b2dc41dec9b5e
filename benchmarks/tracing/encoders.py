"""Coarse encoders, no velocities, a clock that jitters: how often is a verdict wrong, and an effect too many?

    python -m benchmarks tracing encoders

Twenty sets in which nothing is missing and twenty that lack one effect. Finished traces are kept in --runs, the table
goes to --out.
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
from benchmarks.tracing.encoder_sets import jobs, run
from sb3_rpto.evaluation.provenance import machine, versions
from sb3_rpto.files import write_json


def main(arguments: Sequence[str] | None = None) -> None:
    """Trace what has no result yet, then write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="traces side by side")
    parser.add_argument("--runs", type=Path, default=Path("runs/trace_encoders"), help="where single traces are kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "trace_encoders")
    a = parser.parse_args(arguments)
    for folder in (a.runs, a.out):
        folder.mkdir(parents=True, exist_ok=True)
    todo = jobs(a.seed)
    with ProcessPoolExecutor(a.workers) as pool:
        rows = list(tqdm(pool.map(partial(run, folder=a.runs), todo), total=len(todo), desc="traces"))
    table = pd.DataFrame(rows)
    table.to_csv(a.out / "traces.csv", index=False, float_format="%.4g")
    manifest = {
        "command": f"python -m benchmarks tracing encoders --seed {a.seed}",
        "versions": versions(),
        **machine(),
    }
    write_json(a.out / "manifest.json", manifest)
    shown = ["machine", "samples", "planted", "verdict", "named", "R_before", "R_after", "right", "seconds"]
    print(table[shown].to_string(index=False))
    print(table.groupby("lacking")[["right", "too_many"]].sum().to_string())
