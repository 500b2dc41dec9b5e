"""One hierarchy of effects: what shifts a target, is planted in a test, or corrects a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

import mujoco
import numpy as np

from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.names import SCALAR_JOINTS, near, object_id, object_names

Place = Literal["joint", "actuator", "body", "geom", "world", "sensor"]
#: What an effect acts by; it overrides at least one.
HOOKS = ("write", "act", "command", "observe", "late")
#: So many starts spread over the range of a shape that has two bounds.
SPREAD = 6


@dataclass(frozen=True)
class Scales:
    """What is large where an effect sits, from the data: effects of a like size are looked for.

    :param torque: typical peak generalised force of the joint, N·m or N
    :param velocity: typical peak speed of the joint, rad/s or m/s
    :param command: typical peak command of the actuator, in its units
    :param inertia: the joint's inertia, kg·m² or kg
    :param span: range of positions seen, rad or m
    :param mass: mass of the body, or of all bodies, kg
    """

    torque: float = 1.0
    velocity: float = 1.0
    command: float = 1.0
    inertia: float = 1.0
    span: float = 1.0
    mass: float = 1.0


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    :param name: short name, e.g. ``"level"``
    :param unit: SI unit
    :param size: a plausible small size, where screening looks: a number or a function of :class:`Scales`
    :param lower: smallest value
    :param upper: largest value
    :param null: value at which the effect does nothing; for a shape parameter (any value does) where a fit starts
    :param shape: True when the parameter means nothing while the others are at their null values
    :param starts: where a fit may start as well, in sizes from the null; default: :meth:`spread` for a shape, else
        none. At the null a shape may hide what the others do, and a limit that nothing reaches does nothing
    :param own: field of the model that it adds to, e.g. ``"dof_damping"`` or ``"opt.density"``: values may go below
        ``lower`` by what the model has there, for a target that has less of it
    """

    name: str
    unit: str
    size: float | Callable[[Scales], float]
    lower: float = -np.inf
    upper: float = np.inf
    null: float = 0.0
    shape: bool = False
    starts: tuple[float, ...] = ()
    own: str = ""

    def size_for(self, scales: Scales) -> float:
        """:attr:`size` where things are as large as ``scales`` says."""
        return float(self.size(scales) if callable(self.size) else self.size)

    def starts_for(self, size: float) -> list[float]:
        """Values other than the null where a fit may start, within the bounds.

        :param size: see :meth:`size_for`
        """
        if not self.starts and self.shape:
            return self.spread(size)
        return [float(np.clip(self.null + start * size, self.lower, self.upper)) for start in self.starts]

    def spread(self, size: float) -> list[float]:
        """Values over the range of a shape: even ones between two bounds, tenfold either way above one, else in sizes.

        :param size: see :meth:`size_for`
        """
        if np.isfinite(self.upper - self.lower):
            share = (np.arange(SPREAD) + 0.5) / SPREAD
            return [float(value) for value in self.lower + share * (self.upper - self.lower)]
        ways = 10.0 ** np.array([-1.5, -1.0, -0.5, 0.5, 1.0])
        if self.lower >= 0 and self.null > 0:
            return [float(value) for value in self.null * ways if value > self.lower]
        return [
            float(np.clip(self.null + sign * way * size, self.lower, self.upper))
            for way in (1.0, 3.0, 10.0)
            for sign in (-1, 1)
        ]


