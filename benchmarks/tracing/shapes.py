"""Effects with a parameter of shape, at five values of it: is each named, with its values?

    python -m benchmarks tracing shapes
    python -m benchmarks tracing shapes --kinds payload --noises 0 --alone

Two machines, exact transitions and logs with 1 mrad of noise, with only the effect's kind offered and with the whole
library.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.runner import Row, Study
from benchmarks.tracing.own import MACHINES, declared_beside, simulate
from benchmarks.tracing.planting.systems import TIMESTEP
from sb3_rpto.effects import LIBRARY, Effect
from sb3_rpto.sysid import Measurements, Report, trace

#: Five values over the range of each shape.
SHAPES = {
    "payload": ("along", (0.3, 0.8, 1.3, 2.0, 3.0)),
    "spring": ("reference", (-2.5, -1.0, 0.3, 1.0, 2.5)),
    "stribeck_friction": ("speed", (0.1, 0.25, 0.6, 1.2, 2.5)),
    "torque_ripple": ("turns", (2.0, 5.0, 9.0, 16.0, 31.0)),
    "position_friction": ("phase", (-2.5, -1.2, 0.1, 1.3, 2.6)),
}
#: Where each is planted, and its other parameters.
MACHINE = {
    "cartpole": {
        "payload": ("pole", {"mass": 0.12}),
        "spring": ("hinge", {"stiffness": 0.3}),
        "stribeck_friction": ("slide", {"level": 0.4, "extra": 0.4}),
        "torque_ripple": ("hinge", {"cosine": 0.03, "sine": -0.03}),
        "position_friction": ("hinge", {"amplitude": 0.06}),
    },
    "double_pendulum": {
        "payload": ("lower", {"mass": 0.1}),
        "spring": ("elbow", {"stiffness": 0.3}),
        "stribeck_friction": ("shoulder", {"level": 0.2, "extra": 0.2}),
        "torque_ripple": ("elbow", {"cosine": 0.05, "sine": -0.05}),
        "position_friction": ("elbow", {"amplitude": 0.15}),
    },
}
#: Standard deviations of the positions in rad or m; 0: exact transitions of the simulator, ten of its steps long.
NOISES = (0.0, 1e-3)
#: Logs are simulated in steps so short, in s, that the method's own errors do not show beside the noise.
FINE = 1e-4
#: Named values may be off by this share, or by this many widths of their intervals.
OFF = 0.25


@dataclass(frozen=True)
class Job:
    """One trace.

    :param machine: of :data:`MACHINE`
    :param kind: of the effect, of :data:`SHAPES`
    :param shape: value of its parameter of shape
    :param noise: of :data:`NOISES`
    :param alone: whether only effects of this kind are looked for
    """

    machine: str
    kind: str
    shape: float
    noise: float
    alone: bool

    def effect(self) -> Effect:
        """What is planted."""
        on, values = MACHINE[self.machine][self.kind]
        return LIBRARY[self.kind](on, **values, **{SHAPES[self.kind][0]: self.shape})


def jobs(
    machines: Sequence[str] = tuple(MACHINE),
    kinds: Sequence[str] = tuple(SHAPES),
    noises: Sequence[float] = NOISES,
    alone: Sequence[bool] = (True, False),
) -> list[Job]:
    """All of some machines, kinds, noises and libraries."""
    every = product(alone, kinds, range(5), noises, machines)
    return [Job(machine, kind, SHAPES[kind][1][i], noise, only) for only, kind, i, noise, machine in every]


def recorded(job: Job, seed: int = 0) -> Measurements:
    """Six runs of three seconds, 250 samples a second with noise and no velocities, or 50 exact ones."""
    settings: dict[str, Any] = {"episodes": 6, "duration": 3.0, "noise": job.noise}
    if job.noise:
        return simulate(MACHINES[job.machine], [job.effect()], seed, velocity=False, step=FINE, **settings)
    data = simulate(MACHINES[job.machine], [job.effect()], seed, rate=50.0, step=TIMESTEP, **settings)
    return replace(data, exact=True)


def run(job: Job, folder: Path) -> list[Row]:
    """Plant, trace, and compare with the truth.

    :param job: which
    :param folder: not needed
    :return: verdict, what was named, values, and whether they are right
    """
    machine, began = MACHINES[job.machine], time.process_time()
    declared = declared_beside(machine, [job.effect()])
    kinds = [job.kind] if job.alone else None
    report = trace(machine.source(), recorded(job), declared, candidates=kinds, threads=1)
    return [{**judged(job.effect(), report), "seconds": round(time.process_time() - began, 1)}]


def judged(planted: Effect, report: Report) -> dict[str, Any]:
    """Whether an effect is named alone, or is of the class of the one that is, and by how much its values are off.

    A value is right within :data:`OFF` of it (of a shape: of its range from null or size) or within its interval.
    """
    named = {t.effect.label: t for t in report.effects}
    traced = named.get(planted.label)
    off = {}
    if traced is not None:
        for i, p in enumerate(planted.parameters):
            low, high = traced.interval[:, i]
            error = traced.effect.values[i] - planted.values[i]
            unit = max(abs(planted.values[i]), 0.5) if p.shape else abs(planted.values[i])
            off[p.name] = 0.0 if low <= planted.values[i] <= high else abs(error) / unit
    return {
        "verdict": report.verdict,
        "named": "; ".join(named),
        "alone_named": list(named) == [planted.label],
        "in_class": any(planted.label in t.alike for t in report.effects),
        "values": "; ".join(f"{t.effect}" for t in report.effects),
        "worst_off": max(off.values(), default=None),
        "right": list(named) == [planted.label] and report.verdict == "explained" and max(off.values()) < OFF,
        "R_after": report.adequacy_after.ratio,
    }


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--machines", nargs="+", default=list(MACHINE), choices=list(MACHINE))
    parser.add_argument("--kinds", nargs="+", default=list(SHAPES), choices=list(SHAPES))
    parser.add_argument("--noises", nargs="+", type=float, default=list(NOISES))
    library = parser.add_mutually_exclusive_group()
    library.add_argument("--alone", action="store_true", help="only with the effect's kind offered")
    library.add_argument("--whole", action="store_true", help="only with the whole library offered")


def _jobs(asked: argparse.Namespace) -> list[Job]:
    offered = (True,) if asked.alone else (False,) if asked.whole else (True, False)
    return jobs(asked.machines, asked.kinds, asked.noises, offered)


def summary(rows: Sequence[Row]) -> str:
    """How many are named alone, and right, of each kind."""
    return pd.DataFrame(rows).groupby(["kind", "noise", "alone"])[["alone_named", "right"]].sum().to_string()


main = Study("tracing shapes", "trace_shapes", __doc__, _jobs, run, summary, _options).main
