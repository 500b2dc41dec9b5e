"""Whether a MuJoCo environment's step is the simulation of its action alone, and its observations show its states."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects.actuation import command_limits
from sb3_rpto.effects.engine import quiet
from sb3_rpto.effects.model_numbers import differing
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.observations import StateMap, are_known, layers

#: Episodes, and steps of each, that are compared with MuJoCo alone: what remembers shows after the first.
TRIED, FOLLOWED = 3, 4
#: All that a simulation of transitions starts from. What else a reset sets, a mocap body say, it does not know.
KNOWN = ("qpos", "qvel", "act", "history", "qacc_warmstart")
#: Episodes and steps of each whose states are compared with what the observations are said to show.
SHOWN, STEPS = 3, 10
#: Episodes of which a step is compared with those of others; more than noise tells them apart where they differ by this
#: many times as much as steps of one episode.
EPISODES, BEYOND = 8, 3.0
#: A coordinate is wrong where it is off by more than this share of how far the coordinate moves, and by this much.
OFF, LEAST = 0.5, 1e-3
#: It is wrong, too, where its zero is off by more than this share, or its scale, and by more than noise lets them.
SYSTEMATIC = 0.05
#: An answer depends on more than a state where it differs by this share of how far answers do. Rewards of Ant differ by
#: a tenth on the ground: they are told by where the last stage of Runge and Kutta's method leaves its torso.
MEANT = 0.2
#: Fields that say where things are, or how they look.
PLACES = re.compile(r"(body|geom|site|cam|light)_(pos|quat|rgba|dir|poscom0|pos0|mat0)|(mat|tex|vis|stat)[._].*")


def odd_step(env: gym.Env, frame_skip: int) -> str | None:
    """What a step does beside simulating its action; None where nothing is found.

    A copy is stepped by random actions and compared with MuJoCo alone. Nothing is found where it cannot be copied.

    :param env: a MuJoCo environment, whose actions have the shape of the model's commands; untouched
    :param frame_skip: simulation steps in one step of it
    """
    twin = copy_env(env)
    if twin is None:
        return None
    base: Any = twin.unwrapped
    twin.action_space.seed(0)
    low, high = command_limits(base.model)
    over = False
    for step in range(TRIED * FOLLOWED):
        if step % FOLLOWED == 0 or over:
            twin.reset(seed=step)
        action = twin.action_space.sample()
        commands = np.clip(action, low, high)
        alone = mujoco.MjData(base.model)
        for name in KNOWN:
            getattr(alone, name)[:] = getattr(base.data, name)
        alone.time = base.data.time
        alone.ctrl[:] = commands
        with quiet():
            mujoco.mj_step(base.model, alone, nstep=frame_skip)
            over = any(twin.step(action)[2:4])
        if not np.allclose(np.clip(base.data.ctrl, low, high), commands):
            return f"gives the commands {base.data.ctrl} where the action is {action}"
        if not (np.allclose(base.data.qpos, alone.qpos) and np.allclose(base.data.qvel, alone.qvel)):
            return (
                "moves otherwise than MuJoCo from the same positions and velocities under the same command (forces, "
                "bodies or constraints that step() or reset() sets beside them?)"
            )
    return None


def drawn_numbers(env: gym.Env) -> list[str]:
    """Numbers of the model that a reset draws, but for where things are and how they look: those are goals.

    Nothing is found where the environment cannot be copied.

    :param env: a MuJoCo environment; untouched
    """
    twin = copy_env(env)
    if twin is None:
        return []
    model: mujoco.MjModel = twin.unwrapped.model  # type: ignore[attr-defined]
    drawn = list[mujoco.MjModel]()
    for seed in range(TRIED):
        twin.reset(seed=seed)
        drawn.append(model.__copy__())
    found = {name for one, other in pairwise(drawn) for name in differing(one, other)}
    return sorted(name for name in found if not PLACES.fullmatch(name))


def draws_unseeded(env: gym.Env) -> bool:
    """Whether a reset draws where an episode begins from random numbers that its seed does not set.

    Copies of such an environment begin alike whatever their seeds. Nothing is found where it cannot be copied.

    :param env: a MuJoCo environment; untouched
    """
    twins = [copy_env(env) for _ in range(2)]

    def begun(twin: gym.Env, seed: int | None) -> np.ndarray:
        twin.reset(seed=seed)
        data: mujoco.MjData = twin.unwrapped.data  # type: ignore[attr-defined]
        return np.concatenate([data.qpos, data.qvel])

    if twins[0] is None or twins[1] is None:
        return False
    one, other = (begun(twin, seed) for seed, twin in enumerate(twins) if twin is not None)
    return np.array_equal(one, other) and not np.array_equal(one, begun(twins[0], None))


def odd_state(env: gym.Env, recover: StateMap) -> str | None:
    """Which coordinate the observations do not show as they are said to; None where all are, but for some noise.

    A copy is stepped by random actions, and each of its states read twice more by another one, which tells the noise.
    Nothing is found where it cannot be copied.

    :param env: a MuJoCo environment; untouched
    :param recover: states from its observations
    :raises ValueError: what the map returns has other shapes than states
    """
    twin, other = copy_env(env), copy_env(env)
    if twin is None or other is None:
        return None
    base: Any = twin.unwrapped
    twin.action_space.seed(0)
    other.reset(seed=0)
    observations, states, again = list[np.ndarray](), list[np.ndarray](), list[list[np.ndarray]]()
    for seed in range(SHOWN):
        observation, _ = twin.reset(seed=seed)
        for _ in range(STEPS):
            observations.append(np.asarray(observation, dtype=float))
            states.append(np.concatenate([base.data.qpos, base.data.qvel]))
            now = base.data.qpos.copy(), base.data.qvel.copy(), base.data.ctrl.copy()
            again.append([observe(other, *now) if hasattr(base, "_get_obs") else observations[-1] for _ in range(2)])
            observation, _, ended, _, _ = twin.step(twin.action_space.sample())
            if ended:
                break
    shown, true = recover(np.array(observations)), np.array(states)
    off = np.concatenate([shown.qpos, shown.qvel], axis=1) - true
    turns = list(shown.wrapped)
    off[:, turns] = (off[:, turns] + np.pi) % (2 * np.pi) - np.pi
    known = np.concatenate([shown.known_qpos, shown.known_qvel], axis=1)
    one, two = (np.nan_to_num(np.concatenate(recover(x)[:2], axis=1)) for x in np.array(again).swapaxes(0, 1))
    noise = np.sqrt(((one - two) ** 2).mean(axis=0))
    columns = range(true.shape[1])
    wrong = [k for k in columns if _is_off(off[known[:, k], k], true[known[:, k], k], float(noise[k]))]
    if not wrong:
        return None
    column = wrong[0]
    off = np.where(known, off, 0.0)
    nq = base.model.nq
    name = f"qpos[{column}]" if column < nq else f"qvel[{column - nq}]"
    row = int(np.abs(off[:, column]).argmax())
    return (
        f"{name} is {true[row, column]:.4g} where the observation is read as {true[row, column] + off[row, column]:.4g}"
    )


def _is_off(off: np.ndarray, true: np.ndarray, again: float) -> bool:
    """Whether a coordinate is read as another one, or by another zero or scale: noise has neither.

    :param off: what it is read as too much, (n,)
    :param true: what it is, (n,)
    :param again: by how much two readings of one state typically differ
    """
    if len(off) == 0:
        return False
    moved, spread = true - true.mean(), float(true.std())
    scale = float(off @ moved) / max(float(moved @ moved), 1e-12)
    noise = 4 * float(np.std(off - off.mean() - scale * moved)) / np.sqrt(len(off))
    by = max(float(abs(off.mean())), abs(scale) * spread)
    typical = float(np.sqrt((off**2).mean()))
    return by > max(LEAST, SYSTEMATIC * spread, noise) or typical > max(LEAST, OFF * spread, 2 * again)


def beyond_states(env: gym.Env) -> int | None:
    """The first observation of a step that is not that of the state which it led to, but for some noise; or None.

    A copy is stepped by random actions. Nothing is found where it cannot be copied.

    :param env: a MuJoCo environment; untouched
    """
    one, other = copy_env(env), copy_env(env)
    if one is None or other is None:
        return None
    data: Any = one.unwrapped.data  # type: ignore[attr-defined]
    one.action_space.seed(0)
    seen, shown = list[np.ndarray](), list[np.ndarray]()
    for seed in range(SHOWN):
        for copy in (one, other):
            copy.reset(seed=seed)  # with the same goal, if there is one
        over, steps = False, 0
        while not over and steps < STEPS:
            observation, _, *ended, _ = one.step(one.action_space.sample())
            seen.append(np.asarray(observation, dtype=float))
            shown.append(observe(other, data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
            over, steps = any(ended), steps + 1
    true = np.array(seen)
    wrong = np.sqrt(((true - shown) ** 2).mean(axis=0)) > np.maximum(OFF * true.std(axis=0), LEAST)
    return int(np.flatnonzero(wrong)[0]) if wrong.any() else None


def observe(env: gym.Env, qpos: np.ndarray, qvel: np.ndarray, command: np.ndarray) -> np.ndarray:
    """What the agent would see in a state, (observation_dim,)."""
    base: Any = env.unwrapped
    base.data.ctrl[:] = command  # some tasks observe forces
    base.set_state(qpos, qvel)
    observation = base._get_obs()
    for layer in reversed(layers(env)[:-1]):
        if isinstance(layer, gym.ObservationWrapper):
            observation = layer.observation(observation)
    return np.array(observation)


def place_as_after_a_step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Let bodies be where MuJoCo leaves them within an episode: where they were before the last step of the simulation.

    A reward may be told by how far one has come in a step (Ant's is). The fourth-order method leaves them about there,
    by its last stage, which no state tells.
    """
    if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        return
    now = data.qpos.copy()
    mujoco.mj_integratePos(model, data.qpos, data.qvel, -model.opt.timestep)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    data.qpos[:] = now


