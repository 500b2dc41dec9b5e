"""From observations back to simulation states, for gymnasium's MuJoCo tasks and those that a user registers."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_rpto.envs.task_rules import HARMLESS_VEC_WRAPPERS, HARMLESS_WRAPPERS

CLIP = 10.0
"""Speeds are observed up to this bound by Hopper, Walker2d and InvertedDoublePendulum, in m/s or rad/s."""


class States(NamedTuple):
    """Simulation states behind n observations.

    What is not known is NaN where the observation holds nothing of it, else the nearest that it holds: the bound of a
    clipped speed, a place that is one simulation step old.
    """

    qpos: np.ndarray  # (n, nq)
    qvel: np.ndarray  # (n, nv)
    known_qpos: np.ndarray  # (n, nq), bool
    known_qvel: np.ndarray  # (n, nv), bool
    wrapped: tuple[int, ...] = ()  # columns of qpos that are angles within one turn, whole turns being lost


Recover = Callable[[np.ndarray], States]


@dataclass(frozen=True)
class StateMap:
    """Recovers the states of one environment from its observations.

    :param env_name: for messages
    :param sizes: nq and nv of the model
    :param width: length of an observation
    :param recover: the map itself, (n, width) in float64 to :class:`States`
    """

    env_name: str
    sizes: tuple[int, int]
    width: int
    recover: Recover

    def __call__(self, observations: np.ndarray) -> States:
        """Recover the states.

        :param observations: raw (not normalised), shape (n, width)
        :raises ValueError: observations, or what a registered map returns, of another shape
        """
        observations = np.asarray(observations, dtype=np.float64)
        if observations.ndim != 2 or observations.shape[1] != self.width:
            raise ValueError(
                f"observations of {self.env_name} have shape (n, {self.width}), not {observations.shape}; "
                "give the environment that they come from"
            )
        states: Any = self.recover(observations)  # of a user's map anything
        try:
            first = [*states][:4]
            found = [np.shape(array) for array in first]
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the state map of {self.env_name} returned {type(states).__name__}; it must return States(...)"
            ) from error
        shapes = [(len(observations), size) for size in self.sizes] * 2
        if found != shapes:
            raise ValueError(f"the state map of {self.env_name} returned arrays of shapes {found}; expected {shapes}")
        qpos, qvel = (np.asarray(array, dtype=np.float64) for array in first[:2])
        known_qpos, known_qvel = (np.asarray(array, dtype=bool) for array in first[2:])
        return States(qpos, qvel, known_qpos, known_qvel, *[*states][4:])


def whole_state(nq: int, nv: int) -> StateMap:
    """The map of observations that are the state itself, positions and then speeds; NaN where one is not known.

    :param nq: number of positions
    :param nv: number of speeds
    """
    return StateMap("a model alone", (nq, nv), nq + nv, partial(_split, nq))


def _split(nq: int, observations: np.ndarray) -> States:
    qpos, qvel = observations[:, :nq], observations[:, nq:]
    return States(qpos, qvel, np.isfinite(qpos), np.isfinite(qvel))


_NO_MAP = (
    "register_state_map for {} was not given what makes a state map: a function of the environment that returns the "
    "function of observations"
)
_registered: dict[str | type[gym.Env], Callable[[gym.Env], Recover]] = {}


def register_state_map(env: str | type[gym.Env], make: Callable[[gym.Env], Recover]) -> None:
    """Say how the states of an environment are recovered; takes precedence over what is known here.

    For example, where the observation begins with the state, whatever comes after it::

        def make(env):
            nq, nv = env.unwrapped.model.nq, env.unwrapped.model.nv

            def recover(obs):
                qpos, qvel = obs[:, :nq], obs[:, nq : nq + nv]
                return States(qpos, qvel, np.isfinite(qpos), np.isfinite(qvel))

            return recover

        register_state_map("mine/Arm-v0", make)

    :param env: the environment's id, or the class of the unwrapped environment (its subclasses count too)
    :param make: is given the environment with all its wrappers, returns the map of observations (n, d) to
        :class:`States`
    """
    _registered[env] = make


def known_at_rest(recover: StateMap) -> np.ndarray:
    """Which positions and velocities an observation tells of while no speed is at its bound, (nq + nv,)."""
    with np.errstate(all="ignore"):
        rest = recover(np.zeros((1, recover.width)))
    return np.concatenate([rest.known_qpos[0], rest.known_qvel[0]])


def are_known(recover: StateMap, observations: np.ndarray) -> np.ndarray:
    """Whether of the states behind observations (n, width) all is known that these ever tell: no speed at its bound."""
    states = recover(observations)
    known = np.concatenate([states.known_qpos, states.known_qvel], axis=1)
    return np.asarray(known[:, known_at_rest(recover)].all(axis=1))


def noise_of_each(noise: float | Sequence[float] | np.ndarray, recover: StateMap, name: str = "noise") -> np.ndarray:
    """Standard deviation of each observation's noise, (width,), from one for each or for all.

    :param recover: the observations' map
    :param name: of the argument, for the messages
    :raises ValueError: of another shape, no numbers, negative or not finite, or no noise at all; observations that do
        not hold all velocities, without which a noisy sample is no state
    """
    try:
        given = np.asarray(noise, dtype=float)
    except (TypeError, ValueError):
        given = np.array(np.nan)
    fits = given.shape in ((), (recover.width,)) and not isinstance(noise, bool)
    if not fits or not (np.isfinite(given).all() and (given >= 0).all() and given.any()):
        raise ValueError(
            f"{name} is {noise!r}; give a standard deviation above 0, or one for each of the {recover.width} "
            "observations, in their units; leave it out for observations without noise"
        )
    with np.errstate(all="ignore"):
        shown = recover(np.zeros((1, recover.width))).known_qvel[0]
    if not shown.all():
        raise ValueError(
            f"{name}: the observations of {recover.env_name} do not hold the velocities of all joints "
            f"({int((~shown).sum())} of {len(shown)} are missing), so noisy ones are no states: leave it out, or "
            "observe them"
        )
    return np.broadcast_to(given, (recover.width,)).copy()


def single_env(env: gym.Env | VecEnv) -> gym.Env:
    """The environment itself, or the first of a VecEnv in this process; VecNormalize is looked through.

    :param env: buffers hold the raw observations of it
    :raises ValueError: a VecEnv in subprocesses or within a wrapper that changes the observations
    """
    if isinstance(env, gym.Env):
        return env
    inner = env
    while isinstance(inner, VecEnvWrapper) and isinstance(inner, HARMLESS_VEC_WRAPPERS):
        inner = inner.venv
    if not isinstance(inner, DummyVecEnv):
        raise ValueError(
            f"env is a {type(inner).__name__}, whose simulations cannot be read; give one environment (gym.make(...))"
        )
    return inner.envs[0]


def layers(env: gym.Env) -> list[gym.Env]:
    """The wrappers from the outside in, then the environment itself."""
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def env_name(env: gym.Env) -> str:
    """The environment's id, or its class where it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def mujoco_model(env: gym.Env) -> Any:
    """The ``mujoco.MjModel`` that the environment simulates.

    :raises ValueError: there is none
    """
    model = getattr(env.unwrapped, "model", None)
    if type(model).__name__ != "MjModel":
        raise ValueError(
            f"{env_name(env)} has no MuJoCo model (env.unwrapped.model), so its states have no joints to be named by; "
            "describe the system in an MJCF and give its recordings as tables (Measurements.from_tables)"
        )
    return model


