"""Snapshots of environments, so that a resumed run continues bit for bit.

A snapshot is complete or there is none: every layer must be of a class whose state is known here.
"""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import wrappers
from gymnasium.envs.classic_control import Continuous_MountainCarEnv, PendulumEnv
from gymnasium.utils.seeding import np_random
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_rpto.envs.env_copy import FACTORY
from sb3_rpto.envs.observations import layers

# What changes in each layer after it is made. Clocks are left out: they do not influence the course of a run.
_WRAPPERS: dict[type[gym.Wrapper], tuple[str, ...]] = {
    wrappers.TimeLimit: ("_elapsed_steps",),
    wrappers.OrderEnforcing: ("_has_reset",),
    wrappers.PassiveEnvChecker: (
        *("checked_reset", "checked_step", "checked_render", "close_called", "checked_data_reuse", "_previous_data"),
    ),
    wrappers.Autoreset: ("autoreset",),
    wrappers.RecordEpisodeStatistics: (
        *("episode_count", "episode_returns", "episode_lengths", "time_queue", "return_queue", "length_queue"),
    ),
    wrappers.ClipAction: (),
    wrappers.RescaleAction: (),
    wrappers.FlattenObservation: (),
    wrappers.DtypeObservation: (),
    Monitor: (
        *("rewards", "needs_reset", "episode_returns", "episode_lengths", "episode_times"),
        *("total_steps", "current_reset_info"),
    ),
}
_VEC_WRAPPERS: dict[type[VecEnvWrapper], tuple[str, ...]] = {
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
}
_ENVS: dict[type[gym.Env], tuple[str, ...]] = {PendulumEnv: ("state", "last_u"), Continuous_MountainCarEnv: ("state",)}
STATISTICS = ("obs_rms", "ret_rms")
_VECTORISED = ("buf_obs", "buf_dones", "buf_rews", "buf_infos", "reset_infos", "_seeds", "_options")
# Beside the simulation, gymnasium's MuJoCo tasks keep these; Pusher writes the drawn object's place into init_qpos.
_MUJOCO = ("init_qpos", "init_qvel", "goal", "goal_pos", "cylinder_pos")
_MUJOCO_SIZES = ("signature", "nq", "nv", "nu", "na")
_FORWARDING = ("gymnasium.", "stable_baselines3.", "sb3_rpto.")  # whose wrappers hand a seed on


class _Unknown(Exception):
    """A layer whose state is not known here."""


def save_state(env: VecEnv) -> dict[str, Any] | None:
    """Take a snapshot of the simulations, random streams, wrappers and buffers of ``env``.

    Known are DummyVecEnv within VecNormalize and VecMonitor, the wrappers that gymnasium.make and SB3 put around
    environments, wrappers whose class names the attributes that change (``state_attributes``), gymnasium's MuJoCo
    tasks, Pendulum, MountainCarContinuous and every environment that offers ``get_state()`` and ``set_state(state)``.
    Clocks and open files are left out.

    :param env: the environment, untouched
    :return: plain data that pickles, or None when any layer is unknown
    """
    try:
        kept = []
        while isinstance(env, VecEnvWrapper):
            kept.append(_attributes(env, _VEC_WRAPPERS.get(type(env))))
            env = env.venv
        if type(env) is not DummyVecEnv:
            return None
        return {
            "vec_wrappers": kept,
            "buffers": _attributes(env, _VECTORISED),
            "envs": [_save_env(member) for member in env.envs],
        }
    except _Unknown:
        return None


