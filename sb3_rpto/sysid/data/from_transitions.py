"""Measurements from transitions: SB3 replay buffers and Minari datasets of MuJoCo environments."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.buffers import DualReplayBuffer, rows_in_order
from sb3_rpto.dynamics.base import predecessors
from sb3_rpto.effects.actuation import command_limits
from sb3_rpto.envs.observations import (
    StateMap,
    States,
    env_name,
    layers,
    mujoco_model,
    noise_of_each,
    single_env,
    state_map,
)
from sb3_rpto.sysid.data import signal_quality
from sb3_rpto.sysid.data.columns import Columns, columns_of, joint_of
from sb3_rpto.sysid.data.recording import Episode, Noise
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.findings import Finding, FindingKind

ALL = "all episodes"


class Run(NamedTuple):
    """An uninterrupted stretch of transitions."""

    name: str
    observations: np.ndarray  # (T, d), raw
    actions: np.ndarray  # (T - 1, n), as given to env.step


class Recorded(NamedTuple):
    """What transitions tell, field by field as in :class:`~sb3_rpto.sysid.Measurements`."""

    episodes: list[Episode]
    columns: Columns
    findings: list[Finding]
    unobserved: tuple[str, ...]
    exact: bool
    simulated: bool
    noise: Noise | None


def read_replay(
    buffer: ReplayBuffer,
    env: gym.Env | VecEnv,
    exact: bool = True,
    noise: float | Sequence[float] | np.ndarray | None = None,
) -> Recorded:
    """See :meth:`sb3_rpto.sysid.Measurements.from_replay`."""
    env = single_env(env)
    mujoco_model(env)
    if noise is not None:
        noise = noise_of_each(noise, state_map(env))
    side = buffer.target if isinstance(buffer, DualReplayBuffer) else buffer
    if not isinstance(side, ReplayBuffer) or isinstance(side, DictReplayBuffer):
        raise ValueError(f"buffer must be an SB3 ReplayBuffer of vector observations, not {type(buffer).__name__}")
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or space.shape != side.action_space.shape:
        raise ValueError(
            f"actions of {env_name(env)} are {space}, those of the buffer {side.action_space}; "
            "give the environment whose transitions the buffer holds"
        )
    low, high = space.low.astype(float).ravel(), space.high.astype(float).ravel()
    runs: list[Run] = []
    broken = 0
    for column in range(side.n_envs):
        observations, next_observations, actions, dones = _transitions(side, column)
        chains, cut = chain(observations, next_observations, dones)
        broken += cut
        for rows in chains:
            # As BasePolicy.unscale_action, in double precision.
            scaled = actions[rows].astype(float)
            path = np.concatenate([observations[rows], next_observations[rows[-1:]]])
            runs.append(Run(str(len(runs)), path, low + 0.5 * (scaled + 1.0) * (high - low)))
    findings = []
    if broken:
        message = f"{broken} time(s) a transition does not begin where one before it ended; cut there"
        findings.append(Finding(FindingKind.GAP, ALL, message))
    return build(runs, env, exact and noise is None, findings, noise)


def read_minari(dataset: Any, env: gym.Env | VecEnv | None = None) -> Recorded:
    """See :meth:`sb3_rpto.sysid.Measurements.from_minari`."""
    if isinstance(dataset, str):
        try:
            import minari
        except ImportError as error:
            raise ImportError(
                "reading a Minari dataset needs minari: pip install -e '.[data]' in the checkout"
            ) from error
        dataset = minari.load_dataset(dataset)
    env = dataset.recover_environment() if env is None else single_env(env)
    runs = []
    for episode in dataset.iterate_episodes():
        if not isinstance(episode.observations, np.ndarray) or not isinstance(episode.actions, np.ndarray):
            raise ValueError(
                f"episode {episode.id} of the dataset {dataset.id}: observations and actions must be arrays, not "
                f"{type(episode.observations).__name__} and {type(episode.actions).__name__}; "
                "record the flattened observations"
            )
        runs.append(Run(str(episode.id), episode.observations, episode.actions.astype(float)))
    return build(runs, env, exact=True, findings=[])


def _transitions(side: ReplayBuffer, column: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observations, next observations, actions and dones (time limits too) of one environment, oldest first."""
    order = rows_in_order(side)
    if not side.optimize_memory_usage:
        arrays = side.observations, side.next_observations, side.actions, side.dones
        o, n, a, d = (array[order, column] for array in arrays)
        return o, n, a, d.astype(bool)
    # One array holds both: the observation of the oldest row is overwritten, and so are those that ended an episode.
    order = order[1:] if side.full else order
    following = side.observations[(order + 1) % side.buffer_size, column]
    dones = side.dones[order, column].astype(bool)
    kept = ~dones
    broken = np.append(dones[1:], False)
    return side.observations[order, column][kept], following[kept], side.actions[order, column][kept], broken[kept]


