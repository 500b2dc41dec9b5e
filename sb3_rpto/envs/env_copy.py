"""Environments from factories and ids, and trial copies of them with all their wrappers."""

from __future__ import annotations

import io
import pickle
import types
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import wrappers
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_rpto.effects.wrapper import with_numbers
from sb3_rpto.envs.observations import layers

#: Wrappers that only draw or film.
_DRAWING = (wrappers.RecordVideo, wrappers.HumanRendering, wrappers.RenderCollection)
#: Windows belong to the original.
_WINDOWS = ("pygame", "gymnasium.envs.mujoco.mujoco_rendering")
#: What a function may hold that is shared with a copy.
_PLAIN = (str, bytes, int, float, complex, np.generic, np.ndarray, type, types.ModuleType, type(None))
#: Attribute by which an environment keeps the function that made it.
FACTORY = "made_by"

#: What an environment argument may be: the environment, its id, or a function that makes a new one.
EnvSource: TypeAlias = gym.Env | VecEnv | str | Callable[[], gym.Env | VecEnv]


class CopyError(ValueError):
    """An environment holds what cannot be copied, and nothing is known that would make another one."""


def make_env(env: EnvSource, name: str = "env") -> gym.Env | VecEnv:
    """The environment that an argument stands for.

    A function that makes it, or an id, is better than an environment: copies are then made anew where an object's
    contents do not copy.

    :param env: an environment, a VecEnv, an id, or a function without arguments that returns a new environment
    :param name: of the argument, for the message
    :raises TypeError: the function returns something else
    """
    if isinstance(env, gym.Env | VecEnv) or not (isinstance(env, str) or callable(env)):
        return env  # what is no environment is refused elsewhere
    make = partial(gym.make, env) if isinstance(env, str) else env
    made = make()
    if not isinstance(made, gym.Env | VecEnv):
        raise TypeError(f"{name}: the function returned {type(made).__name__}; it must return a new environment")
    if isinstance(made, gym.Env):
        setattr(made, FACTORY, make)
    return made


def copy_env(env: gym.Env | VecEnv) -> gym.Env | None:
    """As :func:`must_copy`; None where it cannot be copied."""
    try:
        return must_copy(env)
    except Exception:  # whatever the contents of a user's environment raise when copied
        return None


def must_copy(env: gym.Env | VecEnv) -> gym.Env:
    """Copy an environment (of a VecEnv the first) with all its wrappers, to try things without touching the original.

    The copy goes on from where the original is. It draws no pictures and writes no files. Helpers and wrappers that
    hold the environment's ``MjModel`` or ``MjData`` hold the copy's. What holds parts of a simulation in other ways (a
    function over the environment, an array that is a view of the simulation) is refused, unless :func:`make_env` had a
    function that makes a new one: that is called, and takes over the numbers of the model, the state of the simulation
    and of the random numbers. (Python's own deep copy of a gymnasium MuJoCo task loses later changes of its model.)

    :param env: the environment, untouched
    :raises CopyError: it cannot be copied
    """
    base = env if isinstance(env, gym.Env) else env.unwrapped
    if not isinstance(base, gym.Env | DummyVecEnv):
        raise CopyError(f"{type(base).__name__} keeps its environments elsewhere")
    original = base if isinstance(base, gym.Env) else base.envs[0]
    try:
        return _copied(original, {})
    except Exception as error:  # whatever the contents of a user's environment raise when copied
        made = next((layer for layer in layers(original) if FACTORY in vars(layer)), None)
        if made is None:
            raise CopyError(f"{error}; pass a function that makes it, or an id, in its place") from error
        return _copied(original, _made_anew(made))


def _made_anew(env: gym.Env) -> dict[int, Any]:
    """Another environment by the function that made ``env``, which goes on from where that is.

    :return: it and its parts, by the ``id`` of those that they replace
    """
    twin = vars(env)[FACTORY]()
    setattr(twin, FACTORY, vars(env)[FACTORY])
    base: Any = env.unwrapped
    new: Any = twin.unwrapped
    parts = {id(env): twin, id(base): new}
    twin.reset(seed=0)  # some have no simulation before
    if isinstance(getattr(base, "data", None), mujoco.MjData):
        with_numbers(twin, base.model)
        mujoco.mj_copyData(new.data, new.model, base.data)
        parts |= {id(base.model): new.model, id(base.data): new.data}
    new.render_mode = None
    new._np_random, new._np_random_seed = _copied(base._np_random, {}), base._np_random_seed
    return parts


