"""Whether a gymnasium MuJoCo environment is what a physical model fits, and what that must know of it."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import ClipAction
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.model_numbers import differing
from sb3_rpto.effects.wrapper import beyond_model, stepped_by
from sb3_rpto.envs.observations import (
    StateMap,
    env_name,
    layers,
    mujoco_model,
    single_env,
    state_map,
    strange_wrapper,
)
from sb3_rpto.envs.step_fidelity import drawn_numbers, draws_unseeded, odd_memory, odd_state, odd_step


def physical_config(env: gym.Env | VecEnv) -> dict[str, Any]:
    """What :class:`~sb3_rpto.dynamics.physical.PhysicalDynamics` must know of an environment; plain data that pickles.

    :param env: with all its wrappers; of a VecEnv the first
    :raises ValueError: as :func:`check_source`
    """
    recover = check_source(env)
    single: Any = single_env(env)
    if draws_unseeded(single):
        warnings.warn(
            f"{env_name(single)}: reset(seed=...) does not decide where an episode begins, so that the copies that the "
            "policy learns and is judged in all begin alike; draw from self.np_random in reset_model()",
            stacklevel=2,
        )
    spec, model = load_model(single)[0], mujoco_model(single)
    plain = model.__copy__() if spec is None else PlainModel.of(spec, model)  # nothing tells the MJCF of some
    return {"mj_model": plain, "recover": recover, "frame_skip": int(single.unwrapped.frame_skip)}


def check_source(env: gym.Env | VecEnv) -> StateMap:
    """Require that an environment does what its model and phi do, and nothing else; the map to its states.

    :param env: with all its wrappers; of a VecEnv the first
    :raises ValueError: no MuJoCo model, or none of gymnasium's environments around it, states that cannot be recovered
        from observations or are not what these are read as, actions that are not the commands of the actuators, steps
        that are more than their simulation, several models
    """
    single = single_env(env)
    mujoco_model(single)  # what is no MuJoCo task is told first
    stepped_by(single)
    recover = state_map(single)
    check_commands(single, "dynamics='physical'")
    check_alike(env)
    hidden = beyond_model(single)
    if hidden:
        raise ValueError(
            f"{env_name(single)} has effects that are no numbers of its model ({', '.join(hidden)}), which phi would "
            "lack, or have twice; give the environment without them, and them as dynamics_kwargs={'effects': [...]} (a "
            "closed loop takes them for known)"
        )
    lacking = [name for name in ("frame_skip", "dt") if not hasattr(single.unwrapped, name)]
    if lacking:
        raise ValueError(f"{env_name(single)} has no {lacking[0]}; derive it from gymnasium.envs.mujoco.MujocoEnv")
    drawn = drawn_numbers(single)
    if drawn:
        raise ValueError(
            f"{env_name(single)}: reset() draws {', '.join(drawn[:3])}, and what it writes undoes phi; let its model "
            "stay, and give dynamics_kwargs={'randomise': 1.0} for episodes that differ"
        )
    check_step(single, int(single.unwrapped.frame_skip))  # type: ignore[attr-defined]
    check_states(single, recover)
    return recover


def check_memoryless(env: gym.Env, recover: StateMap) -> None:
    """Require that the answer to a single step follows from the observation before it.

    :param env: a MuJoCo environment with all its wrappers; untouched
    :param recover: states from its observations
    :raises ValueError: an observation or a reward that tells of something else
    """
    found = odd_memory(env, recover)
    if found is not None:
        raise ValueError(
            f"{env_name(env)}: after a step {found} depends on more than the state before it (a goal that is drawn at "
            "a reset, an action before, the time?), which single steps from recorded states would lack; make it a part "
            "of the model that is observed, or use dynamics='physical' without weighting='value_aware', which "
            "simulates whole episodes, or dynamics='ensemble'"
        )


def check_commands(env: gym.Env, what: str) -> None:
    """Require that actions are the commands of the actuators.

    :param env: a MuJoCo environment with all its wrappers
    :param what: needs it, for the message
    :raises ValueError: actions of another shape than the model's commands, wrappers that change them
    """
    model = mujoco_model(env)
    if env.action_space.shape != (model.nu,):
        raise ValueError(
            f"{env_name(env)}: actions have shape {env.action_space.shape}, the model {model.nu} actuators; "
            f"{what} needs actions that are the commands of the actuators"
        )
    for layer in layers(env)[:-1]:
        # Clipping is what the actuators do themselves.
        if isinstance(layer, gym.ActionWrapper) and not isinstance(layer, ClipAction):
            raise ValueError(
                f"{env_name(env)}: the wrapper {type(layer).__name__} changes actions, and {what} needs those that "
                "are the commands of the actuators; give it an environment without"
            )


def check_alike(env: gym.Env | VecEnv) -> None:
    """Require that all environments of a VecEnv simulate one model: phi is the numbers of one.

    :raises ValueError: models that differ
    """
    members = env.unwrapped.envs if isinstance(env, VecEnv) and isinstance(env.unwrapped, DummyVecEnv) else []
    models = [mujoco_model(member) for member in members]
    for other in models[1:]:
        found = differing(models[0], other)
        if found:
            raise ValueError(
                f"its environments simulate different models ({', '.join(found[:3])}), and phi is the numbers of "
                "one; give one environment, and dynamics_kwargs={'randomise': 1.0} for episodes that differ"
            )


def check_step(env: gym.Env, frame_skip: int) -> None:
    """Require that a step of the environment is the simulation of its action, and nothing else.

    A task that scales actions in ``step()``, say, would have its scaling counted as error of the model. What cannot
    be copied is refused later.

    :param env: a MuJoCo environment with all its wrappers; untouched
    :param frame_skip: simulation steps in one step of it
    :raises ValueError: other commands or another motion
    """
    found = odd_step(env, frame_skip)
    if found is not None:
        raise ValueError(
            f"{env_name(env)}: step() {found}, and phi would make up for what step() adds; let actions be the "
            "commands of the actuators, and forces part of the MJCF or an effect (dynamics_kwargs={'effects': [...]})"
        )


def check_states(env: gym.Env, recover: StateMap) -> None:
    """Require that the states behind the observations are those of the simulation; what cannot be copied passes.

    :param env: a MuJoCo environment with all its wrappers; untouched
    :param recover: states from its observations
    :raises ValueError: a coordinate that is another one, or in other units
    """
    found = odd_state(env, recover)
    if found is not None:
        strange = strange_wrapper(env)
        raise ValueError(
            f"{env_name(env)}: {found}; correct the map that register_state_map was given (order of joints, positions "
            "before velocities, signs, radians)"
            + ("" if strange is None else f", or give env without the wrapper {strange}, which changes observations")
        )
