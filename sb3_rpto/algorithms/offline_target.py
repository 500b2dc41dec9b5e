"""A robot's log as D_target: states on the grid of the environment's steps, and what the agent would see in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from gymnasium import wrappers
from scipy.interpolate import CubicHermiteSpline

from sb3_rpto.dynamics.simulator import check_commands
from sb3_rpto.effects import Effect, Simulation
from sb3_rpto.effects.simulation import names_of
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.observations import env_name, layers, leaves_observations
from sb3_rpto.envs.step_fidelity import beyond_states, observe
from sb3_rpto.envs.task_rules import Rule, task_rules
from sb3_rpto.sysid import Episode, Measurements
from sb3_rpto.sysid.data.coordinates import straight
from sb3_rpto.sysid.data.repairs import remove_whole_turns
from sb3_rpto.sysid.problem.data_model_consistency import check_clock, check_names
from sb3_rpto.sysid.shooting.initial_states import HALF_COUNT, HALF_WIDTH, half_step, start_state
from sb3_rpto.sysid.shooting.windows import command_order, held, noise_levels

#: Observation wrappers whose answer depends on more than the observation.
REMEMBERING = (wrappers.DelayObservation, wrappers.TimeAwareObservation, wrappers.NormalizeObservation)


def check_log(measured: Measurements, env: gym.Env) -> None:
    """Refuse, before anything expensive, a log that is not one of this environment's machine.

    :param measured: the log
    :param env: the source
    :raises ValueError: no gymnasium MuJoCo environment, actions that are not the commands of the actuators, joints or
        actuators that are not in both, a clock that is not in seconds, observations that do not follow from the state
    """
    base: Any = env.unwrapped
    if not isinstance(getattr(base, "model", None), mujoco.MjModel) or not callable(getattr(base, "_get_obs", None)):
        raise ValueError(
            f"target_data: the joints of Measurements must be those of a gymnasium MuJoCo environment, which "
            f"{env_name(env)} is not; pass a replay buffer or an .npz of its transitions"
        )
    check_names(base.model, measured)
    check_clock(base.model, measured)
    check_commands(env, "target_data=Measurements")
    for layer in layers(env)[:-1]:
        if isinstance(layer, REMEMBERING) or not (
            isinstance(layer, gym.ObservationWrapper) or leaves_observations(layer)
        ):
            raise ValueError(
                f"{env_name(env)}: the wrapper {type(layer).__name__} shows more than the state, so a log does not "
                "tell its observations; give the environment without it"
            )
    hidden = beyond_states(env)
    if hidden is not None:
        raise ValueError(
            f"{env_name(env)}: observation[{hidden}] does not follow from the state and the command alone (an action "
            "before, forces of a step?), so a log does not tell it; give an environment that observes states"
        )


def transitions(
    measured: Measurements,
    env: gym.Env,
    effects: Sequence[Effect] = (),
    *,
    reward_fn: Rule | None = None,
    termination_fn: Rule | None = None,
) -> dict[str, np.ndarray]:
    """The steps that the environment would have taken where the log was recorded.

    Each episode is laid on a grid of ``env.unwrapped.dt``, begun where commands change the least within a step. The
    states there are smoothed (:func:`~sb3_rpto.sysid.shooting.initial_states.smoothed_state`; exact data as they are)
    and interpolated between samples; actions are the mean command over a step; observations are those of a copy of the
    environment in these states. A step that holds a sample which is not usable, or an actuator switched off, is left
    out, and so is one that begins where the task is over.

    :param measured: the log
    :param env: the source, with all its wrappers; it is copied
    :param effects: what is known to be in the machine beside ``env``: observations are those of the corrected
        environment, and so are the task's rules
    :param reward_fn: in place of what is known of the task
    :param termination_fn: in place of what is known of the task; where nothing is known, no step ends an episode
    :return: as :func:`sb3_rpto.buffers.chronological`, ``n`` may be 0; without ``rewards`` where they are not known
    :raises ValueError: see :func:`check_log`; an environment that cannot be copied
    """
    check_log(measured, env)
    twin = apply_effects(env, effects) if effects else copy_env(env)
    if twin is None:
        raise ValueError(f"{env} cannot be copied, which target_data=Measurements needs; give it one of gym.make")
    twin.reset(seed=0)
    base: Any = twin.unwrapped
    measured, _ = remove_whole_turns(base.model, measured)  # as the trace reads it, which says so
    log = _Log(measured, base.model, float(base.dt))
    # Sensors that err show the states as they were measured: the simulator is put where they truly were, but for the
    # joints of late ones, which the copy, as it has no past, shows as they are: where the log saw them.
    simulation = Simulation(env.unwrapped.model, effects, 1) if effects else None  # type: ignore[attr-defined]
    found: dict[str, list[np.ndarray]] = {"observations": [], "next_observations": [], "actions": []}
    for episode in measured.episodes:
        qpos, qvel, commands, whole = log.steps(episode)
        if simulation is not None and len(qpos):
            simulation.unobserve(np.tile(simulation.values(), (len(qpos), 1)), qpos, qvel)
        seen = np.array([observe(twin, *state) for state in zip(qpos, qvel, commands)])
        if whole.any():
            found["observations"].append(seen[:-1][whole])
            found["next_observations"].append(seen[1:][whole])
            found["actions"].append(commands[1:][whole])
    # The rules of a task are read off its model, which is the corrected one.
    return _finished(found, twin.env if isinstance(twin, CorrectedEnv) else twin, reward_fn, termination_fn)


class _Log:
    """Lays the episodes of a log on a grid of ``dt`` seconds.

    :param measured: the log
    :param model: the environment's
    :param dt: of its steps
    """

    def __init__(self, measured: Measurements, model: mujoco.MjModel, dt: float) -> None:
        self.measured, self.model, self.dt = measured, model, dt
        self.sigma = noise_levels(measured)
        self.addresses = names_of(model, measured.columns.qpos)
        self.order = np.argsort(command_order(model, measured))
        pairs = straight(model)
        self.straight = np.array(list(pairs), dtype=int), np.array(list(pairs.values()), dtype=int)

    def steps(self, episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """States, the commands before them, and which steps are whole.

        :return: qpos (k + 1, nq), qvel (k + 1, nv), mean commands of the step that ends there (k + 1, nu), and of the
            steps between, (k,), whether all that is needed was measured; k + 1 may be 0
        """
        time, ctrl = episode.time, episode.ctrl[:, self.order]
        # Cubics that lean to one side are too rough at the ends.
        reach = (
            0 if self.measured.whole_states else max(HALF_COUNT, round(HALF_WIDTH / float(np.median(np.diff(time)))))
        )
        nodes = self._nodes(time, ctrl, reach)
        if not len(nodes):
            return np.empty((0, self.model.nq)), np.empty((0, self.model.nv)), np.empty((0, self.model.nu)), np.empty(0)
        edges = np.concatenate([nodes[:1] - self.dt, nodes])
        lead = 0.0 if self.measured.exact or self.measured.simulated else half_step(self.model)
        commands = held(time, ctrl, edges - lead)
        qpos, qvel = self._states(episode, nodes)
        bad = ~(episode.usable & episode.enabled.all(axis=1))
        count = np.concatenate([[0], np.cumsum(bad)])
        first = np.maximum(np.searchsorted(time, nodes[:-1] + 1e-9, side="right") - 1 - reach, 0)
        last = np.minimum(np.searchsorted(time, nodes[1:] - 1e-9) + reach, len(time) - 1)
        return qpos, qvel, commands, count[last + 1] == count[first]

    def _nodes(self, time: np.ndarray, ctrl: np.ndarray, reach: int) -> np.ndarray:
        """Where the environment's steps begin and end, (k + 1,); none where the episode is shorter than a step."""
        low, high = (time[reach], time[-1 - reach]) if len(time) > 2 * reach else (0.0, -1.0)

        def grid(start: float) -> np.ndarray:
            begin = start + self.dt * np.ceil((low - start) / self.dt - 1e-6)
            return begin + self.dt * np.arange(np.floor((high - begin) / self.dt + 1e-6) + 1)

        def mixed(start: float) -> float:
            nodes = grid(start)
            if len(nodes) < 2:
                return 0.0
            return float(np.sum(held(time, ctrl**2, nodes) - held(time, ctrl, nodes) ** 2))

        # A policy's own grid is the one on which it holds its commands; the first sample may not be on it.
        starts = time[time < time[0] + self.dt - 1e-9]
        costs = np.array([mixed(start) for start in starts])
        best = grid(starts[int(np.argmax(costs <= costs.min() + 1e-6 * costs.max()))])
        return best if len(best) > 1 else best[:0]

    def _states(self, episode: Episode, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at the nodes, from those at the samples on both sides, (k + 1, nq) and (k + 1, nv)."""
        time = episode.time
        left = np.clip(np.searchsorted(time, nodes + 1e-9, side="right") - 1, 0, len(time) - 2)
        rows = np.unique([left, left + 1])
        states = [start_state(self.model, self.measured, episode, i, self.sigma, self.addresses)[:2] for i in rows]
        q, v = (np.array(part) for part in zip(*states))
        qpos, qvel = (np.stack([np.interp(nodes, time[rows], c) for c in part.T], axis=1) for part in (q, v))
        of_qpos, of_qvel = self.straight
        curve = CubicHermiteSpline(time[rows], q[:, of_qpos], v[:, of_qvel])
        qpos[:, of_qpos], qvel[:, of_qvel] = curve(nodes), curve(nodes, 1)
        return qpos, qvel


def _finished(
    found: dict[str, list[np.ndarray]], env: gym.Env, reward_fn: Rule | None, termination_fn: Rule | None
) -> dict[str, np.ndarray]:
    """All that begin where the task is not over, with rewards and terminations, actions scaled."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)  # check_commands has compared its shape
    widths = env.observation_space.shape, env.observation_space.shape, space.shape
    none = {name: np.empty((0, *width)) for name, width in zip(found, widths)}  # type: ignore[misc]
    arrays = {name: np.concatenate([none[name], *parts]) for name, parts in found.items()}
    arrays["actions"] = np.clip(arrays["actions"], space.low, space.high)
    rules = task_rules(env)
    reward, ends = reward_fn or rules.reward_fn, termination_fn or rules.termination_fn
    now, then, actions = (th.as_tensor(arrays[n]) for n in ("observations", "next_observations", "actions"))
    over = np.zeros(len(actions), dtype=bool)
    arrays["terminations"] = np.zeros(len(actions))
    if ends is not None:
        over = ends(now, actions, now).numpy().astype(bool)
        arrays["terminations"] = ends(now, actions, then).numpy().astype(float)
    if reward is not None:
        arrays["rewards"] = reward(now, actions, then).numpy()
    arrays["actions"] = 2 * (arrays["actions"] - space.low) / (space.high - space.low) - 1
    return {name: array[~over] for name, array in arrays.items()}