def state_map(env: gym.Env) -> StateMap:
    """How the states of ``env`` are recovered from its observations.

    Known are gymnasium's Ant, HalfCheetah, Hopper, Humanoid, HumanoidStandup, InvertedDoublePendulum,
    InvertedPendulum, Pusher, Reacher, Swimmer and Walker2d (v4, v5), and classes derived from them that leave the
    observation as it is; wrappers that change actions or rewards only do not matter.

    :param env: a MuJoCo environment
    :raises ValueError: the state cannot be recovered; the message names the environment and the remedy
    """
    name, base = env_name(env), env.unwrapped
    model = mujoco_model(env)
    shape = env.observation_space.shape
    if shape is None or len(shape) != 1:
        raise ValueError(f"{name}: observations must be vectors, the space is {env.observation_space}; unwrap env")
    make = _registered.get(env.spec.id if env.spec is not None else "")
    if make is None:
        make = next((_registered[cls] for cls in type(base).__mro__ if cls in _registered), None)
    strange = strange_wrapper(env)
    if make is not None and strange is not None:
        warnings.warn(
            f"{name}: its registered state map is taken to know what the wrapper {strange} makes of the "
            "observations; give the environment without it where it does not",
            stacklevel=2,
        )
    if make is None:
        if strange is not None:
            raise ValueError(
                f"{name}: what the wrapper {strange} makes of the observations is not known; give the "
                "environment without it where it leaves them as they are, else use register_state_map"
            )
        # Whoever wrote _get_obs decides on the layout, however deep a class is derived.
        author = next((cls for cls in type(base).__mro__ if "_get_obs" in vars(cls)), object)
        known = author.__module__.startswith("gymnasium.envs.mujoco.")
        make = _TASKS.get(author.__name__.removesuffix("Env")) if known else None
        if make is None:
            key = type(base).__name__ if env.spec is None else repr(name)
            raise ValueError(
                f"{name}: how its observations (written by {author.__name__}._get_obs) follow from the state is not "
                f"known; tell it with register_state_map({key}, ...), in the module that registers the environment"
            )
    try:
        recover: Any = make(env)
    except (TypeError, IndexError) as error:
        raise ValueError(f"{_NO_MAP.format(name)} ({error})") from error
    if not callable(recover):
        raise ValueError(_NO_MAP.format(name))
    return StateMap(name, (model.nq, model.nv), shape[0], recover)