def chain(observations: np.ndarray, next_observations: np.ndarray, dones: np.ndarray) -> tuple[list[np.ndarray], int]:
    """Link transitions to episodes: each follows the oldest that ended where it begins.

    So the rows of several environments may be interleaved, as they are in a :class:`~sb3_rpto.DualReplayBuffer`.

    :param observations: oldest first, (n, d)
    :param next_observations: (n, d)
    :param dones: (n,), after these nothing follows
    :return: the row numbers of each episode, and how many episodes break off without an end before the last rows
    """
    before = predecessors(observations, next_observations, dones)
    chains: list[list[int]] = []
    belongs = np.full(len(dones), -1)  # to which of them
    for row, last in enumerate(before):
        if last < 0:
            chains.append([])
        belongs[row] = belongs[last] if last >= 0 else len(chains) - 1
        chains[belongs[row]].append(row)
    steps = (np.arange(len(dones)) - before)[before >= 0]
    interleaved = int(np.bincount(steps).argmax()) if len(steps) else 1
    broken = sum(not dones[rows[-1]] and rows[-1] + interleaved < len(dones) for rows in chains)
    return [np.array(rows) for rows in chains], broken


def build(
    runs: Sequence[Run], env: gym.Env, exact: bool, findings: list[Finding], noise: np.ndarray | None = None
) -> Recorded:
    """Turn observations into states and actions into commands; see :func:`read_replay`.

    :param runs: observations and actions
    :param env: whose observations they are
    :param exact: whether the samples come from a simulator
    :param findings: what was found so far, is added to
    :param noise: standard deviation of each observation's, (d,); None: not known
    """
    model, recover = mujoco_model(env), state_map(env)
    columns, dt = columns_of(model), float(env.unwrapped.dt)  # type: ignore[attr-defined]
    kept = [run for run in runs if len(run.actions) >= DATA.min_transitions]
    if not kept:
        raise ValueError(
            f"{len(runs)} episode(s) of {env_name(env)}, none with {DATA.min_transitions} transitions; record longer "
            "ones"
        )
    if len(kept) < len(runs):
        message = f"{len(runs) - len(kept)} of {len(runs)} with fewer than {DATA.min_transitions} transitions; dropped"
        findings.append(Finding(FindingKind.SHORT, ALL, message))
    for run in kept:
        if not (np.isfinite(run.observations).all() and np.isfinite(run.actions).all()):
            raise ValueError(f"episode {run.name} of {env_name(env)} has NaN or infinite values; remove it")
    actions = _commands(np.concatenate([run.actions for run in kept]), env, findings)
    observations = np.concatenate([run.observations for run in kept])
    states = recover(observations)
    known_noise = None
    if noise is not None:
        states, known_noise = _behind_noise(columns, recover, observations, noise)
    repairs = _Repairs(columns, states, env_name(env))
    placed = np.asarray(states.known_qpos[:, repairs.seen_qpos].all(axis=1))
    known = placed & states.known_qvel[:, repairs.seen_qvel].all(axis=1)
    episodes, row, action = [], 0, 0
    for run in kept:
        n = len(run.observations)
        rows = slice(row, row + n)
        time = dt * np.arange(n)
        qpos, qvel = repairs(run.name, time, states.qpos[rows].copy(), states.qvel[rows].copy())
        ctrl = actions[action : action + n - 1]
        episodes.append(
            Episode(
                name=run.name,
                run=run.name,
                time=time,
                qpos=qpos,
                qvel=qvel,
                ctrl=np.concatenate([ctrl, ctrl[-1:]]),
                qfrc=np.empty((n, 0)),
                enabled=np.ones((n, model.nu), dtype=bool),
                usable=known[rows],
                placed=placed[rows],
            )
        )
        row, action = row + n, action + n - 1
    for prefix, names, flags in (("qpos", columns.qpos, states.known_qpos), ("qvel", columns.qvel, states.known_qvel)):
        for i, name in enumerate(names):
            if flags[:, i].any() and not flags[:, i].all():
                unusable = "which are not compared" if prefix == "qpos" else "where no prediction begins"
                message = f"unknown in {(~flags[:, i]).sum()} of {len(flags)} samples, {unusable}"
                findings.append(Finding(FindingKind.CLIPPED, f"{ALL}, {prefix}.{name}", message))
    columns = replace(columns, missing=repairs.missing)
    return Recorded(
        episodes,
        columns,
        findings + repairs.findings(),
        repairs.unobserved,
        exact,
        simulated=known_noise is not None,  # as exact transitions, the environment's own steps are to meet them
        noise=known_noise,
    )


