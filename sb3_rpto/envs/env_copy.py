"""Trial copies of environments, with all their wrappers and whatever looks into their simulation."""

from __future__ import annotations

import copy
import functools
import re
import types
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_rpto.envs.observations import layers

#: Wrappers that only draw or film.
_DRAWING = (wrappers.RecordVideo, wrappers.HumanRendering, wrappers.RenderCollection)
#: MuJoCo's named views: of which structure, and of which kind of object.
_VIEWS = re.compile(r"_(MjData|MjModel)(\w+)Views")
#: Collections of more things hold numbers, not views of a simulation.
_LARGE = 1000


def copy_env(env: gym.Env | VecEnv) -> gym.Env | None:
    """Copy an environment (of a VecEnv the first) with all its wrappers, to try things without touching the original.

    The copy draws no pictures and writes no files. What looks into the simulation (helpers and wrappers that hold its
    ``MjData``, arrays that are views of it, functions over the environment) looks into the copy's. (Python's own deep
    copy of a gymnasium MuJoCo task makes a new one from the constructor's arguments, which loses every later change of
    the model.)

    :param env: the environment, untouched
    :return: the copy, or None when it cannot be made (subprocesses, contents that do not copy)
    """
    try:
        return must_copy(env)
    except Exception:  # whatever the contents of a user's environment raise when copied
        return None


def must_copy(env: gym.Env | VecEnv) -> gym.Env:
    """As :func:`copy_env`.

    :raises Exception: what stands in the way, of any kind
    """
    base = env if isinstance(env, gym.Env) else env.unwrapped
    if not isinstance(base, gym.Env | DummyVecEnv):
        raise TypeError(f"{type(base).__name__} keeps its environments elsewhere")
    return _clone(base if isinstance(base, gym.Env) else base.envs[0], {})


def _clone(env: gym.Env, memo: dict[int, Any]) -> gym.Env:
    """A copy of all layers; ``memo`` is that of :func:`copy.deepcopy`: what is in it is not copied again."""
    kept = [layer for layer in layers(env) if not isinstance(layer, _DRAWING)]
    memo.update({id(layer): object.__new__(type(layer)) for layer in kept})
    inner = memo[id(kept[-1])]
    for layer in reversed(layers(env)):
        inner = memo.setdefault(id(layer), inner)  # in the place of one that draws is what it wraps
    # The innermost first, as it has the model of its data.
    simulations = [pair for layer in reversed(kept) for pair in _cloned_simulation(layer, memo)]
    fields = [pair for one, twin in simulations for pair in _numbers(one, twin)]
    things = list(_reachable([vars(layer) for layer in kept]))
    for thing in things:
        if isinstance(thing, np.ndarray) and thing.base is not None:
            _follow(thing, fields, memo)
        elif _VIEWS.fullmatch(type(thing).__name__):
            _look_up(thing, simulations, memo)
    for thing in things:
        if isinstance(thing, types.FunctionType):
            _twin_of(thing, memo)
    for layer in kept:
        twin = memo[id(layer)]
        for name, value in vars(layer).items():
            vars(twin)[name] = _copied(value, memo)
        if not isinstance(twin, gym.Wrapper):
            twin.render_mode = None
    return memo[id(env)]


def _copied(value: Any, memo: dict[int, Any]) -> Any:
    if id(value) in memo:
        return memo[id(value)]
    if isinstance(value, gym.Env):
        return _clone(value, memo)
    return None if _is_handle(value) else copy.deepcopy(value, memo)


def _is_handle(value: Any) -> bool:
    """Windows and files belong to the original."""
    module = type(value).__module__
    return isinstance(value, ResultsWriter) or module.startswith(("pygame", "gymnasium.envs.mujoco.mujoco_rendering"))