def restore_state(env: VecEnv, state: dict[str, Any]) -> None:
    """Continue where :func:`save_state` was called; the state may be restored any number of times.

    :param env: an environment built as the saved one was; afterwards ``env.step`` continues without a reset
    :param state: what :func:`save_state` returned
    :raises ValueError: when ``env`` is not built like the saved one; nothing is changed then
    """
    vec_layers: list[Any] = []
    while isinstance(env, VecEnvWrapper):
        vec_layers.append(env)
        env = env.venv
    members = env.envs if type(env) is DummyVecEnv else []
    plan: list[tuple[Any, dict[str, Any]]] = list(zip(vec_layers, state["vec_wrappers"]))
    _require(len(vec_layers), len(state["vec_wrappers"]), "VecEnv wrappers")
    _require(len(members), len(state["envs"]), "environments in a DummyVecEnv")
    for member, saved in zip(members, state["envs"]):
        around = layers(member)
        _require([_name(layer) for layer in around], [layer["class"] for layer in saved["layers"]], "layers")
        plan += zip(around, saved["layers"])
        _require(_kind(around[-1]), saved["kind"], "kind of simulation")
    for layer, saved in plan:
        _require(_name(layer), saved["class"], "layer")
    for layer, saved in [*plan, (env, state["buffers"])]:
        for name, value in saved["values"].items():
            _assign(layer, name, value)
    for member, saved in zip(members, state["envs"]):
        _restore_simulation(member.unwrapped, saved)


def _require(found: Any, saved: Any, what: str) -> None:
    if found != saved:
        raise ValueError(f"env is not built like the one whose state was saved: {what} {found}, saved {saved}")


def _name(layer: object) -> str:
    return f"{type(layer).__module__}.{type(layer).__qualname__}"


def save_statistics(normaliser: VecNormalize) -> dict[str, Any]:
    """What it has seen of observations and returns, which is known whatever it wraps."""
    return copy.deepcopy({name: vars(normaliser)[name] for name in STATISTICS if name in vars(normaliser)})


def restore_statistics(normaliser: VecNormalize, statistics: dict[str, Any]) -> None:
    """Put back what :func:`save_statistics` returned, as far as ``normaliser`` has it; others share it as before."""
    for name in statistics.keys() & vars(normaliser).keys():
        _assign(normaliser, name, statistics[name])


def _attributes(layer: Any, names: tuple[str, ...] | None) -> dict[str, Any]:
    if names is None:
        raise _Unknown
    values = {name: vars(layer)[name] for name in names if name in vars(layer)}
    return {"class": _name(layer), "values": copy.deepcopy(values)}


def _assign(layer: Any, name: str, value: Any) -> None:
    current = vars(layer).get(name)
    if isinstance(current, RunningMeanStd):  # in place: the target's VecNormalize may share it
        current.__dict__.update(copy.deepcopy(vars(value)))
    elif isinstance(current, dict) and name == "obs_rms":
        for key in current:
            current[key].__dict__.update(copy.deepcopy(vars(value[key])))
    else:
        vars(layer)[name] = copy.deepcopy(value)


# --- one environment --------------------------------------------------------------------------------------------


def _save_env(env: gym.Env) -> dict[str, Any]:
    *around, base = layers(env)
    kept = [_attributes(layer, _wrapper_state(layer)) for layer in around]
    kind = _kind(base)
    saved: dict[str, Any] = {"kind": kind, "np_random": None}
    if kind == "own":
        kept.append(_attributes(base, ()))
        saved["simulation"] = copy.deepcopy(_call(base, 0))
    elif kind == "plain":
        kept.append(_attributes(base, _ENVS[type(base)]))
    else:
        kept.append(_attributes(base, _MUJOCO))
        # All of MjData: tasks read derived quantities, such as the place of a body, before the next step renews them.
        saved["simulation"] = pickle.dumps(base.data)  # type: ignore[attr-defined]
    if base._np_random is not None:
        saved["np_random"] = copy.deepcopy((base._np_random.bit_generator.state, base._np_random_seed))
    return saved | {"layers": kept}


def _wrapper_state(layer: gym.Env) -> tuple[str, ...] | None:
    if type(layer) in _WRAPPERS:
        return _WRAPPERS[type(layer)]  # type: ignore[index]
    if hasattr(type(layer), "state_attributes"):
        return type(layer).state_attributes  # type: ignore[attr-defined]
    # A wrapper that holds nothing of its own has nothing to save.
    own = vars(layer).keys() - vars(gym.Wrapper(gym.Env())).keys() - {"_saved_kwargs", FACTORY}
    return None if own else ()


