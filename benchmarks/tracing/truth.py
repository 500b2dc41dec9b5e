"""What is in a generated set, in the tracer's own terms, and which answers are the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.tracing.design import DURATION, EPISODES, RATE, Case
from benchmarks.tracing.own import MACHINES, OWN, UNSEEN, declared_beside, find, simulate
from benchmarks.tracing.planting import KINDS, SYSTEMS, Plant, System, draw, generate
from sb3_rpto.effects import LIBRARY, Effect
from sb3_rpto.sysid import Measurements

VALUES: dict[str, Callable[[Any], dict[str, float]]] = {
    "coulomb_friction": lambda p: {"level": p.torque},
    "stribeck_friction": lambda p: {"level": p.coulomb, "extra": p.static - p.coulomb, "speed": p.speed},
    "quadratic_drag": lambda p: {"coefficient": p.coefficient},
    "asymmetric_damping": lambda p: {"forward": p.forward},
    "load_friction": lambda p: {"mu": p.coefficient},
    "position_friction": lambda p: {"amplitude": p.torque, "phase": p.phase},
    "torque_ripple": lambda p: {"sine": p.sine, "cosine": p.cosine, "turns": p.per_turn},
    "torque_offset": lambda p: {"offset": p.torque},
    "spring": lambda p: {"stiffness": p.stiffness},
    # The planting turns gravity to g (sin a, 0, -cos a), the library to Ry(y) (0, 0, -g) = g (-sin y, 0, -cos y).
    "gravity_tilt": lambda p: {"y": -p.angle},
    # At the end of a rod, twice as far out as its centre of mass.
    "payload": lambda p: {"mass": p.mass, "along": 2.0},
    "armature": lambda p: {"inertia": p.inertia},
    "command_deadband": lambda p: {"width": p.width},
    "command_saturation": lambda p: {"inverse_limit": 1 / p.limit},
    "command_gain": lambda p: {"change": p.gain - 1},
    "backlash": lambda p: {"half_width": p.gap / 2},
    "command_delay": lambda p: {"delay": p.delay},
    "actuator_lag": lambda p: {"time_constant": p.time_constant},
    "sensor_delay": lambda p: {"delay": p.delay},
    "sensor_bias": lambda p: {"offset": p.bias},
    "sensor_gain": lambda p: {"change": p.gain - 1},
}
"""Parameters of the library's effects from those of the planted ones."""

UNSEEN_LIMIT = 1.25
"""A motor's limit that its commands do not reach, as a share of their peak."""

_PERIOD = "a pendulum shows but its period and its weight; with the mass declared, all of them change the period alone"
_TURNED = "turning gravity in the plane of motion and turning the zero of the first angle is the same"
_BASE = (
    "of the first link only its inertia about a fixed axis shows beside its weight, which the declared mass takes up"
)
TWINS: tuple[tuple[str, frozenset[str], str], ...] = (
    ("pendulum", frozenset({"payload(pole)", "armature(hinge)", "link_length(pole)"}), _PERIOD),
    (
        "pendulum",
        frozenset({"fluid", "quadratic_drag(hinge)"}),
        "each point's drag grows with the angular rate squared",
    ),
    ("pendulum", frozenset({"gravity_tilt", "sensor_bias(hinge)"}), _TURNED),
    ("double_pendulum", frozenset({"gravity_tilt", "sensor_bias(shoulder)"}), _TURNED),
    ("arm3", frozenset({"gravity_tilt", "sensor_bias(shoulder)"}), _TURNED),
    ("double_pendulum", frozenset({"payload(upper)", "armature(shoulder)"}), _BASE),
    (
        "reacher",
        frozenset({"payload(upper)", "armature(shoulder)"}),
        "without gravity only the first link's inertia about a fixed axis shows",
    ),
    (
        "cartpole",
        frozenset({"payload(cart)", "armature(slide)", "command_gain(motor)"}),
        "all add mass along the rail: less force on all masses is the same force on larger ones, the declared included",
    ),
)
"""Effects of a machine that give the same recordings once the declared parameters are fitted: machine, labels, why."""

UNIDENTIFIABLE = {("pendulum", "payload")}
"""Machines and effects whose class can be found but not its values: mass and place of the payload make one number."""

