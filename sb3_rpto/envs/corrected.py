"""Corrected copies of environments."""

from collections.abc import Sequence

import gymnasium as gym

from sb3_rpto.effects.effect import LIBRARY, Effect
from sb3_rpto.effects.walker_reset import StandingEnv
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.env_copy import CopyError, copy_env, must_copy


def apply_effects(env: gym.Env, effects: Sequence[Effect]) -> CorrectedEnv:
    """A copy of ``env`` with effects, for RPTO, SAC or anything; ``env`` is left alone.

    The copy goes on from where ``env`` and its random numbers are: give several copies seeds of their own, as
    ``make_vec_env`` does, or their episodes begin alike.

    :param env: a gymnasium MuJoCo environment, with all its wrappers; the copy draws no pictures and writes no files
        (for those ``StandingEnv(gym.make(..., render_mode=...), effects)`` of :mod:`sb3_rpto.effects.walker_reset`)
    :param effects: with their values; they come on top of those that ``env`` has already
    :raises TypeError: a VecEnv
    :raises ValueError: no gymnasium MuJoCo environment, or one that cannot be copied
    """
    if not isinstance(env, gym.Env):
        raise TypeError(
            f"env must be a gymnasium environment, not {type(env).__name__}; correct those of a VecEnv before "
            "make_vec_env stacks them; of an MJCF file save the report, its model.xml is the corrected one"
        )
    try:
        twin = must_copy(env)
    except CopyError as error:
        raise ValueError(
            f"{env} cannot be copied ({error}); or wrap a new one: StandingEnv(gym.make(...), effects)"
        ) from error
    return StandingEnv(twin, effects)


#: Hooks by which effects act in a step of an environment or are seen, with a kind, and its parameter, that shows
#: whether they can.
_HOOKS = ((("act", "command"), "command_delay", "delay"), (("observe", "late"), "sensor_bias", "offset"))


def check_carries(env: gym.Env, kinds: Sequence[str]) -> None:
    """Require that effects of some kinds can act in an environment, before anything is spent on looking for them.

    :param env: a gymnasium MuJoCo environment with all its wrappers, untouched; one that cannot be copied passes
    :param kinds: of effects
    :raises ValueError: it steps or reads its simulation by ways of its own
    """
    for hooks, probe, parameter in _HOOKS:
        needed = [k for k in kinds if any(getattr(LIBRARY[k], hook) is not getattr(Effect, hook) for hook in hooks)]
        twin = copy_env(env) if needed else None
        places = [] if twin is None else LIBRARY[probe].places(twin.unwrapped.model)  # type: ignore[attr-defined]
        if twin is None or not places:
            continue
        twin.action_space.seed(0)
        try:
            tried = CorrectedEnv(twin, [LIBRARY[probe](places[0], **{parameter: 1e-3})])
            tried.reset(seed=0)
            tried.step(twin.action_space.sample())
        except ValueError as error:
            raise ValueError(f"{needed[0]}, for one, could not act in it: {error}") from error
