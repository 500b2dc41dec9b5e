"""The numbers of a model that may be declared: where each stands in it, and how it is read and written."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import BIASES, GAINS, LAGS, servo_of
from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.effect import Scales
from sb3_rpto.effects.length import held_by_constraint, link_length, write_length

#: Dry friction in N·m or N that is left of a model's own.
LEAST_FRICTION = 1e-12
_PID = int(mujoco.mjtGain.mjGAIN_PID)


class Number(NamedTuple):
    """How a sort of number is read from a model and written to a world."""

    unit: str
    read: Callable[[mujoco.MjModel, int], float]
    write: Callable[[SimulationBatch, int, np.ndarray, float], None]  # world, id, values (n,), nominal
    size: Callable[[Scales], float]  # scale of a fit where the nominal value is zero
    span: tuple[float, float] | None = None  # default bounds as multiples of the nominal value; None: [0, inf)
    holds: bool = False  # whether a joint stands still where it is large


_Read = Callable[[mujoco.MjModel, int], float]
_Write = Callable[[SimulationBatch, int, np.ndarray, float], None]


def _dof(name: str) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, joint: int) -> float:
        return float(getattr(model, name)[model.jnt_dofadr[joint]])

    def write(batch: SimulationBatch, joint: int, values: np.ndarray, nominal: float) -> None:
        dof = int(batch.model.jnt_dofadr[joint])
        if name == "dof_frictionloss":
            batch.rough(dof)
            # At 0 nothing would tell a saved model that the joint has a constraint of its own.
            values = np.maximum(values, LEAST_FRICTION) if nominal > 0 else values
        batch.field(name)[:, dof] = values

    return read, write


def _column(name: str, column: int | None = None) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, index: int) -> float:
        values = getattr(model, name)[index]
        return float(values if column is None else values[column])

    def write(batch: SimulationBatch, index: int, values: np.ndarray, nominal: float) -> None:
        if column is None:
            batch.field(name)[:, index] = values
        else:
            batch.field(name)[:, index, column] = values

    return read, write


def _write_mass(batch: SimulationBatch, body: int, values: np.ndarray, nominal: float) -> None:
    batch.field("body_mass")[:, body] *= values / nominal
    batch.field("body_inertia")[:, body] *= (values / nominal)[:, None]


def _write_inertia(batch: SimulationBatch, body: int, values: np.ndarray, nominal: float) -> None:
    inertia = batch.field("body_inertia")[:, body]
    inertia *= (values / inertia[:, 0])[:, None]


def _read_kp(model: mujoco.MjModel, actuator: int) -> float:
    kind = servo_of(model, actuator)
    if kind != "position":
        raise ValueError(f"the actuator is no position servo; declare its {'kv' if kind else 'gain'} or strength")
    return float(model.actuator_gainprm[actuator, 0])


def _write_kp(batch: SimulationBatch, actuator: int, values: np.ndarray, nominal: float) -> None:
    batch.field("actuator_gainprm")[:, actuator, 0] = values
    batch.field("actuator_biasprm")[:, actuator, 1] = -values


def _read_kv(model: mujoco.MjModel, actuator: int) -> float:
    if not servo_of(model, actuator):
        raise ValueError("the actuator is no position or velocity servo; declare its gain, damping or strength")
    return -float(model.actuator_biasprm[actuator, 2])


def _write_kv(batch: SimulationBatch, actuator: int, values: np.ndarray, nominal: float) -> None:
    # Of the two servos that have it, that of the velocity: :func:`servo_of` cannot tell once the gain has changed.
    if batch.model.actuator_gainprm[actuator, 0] and not batch.model.actuator_biasprm[actuator, 1]:
        batch.field("actuator_gainprm")[:, actuator, 0] = values
    batch.field("actuator_biasprm")[:, actuator, 2] = -values


def _read_timeconst(model: mujoco.MjModel, actuator: int) -> float:
    if model.actuator_dyntype[actuator] not in LAGS:
        raise ValueError("the actuator has no filter; trace actuator_lag, or give it dyntype filterexact")
    return float(model.actuator_dynprm[actuator, 0])


def _solref(column: int) -> _Read:
    def read(model: mujoco.MjModel, geom: int) -> float:
        if model.geom_solref[geom, 0] <= 0:
            raise ValueError("the geom's solref holds stiffness and damping; give it a time constant and damping ratio")
        return float(model.geom_solref[geom, column])

    return read


def _read_gain(model: mujoco.MjModel, actuator: int) -> float:
    _read_strength(model, actuator)
    if model.actuator_gaintype[actuator] not in GAINS:
        raise ValueError("the actuator's gain is no factor on its command; declare its strength or gear")
    return float(model.actuator_gainprm[actuator, 0])


def _read_strength(model: mujoco.MjModel, actuator: int) -> float:
    """A factor, 1 in the model as it is."""
    linear = model.actuator_gaintype[actuator] in (*GAINS, _PID) and model.actuator_biastype[actuator] in BIASES
    if not linear:
        raise ValueError("the actuator's force is not linear in its parameters; declare its gear")
    return 1.0


def _write_strength(batch: SimulationBatch, actuator: int, values: np.ndarray, nominal: float) -> None:
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        batch.field(name)[:, actuator] *= values[:, None]


def _read_length(model: mujoco.MjModel, body: int) -> float:
    held = held_by_constraint(model, body)
    if held:
        raise ValueError(f"{held} names the body, and its anchor would not move with the link; tie it by sites")
    return link_length(model, body)


def _read_gear(model: mujoco.MjModel, actuator: int) -> float:
    """The largest entry: of a joint's or tendon's transmission the first, of a thruster's that of its axis."""
    gear = model.actuator_gear[actuator]
    return float(gear[np.argmax(np.abs(gear))])


