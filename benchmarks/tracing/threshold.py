"""Which threshold names no effect that is not there: measured on complete generated sets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runner import Row, Study
from benchmarks.tracing.planting import SYSTEMS, generate
from sb3_rpto.sysid.problem.problem import Inputs, prepare
from sb3_rpto.sysid.selection.screening import screen
from sb3_rpto.sysid.selection.search import SelectorPair, correct_for_discretisation, fit_declared, joint_candidates
from sb3_rpto.sysid.selection.threshold_calibration import least_threshold
from sb3_rpto.sysid.settings import DEFAULTS

LEVEL, THRESHOLD = DEFAULTS.selection.calibration_level, DEFAULTS.selection.threshold
#: Seeds of the sets begin here: those of the tracing benchmark are others.
FIRST = 700_000
#: Noises of the position in rad or m, in turn.
NOISES = (1e-3, 5e-3)


@dataclass(frozen=True)
class Job:
    """A complete generated set; all machines and noises take turns."""

    system: str
    noise: float
    seed: int


def jobs(sets: int) -> list[Job]:
    """So many sets.

    :raises ValueError: less than one
    """
    if sets < 1:
        raise ValueError(f"sets is {sets}; give 1 or more")
    systems = list(SYSTEMS)
    turns = [(systems[i % len(systems)], NOISES[i // len(systems) % len(NOISES)]) for i in range(sets)]
    return [Job(system, noise, FIRST + i) for i, (system, noise) in enumerate(turns)]


def needed(job: Job, folder: Path, episodes: int = 10, duration: float = 4.0) -> list[Row]:
    """The least threshold that names nothing in a complete set, although adequacy would have ended the search before.

    :param job: which set
    :param folder: not needed
    :param episodes: how many
    :param duration: of an episode in s
    """
    start = time.process_time()
    made = generate(job.system, None, seed=job.seed, episodes=episodes, duration=duration, noise=job.noise)
    problem = prepare(Inputs(made.xml, made.measurements, made.declared, seed=job.seed, threads=1))
    on = SelectorPair.on(problem, problem.length)
    base = on.fine.fit_model((), fit_declared(on.rough, job.seed), iterations=10)
    chosen = joint_candidates(on.fine, screen(on.fine.train, base.fit))
    t = least_threshold(correct_for_discretisation(on, base.fit.values).rough, base.fit, chosen)
    return [{"candidates": len(chosen), "t": round(t, 3), "seconds": round(time.process_time() - start, 1)}]


def summary(rows: Sequence[Row]) -> str:
    """The quantile in words."""
    ts = [row["t"] for row in rows]
    above, least = sum(t > THRESHOLD for t in ts), np.quantile(ts, LEVEL)
    return f"{LEVEL:.0%} of {len(ts)} complete sets need less than {least:.2f}; {above} need more than {THRESHOLD}"


main = Study(
    "tracing threshold",
    "trace_threshold",
    __doc__,
    jobs=lambda asked: jobs(asked.sets),
    run=needed,
    summary=summary,
    options=lambda parser: parser.add_argument(
        "--sets", metavar="N", type=int, default=40, help="complete sets, of all machines in turn"
    ),
).main
