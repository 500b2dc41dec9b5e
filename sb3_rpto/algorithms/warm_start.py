"""The SAC that was trained in the source: loaded, and its policy, critics and temperature taken over."""

from __future__ import annotations

import copy
import os
import pathlib
import warnings
from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import GymEnv

from sb3_rpto.algorithms import model_zip
from sb3_rpto.algorithms.interfaces import Agent

#: Options of an optimizer that do not decide what it keeps of each parameter.
FREE_OPTIONS = ("params", "lr", "weight_decay", "betas", "eps", "foreach", "fused", "capturable", "differentiable")


def load_sac(source_model: SAC | str | pathlib.Path, device: Any) -> SAC:
    """The source model itself, or from its zip.

    :raises TypeError: for a model of another kind
    :raises ValueError: for a zip that SAC cannot load, and for SLBO
    :raises FileNotFoundError: there is none
    """
    if isinstance(source_model, SAC):
        if getattr(source_model, "trpo", None) is not None:
            raise ValueError("source_model is an SLBO, which acts by TRPO's policy; its SAC has learned nothing since")
        return source_model
    if not isinstance(source_model, str | os.PathLike):
        raise TypeError(f"source_model must be a SAC or the path of its zip, not {type(source_model).__name__}")
    file = model_zip.located(source_model, "source_model")
    misfit = model_zip.misfit_of_sac(model_zip.look_into(file, "source_model"))
    try:
        if misfit:
            raise ValueError(misfit)
        # Its seed is that of its own training, and SB3 would seed the whole process with it.
        return SAC.load(file, device=device, custom_objects={"seed": None})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"source_model={str(source_model)!r} is not the zip of a SAC ({error}); a model of this package goes on "
            "with its own class's load(), and what that loads may be a source_model"
        ) from error


def check_source_spaces(sac: SAC, env: GymEnv) -> None:
    """Require that a source model is one of this environment.

    :raises ValueError: naming the space that differs
    """
    for name in ("observation_space", "action_space"):
        ours, theirs = getattr(env, name), getattr(sac, name)
        if ours.shape != theirs.shape:
            raise ValueError(f"source_model has {name} {theirs}, env has {ours}; pass the agent of this environment")


def carry_over(sac: SAC, agent: Agent, temperature: bool = True) -> None:
    """Take over actor, critics, their targets, the temperature and the state of every optimiser of the same kind.

    :param temperature: whether to take over the temperature, too
    :raises ValueError: when the source model's networks are not the model's
    """
    if sac.action_space != agent.action_space:
        warnings.warn(
            f"source_model was trained with {sac.action_space}, env has {agent.action_space}: the same output of the "
            "policy is another action now",
            stacklevel=3,
        )
    try:
        agent.policy.load_state_dict(sac.policy.state_dict())
    except RuntimeError as error:
        raise ValueError(f"source_model's networks do not fit policy_kwargs={agent.policy_kwargs}: {error}") from error
    for theirs, ours in ((sac.actor.optimizer, agent.actor.optimizer), (sac.critic.optimizer, agent.critic.optimizer)):
        _carry_optimizer(theirs, ours)
    if temperature:
        _carry_temperature(sac, agent)
    agent.state.knows_source = True


def _carry_temperature(sac: SAC, agent: Agent) -> None:
    """Take over the temperature and, where both learn it, its optimiser's state."""
    if agent.log_ent_coef is None:
        learned = None if sac.log_ent_coef is None else sac.log_ent_coef.detach().exp().reshape(())
        agent.ent_coef_tensor = (sac.ent_coef_tensor if learned is None else learned).clone().to(agent.device)
    elif sac.log_ent_coef is None and float(sac.ent_coef_tensor) == 0.0:
        return  # what is learned is a logarithm, which 0 has not: it begins where ent_coef says
    elif sac.log_ent_coef is None:
        agent.log_ent_coef.data.fill_(float(sac.ent_coef_tensor.log()))
    else:
        assert agent.ent_coef_optimizer is not None
        assert sac.ent_coef_optimizer is not None
        agent.log_ent_coef.data.copy_(sac.log_ent_coef.data)
        _carry_optimizer(sac.ent_coef_optimizer, agent.ent_coef_optimizer)


def _carry_optimizer(theirs: th.optim.Optimizer, ours: th.optim.Optimizer) -> None:
    """Take over what an optimizer has learned of its parameters, where ours is one that goes on with it.

    Its options stay those of our ``policy_kwargs``.
    """
    options = [
        [{n: v for n, v in group.items() if n not in FREE_OPTIONS} for group in o.param_groups] for o in (theirs, ours)
    ]
    if type(theirs) is type(ours) and options[0] == options[1]:
        state = copy.deepcopy(theirs.state_dict())
        ours.load_state_dict({**state, "param_groups": ours.state_dict()["param_groups"]})