def strange_wrapper(env: gym.Env) -> str | None:
    """The outermost wrapper that is not known to leave observations as they are; None without one."""
    return next((type(layer).__name__ for layer in layers(env)[:-1] if not leaves_observations(layer)), None)


def leaves_observations(layer: gym.Env) -> bool:
    """Whether a wrapper is known to pass observations on as they are."""
    if isinstance(layer, gym.ObservationWrapper):
        return False
    own = type(layer).__module__.startswith("sb3_rpto.")
    return own or isinstance(layer, gym.ActionWrapper | gym.RewardWrapper) or type(layer).__name__ in HARMLESS_WRAPPERS


# --- layouts ------------------------------------------------------------------------------------------------------


def _make_plain(env: gym.Env, hidden: int = 0, clip: float = np.inf) -> Recover:
    base: Any = env.unwrapped
    if not getattr(base, "_exclude_current_positions_from_observation", hidden > 0):
        hidden = 0
    size, needed = env.observation_space.shape[0], base.model.nq - hidden + base.model.nv  # type: ignore[index]
    if size < needed:
        raise ValueError(
            f"{env_name(env)}: an observation of {size} numbers is too short for the model's {base.model.nq} positions "
            f"and {base.model.nv} velocities; use register_state_map"
        )
    return partial(_plain, hidden=hidden, nq=base.model.nq, nv=base.model.nv, clip=clip)


def _plain(observations: np.ndarray, *, hidden: int, nq: int, nv: int, clip: float) -> States:
    """Positions without the first ``hidden`` ones, velocities, and then whatever else."""
    n, shown = len(observations), nq - hidden
    qpos = np.concatenate([np.full((n, hidden), np.nan), observations[:, :shown]], axis=1)
    qvel = observations[:, shown : shown + nv].copy()
    return States(qpos, qvel, ~np.isnan(qpos), np.abs(qvel) < clip)


