"""From a backend's name to a model: what a checkpoint keeps is what rebuilds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.cartpole import CartPoleDynamics, cartpole_constants
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.envs.rules import task_rules

BACKENDS = ("ensemble", "physical")


def dynamics_config(backend: str, env: VecEnv, kwargs: dict[str, Any], declared: Sequence[str] = ()) -> dict[str, Any]:
    """Everything that rebuilds a model of ``env`` without ``env``: plain, picklable data.

    :param backend: "ensemble" or "physical"
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
        rules = task_rules(env)
        known = {"reward_fn": rules.reward_fn, "termination_fn": rules.termination_fn}
        return {"backend": backend, **known, **kwargs}
    if backend == "physical":
        try:
            constants = cartpole_constants(env)
        except ValueError as error:
            raise ValueError(
                "dynamics='physical' simulates ContinuousCartPole alone in this version, env is another; "
                "use dynamics='ensemble'"
            ) from error
        config = {"backend": backend, "constants": constants, **kwargs}
        return {**config, "declared": tuple(declared)} if declared else config
    raise ValueError(f"dynamics={backend!r} does not exist; choose one of {list(BACKENDS)}")


def make_dynamics(config: dict[str, Any], observation_space: spaces.Box, action_space: spaces.Box) -> Dynamics:
    """Build the model that :func:`dynamics_config` described."""
    arguments = dict(config)
    classes: dict[str, Any] = {"ensemble": EnsembleDynamics, "physical": CartPoleDynamics}
    try:
        return classes[arguments.pop("backend")](observation_space, action_space, **arguments)
    except TypeError as error:
        raise ValueError(
            f"dynamics_kwargs: {error}; see {classes[config['backend']].__name__} for what there is"
        ) from error
