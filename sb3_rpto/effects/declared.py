"""Declared parameters: numbers of the model itself, by the MJCF's own names."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import LAGS
from sb3_rpto.effects.effect import Effect, Parameter, Scales
from sb3_rpto.effects.length import held_by_constraint, link_length, write_length
from sb3_rpto.effects.names import SCALAR_JOINTS, near, object_id, object_names
from sb3_rpto.effects.world import World

OBJECTS = ("joint", "body", "geom", "actuator")
#: Dry friction in N·m or N that is left of a model's own.
LEAST_FRICTION = 1e-12
#: So many plausible sizes above its nominal value, what holds a joint still would do so by several times its torque.
REACH = 100.0


class _Kind(NamedTuple):
    """How a sort of parameter is read from a model and written to a world."""

    unit: str
    read: Callable[[mujoco.MjModel, int], float]
    write: Callable[[World, int, np.ndarray, float], None]  # world, id, values (n,), nominal
    size: Callable[[Scales], float]  # scale of a fit where the nominal value is zero
    span: tuple[float, float] | None = None  # default bounds as multiples of the nominal value; None: [0, inf)
    holds: bool = False  # whether a joint stands still where it is large


_Read = Callable[[mujoco.MjModel, int], float]
_Write = Callable[[World, int, np.ndarray, float], None]


def _dof(name: str) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, joint: int) -> float:
        return float(getattr(model, name)[model.jnt_dofadr[joint]])

    def write(world: World, joint: int, values: np.ndarray, nominal: float) -> None:
        dof = int(world.model.jnt_dofadr[joint])
        if name == "dof_frictionloss":
            world.rough(dof)
            # At 0 nothing would tell a saved model that the joint has a constraint of its own.
            values = np.maximum(values, LEAST_FRICTION) if nominal > 0 else values
        world.field(name)[:, dof] = values

    return read, write


def _column(name: str, column: int | None = None) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, index: int) -> float:
        values = getattr(model, name)[index]
        return float(values if column is None else values[column])

    def write(world: World, index: int, values: np.ndarray, nominal: float) -> None:
        if column is None:
            world.field(name)[:, index] = values
        else:
            world.field(name)[:, index, column] = values

    return read, write


def _write_mass(world: World, body: int, values: np.ndarray, nominal: float) -> None:
    world.field("body_mass")[:, body] *= values / nominal
    world.field("body_inertia")[:, body] *= (values / nominal)[:, None]


def _write_inertia(world: World, body: int, values: np.ndarray, nominal: float) -> None:
    inertia = world.field("body_inertia")[:, body]
    inertia *= (values / inertia[:, 0])[:, None]


def servo_of(model: mujoco.MjModel, actuator: int) -> str:
    """What an actuator regulates: its bias takes back its gain on the position, ``kp (u - q)``, or on the velocity."""
    gain, (_, on_position, on_velocity) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and gain:
        if on_position == -gain:
            return "position"
        if on_velocity == -gain and not on_position:
            return "velocity"
    return ""


def _read_kp(model: mujoco.MjModel, actuator: int) -> float:
    kind = servo_of(model, actuator)
    if kind != "position":
        raise ValueError(f"the actuator is no position servo; declare its {'kv' if kind else 'gain'} or strength")
    return float(model.actuator_gainprm[actuator, 0])


def _write_kp(world: World, actuator: int, values: np.ndarray, nominal: float) -> None:
    world.field("actuator_gainprm")[:, actuator, 0] = values
    world.field("actuator_biasprm")[:, actuator, 1] = -values


def _read_kv(model: mujoco.MjModel, actuator: int) -> float:
    if not servo_of(model, actuator):
        raise ValueError("the actuator is no position or velocity servo; declare its gain, damping or strength")
    return -float(model.actuator_biasprm[actuator, 2])


def _write_kv(world: World, actuator: int, values: np.ndarray, nominal: float) -> None:
    # Of the two servos that have it, that of the velocity: :func:`servo_of` cannot tell once the gain has changed.
    if world.model.actuator_gainprm[actuator, 0] and not world.model.actuator_biasprm[actuator, 1]:
        world.field("actuator_gainprm")[:, actuator, 0] = values
    world.field("actuator_biasprm")[:, actuator, 2] = -values


def _read_timeconst(model: mujoco.MjModel, actuator: int) -> float:
    if model.actuator_dyntype[actuator] not in LAGS:
        raise ValueError("the actuator has no filter; trace actuator_lag, or give it dyntype filterexact")
    return float(model.actuator_dynprm[actuator, 0])


def _write_strength(world: World, actuator: int, values: np.ndarray, nominal: float) -> None:
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        world.field(name)[:, actuator] *= values[:, None]


def _read_length(model: mujoco.MjModel, body: int) -> float:
    held = held_by_constraint(model, body)
    if held:
        raise ValueError(f"{held} names the body, and its anchor would not move with the link; tie it by sites")
    return link_length(model, body)


def _read_gear(model: mujoco.MjModel, actuator: int) -> float:
    """The largest entry: of a joint's or tendon's transmission the first, of a thruster's that of its axis."""
    gear = model.actuator_gear[actuator]
    return float(gear[np.argmax(np.abs(gear))])