def _make_fixed(env: gym.Env, recover: Recover, sizes: tuple[int, int]) -> Recover:
    model = mujoco_model(env)
    if (model.nq, model.nv) != sizes:
        raise ValueError(
            f"{env_name(env)}: the task's model has {sizes[0]} positions and {sizes[1]} velocities, this one "
            f"{model.nq} and {model.nv}; use register_state_map"
        )
    return recover


def _double_pendulum(observations: np.ndarray) -> States:
    """x, the sines of two angles, their cosines, three clipped velocities, constraint forces."""
    x, sin, cos = observations[:, :1], observations[:, 1:3], observations[:, 3:5]
    qpos = np.concatenate([x, np.arctan2(sin, cos)], axis=1)
    qvel = observations[:, 5:8].copy()
    return States(qpos, qvel, np.ones_like(qpos, dtype=bool), np.abs(qvel) < CLIP, wrapped=(1, 2))


def _reacher(observations: np.ndarray) -> States:
    """Cosines of two angles, their sines, the target's coordinates, two velocities; the target rests."""
    cos, sin, target = observations[:, :2], observations[:, 2:4], observations[:, 4:6]
    qpos = np.concatenate([np.arctan2(sin, cos), target], axis=1)
    qvel = np.concatenate([observations[:, 6:8], np.zeros_like(target)], axis=1)
    known = np.ones_like(qpos, dtype=bool)
    return States(qpos, qvel, known, known.copy(), wrapped=(0, 1))


def _make_pusher(env: gym.Env) -> Recover:
    model = mujoco_model(env)
    _make_fixed(env, _reacher, (11, 11))
    place = np.array([model.body_pos[model.joint(j).bodyid[0]] for j in range(7, 11)])
    return partial(_pusher, axes=model.jnt_axis[7:].copy(), place=place, reference=model.qpos0[7:].copy())


def _pusher(observations: np.ndarray, *, axes: np.ndarray, place: np.ndarray, reference: np.ndarray) -> States:
    """Seven arm angles, their velocities, the places of fingertip, object and goal; the goal rests.

    The places are those before the last simulation step, which matters for the object once it is pushed. A body that
    only slides is at ``place + axis (q - reference)``, summed over its joints.

    :param axes: unit axes of the object's two and the goal's two slides, (4, 3)
    :param place: of their bodies in the model, (4, 3)
    :param reference: position of each slide in the model's own configuration, (4,)
    """
    bodies = observations[:, 17:23].reshape(-1, 2, 3).repeat(2, axis=1)
    slides = ((bodies - place) * axes).sum(-1) + reference
    qpos = np.concatenate([observations[:, :7], slides], axis=1)
    qvel = np.concatenate([observations[:, 7:14], np.tile([np.nan, np.nan, 0.0, 0.0], (len(observations), 1))], axis=1)
    known_qpos = np.ones_like(qpos, dtype=bool)
    known_qpos[:, 7:9] = False
    return States(qpos, qvel, known_qpos, ~np.isnan(qvel))


_TASKS: dict[str, Callable[[gym.Env], Recover]] = {
    "Ant": partial(_make_plain, hidden=2),
    "HalfCheetah": partial(_make_plain, hidden=1),
    "Hopper": partial(_make_plain, hidden=1, clip=CLIP),
    "Humanoid": partial(_make_plain, hidden=2),
    "HumanoidStandup": partial(_make_plain, hidden=2),
    "InvertedDoublePendulum": partial(_make_fixed, recover=_double_pendulum, sizes=(3, 3)),
    "InvertedPendulum": _make_plain,
    "Pusher": _make_pusher,
    "Reacher": partial(_make_fixed, recover=_reacher, sizes=(4, 4)),
    "Swimmer": partial(_make_plain, hidden=2),
    "Walker2d": partial(_make_plain, hidden=1, clip=CLIP),
}
