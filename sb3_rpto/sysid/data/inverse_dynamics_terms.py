"""Forces along a given motion: what it needs, and what the model's actuators give."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.data.signal_quality import smoothed_velocity

_LIMIT = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)  # the first of limits and contacts


def filter_length(step: float, exact: bool) -> int:
    """Samples of the filter that differentiates recordings.

    :param step: between two of them, in s
    :param exact: whether they are without noise
    """
    return 5 if exact else int(np.clip(DATA.filter_time / step, DATA.filter_rows, 101)) // 2 * 2 + 1


def filtered_force(time: np.ndarray, force: np.ndarray, window: int) -> np.ndarray:
    """A force as the filter of the acceleration shows it: held from sample to sample, integrated, differentiated."""
    impulse = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(time))])
    return smoothed_velocity(time, impulse, window)


def required_forces(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Forces that a motion needs beyond the model's passive ones, (T, nv), and where no contact or limit acts, (T,)."""
    data = mujoco.MjData(model)
    forces, free = np.empty((len(qpos), model.nv)), np.empty(len(qpos), dtype=bool)
    for k in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_inverse(model, data)
        forces[k] = data.qfrc_inverse
        free[k] = not np.any(data.efc_type >= _LIMIT)
    return forces, free


def actuator_forces(
    model: mujoco.MjModel, time: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray
) -> np.ndarray:
    """Generalised forces of the model's actuators along a given motion, (T, nv)."""
    data = mujoco.MjData(model)
    forces = np.empty((len(qpos), model.nv))
    # Actuators with a memory are led along the motion by the simulator's own steps.
    substeps = max(1, round(float(np.median(np.diff(time))) / model.opt.timestep)) if model.na or model.nhistory else 0
    for k in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[k], qvel[k], ctrl[k]
        mujoco.mj_normalizeQuat(model, data.qpos)
        if substeps:
            mujoco.mj_step(model, data, substeps)
        else:
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fwdActuation(model, data)
        forces[k] = data.qfrc_actuator
    return forces
