"""What the two worlds' environments must satisfy; every error names the argument and the remedy."""

from __future__ import annotations

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.envs.env_snapshot import accepts_seed
from sb3_rpto.envs.observations import layers

#: They scale by what their own world has shown so far.
NORMALISERS = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse what the algorithms are not written for.

    :raises NotImplementedError: for observations or actions that are not a flat Box
    """
    if not isinstance(observation_space, spaces.Box) or is_image_space(observation_space):
        raise NotImplementedError(
            f"env has the observation space {observation_space}; only flat Box observations are supported "
            "(wrap a Dict in gymnasium.wrappers.FlattenObservation)"
        )
    if len(observation_space.shape) != 1:
        raise NotImplementedError(
            f"env has observations of shape {observation_space.shape}; flatten them with "
            "gymnasium.wrappers.FlattenObservation"
        )
    if not isinstance(action_space, spaces.Box):
        raise NotImplementedError(
            f"env has the action space {action_space}; only continuous (Box) actions are supported"
        )
    if len(action_space.shape) != 1:
        raise NotImplementedError(
            f"env has actions of shape {action_space.shape}; only flat ones are supported (let a "
            "gymnasium.wrappers.TransformAction with a flat Box reshape them for the environment)"
        )


def check_pair(source: VecEnv, target: VecEnv) -> None:
    """Refuse a target that cannot be the source's target.

    :raises ValueError: for the same environment object, unequal spaces, or statistics of one world alone
    """
    if members(source) & members(target):
        raise ValueError("target_env is env: both worlds would step the same object; build a second environment")
    for name, world in (("env", source), ("target_env", target)):
        found = [x for env in _inside(world) for x in layers(env) if isinstance(x, NORMALISERS)]
        if found:
            raise ValueError(
                f"{name} is in gymnasium's {type(found[0]).__name__}, whose statistics are each world's own and drift; "
                "wrap env (the source) in stable_baselines3's VecNormalize instead, the target then shares its "
                "statistics"
            )
    for name in ("observation_space", "action_space"):
        of_source, of_target = getattr(source, name), getattr(target, name)
        if of_source != of_target:
            raise ValueError(
                f"target_env has {name} {of_target}, env has {of_source}; source and target must share their spaces"
            )


def check_environment(env: gym.Env | VecEnv, name: str) -> None:
    """Refuse what is no environment, and one that cannot be reset with a seed.

    :raises TypeError: naming the argument
    :raises ValueError: naming the argument
    """
    if not isinstance(env, gym.Env | VecEnv):
        raise TypeError(
            f"{name} must be a gymnasium environment, a VecEnv or an id, not {type(env).__name__}; call what makes "
            "one, stack several by make_vec_env, and pass recordings as target_data="
        )
    if isinstance(env, gym.Env) and not accepts_seed(env):
        raise ValueError(
            f"{name}: reset() of {env} takes no seed=; give it the signature reset(self, *, seed=None, options=None)"
        )


def members(venv: VecEnv) -> set[int]:
    """Identities of the environments that a VecEnv steps; its own where they are in other processes."""
    return {id(env.unwrapped) for env in _inside(venv)} or {id(venv.unwrapped)}


def _inside(venv: VecEnv) -> list[gym.Env]:
    """The environments that are in this process."""
    return list(getattr(venv.unwrapped, "envs", []))