def _cloned_simulation(layer: gym.Env, memo: dict[int, Any]) -> Iterator[tuple[Any, Any]]:
    """Let ``memo`` have a copy of the layer's ``MjData`` that steps a copy of its model; both with their copies."""
    for data in vars(layer).values():
        if type(data).__name__ != "MjData" or id(data) in memo:
            continue
        import mujoco

        model = vars(layer)["model"]
        memo[id(data)] = mujoco.MjData(copy.deepcopy(model, memo))
        mujoco.mj_copyData(memo[id(data)], memo[id(model)], data)
        yield from ((data, memo[id(data)]), (model, memo[id(model)]))


def _numbers(one: Any, twin: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The arrays of what holds some by name, each with that of its copy."""
    for name in dir(one):
        field = None if name.startswith("_") else getattr(one, name, None)
        if isinstance(field, np.ndarray) and field.size:
            yield field, getattr(twin, name)


def _reachable(values: list[Any]) -> Iterator[Any]:
    """All that is held, also by the helpers, collections and functions that are."""
    seen: set[int] = set()
    while values:
        value = values.pop()
        if id(value) in seen or isinstance(value, type | types.ModuleType):
            continue
        seen.add(id(value))
        yield value
        if isinstance(value, dict | list | tuple | set):
            if len(value) <= _LARGE:
                values.extend(value.values() if isinstance(value, dict) else value)
        elif isinstance(value, functools.partial):
            values += [value.func, value.args, value.keywords]
        elif isinstance(value, types.MethodType):
            values.append(value.__self__)
        elif isinstance(value, types.FunctionType):
            values += [value.__defaults__, *map(_content, value.__closure__ or ())]
        elif hasattr(value, "__dict__"):
            values.append(vars(value))


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # of a name that is bound later
        return None


def _follow(array: np.ndarray, fields: Sequence[tuple[np.ndarray, np.ndarray]], memo: dict[int, Any]) -> None:
    """Let the copy of a view of a simulation's numbers be that view of its copy's."""
    for field, twin in fields:
        if np.may_share_memory(array, field):
            start = array.__array_interface__["data"][0] - field.__array_interface__["data"][0]
            memo[id(array)] = np.ndarray(array.shape, array.dtype, twin.reshape(-1), start, array.strides)
            return


def _look_up(view: Any, simulations: Sequence[tuple[Any, Any]], memo: dict[int, Any]) -> None:
    """Let the copy of ``data.joint("elbow")``, or of another named view, be that of its simulation's copy."""
    of, what = _VIEWS.fullmatch(type(view).__name__).groups()  # type: ignore[union-attr]
    for one, twin in simulations:
        if type(one).__name__ == of:
            same, found = (getattr(side, what.lower())(view.id) for side in (one, twin))
            if any(np.may_share_memory(field, mine) for field, mine in _numbers(view, same)):
                memo[id(view)] = found
                return


def _twin_of(value: Any, memo: dict[int, Any]) -> Any:
    """What takes the place of what a function holds: itself, unless it looks into the environment or its simulation."""
    if id(value) not in memo and any(id(held) in memo for held in _reachable([value])):
        if isinstance(value, types.FunctionType):
            _rebind(value, memo)
        else:
            copy.deepcopy(value, memo)
    return memo.get(id(value), value)


def _rebind(function: types.FunctionType, memo: dict[int, Any]) -> None:
    """Let the copy of a function over the environment, or over its simulation, be that function over the copy."""
    cells = tuple(types.CellType() for _ in function.__closure__ or ())
    twin = types.FunctionType(function.__code__, function.__globals__, function.__name__, None, cells)
    memo[id(function)] = twin  # before what it holds, which may be itself
    for cell, old in zip(cells, function.__closure__ or (), strict=True):
        cell.cell_contents = _twin_of(_content(old), memo)
    if function.__defaults__ is not None:
        twin.__defaults__ = tuple(_twin_of(value, memo) for value in function.__defaults__)
    twin.__kwdefaults__ = function.__kwdefaults__
    vars(twin).update(vars(function))