def _behind_noise(
    columns: Columns, recover: StateMap, observations: np.ndarray, noise: np.ndarray
) -> tuple[States, Noise]:
    """States behind noisy observations, and their noise by draws of it: none where no observation tells of one.

    A speed at its bound shows as one beside it: what could be beyond is not known.

    :param columns: whose quaternions are of unit length
    :param recover: states from observations
    :param observations: (n, d)
    :param noise: standard deviation of each, (d,)
    """
    rows = np.resize(np.arange(len(observations)), DATA.noise_draws)
    shaken = noise * np.random.default_rng(0).standard_normal((DATA.noise_draws, len(noise)))
    states, drawn = (_of_unit_length(columns, recover(o)) for o in (observations, observations[rows] + shaken))
    for far in (-DATA.bound_margin, DATA.bound_margin):
        away = recover(observations + far * noise)
        states = states._replace(
            known_qpos=states.known_qpos & away.known_qpos, known_qvel=states.known_qvel & away.known_qvel
        )
    turns, wrapped = drawn.qpos - states.qpos[rows], list(states.wrapped)
    turns[:, wrapped] = (turns[:, wrapped] + np.pi) % (2 * np.pi) - np.pi
    both = (states.known_qpos[rows] & drawn.known_qpos), (states.known_qvel[rows] & drawn.known_qvel)
    return states, Noise(_scatter(turns, both[0]), _scatter(drawn.qvel - states.qvel[rows], both[1]))


def _of_unit_length(columns: Columns, states: States) -> States:
    """The states with the quaternions of their ball and free joints of length one."""
    qpos = states.qpos.copy()
    for _, first in columns.quaternions():
        qpos[:, first : first + 4] /= np.linalg.norm(qpos[:, first : first + 4], axis=1, keepdims=True)
    return states._replace(qpos=qpos)


def _scatter(moved: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Root mean square of each column's known values, (m,); 0 where there are none."""
    squares = np.where(known, np.nan_to_num(moved), 0.0) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)))


def _commands(actions: np.ndarray, env: gym.Env, findings: list[Finding]) -> np.ndarray:
    """What the actuators are told, (n, nu): through gymnasium's own action wrappers, then cut at the model's ranges."""
    model = mujoco_model(env)
    for layer in layers(env)[:-1]:
        if not isinstance(layer, gym.ActionWrapper):
            continue
        if type(layer).__module__.startswith("gymnasium.wrappers."):
            actions = np.stack([layer.action(action) for action in actions])
        else:
            # It may be the very effect that is looked for, and have a state or a random stream of its own.
            message = f"{type(layer).__name__} is taken as part of the machine: commands are what it receives"
            findings.append(Finding(FindingKind.WRAPPER, ALL, message))
    if actions.shape != (len(actions), model.nu):
        raise ValueError(
            f"{env_name(env)}: actions have shape (n, {actions.shape[1:]}), the model {model.nu} actuators; "
            "give an environment whose action is the command of its actuators"
        )
    return np.clip(actions.astype(float), *command_limits(model))