def _write_gear(world: World, actuator: int, values: np.ndarray, nominal: float) -> None:
    world.field("actuator_gear")[:, actuator] = np.outer(values / nominal, world.model.actuator_gear[actuator])


def _range(model: mujoco.MjModel, joint: int) -> float:
    low, high = model.jnt_range[joint]
    return float(high - low) if model.jnt_limited[joint] else 0.0


def _write_range(world: World, joint: int, values: np.ndarray, nominal: float) -> None:
    limits = world.field("jnt_range")[:, joint]
    # The range keeps the reference pose, or the bound next to it.
    reference = world.model.qpos0[world.model.jnt_qposadr[joint]]
    pivot = np.clip(reference, limits[:, :1], limits[:, 1:])
    limits[:] = pivot + (limits - pivot) * (values / nominal)[:, None]


def _one(model: mujoco.MjModel, index: int) -> float:
    return 1.0


def _friction_size(scales: Scales) -> float:
    return 0.05 * scales.torque


def _viscous_size(scales: Scales) -> float:
    return 0.05 * scales.torque / scales.velocity


_POSITIVE = (0.1, 10.0)
_KINDS: dict[str, dict[str, _Kind]] = {
    "joint": {
        "damping": _Kind("N·m·s/rad", *_dof("dof_damping"), _viscous_size, holds=True),
        "frictionloss": _Kind("N·m", *_dof("dof_frictionloss"), _friction_size, holds=True),
        "armature": _Kind("kg·m²", *_dof("dof_armature"), lambda s: 0.05 * s.inertia),
        "stiffness": _Kind("N·m/rad", *_column("jnt_stiffness"), lambda s: 0.05 * s.torque / s.span, holds=True),
        "range": _Kind("rad", _range, _write_range, lambda s: s.span, _POSITIVE),
    },
    "body": {
        "mass": _Kind("kg", *_column("body_mass")[:1], _write_mass, lambda s: 0.05 * s.mass, _POSITIVE),
        "inertia": _Kind("kg·m²", *_column("body_inertia", 0)[:1], _write_inertia, lambda s: s.inertia, (0.03, 30.0)),
        "length": _Kind("m", _read_length, write_length, lambda s: 0.1, (0.5, 2.0)),
    },
    "geom": {"friction": _Kind("", *_column("geom_friction", 0), lambda s: 0.1)},
    "actuator": {
        "gear": _Kind("", _read_gear, _write_gear, lambda s: 1.0, _POSITIVE),
        "gain": _Kind("", *_column("actuator_gainprm", 0), lambda s: 1.0, _POSITIVE),
        "kp": _Kind("N·m/rad", _read_kp, _write_kp, lambda s: 1.0, _POSITIVE),
        "kv": _Kind("N·m·s/rad", _read_kv, _write_kv, _viscous_size),
        "timeconst": _Kind("s", _read_timeconst, _column("actuator_dynprm", 0)[1], lambda s: 0.01, _POSITIVE),
        "strength": _Kind("", _one, _write_strength, lambda s: 1.0, _POSITIVE),
        "damping": _Kind("N·m·s/rad", *_column("actuator_damping"), _viscous_size),
    },
}


