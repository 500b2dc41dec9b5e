"""What distinguishes a target from its source: a named, seeded, printable set of factors and effects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_rpto.effects.declared import Declared, declare
from sb3_rpto.effects.effect import Effect, from_json
from sb3_rpto.effects.walker_reset import StandingEnv, WalkerReset
from sb3_rpto.effects.wrapper import CorrectedEnv, with_numbers
from sb3_rpto.envs.cartpole import ContinuousCartPoleEnv
from sb3_rpto.envs.differences import Difference, differs
from sb3_rpto.envs.env_copy import CopyError, must_copy

__all__ = ["Difference", "EnvShift", "ShiftedCartPole", "differs"]


@dataclass(frozen=True)
class EnvShift:
    """Factors on an environment's numbers, and effects that it lacks.

    >>> shift = EnvShift("slippery", {"*.friction": 0.5})
    >>> target = shift.apply(gym.make("HalfCheetah-v5"))

    It holds plain data only, so that it pickles, compares, and is part of an environment's spec. Numbers are named as
    :func:`sb3_rpto.effects.declare` names them, shell wildcards included; those of the cart-pole are the fields of
    :class:`~sb3_rpto.envs.cartpole.CartPoleParameters`.

    A walker that a shift has made taller or smaller stands at reset as it did before; see
    :class:`~sb3_rpto.effects.walker_reset.WalkerReset`.

    :param name: what it is called
    :param factors: of numbers by name, each > 0; where two names mean one number, both count
    :param effects: of the library, with their values (or their ``to_json()``); they come on top
    :param seed: what the factors were drawn from; None: they were not drawn
    :raises ValueError: a factor that is not a positive finite number
    """

    name: str
    factors: Mapping[str, float] = field(default_factory=dict)
    effects: Sequence[Effect | Mapping[str, Any]] = ()
    seed: int | None = None

    def __post_init__(self) -> None:
        for name, factor in self.factors.items():
            if not (math.isfinite(factor) and factor > 0):
                raise ValueError(f"{self.name}: the factor of {name} must be positive and finite, not {factor!r}")
        object.__setattr__(self, "factors", {name: float(factor) for name, factor in self.factors.items()})
        object.__setattr__(self, "effects", list(map(_as_json, self.effects)))

    @classmethod
    def draw(
        cls, env: gym.Env, names: Sequence[str], seed: int, *, low: float = 0.8, high: float = 1.2, name: str = ""
    ) -> EnvShift:
        """A factor from U(low, high) for each number, rounded to four digits.

        :param env: the source, for what the names stand for
        :param names: of its numbers, wildcards included
        :param seed: the same seed draws the same factors
        :param low: smallest factor, > 0
        :param high: largest factor
        :param name: default: ``target<seed>``
        :raises ValueError: unknown names (the near ones are said), or bounds the wrong way round
        """
        if not 0 < low < high:
            raise ValueError(f"low and high must be 0 < low < high, not {low!r} and {high!r}")
        labels = number_names(env, names)
        # The names too, or the first links of all tasks would have the same factors.
        rng = np.random.default_rng([seed, *" ".join(labels).encode()])
        drawn = rng.uniform(low, high, len(labels)).round(4)
        return cls(name or f"target{seed}", dict(zip(labels, drawn.tolist())), seed=seed)

    def apply(self, env: gym.Env) -> gym.Env:
        """A shifted copy of ``env``, which is left alone; as from ``report.apply``, the copy draws no pictures.

        :param env: a gymnasium MuJoCo environment or a cart-pole, with all its wrappers and effects
        :raises TypeError: a VecEnv
        :raises ValueError: one of neither kind, one that cannot be copied, or names that it does not have
        """
        if not isinstance(env, gym.Env):
            raise TypeError(f"env must be a gymnasium environment, not {type(env).__name__}; shift each one before")
        try:
            return self.wrap(must_copy(env))
        except CopyError as error:
            raise ValueError(f"{env} cannot be copied ({error}); or use shift.wrap(gym.make(...))") from error

    def wrap(self, env: gym.Env) -> gym.Env:
        """``env`` itself, shifted: its innermost environment has the target's numbers from now on.

        :param env: as in :meth:`apply`; what it renders is the target
        """
        if isinstance(env.unwrapped, ContinuousCartPoleEnv):
            return ShiftedCartPole(env, self)
        return ShiftedEnv(env, self)

    def __str__(self) -> str:
        head = self.name if self.seed is None else f"{self.name} (seed {self.seed})"
        lines = [f"  {name} × {factor:g}" for name, factor in self.factors.items()]
        for effect in self.effects:
            values = ", ".join(f"{name}={value:g}" for name, value in effect["values"].items())  # type: ignore[index]
            lines.append(f"  {effect['kind']}({effect['on']}): {values}")  # type: ignore[index]
        return "\n".join([head, *lines])


def _as_json(effect: Effect | Mapping[str, Any]) -> dict[str, Any]:
    stored = dict(effect if isinstance(effect, Mapping) else effect.to_json())
    if stored["kind"] == "declared":
        raise ValueError(f"{next(iter(stored['values']))} is a number of the model: give its factor, not an effect")
    return {**stored, "values": {name: float(value) for name, value in stored["values"].items()}}


def as_shift(shift: EnvShift | Mapping[str, Any]) -> EnvShift:
    """The shift itself, or the one that a mapping of its fields describes (a spec that was JSON)."""
    return shift if isinstance(shift, EnvShift) else EnvShift(**shift)


def number_names(env: gym.Env, names: Sequence[str]) -> list[str]:
    """The numbers of an environment that ``names`` stand for, one by one, each once.

    :param env: a gymnasium MuJoCo environment or a cart-pole
    :param names: with wildcards, which stand for no number that is 0: it cannot be scaled
    :raises ValueError: names that match nothing
    """
    base: Any = env.unwrapped
    if not isinstance(base, ContinuousCartPoleEnv):
        return [number.label for number in declare(base.model, names) if number.nominal or number.label in names]
    known = vars(base.parameters)
    unknown = sorted(set(names) - known.keys())
    if unknown:
        raise ValueError(f"the cart-pole has no {', '.join(unknown)}; it has {', '.join(known)}")
    return list(dict.fromkeys(names))


class ShiftedCartPole(gym.Wrapper, RecordConstructorArgs):
    """A cart-pole with other constants, which its innermost environment has from now on.

    :param env: a :class:`~sb3_rpto.envs.cartpole.ContinuousCartPoleEnv` with its wrappers
    :param shift: factors of its constants
    :raises ValueError: constants that it does not have, factors that lead out of their range, effects
    """

    state_attributes: ClassVar[tuple[str, ...]] = ()  # for save_state: it never changes

    def __init__(self, env: gym.Env, shift: EnvShift | Mapping[str, Any]) -> None:
        shift = as_shift(shift)
        RecordConstructorArgs.__init__(self, shift=asdict(shift))
        gym.Wrapper.__init__(self, env)
        self.shift = shift
        if shift.effects:
            raise ValueError(f"{shift.name}: effects act in MuJoCo's simulations, not in the cart-pole")
        base: Any = self.unwrapped
        number_names(env, list(shift.factors))
        base.scale(shift.factors)


def shift_effects(shift: EnvShift, env: gym.Env) -> list[Effect]:
    """What a shift does to a MuJoCo environment: declared numbers with other values, and effects.

    :raises ValueError: names that the model does not have, numbers that are 0
    """
    model = env.unwrapped.model  # type: ignore[attr-defined]
    scaled: dict[tuple[str, int, str], Declared] = {}  # one number may be called by several names
    for name, factor in shift.factors.items():
        for label in number_names(env, [name]):
            number = Declared(model, label, (-np.inf, np.inf))
            number = scaled.get(number.number, number)
            if number.nominal == 0:
                raise ValueError(f"{shift.name}: {label} is 0 in the model, so it cannot be scaled; give an effect")
            scaled[number.number] = number.with_values(number.values * factor)
    return [*scaled.values(), *map(from_json, shift.effects)]  # type: ignore[arg-type]


class ShiftedEnv(StandingEnv):
    """A gymnasium MuJoCo environment with a shift.

    :param env: one whose innermost environment has MuJoCo's ``model`` and ``data`` and steps them by ``do_simulation``;
        with effects or not
    :param shift: factors and effects, relative to ``env`` as it is
    :raises ValueError: no MuJoCo environment, names that its model does not have
    """

    def __init__(self, env: gym.Env, shift: EnvShift | Mapping[str, Any]) -> None:
        shift = as_shift(shift)
        RecordConstructorArgs.__init__(self, shift=asdict(shift))  # plain data, for specs as JSON
        self.shift = shift
        base: Any = env.unwrapped
        if not isinstance(getattr(base, "model", None), mujoco.MjModel):
            raise ValueError(f"{type(base).__name__} is neither a gymnasium MuJoCo environment nor a cart-pole")
        self._walker_reset = WalkerReset(base)
        CorrectedEnv.__init__(self, env, shift_effects(shift, env))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "shift": self.shift}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ShiftedEnv.__init__(self, with_numbers(state["env"], state.get("model")), state["shift"])
        self.set_effects(state["effects"])
