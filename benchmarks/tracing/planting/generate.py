"""Measurements of a machine with effects in it that nobody declared, and the truth about them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.tracing.planting.excitation import Excitation
from benchmarks.tracing.planting.plants import Plant
from benchmarks.tracing.planting.simulation import Simulation
from benchmarks.tracing.planting.sizes import KINDS, OF_THE_MACHINE, OF_THE_MOTOR, draw, joints_for
from benchmarks.tracing.planting.systems import SYSTEMS, System
from sb3_rpto.sysid import Measurements

STEP = 0.0005
"""Longest step of the integration in s."""
SPREAD = 0.15
"""The declared parameters lie within this fraction of their nominal values."""
VELOCITY_NOISE = 20.0
"""Noise of a velocity in rad/s against that of a position in rad."""


@dataclass(frozen=True)
class Truth:
    """What is in the machine.

    :param effects: for each planted effect its parameters in SI units
    :param places: for each planted effect its joint, its motor where it is one of the motor, or ``"world"``
    :param declared: true values of the declared parameters
    :param explainable: whether all effects are of the tracer's library; a complete model is
    :param qpos: positions without sensor effects and noise in rad or m, shape (episodes, T, n)
    :param qvel: velocities likewise
    :param zeros: what each episode's encoders show beyond that in rad or m, shape (episodes, n)
    """

    effects: dict[str, dict[str, float]]
    places: dict[str, str]
    declared: dict[str, float]
    explainable: bool
    qpos: np.ndarray
    qvel: np.ndarray
    zeros: np.ndarray


@dataclass(frozen=True)
class Planted:
    """A generated set.

    :param measurements: what a tracer may see
    :param xml: MJCF of the nominal machine, without the effects
    :param declared: names of the declared parameters
    :param truth: what a tracer must not see
    """

    measurements: Measurements
    xml: str
    declared: tuple[str, ...]
    truth: Truth


def generate(
    system: System | str,
    effects: Sequence[Plant | tuple[str, str]] | None,
    seed: int,
    episodes: int = 10,
    duration: float = 4.0,
    rate: float = 200.0,
    noise: float = 1e-3,
    jitter: float = 0.0,
    quantum: float = 0.0,
    velocity: bool = True,
    zeros: float = 0.0,
) -> Planted:
    """Simulate a machine whose declared parameters are off by up to 15 % and that has undeclared effects.

    Samples are q + noise, rounded to the quantum, qd + 20 noise, and the command that is held until the next sample.
    Streams of random numbers are apart, so excitation, noise and declared values do not depend on the effects.

    :param system: the machine or its name, one of ``SYSTEMS``
    :param effects: plants, or (kind, size) to be drawn by seed, each kind once; None or empty for a complete model
    :param seed: of everything
    :param episodes: how many
    :param duration: of an episode in s
    :param rate: of the samples in Hz
    :param noise: standard deviation of the position noise in rad or m, >= 0
    :param jitter: sample times are off their grid by up to half this fraction of the interval, in [0, 1)
    :param quantum: of the position's encoder in rad or m, 0 for none
    :param velocity: whether the velocity is recorded
    :param zeros: standard deviation of the encoders' zeros over the episodes in rad or m, >= 0
    :raises ValueError: unknown names, an effect twice or without a place, or a setting out of range
    """
    if isinstance(system, str):
        if system not in SYSTEMS:
            raise ValueError(f"system is {system!r}; use one of {', '.join(SYSTEMS)}")
        system = SYSTEMS[system]
    for name, value, ok in (
        ("episodes", episodes, episodes >= 1),
        ("rate", rate, rate > 0),
        ("duration", duration, duration * rate >= 5),
        ("noise", noise, noise >= 0),
        ("jitter", jitter, 0 <= jitter < 1),
        ("quantum", quantum, quantum >= 0),
        ("zeros", zeros, zeros >= 0),
    ):
        if not (ok and math.isfinite(value)):
            raise ValueError(f"{name} is {value}; see the ranges in the documentation of generate")
    for effect in [effects] if isinstance(effects, str) else effects or ():
        if not isinstance(effect, Plant) and (isinstance(effect, str) or len(effect) != 2):
            raise ValueError(f"effects hold {effect!r}; give plants or pairs such as ('coulomb_friction', 'large')")
    plants = [e if isinstance(e, Plant) else draw(system, *e, seed) for e in effects or ()]
    kinds = [plant.kind for plant in plants]
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"effects are {kinds}; plant each kind once")
    for plant in plants:
        if plant.kind not in OF_THE_MACHINE and plant.joint not in joints_for(system, plant.kind):
            raise ValueError(
                f"{plant.kind} is at joint {plant.joint} of {system.name}; it acts at {joints_for(system, plant.kind)}"
            )
    plants.sort(key=lambda plant: list(KINDS).index(plant.kind))
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(6)]
    for_declared, for_times, for_excitation, for_noise, for_effects, for_zeros = streams

    factors = for_declared.uniform(1 - SPREAD, 1 + SPREAD, len(system.declared))
    declared = {name: value * float(f) for (name, value), f in zip(system.declared.items(), factors)}
    samples, n = round(duration * rate), len(system.links)
    times = np.arange(samples) / rate + jitter / rate * for_times.uniform(-0.5, 0.5, (episodes, samples))
    times -= times[:, :1]
    excitation = Excitation(system, times, for_excitation)
    offsets = zeros * for_zeros.standard_normal((episodes, n))
    errors = (
        noise
        * for_noise.standard_normal((2, samples, episodes, n))
        * np.array([1, VELOCITY_NOISE])[:, None, None, None]
    )

    simulation = Simulation(
        system.with_declared(declared), plants, excitation.q, np.zeros_like(excitation.q), for_effects
    )
    intervals = np.diff(times)
    steps = int(np.ceil(intervals.max() / STEP - 1e-9))
    truth, measured, commands = np.empty((2, episodes, samples, n)), np.empty((2, episodes, samples, n)), []
    for k in range(samples):
        truth[:, :, k] = simulation.q, simulation.qd
        q, qd = np.array(simulation.sense()) + errors[:, k]
        q = q + offsets
        if quantum:
            q = quantum * np.round(q / quantum)
        measured[:, :, k] = q, qd
        commands.append(excitation.command(k, q, qd))
        if k + 1 < samples:
            simulation.hold(commands[-1], times[:, k], intervals[:, k], steps)

    table = {"episode": np.repeat(np.arange(episodes), samples).astype(str), "time": times.ravel()}
    for name, values in zip(("qpos", "qvel") if velocity else ("qpos",), measured):
        table |= {f"{name}.{joint}": values[..., j].ravel() for j, joint in enumerate(system.joints)}
    ctrl = np.stack(commands, 1)
    table |= {f"ctrl.{motor}": ctrl[..., j].ravel() for j, motor in zip(system.driven, system.motors)}
    return Planted(
        measurements=Measurements.from_tables({"planted": table}),
        xml=system.xml,
        declared=tuple(system.declared),
        truth=Truth(
            effects={plant.kind: plant.parameters for plant in plants},
            places={plant.kind: _place(system, plant) for plant in plants},
            declared=declared,
            explainable=all(plant.library for plant in plants),
            qpos=truth[0],
            qvel=truth[1],
            zeros=offsets,
        ),
    )


def _place(system: System, plant: Plant) -> str:
    if plant.kind in OF_THE_MACHINE:
        return "world"
    link = system.links[plant.joint]
    return str(link.motor) if plant.kind in OF_THE_MOTOR else link.joint