def odd_memory(env: gym.Env, recover: StateMap) -> str | None:
    """What a step answers from more than the state that was observed before it; None where nothing is found.

    Steps of episodes are compared with first steps from the same states in other episodes: a goal, say, that a reset
    draws and keeps beside the model is another one there, and later so are the time and the action before.

    :param env: a MuJoCo environment; untouched
    :param recover: states from its observations
    """
    return _odd_answer(env, recover, later=False) or _odd_answer(env, recover, later=True)


def _odd_answer(env: gym.Env, recover: StateMap, later: bool) -> str | None:
    """The first answer to the first steps of episodes, or to ``later`` ones, that differs by more than noise.

    First steps are repeated in the same episode, where a goal is the same: what differs then is noise. Later ones are
    repeated in another one, so that nothing comes before.
    """
    one, other = copy_env(env), copy_env(env)
    if one is None or other is None:
        return None
    first: Any = one.unwrapped
    base: Any = other.unwrapped
    one.action_space.seed(0)
    answers = []
    for seed in range(EPISODES):
        observation, _ = one.reset(seed=seed)
        for _ in range((1 + seed) * later):
            following, _, *ended, _ = one.step(one.action_space.sample())
            if any(ended):
                observation, _ = one.reset(seed=seed)
                break
            observation = following
        seen = np.asarray(observation, dtype=float)[None]
        if not are_known(recover, seen)[0]:
            continue
        states, data = recover(seen), first.data
        qpos, qvel = np.nan_to_num(states.qpos[0]), np.nan_to_num(states.qvel[0])
        # Again from as far on the other side of the true state: off by noise, in the observation before the step, too.
        mirrored = (
            np.where(states.known_qpos[0], 2 * data.qpos - qpos, qpos),
            np.where(states.known_qvel[0], 2 * data.qvel - qvel, qvel),
        )
        under_way, action = bool(data.time > 0), one.action_space.sample()
        stepped, over = [one.step(action)], True
        for k, state in enumerate(((qpos, qvel), mirrored), 1):
            if later or over:
                other.reset(seed=EPISODES * (k if later else 1) + seed)
            base.set_state(*state)
            if under_way:
                place_as_after_a_step(base.model, base.data)
            stepped.append(other.step(action))
            over = any(stepped[-1][2:4])
        answers.append([[*observation, reward] for observation, reward, *_ in stepped])
    if not answers:
        return None
    true, found, again = np.array(answers, dtype=float).transpose(1, 0, 2)
    off, noise = (np.sqrt(((found - against) ** 2).mean(axis=0)) for against in (true, again))
    wrong = off > np.maximum(np.maximum(MEANT * true.std(axis=0), LEAST), BEYOND * noise)
    if not wrong.any():
        return None
    column = int(np.flatnonzero(wrong)[0])
    return "the reward" if column == true.shape[1] - 1 else f"observation[{column}]"