def _copied(value: Any, known: Mapping[int, Any]) -> Any:
    """A deep copy by pickling, which tells what a deep copy would share or lose.

    :param known: copies that there are already, by the ``id`` of their originals
    """
    written = io.BytesIO()
    pickler = _Pickler(written, known)
    pickler.dump(value)
    written.seek(0)
    return _Unpickler(written, pickler.shared).load()


class _Pickler(pickle.Pickler):
    """Writes an environment; what is shared with the copy, or copied by other means, is kept beside."""

    def __init__(self, file: io.BytesIO, known: Mapping[int, Any]) -> None:
        super().__init__(file, protocol=5)
        self.known, self.shared = dict(known), list[Any]()
        self.originals = list[Any]()  # alive, so that no other object has their id

    def persistent_id(self, value: Any) -> int | None:
        if id(value) in self.known:
            return self._kept(self.known[id(value)])
        kind = type(value)
        if isinstance(value, ResultsWriter) or kind.__module__.startswith(_WINDOWS):
            return self._kept(None)
        if isinstance(value, type | types.ModuleType):
            return self._kept(value)
        if isinstance(value, types.FunctionType):
            _require_apart(value, set())
            return self._kept(value)
        if isinstance(value, mujoco.MjModel | mujoco.MjData | mujoco.MjSpec):
            return self._kept(self._simulation(value))
        if isinstance(value, np.ndarray) and _is_view_of_a_simulation(value):
            raise pickle.PicklingError("it holds an array that is a view of the simulation")
        return None

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, _DRAWING):
            return _itself, (value.env,)
        if isinstance(value, gym.Env):  # EzPickle would make a new one from the constructor's arguments
            if FACTORY in vars(value):
                self.known[id(vars(value)[FACTORY])] = vars(value)[FACTORY]
            state = vars(value) if isinstance(value, gym.Wrapper) else {**vars(value), "render_mode": None}
            return object.__new__, (type(value),), state, None, None, _set_state
        return NotImplemented

    def _kept(self, value: Any) -> int:
        self.shared.append(value)
        return len(self.shared) - 1

    def _simulation(self, value: Any) -> Any:
        """A copy of an ``MjModel`` or ``MjSpec``; of an ``MjData`` one that steps the copy of its model."""
        if isinstance(value, mujoco.MjData):
            self.persistent_id(value.model)
            twin = mujoco.MjData(self.known[id(value.model)])
            mujoco.mj_copyData(twin, twin.model, value)
        else:
            twin = value.copy() if isinstance(value, mujoco.MjSpec) else value.__copy__()
        self.known[id(value)] = twin
        self.originals.append(value)
        return twin


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, shared: list[Any]) -> None:
        super().__init__(file)
        self.shared = shared

    def persistent_load(self, pid: int) -> Any:
        return self.shared[pid]


def _itself(value: Any) -> Any:
    return value


def _set_state(env: gym.Env, state: dict[str, Any]) -> None:
    vars(env).update(state)


def _require_apart(held: Any, seen: set[int]) -> None:
    """Refuse a function that holds more than plain values: in a copy it would look into the original.

    :param held: the function, or what it holds
    :param seen: ids of functions that were looked at
    :raises pickle.PicklingError: likewise
    """
    if isinstance(held, types.FunctionType):
        # Those of gymnasium's wrappers, such as ClipAction, look at the spaces alone.
        if id(held) not in seen and not held.__module__.startswith("gymnasium."):
            seen.add(id(held))
            cells = [cell for cell in held.__closure__ or () if cell != types.CellType()]  # empty: bound later
            defaults = *(held.__defaults__ or ()), *(held.__kwdefaults__ or {}).values()
            for value in (*defaults, *(cell.cell_contents for cell in cells)):
                _require_apart(value, seen)
    elif isinstance(held, tuple):
        for value in held:
            _require_apart(value, seen)
    elif not isinstance(held, _PLAIN) or (isinstance(held, np.ndarray) and _is_view_of_a_simulation(held)):
        raise pickle.PicklingError(f"it holds a function over {type(held).__name__}, which may be the environment's")


def _is_view_of_a_simulation(array: np.ndarray) -> bool:
    """MuJoCo's arrays are views of memory that no Python object owns."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return type(base).__name__ == "PyCapsule"
