"""Corrected copies of environments."""

from collections.abc import Sequence

import gymnasium as gym

from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.stance import StandingEnv
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.copies import copy_env


def apply_effects(env: gym.Env, effects: Sequence[Effect]) -> CorrectedEnv:
    """A copy of ``env`` with effects, for RPTO, SAC or anything; ``env`` is left alone.

    The copy goes on from where ``env`` and its random numbers are: give several copies seeds of their own, as
    ``make_vec_env`` does, or their episodes begin alike.

    :param env: a gymnasium MuJoCo environment, with all its wrappers; the copy draws no pictures and writes no files
        (for those ``StandingEnv(gym.make(..., render_mode=...), effects)`` of :mod:`sb3_rpto.effects.stance`)
    :param effects: with their values; they come on top of those that ``env`` has already
    :raises TypeError: a VecEnv
    :raises ValueError: no gymnasium MuJoCo environment, or one that cannot be copied
    """
    if not isinstance(env, gym.Env):
        raise TypeError(
            f"env must be a gymnasium environment, not {type(env).__name__}; correct those of a VecEnv before "
            "make_vec_env stacks them; of an MJCF file save the report, its model.xml is the corrected one"
        )
    twin = copy_env(env)
    if twin is None:
        raise ValueError(
            f"{env} holds what cannot be copied; make a new one and wrap it: "
            "sb3_rpto.effects.stance.StandingEnv(gym.make(...), effects)"
        )
    return StandingEnv(twin, effects)
