"""What users pass for the dynamics and the closed loop, looked at before anything expensive."""

from __future__ import annotations

from collections.abc import Collection, Sequence, Set
from typing import Any

import cloudpickle
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.factory import is_mujoco
from sb3_rpto.effects import LIBRARY, from_json
from sb3_rpto.effects.library import given
from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.effects.names import near
from sb3_rpto.envs.corrected import check_carries
from sb3_rpto.envs.observations import single_env
from sb3_rpto.envs.task_rules import misfit


def check_kinds(close_loop: bool | Sequence[str]) -> None:
    """Refuse kinds of effects that no trace can look for.

    :param close_loop: whether, or the kinds of effects to look for
    :raises TypeError: for a single kind, and for what is no kind
    :raises ValueError: for a kind that is not in the library
    """
    if isinstance(close_loop, str):
        raise TypeError(f"close_loop must be True or a list of kinds, not a string; write [{close_loop!r}]")
    if not isinstance(close_loop, bool | Sequence | Set):
        raise TypeError(f"close_loop must be True, False or a list of kinds, not {close_loop!r}; leave it out")
    for kind in [] if isinstance(close_loop, bool) else close_loop:
        if not isinstance(kind, str):
            raise TypeError(
                f"close_loop holds kinds of effects to look for, such as 'coulomb_friction', not {kind!r}; effects "
                "that are known beforehand are dynamics_kwargs={'effects': [...]}"
            )
        if kind not in LIBRARY:
            raise ValueError(f"close_loop: no effect {kind!r} is registered; {near(kind, LIBRARY)}")


def check_backend(
    config: dict[str, Any], close_loop: bool | Sequence[str], traces_log: bool, passed: Collection[str]
) -> None:
    """Refuse what a backend has no use for, or would lose.

    :param config: of the dynamics
    :param close_loop: whether, or the kinds of effects to look for
    :param traces_log: measurements stand in for the target
    :param passed: names of the arguments that the user passed
    :raises ValueError: with the remedy
    """
    if close_loop is not False and not (config["backend"] == "physical" and is_mujoco(config)):
        raise ValueError(
            "close_loop=True traces what a MuJoCo simulator lacks: pass dynamics='physical' and a gymnasium MuJoCo env"
        )
    if config.get("observation_noise") is not None and (close_loop is False or traces_log):
        raise ValueError(
            "dynamics_kwargs['observation_noise'] is for traces of a closed loop on transitions of the target; leave "
            "it out, "
            + (
                "recordings tell their own: Measurements.from_replay(..., noise=...) where it is known"
                if traces_log
                else "or pass dynamics='physical' and close_loop=True on a MuJoCo env"
            )
        )
    if config["backend"] == "physical" and "rollout_start" in passed:
        raise ValueError(
            "rollout_start is for one-step branches; dynamics='physical' simulates whole episodes: leave it out"
        )
    residual = config["backend"] == "residual"
    late = [e.label for e in map(from_json, config.get("effects", ())) if e.remembers] if residual else []
    if late:
        raise ValueError(
            f"dynamics='residual' answers each step from its observation alone, where {', '.join(late)} would be lost; "
            "pass dynamics='physical', which simulates whole episodes"
        )


def check_carried(env: VecEnv, close_loop: bool | Sequence[str]) -> None:
    """Refuse a source in which nothing that a trace may find could act: the target steps would be spent by then.

    :param env: the source, a MuJoCo environment
    :param close_loop: whether, or the kinds of effects to look for
    :raises ValueError: with the remedy
    """
    if close_loop is False:
        return
    kinds = [kind for kind, effect in LIBRARY.items() if effect.offered] if close_loop is True else close_loop
    try:
        check_carries(single_env(env), kinds)
    except ValueError as error:
        raise ValueError(
            f"close_loop={close_loop}: {error}; or pass close_loop=[...] with kinds that are numbers of the model alone"
        ) from error


def check_something_to_fit(config: dict[str, Any], close_loop: bool | Sequence[str], traces_log: bool) -> None:
    """Refuse a MuJoCo simulator without parameters, and those that a trace would refuse after many target steps.

    :param config: of the dynamics
    :param close_loop: whether, or the kinds of effects to look for
    :param traces_log: measurements stand in for the target
    :raises ValueError: with the remedy
    """
    if config["backend"] != "physical" or not is_mujoco(config):
        return
    if close_loop is not False or traces_log:
        model = config["mj_model"]
        compiled = model.compile() if isinstance(model, PlainModel) else model
        given(compiled, config.get("declared", ()), [from_json(stored) for stored in config.get("effects", ())])
    if not close_loop and not config.get("declared") and not config.get("effects"):
        raise ValueError(
            "dynamics='physical' has nothing to fit: pass declared=[...], names of the model's numbers such as "
            "'hinge.damping' or '*.mass', or close_loop=True"
        )


def check_rules(kwargs: dict[str, Any], observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse rules of the user's that answer in another form than the dynamics read.

    :param kwargs: of the dynamics
    :param observation_space: both worlds'
    :param action_space: both worlds'
    :raises ValueError: naming the rule and what it gave
    """
    for name in ("reward_fn", "termination_fn"):
        if kwargs.get(name) is None:
            continue
        try:
            cloudpickle.dumps(kwargs[name])
        except Exception as error:  # whatever an object's own pickling raises
            raise ValueError(
                f"dynamics_kwargs[{name!r}] does not pickle ({error}), and checkpoints hold it; give a function of the "
                "tensors alone"
            ) from error
        found = misfit(kwargs[name], observation_space, action_space)
        if found is not None:
            raise ValueError(
                f"dynamics_kwargs[{name!r}] must answer n observations, actions and next observations by a tensor of "
                f"shape (n,); of two it made {found}"
            )
