"""From a backend's name to a model: what a checkpoint keeps is what rebuilds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.cartpole import CartPoleDynamics, cartpole_constants, is_cartpole
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.residual import ResidualDynamics
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.envs.task_rules import task_rules

BACKENDS = ("ensemble", "physical", "residual")


def dynamics_config(backend: str, env: VecEnv, kwargs: dict[str, Any], declared: Sequence[str] = ()) -> dict[str, Any]:
    """Everything that rebuilds a model of ``env`` without ``env``: plain, picklable data.

    :param backend: "ensemble", "physical" or "residual"
    :param env: the source environment
    :param kwargs: the user's arguments of the backend; a ``reward_fn`` or ``termination_fn`` among them replaces what
        is known of the task
    :param declared: names of the physical parameters to fit
    :raises ValueError: for an unknown backend, a physical model of an environment that has none, declared parameters
        of an ensemble
    """
    if backend == "ensemble":
        if declared:
            raise ValueError("declared= names physical parameters; it needs dynamics='physical'")
        return {"backend": backend, **_rules(env), **kwargs}
    if backend in ("physical", "residual"):
        config = {"backend": backend, **_simulator(env, backend)}
        taken = sorted(kwargs.keys() & config.keys())
        if taken:
            raise ValueError(f"dynamics_kwargs={taken} are read off the source environment; leave them out")
        if backend == "residual":
            config |= _rules(env)
        return {**config, **kwargs, **({"declared": tuple(declared)} if declared else {})}
    raise ValueError(f"dynamics={backend!r} does not exist; choose one of {list(BACKENDS)}")


def preset_section(backend: str | None, env: VecEnv | None) -> str:
    """The part of a preset that fits the source's kind.

    :param backend: of the dynamics; None where they are not trained
    :param env: the source; None before it is known
    """
    if backend is None:
        return "real"
    # Fits of our own cart-pole's numbers cost nothing.
    mujoco = backend == "physical" and env is not None and not is_cartpole(env)
    return "mujoco" if mujoco else backend


def _rules(env: VecEnv) -> dict[str, Any]:
    """What is known of the task's rewards and terminations."""
    rules = task_rules(env)
    return {"reward_fn": rules.reward_fn, "termination_fn": rules.termination_fn}


def _simulator(env: VecEnv, backend: str) -> dict[str, Any]:
    """What a physical model must know of the source."""
    if backend == "physical" and is_cartpole(env):
        return {"constants": cartpole_constants(env)}
    try:
        return physical_config(env)
    except ValueError as error:
        raise ValueError(
            f"dynamics={backend!r} cannot simulate env: {error}; without a simulator that can be changed and read, use "
            "dynamics='ensemble'"
        ) from error


def is_mujoco(config: dict[str, Any]) -> bool:
    """Whether a config is that of a MuJoCo simulator."""
    return "mj_model" in config


def make_dynamics(config: dict[str, Any], observation_space: spaces.Box, action_space: spaces.Box) -> Dynamics:
    """Build the model that :func:`dynamics_config` described."""
    arguments = dict(config)
    physical = PhysicalDynamics if is_mujoco(config) else CartPoleDynamics
    classes: dict[str, Any] = {"ensemble": EnsembleDynamics, "residual": ResidualDynamics, "physical": physical}
    made_by = classes[arguments.pop("backend")]
    try:
        return made_by(observation_space, action_space, **arguments)
    except TypeError as error:
        raise ValueError(f"dynamics_kwargs: {error}; see {made_by.__name__} for what there is") from error
