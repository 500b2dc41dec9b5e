"""Coarse encoders, no velocities, a clock that jitters: how often is a verdict wrong, and an effect too many?

Twenty sets in which nothing is missing, and twenty that lack one effect: five machines, two of them with position
servos, each with four kinds of samples. They are simulated without feedback, by the Runge-Kutta method in steps of half
a millisecond: a semi-implicit method's own errors would show beside the noise.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd

from benchmarks.runner import Row, Study
from benchmarks.tracing.planting.generate import SPREAD
from benchmarks.tracing.planting.systems import SYSTEMS
from sb3_rpto.effects import LIBRARY, Drive, Effect, Simulation, declare
from sb3_rpto.sysid import Measurements, Report, trace

STEP, RATE, RUNS, SECONDS = 5e-4, 100.0, 6, 5.0
#: 12 bits a turn, and noise of the positions besides, rad.
QUANTUM, NOISE = 2 * np.pi / 4096, 1e-3
#: Sample times are off by up to so large a share of their interval.
JITTER = 0.15
#: Kinds of samples: quantised, with velocities, with a clock that jitters.
SAMPLES = {
    "quantised": (True, True, False),
    "positions": (False, False, False),
    "jittered": (False, True, True),
    "all three": (True, False, True),
}
SERVO = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.002" integrator="implicitfast">
<flag contact="disable"/></option><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/>{fore}</body></worldbody><actuator>
<position name="shoulder_servo" joint="shoulder" kp="25" kv="0.6" forcerange="-6 6"/>{elbow}</actuator></mujoco>"""
FORE = """<body name="fore" pos="0.25 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.015" mass="0.3"/></body>"""
ELBOW = '<position name="elbow_servo" joint="elbow" kp="12" kv="0.25" forcerange="-3 3"/>'
#: Each machine's MJCF, what is declared, and the commands' size (of a servo in rad, else in N·m).
MACHINES = {
    "servo arm": (
        SERVO.format(fore=FORE, elbow=ELBOW),
        ("fore.mass", "shoulder.damping", "elbow.damping"),
        (0.6, 0.6),
    ),
    "servo": (SERVO.format(fore="", elbow=""), ("upper.mass", "shoulder.damping"), (0.7,)),
    **{
        name: (SYSTEMS[name].xml, tuple(SYSTEMS[name].declared), size)
        for name, size in (
            ("double_pendulum", (1.2, 0.4)),
            ("reacher", (0.05, 0.02)),
            ("arm3", (3.0, 1.2, 0.25)),
        )
    },
}
#: One effect for each kind of samples, on the machine's last joint or its motor: with shares of what moves it.
PLANTED = {
    "servo arm": (
        ("coulomb_friction", "elbow", {"level": 0.06}),
        ("command_delay", "shoulder_servo", {"delay": 0.015}),
        ("payload", "fore", {"mass": 0.06, "along": 2.0}),
        ("command_delay", "elbow_servo", {"delay": 0.015}),
    ),
    "servo": (
        ("command_delay", "shoulder_servo", {"delay": 0.012}),
        ("coulomb_friction", "shoulder", {"level": 0.2}),
        ("torque_offset", "shoulder", {"offset": 0.2}),
        ("stribeck_friction", "shoulder", {"level": 0.12, "extra": 0.12, "speed": 0.3}),
    ),
    "double_pendulum": (
        ("quadratic_drag", "elbow", {"coefficient": 0.01}),
        ("torque_offset", "shoulder", {"offset": 0.15}),
        ("coulomb_friction", "elbow", {"level": 0.05}),
        ("command_delay", "elbow_motor", {"delay": 0.015}),
    ),
    "reacher": (
        ("coulomb_friction", "shoulder", {"level": 0.01}),
        ("actuator_lag", "shoulder_motor", {"time_constant": 0.03}),
        ("command_gain", "elbow_motor", {"change": -0.15}),
        ("spring", "elbow", {"stiffness": 0.02}),
    ),
    "arm3": (
        ("payload", "hand", {"mass": 0.08, "along": 2.0}),
        ("quadratic_drag", "elbow", {"coefficient": 0.03}),
        ("command_delay", "shoulder_motor", {"delay": 0.015}),
        ("coulomb_friction", "elbow", {"level": 0.15}),
    ),
}


@dataclass(frozen=True)
class Job:
    """One set.

    :param machine: of :data:`MACHINES`
    :param samples: of :data:`SAMPLES`
    :param lacking: whether the effect of :data:`PLANTED` is in it, or nothing
    :param seed: of everything
    """

    machine: str
    samples: str
    lacking: bool
    seed: int = 0

    def effect(self) -> Effect | None:
        """What is planted."""
        kind, on, values = PLANTED[self.machine][list(SAMPLES).index(self.samples)]
        return LIBRARY[kind](on, **values) if self.lacking else None


def jobs(seed: int = 0) -> list[Job]:
    """The forty sets of a seed."""
    return [Job(m, samples, lacking, seed) for lacking in (False, True) for samples in SAMPLES for m in MACHINES]


