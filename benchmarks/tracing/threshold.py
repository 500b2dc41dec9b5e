"""Which threshold names no effect that is not there: ``python -m benchmarks tracing threshold``."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracing.planting import SYSTEMS, generate
from sb3_rpto.evaluation import provenance
from sb3_rpto.files import write_json
from sb3_rpto.sysid.problem.problem import Inputs, prepare
from sb3_rpto.sysid.selection.screening import screen
from sb3_rpto.sysid.selection.search import SelectorPair, correct_for_discretisation, fit_declared, joint_candidates
from sb3_rpto.sysid.selection.threshold_calibration import least_threshold
from sb3_rpto.sysid.settings import DEFAULTS

LEVEL, THRESHOLD = DEFAULTS.selection.calibration_level, DEFAULTS.selection.threshold
NAME = "python -m benchmarks tracing threshold"
#: Seeds of the sets begin here: those of the tracing benchmark are others.
FIRST = 700_000
#: Noises of the position in rad or m, in turn.
NOISES = (1e-3, 5e-3)

Row = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the threshold that complete generated sets need, those without a row, and print its quantile.

    :param arguments: without the program's name; default: those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog=NAME, description=__doc__)
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for threshold.json")
    parser.add_argument("--sets", metavar="N", type=int, default=40, help="complete sets, of all machines in turn")
    parsed = parser.parse_args(arguments)
    if parsed.sets < 1:
        raise ValueError(f"sets is {parsed.sets}; give 1 or more")
    print(measure(parsed.out, parsed.sets))
    return 0


def measure(out: str | os.PathLike[str], sets: int) -> str:
    """Add what is missing to ``threshold.json`` in a folder.

    :param out: folder; a file of an interrupted run is gone on with
    :param sets: number of complete sets
    :return: the quantile in words
    """
    path = Path(out) / "threshold.json"
    rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["sets"] if path.exists() else []
    for i in range(len(rows), sets):
        rows.append(needed(list(SYSTEMS)[i % len(SYSTEMS)], NOISES[i // len(SYSTEMS) % len(NOISES)], FIRST + i))
        ts = [row["t"] for row in rows]
        summary = {"level": LEVEL, "quantile": float(np.quantile(ts, LEVEL)), "shipped": THRESHOLD}
        made = {
            "command": f"{NAME} --sets {sets} --out DIR",
            "commit": provenance.commit(),
            "versions": provenance.versions(),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, summary | made | {"sets": rows})
    ts = [row["t"] for row in rows[:sets]]
    above = sum(t > THRESHOLD for t in ts)
    least = np.quantile(ts, LEVEL)
    return f"{LEVEL:.0%} of {len(ts)} complete sets need less than {least:.2f}; {above} need more than {THRESHOLD}"


def needed(system: str, noise: float, seed: int, episodes: int = 10, duration: float = 4.0) -> Row:
    """The least threshold that names nothing in a complete set, although adequacy would have ended the search before.

    :param system: machine, one of ``SYSTEMS``
    :param noise: of the positions in rad or m
    :param seed: of the set
    :param episodes: how many
    :param duration: of an episode in s
    :return: the set's row
    """
    start = time.process_time()
    made = generate(system, None, seed=seed, episodes=episodes, duration=duration, noise=noise)
    problem = prepare(Inputs(made.xml, made.measurements, made.declared, seed=seed, threads=1))
    on = SelectorPair.on(problem, problem.length)
    base = on.fine.fit_model((), fit_declared(on.rough, seed), iterations=10)
    chosen = joint_candidates(on.fine, screen(on.fine.train, base.fit))
    t = least_threshold(correct_for_discretisation(on, base.fit.values).rough, base.fit, chosen)
    seconds = round(time.process_time() - start, 1)
    return {
        "system": system,
        "noise": noise,
        "seed": seed,
        "candidates": len(chosen),
        "t": round(t, 3),
        "seconds": seconds,
    }