VECTORS: dict[str, Callable[[Mapping[str, float]], list[float]]] = {
    "position_friction": lambda v: [v["amplitude"] * np.cos(v["phase"]), v["amplitude"] * np.sin(v["phase"])],
    "torque_ripple": lambda v: [v["sine"], v["cosine"]],
    "stribeck_friction": lambda v: [v["level"], v["level"] + v["extra"]],
    "asymmetric_damping": lambda v: [v["forward"] - v["backward"]],  # the rest is declared damping
    "gravity_tilt": lambda v: [v["y"]],  # the other one turns gravity out of the plane of motion
    "directional_load_friction": lambda v: [v["mu_driving"], v["mu_driven"]],
}
"""What of an effect's values is compared, where it is not each parameter of strength by itself."""


@dataclass(frozen=True)
class Set:
    """A generated set.

    :param model: what the tracer is given: MJCF text or a gymnasium environment
    :param measurements: likewise
    :param declared: likewise
    :param planted: labels of what is in it
    :param effects: the same as effects of the library; empty where one is outside of it
    :param zeros: what each joint's encoder shows beyond the truth in each episode, rad or m
    """

    model: Any
    measurements: Measurements
    declared: tuple[str, ...]
    planted: tuple[str, ...]
    effects: tuple[Effect, ...]
    zeros: dict[str, list[float]] = field(default_factory=dict)


def make(case: Case, episodes: int = EPISODES, duration: float = DURATION) -> Set:
    """Generate a set.

    :param case: which
    :param episodes: how many
    :param duration: of an episode in s
    """
    if case.planted_by == "effects":
        return _make_own(case, episodes, duration)
    system = SYSTEMS[case.system]
    plants = [_plant(system, kind, size, case.seed) for kind, size in case.effects]
    planted = generate(
        system,
        plants,
        case.seed,
        episodes,
        duration,
        RATE,
        noise=case.noise,
        jitter=case.jitter,
        quantum=case.quantum,
        velocity=case.velocity,
        zeros=case.zeros,
    )
    effects = [as_effect(system, plant) for plant in plants if plant.library]
    labels = [e.label for e in effects] + [f"{p.kind}({system.links[p.joint].motor})" for p in plants if not p.library]
    return Set(
        planted.xml,
        planted.measurements,
        planted.declared,
        tuple(labels),
        tuple(effects) if planted.truth.explainable else (),
        {joint: column.tolist() for joint, column in zip(system.joints, planted.truth.zeros.T)},
    )


def _make_own(case: Case, episodes: int, duration: float) -> Set:
    machine, gentle = MACHINES[case.system], case.group == "not excited"
    effects = [find(UNSEEN if gentle else OWN, case.system, kind).effect() for kind, _ in case.effects]
    data = simulate(
        machine,
        effects,
        case.seed,
        gentle=gentle,
        episodes=episodes,
        duration=duration,
        rate=RATE,
        noise=case.noise,
        velocity=case.velocity,
    )
    labels = tuple(e.label for e in effects)
    return Set(machine.source(), data, declared_beside(machine, effects), labels, tuple(effects))


def _plant(system: System, kind: str, size: str, seed: int) -> Plant:
    if size != "unseen":
        return draw(system, kind, size, seed)
    joint = system.driven[seed % len(system.driven)]
    null = KINDS[kind](joint)
    return replace(null, limit=UNSEEN_LIMIT * system.links[joint].torque)  # type: ignore[call-arg]


def as_effect(system: System, plant: Plant) -> Effect:
    """The library's effect that is the same as a planted one.

    :raises KeyError: the library has none
    """
    kind, link = LIBRARY[plant.kind], system.links[plant.joint]
    on = {"joint": link.joint, "sensor": link.joint, "actuator": link.motor, "body": link.body, "world": ""}[kind.place]
    return kind(str(on), **{name: float(value) for name, value in VALUES[plant.kind](plant).items()})


def twins(system: str, one: str, other: str) -> bool:
    """Whether two labels stand for the same recordings of a machine, see :data:`TWINS`."""
    return one == other or any(s == system and {one, other} <= labels for s, labels, _ in TWINS)


def kind_of(label: str) -> str:
    """The kind in a label."""
    return label.partition("(")[0]


def deviation(kind: str, true: Mapping[str, float], found: Mapping[str, float]) -> float:
    """Relative error of an effect's values: the worst of its parameters, or of the vector that they make together.

    Parameters of shape are not compared, nor those that are at their null value in truth.
    """
    if kind in VECTORS:
        t, f = (np.array(VECTORS[kind](v)) for v in (true, found))
        return float(np.linalg.norm(f - t) / np.linalg.norm(t))
    compared = [p.name for p in LIBRARY[kind].parameters if not p.shape and true[p.name] != p.null]
    return max(abs(found[name] / true[name] - 1) for name in compared)
