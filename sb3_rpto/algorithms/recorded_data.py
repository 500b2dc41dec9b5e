"""Recorded transitions and logs, put into D_source and D_target."""

from __future__ import annotations

import pathlib
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.sac.policies import SACPolicy

from sb3_rpto.algorithms import offline_target
from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.algorithms.transition_checks import check_rewards
from sb3_rpto.buffers import World, load_transitions
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.effects import Effect
from sb3_rpto.envs.observations import single_env
from sb3_rpto.envs.task_rules import task_rules
from sb3_rpto.sysid import Measurements


def as_transitions(arrays: dict[str, np.ndarray], policy: SACPolicy, device: th.device) -> Transitions:
    """Arrays of :func:`~sb3_rpto.buffers.chronological` as tensors, with actions in the environment's units."""
    tensors = {name: th.as_tensor(array, device=device) for name, array in arrays.items()}
    tensors["actions"] = th.as_tensor(policy.unscale_action(arrays["actions"]), device=device)
    return Transitions(**tensors)


def fill_source(agent: Agent, source_data: ReplayBuffer | str | pathlib.Path) -> None:
    """Put recorded source transitions into D_source; branches may start from their states."""
    arrays = _loaded(source_data, agent, "source_data")
    agent.replay_buffer.resize("source", max(agent.buffer_size, len(arrays["rewards"])))
    _append_newest(agent, "source", arrays)
    agent.replay_buffer.source_starts = arrays["observations"].astype(agent.observation_space.dtype)


def fill_target(agent: Agent, target_data: ReplayBuffer | str | pathlib.Path | Measurements) -> None:
    """Put recorded target transitions into D_target, with rewards by :func:`_with_rewards`."""
    if isinstance(target_data, Measurements):
        fill_recorded(agent, target_data)
        return
    arrays = _loaded(target_data, agent, "target_data", world="target", rewards_optional=True)
    _append_newest(agent, "target", _with_rewards(agent, arrays))


def fill_recorded(agent: Agent, measured: Measurements, effects: Sequence[Effect] = ()) -> None:
    """Let D_target hold what a robot's log tells, and nothing else.

    :param agent: with its source
    :param measured: the log
    :param effects: what is known to be in the machine beside the source
    :raises ValueError: a log of another machine; none of its steps is one of the task where phi is fitted to steps;
        rewards that are not known where they are needed
    """
    assert agent.env is not None
    rules = {name: agent.dynamics_kwargs.get(name) for name in ("reward_fn", "termination_fn")}
    arrays = offline_target.transitions(measured, single_env(agent.env), effects, **rules)
    agent.replay_buffer.reset()
    agent.replay_buffer.estimated = _traces(agent)
    if not len(arrays["actions"]):
        message = "target_data holds no whole step that begins where the task goes on"
        if not _traces(agent):
            raise ValueError(f"{message}: record motion of the task, for longer than a step without gaps")
        warnings.warn(f"{message}: it corrects the simulator, and the policy learns there alone", stacklevel=4)
        return
    _append_newest(agent, "target", _with_rewards(agent, arrays))


def _loaded(data: Any, agent: Agent, name: str, **how: Any) -> dict[str, np.ndarray]:
    """The recorded transitions, unless they are not of this model's environments.

    :param name: of the argument that they were passed as
    :param how: as of :func:`~sb3_rpto.buffers.load_transitions`
    :raises ValueError: for what holds none, for other shapes and for actions that are not on the buffers' scale
    """
    try:
        arrays = load_transitions(data, **how)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    of_observation, of_action = agent.observation_space.shape, agent.action_space.shape
    expected = {"observations": of_observation, "next_observations": of_observation, "actions": of_action}
    for array, values in arrays.items():
        if values.shape[1:] != expected.get(array, ()):
            raise ValueError(
                f"{name} holds {array} of shape {values.shape[1:]}, the environment's is {expected.get(array, ())}"
            )
        if len(values) != len(arrays["observations"]):
            raise ValueError(f"{name} holds {len(values)} {array} and {len(arrays['observations'])} observations")
    if np.abs(arrays["actions"]).max() > 1 + 1e-3:
        raise ValueError(
            f"{name} holds actions outside [-1, 1]; scale them by policy.scale_action, as SB3's buffers do"
        )
    if "rewards" in arrays:
        check_rewards(f"{name} holds", arrays["rewards"])
    if not np.isin(arrays["terminations"], (0, 1)).all():
        raise ValueError(f"{name} holds values of done other than 0 and 1 (terminal, not a time limit); mend them")
    return arrays


def _with_rewards(agent: Agent, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Recorded transitions with rewards: their own, those of a known rule, or zeros where nothing is to read them.

    A share of target transitions in the critic's batches that nobody asked for is left out as long as these are there.

    :raises ValueError: there are none, and something needs them
    """
    if "rewards" in arrays:
        return arrays
    assert agent.env is not None  # target_data is an argument of the constructor, which has one
    reward_fn = agent.dynamics_kwargs.get("reward_fn") or task_rules(agent.env).reward_fn
    if reward_fn is not None:
        data = as_transitions({**arrays, "rewards": arrays["terminations"]}, agent.policy, agent.device)
        rewards = reward_fn(data.observations, data.actions, data.next_observations).cpu().numpy()
        return {**arrays, "rewards": rewards}
    need = _need_of_rewards(agent)
    if need:
        raise ValueError(f"target_data holds no rewards, and the task's are not known: {need}")
    agent.replay_buffer.unrewarded = True
    if agent.real_ratio > 0 and agent.updates_policy and not _traces(agent):  # where the critic needs none
        warnings.warn(
            "target_data holds no rewards, and the task's are not known: the critic learns from the source's "
            f"transitions alone, without the share real_ratio={agent.real_ratio} of the target's",
            stacklevel=5,
        )
    return {**arrays, "rewards": np.zeros(len(arrays["actions"]))}


def _need_of_rewards(agent: Agent) -> str:
    """What needs the target's rewards, and the remedy; empty where nothing does."""
    rule = "{'reward_fn': f} with f(observations, actions, next_observations) -> (n,)"
    if agent.dynamics_backend == "ensemble":
        return (
            f"dynamics='ensemble' would learn them; pass dynamics_kwargs={rule}, record them (rew), or take "
            "dynamics='physical' or 'residual', which earn the source's own"
        )
    if agent.weighting is not None and not _traces(agent):
        return "RTO's weight is made of them; pass weighting=None or record them (rew)"
    if agent.real_ratio > 0 and "real_ratio" in agent.given_arguments:
        return "real_ratio is the share of the critic's batches that holds them; pass real_ratio=0 or leave it out"
    return ""


def _append_newest(agent: Agent, world: World, arrays: dict[str, np.ndarray]) -> None:
    """Add as many of the newest transitions as that side of the buffer holds."""
    capacity, given = agent.replay_buffer.side(world).buffer_size, len(arrays["actions"])
    if given > capacity:
        warnings.warn(
            f"of {given} {world} transitions the buffer takes the newest {capacity}; pass "
            + ('replay_buffer_kwargs={"target_size": ...}' if world == "target" else "buffer_size="),
            stacklevel=4,
        )
    newest = {name: array[-capacity:] for name, array in arrays.items()}
    agent.replay_buffer.append(world, dones=newest.pop("terminations"), **newest)


def _traces(agent: Agent) -> bool:
    """Whether a log stands in for the target whose trace makes phi."""
    return agent.target is not None and agent.target.is_traced