class Effect:
    """Something that a simulation may lack, at one place, with parameters that make it vanish at their null values.

    A subclass states ``kind``, ``place``, ``parameters`` and ``equation`` and overrides one hook: :meth:`write` (a
    field of the model), :meth:`act` (a force or dry friction in every substep), :meth:`command` (on the signal
    before the actuators), :meth:`observe` or :meth:`late` (on the sensors). Each hook works on ``n`` simulations at
    once; ``x`` is (n, p), the parameters of each. ``act`` and ``command`` need no more than NumPy.

    :param on: name of the object it sits on, as in the MJCF; none for ``place = "world"``
    :param values: parameters by name; those not given are at their null value
    :raises ValueError: unknown parameters, or values outside the bounds
    """

    kind: ClassVar[str]
    place: ClassVar[Place]
    parameters: ClassVar[tuple[Parameter, ...]]
    equation: ClassVar[str]
    #: MJCF attribute that holds it in a saved model; empty: the wrapper carries it
    native: ClassVar[str] = ""
    #: what sort of experiment would excite it, for "not excited" findings
    excite: ClassVar[str] = "larger and faster motion"
    #: declared parameters of the same object that are the same number, e.g. ``("damping",)``
    same: ClassVar[tuple[str, ...]] = ()
    #: whether it is looked for in a machine's data: else only where it is named, or in a simulator's exact states
    offered: ClassVar[bool] = True
    #: where in the chain of command effects it stands; smaller is nearer the controller. Of forces: smaller acts first
    order: ClassVar[int] = 0
    #: whether what :meth:`act` adds to ``world.force``, alone, at the beginning of a step of the environment acts until
    #: its end
    held: ClassVar[bool] = False
    #: whether :meth:`act` reads ``world.actuation``, which costs an evaluation in every substep
    asks_simulator: bool = False
    #: whether the model has it from the start: fitted like the others, and nothing asks whether it is needed
    known: bool = False
    #: of a late command: whether an environment's episodes begin as if zeros had been sent before, as where a reset
    #: empties a queue of commands; else as if the first command had held
    idle: bool = False

    def __init__(self, on: str = "", **values: float) -> None:
        names = [p.name for p in self.parameters]
        for name in values:
            if name not in names:
                raise ValueError(f"{self.kind} has no parameter {name!r}; {near(name, names)}")
        self.on = on
        self.values = np.array([float(values.get(p.name, p.null)) for p in self.parameters])
        for p, value in zip(self.parameters, self.values):
            if not (-np.inf if p.own else p.lower) <= value <= p.upper:
                raise ValueError(f"{self.kind}: {p.name}={value:g} {p.unit} is outside [{p.lower:g}, {p.upper:g}]")

    @property
    def label(self) -> str:
        """``kind(object)``, unique among the effects of a model."""
        return f"{self.kind}({self.on})" if self.on else self.kind

    def __repr__(self) -> str:
        values = ", ".join(f"{p.name}={v:.4g} {p.unit}".rstrip() for p, v in zip(self.parameters, self.values))
        return f"{self.label}: {values}"

    def with_values(self, values: np.ndarray) -> Effect:
        """The same effect with other parameters, (p,), clipped to their bounds."""
        low, high = zip(*((-np.inf if p.own else p.lower, p.upper) for p in self.parameters))
        clipped = np.clip(values, low, high)
        made = type(self)(self.on, **{p.name: float(v) for p, v in zip(self.parameters, clipped)})
        made.idle = self.idle
        return made

    @property
    def does_nothing(self) -> bool:
        """Whether all parameters but those of shape are at their nulls."""
        return all(value == p.null for p, value in zip(self.parameters, self.values) if not p.shape)

    def as_known(self) -> Effect:
        """The same effect, :attr:`known` to be there: its nulls are its values, where fits begin.

        :raises ValueError: with these values it does nothing
        """
        if self.does_nothing:
            raise ValueError(f"known: {self!r} does nothing; give the values that are known, or leave it to the search")
        made = self.with_values(self.values)
        made.known = True
        made._begin_at(self.values)
        return made

    def _begin_at(self, nulls: Sequence[float] | np.ndarray) -> None:
        self.parameters = tuple(  # type: ignore[misc]
            replace(p, null=float(null)) for p, null in zip(type(self).parameters, nulls)
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without the parameters of a known effect, the class's with other nulls: their sizes are functions."""
        if not self.known:
            return dict(vars(self))
        kept = {name: value for name, value in vars(self).items() if name != "parameters"}
        return {**kept, "nulls": [p.null for p in self.parameters]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        nulls = state.pop("nulls", None)
        vars(self).update(state)
        if nulls is not None:
            self._begin_at(nulls)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Names of the objects of ``model`` on which the effect can sit."""
        if cls.place == "world":
            return [""]
        if cls.place in ("joint", "sensor"):
            names = object_names(model, "joint")
            return [names[i] for i in range(model.njnt) if model.jnt_type[i] in SCALAR_JOINTS]
        if cls.place == "body":
            names = object_names(model, "body")
            return [names[i] for i in range(model.nbody) if model.body_weldid[i] and model.body_mass[i] > 0]
        names = object_names(model, cls.place)
        if cls.place == "actuator":
            return [names[i] for i in range(model.nactuator) if model.actuator_ctrlnum[i] == 1]
        return names

    def bind(self, model: mujoco.MjModel) -> None:
        """Look up the ids of the place: ``self.dof`` and ``self.adr`` of a joint, ``self.index`` of anything.

        :raises ValueError: the model has no such object, the effect cannot sit on it, see :meth:`places`, or it takes
            away more than the model has
        """
        if self.place in ("joint", "sensor"):
            joint = object_id(model, "joint", self.on)
            self.index, self.dof, self.adr = joint, int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        elif self.place != "world":
            self.index = object_id(model, self.place, self.on)
        if self.place == "actuator":
            self._ctrl = int(model.actuator_ctrladr[self.index])
        # Which geoms touch, and whether there is a fluid or gravity, follows from numbers that other effects change.
        if self.place not in ("geom", "world") and self.on not in self.places(model):
            raise ValueError(f"{self.kind} cannot sit on {self.place} {self.on!r}: {self.why_not(model)}")
        for p, value, lowest in zip(self.parameters, self.values, self.lowest(model)):
            if value < lowest - 1e-9 * abs(lowest):
                raise ValueError(
                    f"{self.label}: {p.name}={value:g} {p.unit} takes away more than the model has; "
                    f"give {lowest:g} or more"
                )

    def lowest(self, model: mujoco.MjModel) -> np.ndarray:
        """Smallest values of the parameters in a model that it is bound to, (p,): see ``own`` of :class:`Parameter`."""
        return np.array([p.lower - (self._has(model, p.own) if p.own else 0.0) for p in self.parameters])

    def _has(self, model: mujoco.MjModel, field: str) -> float:
        if field.startswith("opt."):
            return float(getattr(model.opt, field.removeprefix("opt.")))
        return float(getattr(model, field)[self.dof if field.startswith("dof_") else self.index])

    @property
    def ctrl(self) -> int:
        """Address of the actuator's command in ``ctrl``, which is its id unless actuators take several."""
        return int(vars(self).get("_ctrl", self.index))

    def why_not(self, model: mujoco.MjModel) -> str:
        """What to say of an object that :meth:`places` leaves out."""
        places = self.places(model)
        return f"it can on {', '.join(places[:12])}{' …' if len(places) > 12 else ''}" if places else "it can on none"

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Change fields of the model, once before a rollout."""

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to ``world.force`` or ``world.friction``, before every substep."""

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """What the actuator receives instead of the command ``u`` (n,), every substep of ``dt`` s.

        :param memory: of this effect, empty before the first step; with delays the past is kept here
        """
        return u

    def observe(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the joint's sensor shows of its position and velocity, all (n, ...) along leading axes."""
        return q, v

    def unobserve(self, q: np.ndarray, v: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of :meth:`observe`."""
        return q, v

    def memory_at_reset(self, x: np.ndarray, dt: float) -> dict[str, Any]:
        """The memory of :meth:`command` at the beginning of an episode, for parameters (n, p)."""
        memory: dict[str, Any] = {}
        if self.idle:
            self.command(np.zeros(len(x)), x, memory, dt)
        return memory

    def late(self, x: np.ndarray) -> np.ndarray:
        """How old in s, (...,) of ``x`` (..., p), what the joint's sensor shows is: position and velocity of then.

        Another effect's :meth:`observe` on the same joint acts on what is shown late.
        """
        return np.zeros(x.shape[:-1])

    @property
    def senses(self) -> bool:
        """Whether the effect is on a sensor."""
        return self.overrides("observe") or self.overrides("late")

    @property
    def remembers(self) -> bool:
        """Whether what it does follows from more than the present state and command, as with delays."""
        memory: dict[str, Any] = {}
        if self.overrides("command"):
            self.command(np.zeros(1), self.values[None], memory, 1e-3)
        return bool(memory) or self.overrides("late")

    def overrides(self, hook: str) -> bool:
        """Whether the effect acts by ``hook``."""
        return getattr(type(self), hook) is not getattr(Effect, hook)

    def to_json(self) -> dict[str, Any]:
        """Kind, place and values, from which :func:`from_json` makes it again bit for bit."""
        values = dict(zip([p.name for p in self.parameters], self.values))
        return {"kind": self.kind, "on": self.on, "values": values, **({"idle": True} if self.idle else {})}


#: Every known effect by kind; :func:`register` adds to it.
LIBRARY: dict[str, type[Effect]] = {}


def register(effect: type[Effect]) -> type[Effect]:
    """Class decorator: add an effect to the library, so that :func:`sb3_rpto.sysid.trace` looks for it.

    :raises ValueError: the class lacks an attribute, one does not fit, it overrides no hook, or another effect has its
        kind
    """
    for attribute in ("kind", "place", "parameters", "equation"):
        if not hasattr(effect, attribute):
            raise ValueError(f"{effect.__name__} needs a class attribute {attribute!r}; see Effect")
    known = LIBRARY.get(effect.kind)
    names = [(cls.__module__, cls.__qualname__) for cls in (known, effect) if cls is not None]
    if len({*names}) > 1:  # a class that is defined again, as in a notebook, takes the place of the old one
        raise ValueError(f"there is an effect {effect.kind!r} already ({'.'.join(names[0])}); choose another kind")
    if not (isinstance(effect.kind, str) and effect.kind.isidentifier()):
        raise ValueError(f"{effect.__name__}: kind is {effect.kind!r}; give a name of letters, digits and underscores")
    if effect.place not in get_args(Place):
        raise ValueError(f"{effect.__name__}: place is {effect.place!r}; choose one of {', '.join(get_args(Place))}")
    if not effect.parameters or not all(isinstance(p, Parameter) for p in effect.parameters):
        raise ValueError(f"{effect.__name__}: parameters is {effect.parameters!r}; give a tuple of Parameter")
    if all(getattr(effect, hook) is getattr(Effect, hook) for hook in HOOKS):
        raise ValueError(f"{effect.__name__} does nothing; override one of {', '.join(HOOKS)}")
    if (effect.observe is Effect.observe) != (effect.unobserve is Effect.unobserve):
        raise ValueError(f"{effect.__name__}: observe and its inverse, unobserve, go together; override both")
    parameters = [p.name for p in effect.parameters]
    if len({*parameters}) < len(parameters):
        raise ValueError(f"{effect.__name__}: parameters have the names {', '.join(parameters)}; give each its own")
    for p in effect.parameters:
        if not callable(p.size) and not p.size > 0:
            raise ValueError(f"{effect.__name__}: size of {p.name} is {p.size}; give a plausible small one, above 0")
    LIBRARY[effect.kind] = effect
    return effect


def from_json(stored: Mapping[str, Any]) -> Effect:
    """The effect that :meth:`Effect.to_json` described.

    :raises TypeError: it is no description
    :raises ValueError: no effect of that kind is registered, or the description is not whole
    """
    if not isinstance(stored, Mapping):
        raise TypeError(f"{stored!r} is no description of an effect; pass what its to_json() returns")
    lacks = {"kind", "on", "values"} - set(stored)
    if lacks:
        raise ValueError(
            f"{dict(stored)!r} describes no effect: it lacks {', '.join(sorted(lacks))}; see Effect.to_json"
        )
    if stored["kind"] not in LIBRARY:
        raise ValueError(f"no effect {stored['kind']!r} is registered; {near(stored['kind'], LIBRARY)}")
    made = LIBRARY[stored["kind"]](stored["on"], **stored["values"])
    made.idle = bool(stored.get("idle", False))
    return made