def _write_gear(batch: SimulationBatch, actuator: int, values: np.ndarray, nominal: float) -> None:
    batch.field("actuator_gear")[:, actuator] = np.outer(values / nominal, batch.model.actuator_gear[actuator])


def _range(model: mujoco.MjModel, joint: int) -> float:
    low, high = model.jnt_range[joint]
    return float(high - low) if model.jnt_limited[joint] else 0.0


def _write_range(batch: SimulationBatch, joint: int, values: np.ndarray, nominal: float) -> None:
    limits = batch.field("jnt_range")[:, joint]
    # The range keeps the reference pose, or the bound next to it.
    reference = batch.model.qpos0[batch.model.jnt_qposadr[joint]]
    pivot = np.clip(reference, limits[:, :1], limits[:, 1:])
    limits[:] = pivot + (limits - pivot) * (values / nominal)[:, None]


def _friction_size(scales: Scales) -> float:
    return 0.05 * scales.torque


def _viscous_size(scales: Scales) -> float:
    return 0.05 * scales.torque / scales.velocity


_POSITIVE = (0.1, 10.0)
#: By the kind of object that has them.
NUMBERS: dict[str, dict[str, Number]] = {
    "joint": {
        "damping": Number("N·m·s/rad", *_dof("dof_damping"), _viscous_size, holds=True),
        "frictionloss": Number("N·m", *_dof("dof_frictionloss"), _friction_size, holds=True),
        "armature": Number("kg·m²", *_dof("dof_armature"), lambda s: 0.05 * s.inertia),
        "stiffness": Number("N·m/rad", *_column("jnt_stiffness"), lambda s: 0.05 * s.torque / s.span, holds=True),
        "range": Number("rad", _range, _write_range, lambda s: s.span, _POSITIVE),
    },
    "body": {
        "mass": Number("kg", *_column("body_mass")[:1], _write_mass, lambda s: 0.05 * s.mass, _POSITIVE),
        "inertia": Number("kg·m²", *_column("body_inertia", 0)[:1], _write_inertia, lambda s: s.inertia, (0.03, 30.0)),
        "length": Number("m", _read_length, write_length, lambda s: 0.1, (0.5, 2.0)),
    },
    "geom": {
        "friction": Number("", *_column("geom_friction", 0), lambda s: 0.1),
        "timeconst": Number("s", _solref(0), _column("geom_solref", 0)[1], lambda s: 0.01, _POSITIVE),
        "dampratio": Number("", _solref(1), _column("geom_solref", 1)[1], lambda s: 0.1, _POSITIVE),
    },
    "actuator": {
        "gear": Number("", _read_gear, _write_gear, lambda s: 1.0, _POSITIVE),
        "gain": Number("", _read_gain, _column("actuator_gainprm", 0)[1], lambda s: 1.0, _POSITIVE),
        "kp": Number("N·m/rad", _read_kp, _write_kp, lambda s: 1.0, _POSITIVE),
        "kv": Number("N·m·s/rad", _read_kv, _write_kv, _viscous_size),
        "timeconst": Number("s", _read_timeconst, _column("actuator_dynprm", 0)[1], lambda s: 0.01, _POSITIVE),
        "strength": Number("", _read_strength, _write_strength, lambda s: 1.0, _POSITIVE),
        "damping": Number("N·m·s/rad", *_column("actuator_damping"), _viscous_size),
    },
}


def _write_gravity(batch: SimulationBatch, index: int, values: np.ndarray, nominal: float) -> None:
    batch.field("opt.gravity")[:] *= (values / nominal)[:, None]


def _option(name: str) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, index: int) -> float:
        return float(getattr(model.opt, name))

    def write(batch: SimulationBatch, index: int, values: np.ndarray, nominal: float) -> None:
        batch.field(f"opt.{name}")[:] = values.reshape(batch.field(f"opt.{name}").shape)

    return read, write


#: Those of the world, which are declared as ``option.gravity``.
OPTIONS: dict[str, Number] = {
    "gravity": Number(
        "m/s²",
        lambda model, _: float(np.linalg.norm(model.opt.gravity)),
        _write_gravity,
        lambda s: 1.0,
        (0.1, 10.0),
    ),
    "viscosity": Number("Pa·s", *_option("viscosity"), lambda s: 0.1),
    "density": Number("kg/m³", *_option("density"), lambda s: 100.0),
}
