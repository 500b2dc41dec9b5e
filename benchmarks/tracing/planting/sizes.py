"""Where each effect may sit and how large it is drawn: small, about 5 to 8 % of the motor's peak, or 2.5 times that."""

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.tracing.planting.outside import OUTSIDE
from benchmarks.tracing.planting.plants import LIBRARY, Plant
from benchmarks.tracing.planting.systems import SYSTEMS, System

SIZES = {"null": 0.0, "small": 1.0, "large": 2.5}
KINDS: dict[str, type[Plant]] = {plant.kind: plant for plant in (*LIBRARY, *OUTSIDE)}
"""All effects by name, in the order in which they act."""

OF_THE_MOTOR = {
    "load_friction",
    "torque_ripple",
    "command_deadband",
    "command_saturation",
    "command_gain",
    "command_delay",
    "actuator_lag",
    "backlash",
    "flexible",
    "thermal",
}
OF_THE_MACHINE = {"gravity_tilt", "payload"}
OF_A_TURN = {"torque_ripple", "position_friction"}


def joints_for(system: System, kind: str) -> list[int]:
    """Joints at which an effect acts, whether or not it can be identified there; all for one of the whole machine."""
    joints = list(range(len(system.links)))
    if kind in OF_THE_MOTOR:
        joints = [j for j in joints if j in system.driven]
    if kind in OF_A_TURN:
        joints = [j for j in joints if system.links[j].hinge]
    return joints


def places(system: System, kind: str) -> list[int]:
    """Joints at which an effect is possible and, together with what is declared, identifiable in principle.

    Left out: a sensor's bias where the machine looks the same from every position, its delay where it is the only one
    and as good as a late command, a gain where it could not be told from mass and damping.

    :param system: the machine
    :param kind: one of :data:`KINDS`
    :return: indices, perhaps none; the last joint for an effect of the whole machine
    :raises ValueError: an unknown effect
    """
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}; use one of {', '.join(KINDS)}")
    joints = joints_for(system, kind)
    if kind in OF_THE_MACHINE:
        return joints[-1:]
    if kind == "sensor_bias":
        joints = [j for j in joints if j > 0 or (system.links[j].hinge and system.vertical)]
    if kind == "sensor_delay" and len(joints) == 1:
        return []
    all_declared = len(system.declared) == 2 * len(system.links)
    if kind == "command_gain" and len(system.driven) == 1 and all_declared:
        return []
    return joints


def draw(system: System | str, kind: str, size: str, seed: int) -> Plant:
    """Draw an effect: its joint, sign and parameters.

    :param system: the machine or its name
    :param kind: one of :data:`KINDS`
    :param size: ``"small"``, ``"large"``, or ``"null"`` for the parameters at which the effect does nothing
    :param seed: of the draw; large and small are drawn alike
    :raises ValueError: an unknown effect or size, or an effect with no place in this machine
    """
    system = SYSTEMS[system] if isinstance(system, str) else system
    if size not in SIZES:
        raise ValueError(f"size is {size!r}; use one of {', '.join(SIZES)}")
    joints = places(system, kind)
    if not joints:
        raise ValueError(f"{kind} cannot be told from the declared parameters of {system.name}; choose another effect")
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    joint = int(rng.choice(joints))
    if size == "null":
        return KINDS[kind](joint)
    values = PARAMETERS[kind](system, joint, rng, SIZES[size])
    return KINDS[kind](joint, **{name: float(value) for name, value in values.items()})


def _torque(scale: float = 1.0) -> Callable[..., float]:
    return lambda system, j, rng, size: scale * size * rng.uniform(0.05, 0.08) * system.links[j].torque


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _travel(system: System, j: int, turn: float, slide: float) -> float:
    return turn if system.links[j].hinge else slide


def _inertia(system: System, j: int) -> float:
    return float(system.mass_matrix(np.zeros((1, len(system.links))))[0, j, j])