class _Repairs:
    """Fills in what no observation holds, and remembers what it did.

    :param columns: of the model
    :param states: all of them; what is known in none was not observed
    :param name: the environment's
    :raises ValueError: a coordinate follows from nothing
    """

    def __init__(self, columns: Columns, states: States, name: str) -> None:
        self.columns, self.wrapped = columns, states.wrapped
        self.seen_qpos = np.asarray(states.known_qpos.any(axis=0))
        self.seen_qvel = np.asarray(states.known_qvel.any(axis=0))
        self.turns: dict[str, int] = defaultdict(int)
        self.integrated: set[str] = set()
        self.unobserved = tuple(n for n, seen in zip(columns.qpos, self.seen_qpos) if not seen)
        self.missing = tuple(n for n, seen in zip(columns.qvel, self.seen_qvel) if not seen)
        for column in self.missing:
            if column not in columns.qpos or column != joint_of(column):
                raise ValueError(
                    f"{name}: no observation holds the velocity {column}, and nothing tells it; observe it"
                )

    def __call__(
        self, episode: str, time: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Repair the arrays of one episode, (T, nq) and (T, nv), in place."""
        c = self.columns
        for array, seen in ((qpos, self.seen_qpos), (qvel, self.seen_qvel)):
            for i in np.flatnonzero(seen).tolist():
                hole = np.isnan(array[:, i])
                if hole.any():  # not usable samples; the filters of others want numbers there
                    array[hole, i] = 0.0 if hole.all() else np.interp(time[hole], time[~hole], array[~hole, i])
        for name in self.missing:
            i, position = c.qvel.index(name), qpos[:, c.qpos.index(name)]
            if np.isnan(position).any():
                raise ValueError(f"episode {episode}: neither position nor velocity of {name} is observed; observe one")
            enough = len(time) >= DATA.min_rows
            qvel[:, i] = signal_quality.smoothed_velocity(time, position) if enough else np.gradient(position, time)
        for name in self.unobserved:
            i = c.qpos.index(name)
            if not np.isnan(qpos[:, i]).any():
                continue
            if not c.slides(name):
                raise ValueError(f"episode {episode}: the orientation {name} is not observed; observe it")
            qpos[:, i] = _integral(time, qvel[:, c.qvel.index(name)])
            self.integrated.add(name)
        for i in self.wrapped:
            name = c.qpos[i]
            steps = np.diff(qpos[:, i])
            # The velocity tells how far it turned between two samples.
            expected = np.diff(_integral(time, qvel[:, c.qvel.index(name)]))
            turns = np.round((expected - steps) / (2 * np.pi))
            qpos[1:, i] += 2 * np.pi * np.cumsum(turns)
            self.turns[name] += int(np.abs(turns).sum())
        return qpos, qvel

    def findings(self) -> list[Finding]:
        """What was repaired in the episodes so far."""
        found = []
        for name in self.unobserved:
            done = "integrated from its velocity" if name in self.integrated else "known only roughly"
            found.append(Finding(FindingKind.UNOBSERVED, f"{ALL}, qpos.{name}", f"not observed; {done}, not compared"))
        for name in self.missing:
            message = "not observed; estimated from the position by a cubic Savitzky-Golay filter"
            found.append(Finding(FindingKind.MISSING_VELOCITY, f"{ALL}, qvel.{name}", message))
        for name, count in self.turns.items():
            if count:
                message = f"{count} turn(s) that the observation lost; recovered by means of the velocity"
                found.append(Finding(FindingKind.WRAPPED_ANGLE, f"{ALL}, qpos.{name}", message))
        return found


def _integral(time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Trapezoidal rule from 0, (T,)."""
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])
