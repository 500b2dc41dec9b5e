"""Declared parameters: numbers of the model itself, by the MJCF's own names."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np

from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.effect import Effect, Parameter, Scales
from sb3_rpto.effects.model_parameters import NUMBERS, OPTIONS, Number
from sb3_rpto.effects.names import SCALAR_JOINTS, near, object_id, object_names

OBJECTS = ("joint", "body", "geom", "actuator")
#: So many plausible sizes above its nominal value, what holds a joint still would do so by several times its torque.
REACH = 100.0


class Declared(Effect):
    """One number of the model that its user declared unknown, e.g. ``hinge.damping``; its null is the nominal value.

    ``range`` is the width of a joint's limits, about the point in them that is nearest to the reference pose;
    ``length`` is that of a link: its capsules and the offsets of its children, at constant density (see
    :mod:`sb3_rpto.effects.length`); ``mass`` scales the inertia with it, and is that at the nominal length where
    the length is declared too; ``inertia`` is the first principal moment, the others in proportion, at whatever mass;
    ``kp`` is the stiffness of a position servo, ``kv`` its damping or the gain of a velocity servo, ``strength`` a
    factor on all that an actuator does (gain, bias and force limits), ``timeconst`` that of its filter, or, with
    ``dampratio``, a geom's ``solref``.

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
    #: of friction that the model has none of: whether it gives way near rest as MuJoCo's ``frictionloss`` by default
    #: does, in place of the stiffest constraint that the time step allows
    soft: bool = False

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
        known = OPTIONS if self.owner == "option" else NUMBERS[self.owner]
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
    def firm(self) -> bool:
        """Whether it is dry friction of a joint that has none in the model, and holds as a machine's does."""
        return self.number[::2] == ("joint", "frictionloss") and self.nominal == 0 and not self.soft

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
        """The largest value in a trace: where nobody bounds them, a joint's damping, friction and stiffness have one.

        It is ten times the nominal value, or what would hold the joint still against several times its torque. A fit
        to what something undeclared moves could freeze the joint, and with it all that might tell what that is.

        :param scales: of the joint
        """
        (parameter,) = self.parameters
        if not self._how.holds or parameter.upper < np.inf:
            return parameter.upper
        return self.nominal + REACH * max(0.1 * self.nominal, self._how.size(scales))

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Write the parameter's field."""
        if self.soft:
            batch.field("dof_frictionloss")[:, self.dof] = x[:, 0]
        else:
            self._how.write(batch, self.index, x[:, 0], self.nominal)


def _find(model: mujoco.MjModel, name: str) -> tuple[str, int, Number]:
    owner, dot, parameter = name.rpartition(".")
    if not dot:
        raise ValueError(f"{name!r} is no parameter; write <object>.<parameter>, e.g. 'hinge.damping'")
    if owner == "option":
        if parameter not in OPTIONS:
            raise ValueError(f"option has no parameter {parameter!r}; {near(parameter, OPTIONS)}")
        return "option", 0, OPTIONS[parameter]
    prefix, colon, rest = owner.partition(":")
    if colon and prefix in OBJECTS:
        candidates, owner = [prefix], rest
    else:
        candidates = [kind for kind in OBJECTS if owner in object_names(model, kind)]
        if not candidates:
            names = dict.fromkeys(n for kind in OBJECTS for n in object_names(model, kind))
            raise ValueError(f"{name!r}: the model has no object {owner!r}; {near(owner, names)}")
    having = [kind for kind in candidates if parameter in NUMBERS[kind]]
    if not having:
        known = [p for kind in candidates for p in NUMBERS[kind]]
        has = "has" if len(candidates) == 1 else "have"
        raise ValueError(
            f"{name!r}: {' and '.join(candidates)} {owner!r} {has} no {parameter!r}; {near(parameter, known)}"
        )
    if len(having) > 1:
        raise ValueError(f"{name!r} may be of {' or '.join(having)}; write '{having[0]}:{name}'")
    index = object_id(model, having[0], owner)
    if having[0] == "joint" and model.jnt_type[index] not in SCALAR_JOINTS:
        raise ValueError(f"{name!r}: joint {owner!r} is neither a hinge nor a slide: set it in the MJCF")
    return having[0], index, NUMBERS[having[0]][parameter]


def parameter_names(model: mujoco.MjModel) -> list[str]:
    """Every name that may be declared, one by one."""
    names = [f"option.{p}" for p in OPTIONS]
    for kind in OBJECTS:
        for i, owner in enumerate(object_names(model, kind)):
            if (kind == "joint" and model.jnt_type[i] not in SCALAR_JOINTS) or (kind == "body" and i == 0):
                continue
            others = [k for k in OBJECTS if k != kind and owner in object_names(model, k)]
            for p in NUMBERS[kind]:
                if not _has(model, kind, i, p):
                    continue
                clash = any(p in NUMBERS[k] for k in others)
                names.append(f"{kind}:{owner}.{p}" if clash else f"{owner}.{p}")
    return names


def _has(model: mujoco.MjModel, kind: str, index: int, parameter: str) -> bool:
    try:
        NUMBERS[kind][parameter].read(model, index)
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
    # What has none of these marks is a name as it stands.
    known = parameter_names(model) if any(c in entry for entry in entries for c in "=*?[") else []
    for entry in entries:
        name, bounds = _parted(entry, known)
        matches = [name]
        if _is_pattern(name, known):
            matches = [m for m in fnmatch.filter(known, name) if _scalable(model, m)]
            if not matches:
                raise ValueError(f"declared {name!r} matches nothing; {near(name, known)}")
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


def _is_pattern(name: str, known: Collection[str]) -> bool:
    """Whether a name has wildcards; those of objects may have brackets themselves."""
    return any(c in name for c in "*?[") and not _is_known(name, known)


def _is_known(name: str, known: Collection[str]) -> bool:
    """Whether a name is of one number, be it with its object's kind before it."""
    kind, _, rest = name.partition(":")
    return name in known or (kind in OBJECTS and rest in known)


def _parted(entry: str, known: Collection[str]) -> tuple[str, tuple[float, float] | None]:
    """A name, and the bounds behind the last ``=`` that is no part of it."""
    name, equals, given = entry.rpartition("=")
    if not equals or _is_known(entry, known) or fnmatch.filter(known, entry):
        return entry, None
    try:
        lower, upper = (float(part) for part in given.split(":"))
        return name, (lower, upper)
    except ValueError:
        if _is_known(name, known) or fnmatch.filter(known, name):
            raise ValueError(f"declared {entry!r}: write bounds as <name>=<lower>:<upper>") from None
        return entry, None
