"""Replay memory for two worlds, kept apart."""

from __future__ import annotations

import io
import pathlib
import pickle
import sys
import zipfile
from functools import partial
from typing import Any, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

World = Literal["source", "target"]

#: Target data are scarce: this many transitions hold any budget for which a transfer method is worth its while.
TARGET_CAPACITY = 200_000

_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class DualReplayBuffer(ReplayBuffer):
    """D_source and D_target of Algorithm 1 in one SB3 replay buffer.

    ``add``, ``size`` and ``sample`` on the object mean the target, so SB3's own collection code, callbacks and
    ``save_replay_buffer`` work on it; ``sample(n, world="source")`` draws from the other side. Each side is an SB3
    replay buffer of its own in :attr:`source` and :attr:`target`. Both take any number of environments and of
    one-step branches at once; rows are kept in the order in which they came.

    :param buffer_size: capacity of the source side in transitions
    :param observation_space: a Box
    :param action_space: a Box
    :param device: device of the sampled tensors
    :param n_envs: ignored (each side accepts any number of rows at a time); SB3 passes it
    :param optimize_memory_usage: refused: branches are not trajectories, so their next observations must be stored
    :param handle_timeout_termination: as in SB3
    :param target_size: capacity of the target side
    :param side_class: the replay buffer class of each side
    :param side_kwargs: further arguments of each side's constructor
    :raises NotImplementedError: for ``optimize_memory_usage=True``
    :raises ValueError: for a ``target_size`` that is no positive integer
    """

    #: whether rewards of the target side are zeros that stand for unknown ones; of the class, for buffers saved without
    unrewarded = False

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        target_size: int = TARGET_CAPACITY,
        side_class: type[ReplayBuffer] = ReplayBuffer,
        side_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if optimize_memory_usage:
            raise NotImplementedError(
                "optimize_memory_usage=True stores trajectories only, the source side also holds one-step branches; "
                "leave it False and lower buffer_size to save memory"
            )
        if not isinstance(target_size, int | np.integer) or target_size < 1:
            raise ValueError(f"target_size must be a positive integer, got {target_size!r}")
        kwargs = {"handle_timeout_termination": handle_timeout_termination, **(side_kwargs or {})}
        self._make_side = partial(side_class, observation_space=observation_space, action_space=action_space, **kwargs)
        self.source = self._sized("source", buffer_size, device)
        self.target = self._sized("target", target_size, device)
        #: transitions of this target that were ever added, those that its side forgot included
        self.target_added = 0
        #: whether the target side is a robot's log that was traced, whose states are estimates
        self.estimated = False
        #: observations of the real source environment, from which model branches may start; (n, observation_dim)
        self.source_starts = np.empty((0, *observation_space.shape), dtype=observation_space.dtype)
        # BaseBuffer alone: ReplayBuffer's constructor would allocate a third set of arrays.
        BaseBuffer.__init__(self, target_size, observation_space, action_space, device)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination

    def __getattr__(self, name: str) -> Any:
        # SB3 reads the arrays of ``model.replay_buffer``; there it means the target's.
        if name in _ARRAYS and "target" in self.__dict__:
            return getattr(self.target, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def pos(self) -> int:
        """Write position of the target side."""
        return self.target.pos

    @pos.setter
    def pos(self, value: int) -> None:
        self.target.pos = value

    @property
    def full(self) -> bool:
        """Whether the target side has wrapped around."""
        return self.target.full

    @full.setter
    def full(self, value: bool) -> None:
        self.target.full = value

    @property
    def device(self) -> th.device:
        """Device of the sampled tensors; setting it moves no memory."""
        return self.target.device

    @device.setter
    def device(self, value: th.device) -> None:
        self.source.device = self.target.device = value

    def side(self, world: World) -> ReplayBuffer:
        """The replay buffer of one world.

        :raises ValueError: there is no such world
        """
        if world not in ("source", "target"):
            raise ValueError(f'world must be "source" or "target", not {world!r}')
        return self.source if world == "source" else self.target

    def reset(self) -> None:
        """Forget the target side: to SB3 it is the replay buffer."""
        self.target.reset()
        self.target_added = 0
        self.estimated = self.unrewarded = False

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one target step of any number of environments; arguments as in SB3."""
        timeouts = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        self.append("target", obs, next_obs, action, reward, done, timeouts, infos)

    def _sized(self, world: World, capacity: int, device: th.device | str) -> ReplayBuffer:
        """One side, empty.

        :raises ValueError: it is larger than the memory
        """
        seen, done = (self._make_side.keywords[name] for name in ("observation_space", "action_space"))
        row = int(2 * np.prod(seen.shape) * seen.dtype.itemsize + np.prod(done.shape) * done.dtype.itemsize) + 12
        try:
            if capacity * row > sys.maxsize:
                raise MemoryError
            return self._make_side(buffer_size=capacity, device=device)
        except MemoryError as error:
            name = 'replay_buffer_kwargs["target_size"]'
            if world == "source":
                name = "buffer_size (in the source phase source_timesteps, where that is larger)"
            raise ValueError(
                f"{name}: {capacity:,} transitions of {row} bytes each, {capacity * row / 2**30:,.0f} GiB, do not fit "
                "into memory; give a smaller number"
            ) from error

    def resize(self, world: World, capacity: int) -> None:
        """Give one side another capacity; the newest transitions that fit are kept.

        A class of the user's, which may keep what came in ``infos``, stays as large as it is once it holds some.

        :param world: "source" or "target"
        :param capacity: in transitions
        """
        side, added = self.side(world), self.target_added
        foreign = type(side).add is not ReplayBuffer.add and side.size() > 0
        if capacity == side.buffer_size or foreign:
            return
        order = rows_in_order(side)[-capacity:]
        kept = {name: getattr(side, name)[order, 0] for name in _ARRAYS if hasattr(side, name)}
        setattr(self, world, self._sized(world, capacity, self.device))
        if len(order) > 0:
            self.append(world, **kept)
        self.target_added, self.buffer_size = added, self.target.buffer_size

    def append(
        self,
        world: World,
        observations: np.ndarray,
        next_observations: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        dones: np.ndarray,
        timeouts: np.ndarray | None = None,
        infos: Any = None,
    ) -> None:
        """Add ``n`` transitions to one world.

        :param world: "source" or "target"
        :param observations: (n, observation_dim), raw (not normalised)
        :param next_observations: (n, observation_dim)
        :param actions: (n, action_dim), scaled to [-1, 1] as SB3 stores them
        :param rewards: (n,)
        :param dones: (n,), whether the episode ended
        :param timeouts: (n,), whether it ended by a time limit; None: nowhere
        :param infos: SB3's list of n dicts, for a replay buffer class of the user's; None: the time limits alone
        """
        side = self.side(world)
        n = len(rewards)
        self.target_added += n if world == "target" else 0
        timeouts = np.zeros(n, dtype=bool) if timeouts is None else timeouts
        actions = actions.reshape(n, -1)
        if type(side).add is not ReplayBuffer.add or n > side.buffer_size:  # a class of the user's sees every row
            for i in range(n):
                info = [{**(infos[i] if infos else {}), "TimeLimit.truncated": bool(timeouts[i])}]
                row = slice(i, i + 1)
                side.add(observations[row], next_observations[row], actions[row], rewards[row], dones[row], info)
            return
        rows = (side.pos + np.arange(n)) % side.buffer_size
        side.observations[rows, 0] = observations
        side.next_observations[rows, 0] = next_observations
        side.actions[rows, 0] = actions
        side.rewards[rows, 0] = rewards
        side.dones[rows, 0] = dones
        if side.handle_timeout_termination:
            side.timeouts[rows, 0] = timeouts
        side.full = side.full or side.pos + n >= side.buffer_size
        side.pos = (side.pos + n) % side.buffer_size

    def sample(self, batch_size: int, env: VecNormalize | None = None, world: World = "target") -> ReplayBufferSamples:
        """Draw transitions uniformly from one world; as SB3's ``ReplayBuffer.sample`` on that side.

        :raises ValueError: that side is empty, or there is no such world
        """
        side = self.side(world)
        if side.size() == 0:
            raise ValueError(f"the {world} side of the replay buffer is empty: nothing can be sampled from it")
        return side.sample(batch_size, env=env)


def rows_in_order(side: ReplayBuffer) -> np.ndarray:
    """Where the transitions of a buffer are in its arrays, (n,), oldest first."""
    return (np.arange(side.size()) + side.pos * side.full) % side.buffer_size


def chronological(side: ReplayBuffer) -> dict[str, np.ndarray]:
    """All transitions of one side, oldest first, as arrays.

    :return: ``observations`` and ``next_observations`` (n, observation_dim), ``actions`` (n, action_dim) scaled to
        [-1, 1], ``rewards`` (n,), ``terminations`` (n,) without time limits
    """
    order = rows_in_order(side)
    rows = {name: getattr(side, name)[order] for name in _ARRAYS if hasattr(side, name)}
    kept = np.ones((len(order), side.n_envs), dtype=bool)
    if side.optimize_memory_usage:
        # One array holds both: lost are the oldest observation, once overwritten, and what ended an episode.
        rows["next_observations"] = side.observations[(order + 1) % side.buffer_size]
        kept = rows["dones"] == 0
        kept[:1] &= not side.full
    flat = {name: values[kept] for name, values in rows.items()}
    terminations = flat.pop("dones") * (1 - flat.pop("timeouts"))
    return {**flat, "terminations": terminations}


def load_transitions(
    data: ReplayBuffer | str | pathlib.Path | io.BufferedIOBase, world: World = "source", rewards_optional: bool = False
) -> dict[str, np.ndarray]:
    """Read transitions from an SB3 replay buffer, its pickle, or an ``.npz`` file.

    The ``.npz`` form holds ``obs``, ``act`` (scaled to [-1, 1]), ``next_obs``, ``rew`` and ``done`` (terminal, not a
    time limit).

    :param data: where they are
    :param world: the side that is read of a :class:`DualReplayBuffer`
    :param rewards_optional: whether an ``.npz`` may lack ``rew``; the result then has no ``rewards``
    :return: the arrays of :func:`chronological`
    :raises ValueError: for a table, a file with other contents, an empty set or values that are not finite
    :raises TypeError: for anything else
    """
    if not isinstance(data, str | pathlib.Path | ReplayBuffer | io.BufferedIOBase):
        raise TypeError(
            f"source_data and target_data are a replay buffer, its pickle or an .npz file, not {type(data).__name__}; "
            "a robot's log is target_data=Measurements.from_csv(...), from_tables(...), ... (from sb3_rpto.sysid)"
        )
    if isinstance(data, str | pathlib.Path) and str(data).endswith((".csv", ".parquet")):
        reader = f"Measurements.from_{str(data).rpartition('.')[2]}({str(data)!r})"
        raise ValueError(
            f"{str(data)!r} is a table; transitions are read from a replay buffer, its pickle or an .npz file. For a "
            f"robot's log pass target_data={reader} (from sb3_rpto.sysid)"
        )
    if isinstance(data, str | pathlib.Path) and str(data).endswith(".npz"):
        arrays = _load_npz(data, rewards_optional)
    else:
        buffer = data if isinstance(data, ReplayBuffer) else _unpickled(data)
        if not isinstance(buffer, ReplayBuffer):
            raise ValueError(f"expected an SB3 ReplayBuffer, its pickle or an .npz file, got {type(buffer).__name__}")
        if isinstance(buffer, DictReplayBuffer):
            raise ValueError(
                f"a {type(buffer).__name__} holds Dict observations; record with "
                "gymnasium.wrappers.FlattenObservation around the environment, in a ReplayBuffer"
            )
        arrays = chronological(buffer.side(world) if isinstance(buffer, DualReplayBuffer) else buffer)
    if len(arrays["observations"]) == 0:
        raise ValueError("the transitions to load are empty; give at least one")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} of the loaded transitions hold NaN or infinite values; remove those rows")
    return arrays


def _unpickled(file: str | pathlib.Path | io.BufferedIOBase) -> Any:
    """What a pickle holds.

    :raises ValueError: it is none, or torn
    """
    try:
        return load_from_pkl(file)
    except (pickle.UnpicklingError, EOFError, IndexError, KeyError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{str(file)!r} is no pickle ({error}); give what save_replay_buffer() wrote, or an .npz file"
        ) from error


def _load_npz(path: str | pathlib.Path, rewards_optional: bool) -> dict[str, np.ndarray]:
    names = {
        "observations": "obs",
        "next_observations": "next_obs",
        "actions": "act",
        "rewards": "rew",
        "terminations": "done",
    }
    try:
        opened = np.load(path)
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"{str(path)!r} is no .npz file ({error}); write one by numpy.savez") from error
    with opened as file:
        missing = set(names.values()) - set(file.files)
        if missing - ({"rew"} if rewards_optional else set()):
            raise ValueError(f"{path} lacks the arrays {sorted(missing)}; expected obs, act, next_obs, rew, done")
        return {name: file[key] for name, key in names.items() if key in file.files}