def _write_gravity(world: World, index: int, values: np.ndarray, nominal: float) -> None:
    world.field("opt.gravity")[:] *= (values / nominal)[:, None]


def _option(name: str) -> tuple[_Read, _Write]:
    def read(model: mujoco.MjModel, index: int) -> float:
        return float(getattr(model.opt, name))

    def write(world: World, index: int, values: np.ndarray, nominal: float) -> None:
        world.field(f"opt.{name}")[:] = values.reshape(world.field(f"opt.{name}").shape)

    return read, write


_OPTIONS: dict[str, _Kind] = {
    "gravity": _Kind(
        "m/s²",
        lambda model, _: float(np.linalg.norm(model.opt.gravity)),
        _write_gravity,
        lambda s: 1.0,
        (0.1, 10.0),
    ),
    "viscosity": _Kind("Pa·s", *_option("viscosity"), lambda s: 0.1),
    "density": _Kind("kg/m³", *_option("density"), lambda s: 100.0),
}


class Declared(Effect):
    """One number of the model that its user declared unknown, e.g. ``hinge.damping``; its null is the nominal value.

    ``range`` is the width of a joint's limits, about the point in them that is nearest to the reference pose;
    ``length`` is that of a link: its capsules and the offsets of its children, at constant density (see
    :mod:`sb3_rpto.effects.length`); ``mass`` scales the inertia with it, and is that at the nominal length where
    the length is declared too; ``inertia`` is the first principal moment, the others in proportion, at whatever mass;
    ``kp`` is the stiffness of a position servo, ``kv`` its damping or the gain of a velocity servo, ``strength`` a
    factor on all that an actuator does (gain, bias and force limits), ``timeconst`` that of its filter.

    :param model: the model that has it
    :param name: ``<object>.<parameter>``, with ``joint:`` (``body:``, ``geom:``, ``actuator:``) before the object
        where two objects share a name, and ``option`` as the object of ``gravity``, ``viscosity`` and ``density``
    :param bounds: smallest and largest value; default: from 0 (to :meth:`ceiling` in a trace), or a tenth to ten times
        the nominal value
    :param nominal: its nominal value where ``model`` has been corrected since; default: that of ``model``
    :raises ValueError: no such object or parameter, an actuator that is not the servo which has it, a nominal value of
        zero where only factors make sense, bounds that do not hold the nominal value
    """

    kind = "declared"
    place = "world"
    equation = "a number of the model"
    known = True

    def __init__(
        self,
        model: mujoco.MjModel,
        name: str,
        bounds: tuple[float, float] | None = None,
        nominal: float | None = None,
    ) -> None:
        #: kind of object it belongs to, or ``option``
        self.owner, self.index, self._how = _find(model, name)
        how = self._how
        try:
            nominal = how.read(model, self.index) if nominal is None else nominal
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        if how.span is not None and nominal == 0:
            raise ValueError(f"{name} is 0 in the model, so it cannot be scaled; give it a value in the MJCF")
        lower, upper = bounds or ((0.0, np.inf) if how.span is None else tuple(sorted(nominal * s for s in how.span)))
        if lower > upper:
            raise ValueError(f"{name}: the bounds [{lower:g}, {upper:g}] are the wrong way round; give low:high")
        if not lower <= nominal <= upper or lower == upper:
            raise ValueError(
                f"{name}: the bounds [{lower:g}, {upper:g}] do not hold the nominal value {nominal:g}; give low:high "
                "around it"
            )
        self._take(name, nominal, lower, upper)
        super().__init__("")

    def _take(self, name: str, nominal: float, lower: float, upper: float) -> None:
        """An instance has its own parameter, with the model's value as its null."""
        size: float | Callable[[Scales], float] = 0.1 * abs(nominal) if nominal else self._how.size
        self.parameters = (Parameter(name, self._how.unit, size, lower, upper, nominal),)  # type: ignore[misc]
        self.nominal = nominal

    def __getstate__(self) -> dict[str, Any]:
        # How it is read and written is a function, which does not pickle.
        kept = {name: value for name, value in vars(self).items() if name not in ("_how", "parameters")}
        return {**kept, "parameter": (self.label, self.nominal, self.parameters[0].lower, self.parameters[0].upper)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        parameter = state.pop("parameter")
        vars(self).update(state)
        known = _OPTIONS if self.owner == "option" else _KINDS[self.owner]
        self._how = known[parameter[0].rpartition(".")[2]]
        self._take(*parameter)

    @property
    def label(self) -> str:
        """The parameter's name."""
        return self.parameters[0].name

    @property
    def scales(self) -> bool:
        """Whether it acts as a factor on the nominal value, and so is never 0."""
        return self._how.span is not None

    @property
    def number(self) -> tuple[str, int, str]:
        """Which number of the model it is, by whatever name: object's kind, index, parameter."""
        return self.owner, self.index, self.label.rpartition(".")[2]

    @property
    def rank(self) -> int:
        """Its turn among declared parameters: factors come after what they multiply."""
        return {"mass": 1, "inertia": 2, "strength": 3}.get(self.label.rpartition(".")[2], 0)

    def __repr__(self) -> str:
        return f"{self.label} = {self.values[0]:.4g} {self.parameters[0].unit}".rstrip()

    def with_values(self, values: np.ndarray) -> Declared:
        """As in :class:`Effect`."""
        clone = object.__new__(Declared)
        clone.__dict__.update(self.__dict__)
        p = self.parameters[0]
        clone.values = np.clip(np.asarray(values, dtype=float), p.lower, p.upper)
        return clone

    def bind(self, model: mujoco.MjModel) -> None:
        """Look up ``self.dof`` of a joint; the name was looked up when it was declared."""
        if self.owner == "joint":
            self.dof = int(model.jnt_dofadr[self.index])

    def ceiling(self, scales: Scales) -> float:
        """The largest value in a trace: without bounds, a joint's damping, friction and stiffness have one there.

        It is ten times the nominal value, or what would hold the joint still against several times its torque. A fit
        to what something undeclared moves could freeze the joint, and with it all that might tell what that is.

        :param scales: of the joint
        """
        (parameter,) = self.parameters
        if not self._how.holds:
            return parameter.upper
        return min(parameter.upper, self.nominal + REACH * max(0.1 * self.nominal, self._how.size(scales)))

    def write(self, world: World, x: np.ndarray) -> None:
        """Write the parameter's field."""
        self._how.write(world, self.index, x[:, 0], self.nominal)


def _find(model: mujoco.MjModel, name: str) -> tuple[str, int, _Kind]:
    owner, dot, parameter = name.rpartition(".")
    if not dot:
        raise ValueError(f"{name!r} is no parameter; write <object>.<parameter>, e.g. 'hinge.damping'")
    if owner == "option":
        if parameter not in _OPTIONS:
            raise ValueError(f"option has no parameter {parameter!r}; {near(parameter, _OPTIONS)}")
        return "option", 0, _OPTIONS[parameter]
    prefix, colon, rest = owner.partition(":")
    if colon and prefix in OBJECTS:
        candidates, owner = [prefix], rest
    else:
        candidates = [kind for kind in OBJECTS if owner in object_names(model, kind)]
        if not candidates:
            names = dict.fromkeys(n for kind in OBJECTS for n in object_names(model, kind))
            raise ValueError(f"{name!r}: the model has no object {owner!r}; {near(owner, names)}")
    having = [kind for kind in candidates if parameter in _KINDS[kind]]
    if not having:
        known = [p for kind in candidates for p in _KINDS[kind]]
        raise ValueError(
            f"{name!r}: {' and '.join(candidates)} {owner!r} has no {parameter!r}; {near(parameter, known)}"
        )
    if len(having) > 1:
        raise ValueError(f"{name!r} may be of {' or '.join(having)}; write '{having[0]}:{name}'")
    index = object_id(model, having[0], owner)
    if having[0] == "joint" and model.jnt_type[index] not in SCALAR_JOINTS:
        raise ValueError(f"{name!r}: joint {owner!r} is neither a hinge nor a slide: set it in the MJCF")
    return having[0], index, _KINDS[having[0]][parameter]


def parameter_names(model: mujoco.MjModel) -> list[str]:
    """Every name that may be declared, one by one."""
    names = [f"option.{p}" for p in _OPTIONS]
    for kind in OBJECTS:
        for i, owner in enumerate(object_names(model, kind)):
            if (kind == "joint" and model.jnt_type[i] not in SCALAR_JOINTS) or (kind == "body" and i == 0):
                continue
            others = [k for k in OBJECTS if k != kind and owner in object_names(model, k)]
            for p in _KINDS[kind]:
                if not _has(model, kind, i, p):
                    continue
                clash = any(p in _KINDS[k] for k in others)
                names.append(f"{kind}:{owner}.{p}" if clash else f"{owner}.{p}")
    return names


def _has(model: mujoco.MjModel, kind: str, index: int, parameter: str) -> bool:
    try:
        _KINDS[kind][parameter].read(model, index)
    except ValueError:
        return False
    return True


def declare(model: mujoco.MjModel, names: Iterable[str]) -> list[Declared]:
    """Look up declared parameters.

    :param model: the compiled model
    :param names: ``<object>.<parameter>``, with shell wildcards (``*.damping``) and bounds in the parameter's SI unit
        (``arm.mass=0.2:0.9``, kg)
    :return: one :class:`Declared` for each name, in order, none twice: the last entry gives its bounds
    :raises TypeError: one string in place of a list, a mapping, entries that are no strings
    :raises ValueError: unknown or ambiguous names (the near ones are said), wildcards that match nothing, malformed
        bounds, bounds below 0 of what is never negative, bounds that do not hold the nominal value, a nominal value of
        zero where only factors make sense
    """
    if isinstance(names, str):
        raise TypeError(f"declared must be a list of names, not the string {names!r}; write [{names!r}]")
    entries = [*names]
    if isinstance(names, Mapping) or not all(isinstance(entry, str) for entry in entries):
        raise TypeError(f"declared must be a list of names, not {names!r}; bounds are part of one: 'arm.mass=0.2:0.9'")
    found: dict[tuple[str, int, str], Declared] = {}
    for entry in entries:
        name, equals, given = entry.partition("=")
        bounds = _bounds(entry, given) if equals else None
        matches = [name]
        if any(c in name for c in "*?[") and name not in parameter_names(model):  # names may have brackets
            matches = fnmatch.filter(parameter_names(model), name)
            matches = [m for m in matches if _scalable(model, m)]
            if not matches:
                raise ValueError(f"declared {name!r} matches nothing; {near(name, parameter_names(model))}")
        for match in matches:
            one = Declared(model, match, bounds)
            least, bounded = one.parameters[0].lower, bounds is not None and one.owner != "actuator"
            if bounded and least <= 0 <= one.nominal and (one.scales or least < 0):
                raise ValueError(
                    f"{match}: the lower bound {least:g} must be {'above' if one.scales else 'at least'} 0"
                )
            found[one.number] = one
    return list(found.values())


def _scalable(model: mujoco.MjModel, name: str) -> bool:
    """Whether a wildcard should match: a factor on zero means nothing, and a motor's null damping is its joint's."""
    try:
        found = Declared(model, name)
    except ValueError:
        return False
    return found.owner != "actuator" or found.nominal != 0


def _bounds(entry: str, given: str) -> tuple[float, float]:
    try:
        lower, upper = (float(part) for part in given.split(":"))
    except ValueError:
        raise ValueError(f"declared {entry!r}: write bounds as <name>=<lower>:<upper>") from None
    return lower, upper
