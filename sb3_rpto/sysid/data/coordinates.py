"""Where a model has the coordinates of recordings: which of them are straight and which turn."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.effects.names import SCALAR_JOINTS, object_names
from sb3_rpto.sysid.data.columns import Columns


def straight(model: mujoco.MjModel) -> dict[int, int]:
    """Addresses in qpos and in qvel of what is the integral of its velocity: hinges, slides, free joints' positions."""
    pairs = {int(model.jnt_qposadr[j]): int(model.jnt_dofadr[j]) for j in scalar_joints(model)}
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        pairs |= {int(model.jnt_qposadr[j]) + k: int(model.jnt_dofadr[j]) + k for k in range(3)}
    return pairs


def turning(model: mujoco.MjModel) -> dict[int, int]:
    """Addresses of the quaternions of ball and free joints in qpos, and of their angular velocities in qvel."""
    pairs = {}
    for j in range(model.njnt):
        if model.jnt_type[j] not in SCALAR_JOINTS:
            on = 3 if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else 0
            pairs[int(model.jnt_qposadr[j]) + on] = int(model.jnt_dofadr[j]) + on
    return pairs


def scalar_joints(model: mujoco.MjModel) -> list[int]:
    """Ids of hinges and slides."""
    return [j for j in range(model.njnt) if model.jnt_type[j] in SCALAR_JOINTS]


def velocity_addresses(model: mujoco.MjModel, columns: Columns) -> np.ndarray:
    """Addresses in qvel of velocity columns."""
    joints = object_names(model, "joint")
    out = []
    for name in columns.qvel:
        joint, offset = (name, 0) if name in joints else (name.rpartition(".")[0], int(name.rpartition(".")[2]))
        out.append(int(model.jnt_dofadr[joints.index(joint)]) + offset)
    return np.array(out, dtype=int)