def _kind(base: gym.Env) -> Any:
    """How the environment's state is read; for MuJoCo also the layout of the model."""
    if _own(base) is not None:
        return "own"
    if type(base) in _ENVS:
        return "plain"
    if _is_mujoco_task(base):
        return tuple(int(getattr(base.model, name)) for name in _MUJOCO_SIZES)  # type: ignore[attr-defined]
    raise _Unknown


#: Pairs of methods by which an environment of one's own saves and restores its state; MujocoEnv has another set_state.
_OWN = (("get_state", "set_state"), ("save_state", "restore_state"))


def _own(base: gym.Env) -> tuple[str, str] | None:
    """Names of the methods that return the state and take it."""
    for get, put in _OWN:
        if callable(getattr(base, get, None)) and _takes_one(getattr(base, put, None)):
            return get, put
    return None


def _is_mujoco_task(base: gym.Env) -> bool:
    """Whether it is one of gymnasium's or of this package's, whose state is known."""
    return hasattr(base, "model") and type(base).__module__.startswith(("gymnasium.envs.mujoco.", "sb3_rpto.envs."))


def _call(base: gym.Env, which: int, *args: Any) -> Any:
    names = _own(base)
    assert names is not None  # its kind is "own"
    return getattr(base, names[which])(*args)


def _takes_one(method: Any) -> bool:
    """Whether ``method(state)`` is a valid call; MujocoEnv.set_state takes positions and velocities."""
    try:
        inspect.signature(method).bind(None)
    except TypeError:
        return False
    return True


def _restore_simulation(base: gym.Env, saved: dict[str, Any]) -> None:
    if saved["np_random"] is not None:
        stream, seed = saved["np_random"]
        base._np_random = np.random.Generator(getattr(np.random, stream["bit_generator"])())
        base._np_random.bit_generator.state = copy.deepcopy(stream)
        base._np_random_seed = seed
    if saved["kind"] == "own":
        _call(base, 1, copy.deepcopy(saved["simulation"]))
    elif saved["kind"] != "plain":
        mujoco.mj_copyData(base.data, base.model, pickle.loads(saved["simulation"]))  # type: ignore[attr-defined]


def reseed(env: VecEnv, seed: int) -> None:
    """Begin new random streams in the midst of episodes, as a seeded reset begins them.

    Of a DummyVecEnv's members, each from a seed of its own; nothing is done to other VecEnvs.

    :param env: the environment
    :param seed: of the first member
    """
    base = env.unwrapped
    for index, member in enumerate(base.envs if type(base) is DummyVecEnv else ()):
        member.unwrapped.np_random = np_random(seed + index)[0]


def whereabouts(env: VecEnv) -> list[tuple[Any, ...]]:
    """Where the episodes of ``env`` stand, as far as that is cheap to tell: equal while nobody steps or resets it.

    Told are gymnasium's step counters, and the states of its MuJoCo tasks and classic tasks. Nothing is asked of other
    environments: a robot moves by itself.

    :param env: the environment, untouched
    :return: for each member of a DummyVecEnv; empty for others
    """
    base = env.unwrapped
    return [_whereabouts(member) for member in base.envs] if type(base) is DummyVecEnv else []


def _whereabouts(env: gym.Env) -> tuple[Any, ...]:
    *around, base = layers(env)
    known: list[Any] = [layer._elapsed_steps for layer in around if isinstance(layer, wrappers.TimeLimit)]
    if type(base) in _ENVS:
        known.append(np.array(getattr(base, "state", None)).tobytes())  # some have none before the first reset
    elif _is_mujoco_task(base):
        known += [base.data.time, base.data.qpos.tobytes()]  # type: ignore[attr-defined]
    return tuple(known)


def accepts_seed(env: gym.Env) -> bool:
    """Whether ``env.reset(seed=...)`` works, looking inward where a wrapper only hands its arguments on.

    :param env: an environment; it is not reset
    """
    for layer in layers(env):
        parameters = inspect.signature(layer.reset).parameters
        named = "seed" in parameters
        if not named and not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
            return False
        # Another wrapper that names the seed answers for it.
        if named and not type(layer).reset.__module__.startswith(_FORWARDING):
            return True
    return True