def _stribeck(system: System, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    coulomb = _torque(0.8)(system, j, rng, size)
    speed = rng.uniform(0.25, 0.5) * _travel(system, j, 1.0, 0.3)
    return {"coulomb": coulomb, "static": rng.uniform(1.6, 2.0) * coulomb, "speed": speed}


def _ripple(system: System, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    amplitude, phase = _torque()(system, j, rng, size), rng.uniform(0, 2 * np.pi)
    return {"sine": amplitude * np.cos(phase), "cosine": amplitude * np.sin(phase)}


def _flexible(system: System, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    """A rotor of 0.2 of the joint's inertia on a spring: 4 to 5 Hz, lower when large, damped by 5 %.

    So with the other joints held; free ones make it faster.
    """
    inertia = _inertia(system, j)
    rotor = 0.2 * inertia
    reduced = rotor * inertia / (rotor + inertia)
    omega = 2 * np.pi * rng.uniform(4, 5) / np.sqrt(size)
    return {"inertia": rotor, "stiffness": reduced * omega**2, "damping": 0.1 * reduced * omega}


_Rule = Callable[[System, int, np.random.Generator, float], dict[str, Any]]
PARAMETERS: dict[str, _Rule] = {
    "coulomb_friction": lambda *a: {"torque": _torque()(*a)},
    "stribeck_friction": _stribeck,
    "quadratic_drag": lambda s, j, r, k: {"coefficient": _torque()(s, j, r, k) / _travel(s, j, 3.0, 1.0) ** 2},
    "asymmetric_damping": lambda s, j, r, k: {"forward": _torque()(s, j, r, k) / _travel(s, j, 3.0, 1.0)},
    "load_friction": lambda s, j, r, k: {"coefficient": k * r.uniform(0.1, 0.16)},
    "position_friction": lambda s, j, r, k: {
        "torque": _torque(1.5)(s, j, r, k),
        "phase": r.uniform(-np.pi, np.pi),
    },
    "torque_ripple": _ripple,
    "torque_offset": lambda s, j, r, k: {"torque": _sign(r) * _torque()(s, j, r, k)},
    "spring": lambda s, j, r, k: {"stiffness": _torque()(s, j, r, k) / _travel(s, j, 0.6, 0.4)},
    "gravity_tilt": lambda s, j, r, k: {"angle": _sign(r) * k * r.uniform(0.04, 0.06)},
    "payload": lambda s, j, r, k: {"mass": k * r.uniform(0.12, 0.16) * s.links[j].mass},
    "armature": lambda s, j, r, k: {"inertia": k * r.uniform(0.1, 0.14) * _inertia(s, j)},
    "command_deadband": lambda *a: {"width": _torque()(*a)},
    "command_saturation": lambda s, j, r, k: {"limit": (1 - 0.24 * k + r.uniform(-0.04, 0.04)) * s.links[j].torque},
    "command_gain": lambda s, j, r, k: {"gain": 1 + _sign(r) * k * r.uniform(0.06, 0.09)},
    "backlash": lambda *a: {"gap": 2 * _torque()(*a)},
    "command_delay": lambda s, j, r, k: {"delay": k * r.uniform(0.007, 0.012)},
    "actuator_lag": lambda s, j, r, k: {"time_constant": k * r.uniform(0.01, 0.016)},
    "sensor_delay": lambda s, j, r, k: {"delay": k * r.uniform(0.007, 0.012)},
    "sensor_bias": lambda s, j, r, k: {"bias": _sign(r) * k * r.uniform(0.03, 0.05) * _travel(s, j, 1.0, 0.3)},
    "sensor_gain": lambda s, j, r, k: {"gain": 1 + _sign(r) * k * r.uniform(0.04, 0.06)},
    "thermal": lambda s, j, r, k: {"drop": (0.3 if k < 2 else 0.6) * r.uniform(0.9, 1.1)},
    "flexible": _flexible,
    "bouc_wen": lambda s, j, r, k: {"torque": _torque(2)(s, j, r, k), "travel": _travel(s, j, 0.6, 0.2)},
    "wind_gusts": lambda s, j, r, k: {"torque": _torque(1.5)(s, j, r, k), "frequency": r.uniform(0.6, 1.4)},
    "random_walk": lambda *a: {"rate": _torque(1.5)(*a)},
}
