"""Gymnasium's MuJoCo environments with a shift in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_rpto.effects.declared import Declared
from sb3_rpto.effects.effect import Effect, from_json
from sb3_rpto.effects.stance import Stance, StandingEnv
from sb3_rpto.effects.wrapper import CorrectedEnv, with_numbers
from sb3_rpto.envs.shifts import EnvShift, as_shift, number_names


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
        self._stance = Stance(base)
        CorrectedEnv.__init__(self, env, shift_effects(shift, env))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "shift": self.shift}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ShiftedEnv.__init__(self, with_numbers(state["env"], state.get("model")), state["shift"])
        self.set_effects(state["effects"])