def recorded(job: Job) -> Measurements:
    """The recordings: declared numbers are off by up to 15 %."""
    xml, names, sizes = MACHINES[job.machine]
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    rng = np.random.default_rng([job.seed, *f"{job.machine} {job.samples} {job.lacking}".encode()])
    effect = job.effect()
    acting = [d.with_values(d.values * rng.uniform(1 - SPREAD, 1 + SPREAD)) for d in declare(model, names)]
    simulation = Simulation(model, [*acting, *([effect] if effect else [])], 1)
    quantised, velocity, jitters = SAMPLES[job.samples]
    every, samples = round(1 / RATE / STEP), round(SECONDS * RATE)
    at = every * np.arange(samples)[None] + np.zeros((RUNS, 1), dtype=int)
    if jitters:
        at[:, 1:] += rng.integers(-round(JITTER * every), round(JITTER * every) + 1, (RUNS, samples - 1))
    u = commands(np.array(sizes), at * STEP, rng)
    steps = np.arange(at.max())  # each command holds from its sample on
    fine = np.stack([u[e][np.searchsorted(at[e], steps, side="right") - 1] for e in range(RUNS)])
    start, rest = np.tile(model.qpos0, (RUNS, 1)), np.zeros((RUNS, model.nv))
    q, v = simulation.rollout(np.tile(simulation.values(), (RUNS, 1)), start, rest, Drive(fine))
    rows = np.arange(RUNS)[:, None]
    q, v = q[rows, at], v[rows, at]
    q = q + NOISE * rng.standard_normal(q.shape)
    q = QUANTUM * np.round(q / QUANTUM) if quantised else q
    v = v + 20 * NOISE * rng.standard_normal(v.shape)
    tables = {}
    for e in range(RUNS):
        table = {"time": at[e] * STEP} | {f"qpos.{model.joint(j).name}": q[e, :, j] for j in range(model.nq)}
        table |= {f"qvel.{model.joint(j).name}": v[e, :, j] for j in range(model.nv)} if velocity else {}
        tables[f"run{e}"] = table | {f"ctrl.{model.actuator(a).name}": u[e, :, a] for a in range(model.nu)}
    return Measurements.from_tables(tables)


def commands(sizes: np.ndarray, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Three tones for each actuator, in every other run with steps on top, (E, T, nu)."""
    runs, nu = len(times), len(sizes)
    tones, phase = rng.uniform(0.1, 1.5, (runs, nu, 3)), rng.uniform(0, 2 * np.pi, (runs, nu, 3))
    share = rng.uniform(0.3, 1.0, (runs, nu, 3))
    waves = np.sin(2 * np.pi * tones[:, None] * times[:, :, None, None] + phase[:, None])
    u = (share[:, None] * waves).sum(-1) / share.sum(-1)[:, None]
    held = (times / 0.8).astype(int)
    steps = rng.uniform(-0.6, 0.6, (runs, held.max() + 1, nu))
    u += np.where(np.arange(runs)[:, None, None] % 2, steps[np.arange(runs)[:, None], held], 0.0)
    return np.asarray(sizes * u)


def run(job: Job, folder: Path) -> list[Row]:
    """Generate, trace, and compare with the truth."""
    began, (xml, names, _) = time.process_time(), MACHINES[job.machine]
    effect = job.effect()
    names = tuple(n for n in names if effect is None or n not in {f"{effect.on}.{s}" for s in effect.same})
    report = trace(xml, recorded(job), names, threads=1, seed=job.seed)
    return [{**judged(effect, report), "seconds": round(time.process_time() - began, 1)}]


def judged(effect: Effect | None, report: Report) -> dict[str, Any]:
    """Verdict, what is named, and whether that is too much or wrong."""
    named = [t.effect.label for t in report.effects]
    right = [t for t in report.effects if effect and effect.label in (t.effect.label, *t.alike)]
    return {
        "planted": repr(effect) if effect else "",
        "verdict": report.verdict,
        "named": "; ".join(repr(t.effect) for t in report.effects),
        "too_many": len(named) - len(right),
        "right_class": bool(right),
        "right": report.verdict == ("explained" if effect else "complete") and len(named) == len(right) <= 1,
        "R_before": report.adequacy_before.ratio,
        "R_after": report.adequacy_after.ratio,
        "findings": "; ".join(dict.fromkeys(f.kind for f in report.findings)),
    }


def summary(rows: Sequence[Row]) -> str:
    """Each set, and how many are right."""
    table = pd.DataFrame(rows)
    shown = ["machine", "samples", "planted", "verdict", "named", "R_before", "R_after", "right", "seconds"]
    return f"{table[shown].to_string(index=False)}\n{table.groupby('lacking')[['right', 'too_many']].sum()}"


main = Study(
    "tracing encoders",
    "trace_encoders",
    __doc__,
    jobs=lambda asked: jobs(asked.seed),
    run=run,
    summary=summary,
    options=lambda parser: parser.add_argument("--seed", type=int, default=0),
).main
