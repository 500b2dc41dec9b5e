"""Whether a step of a MuJoCo environment is the simulation of its action, and nothing else."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects.engine import quiet
from sb3_rpto.envs.state import copy_env

#: Episodes whose first step is compared with MuJoCo alone.
TRIED = 3


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
    limited = base.model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(limited, base.model.actuator_ctrlrange, (-np.inf, np.inf)).T
    for seed in range(TRIED):
        twin.reset(seed=seed)
        action = twin.action_space.sample()
        commands = np.clip(action, low, high)
        alone = mujoco.MjData(base.model)
        mujoco.mj_copyData(alone, base.model, base.data)
        alone.ctrl[:] = commands
        with quiet():
            mujoco.mj_step(base.model, alone, nstep=frame_skip)
            twin.step(action)
        if not np.allclose(np.clip(base.data.ctrl, low, high), commands):
            return f"gives the commands {base.data.ctrl} where the action is {action}"
        if not (np.allclose(base.data.qpos, alone.qpos) and np.allclose(base.data.qvel, alone.qvel)):
            return "moves otherwise than MuJoCo under the same command"
    return None
