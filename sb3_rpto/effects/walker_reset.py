"""How a walker stands: where its feet are at reset, and which heights count as healthy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.wrapper import CorrectedEnv

_FAR = 1e3  # m, farther than any robot's feet
_UPRIGHT = 0.5  # of a floor's normal, its vertical part
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class WalkerReset:
    """Stands a walker whose body has changed as it stood before.

    Its lowest point at reset keeps its distance from the floor, and ``_healthy_z_range``, where the task has one, keeps
    its proportion to the height of the root body over that lowest point. Tasks without a vertical coordinate or a floor
    are left alone, and so is what hangs or falls: farther above the floor than its root body is above its lowest point.

    :param base: an unwrapped gymnasium MuJoCo environment, as it stands before
    :param before: :func:`nominal_heights` of the model before, where that of ``base`` has changed already; of use where
        episodes begin in the reference pose
    """

    def __init__(self, base: Any, before: tuple[float, float] | None = None) -> None:
        self.before = before
        self._joint = _vertical(base.model) if hasattr(base, "init_qpos") else None
        found = None if self._joint is None else _heights(base.model, self._joint, base.init_qpos)
        if found is not None and before is not None and np.allclose(base.init_qpos, base.model.qpos0):
            found = before
        if found is None or found[0] > found[1]:
            self._joint = None
            return
        self._qpos = base.init_qpos.copy()
        self._gap, self._height = found
        self._healthy: tuple[float, float] | None = getattr(base, "_healthy_z_range", None)

    def apply(self, base: Any) -> None:
        """Stand the walker of ``base`` as it is now: its start height and healthy heights are set."""
        if self._joint is None:
            return
        found = _heights(base.model, self._joint, self._qpos)
        assert found is not None  # the floor stays
        column = _address(base.model, self._joint)
        base.init_qpos[column] = self._qpos[column] + self._gap - found[0]
        if self._healthy is not None:
            low, high = self._healthy
            scale = found[1] / self._height
            base._healthy_z_range = (low * scale, high * scale)


class StandingEnv(CorrectedEnv):
    """A gymnasium MuJoCo environment with effects, on its feet.

    As :class:`~sb3_rpto.effects.wrapper.CorrectedEnv`, and its start height and healthy heights follow its body
    (:class:`WalkerReset`) from the next reset on.

    :param env: as there
    :param effects: as there
    :param before: as of :class:`WalkerReset`
    :raises ValueError: as there
    """

    def __init__(self, env: gym.Env, effects: Sequence[Effect], before: tuple[float, float] | None = None) -> None:
        self._walker_reset = WalkerReset(env.unwrapped, before)
        super().__init__(env, effects)

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """As in :class:`~sb3_rpto.effects.wrapper.CorrectedEnv`; the walker stands on its feet at the next reset."""
        super().set_effects(effects)
        self._walker_reset.apply(self.unwrapped)

    def __getstate__(self) -> dict[str, Any]:
        """As in :class:`~sb3_rpto.effects.wrapper.CorrectedEnv`."""
        return {**super().__getstate__(), "before": self._walker_reset.before}


def nominal_heights(model: mujoco.MjModel) -> tuple[float, float] | None:
    """Of the reference pose in m: its lowest point over the floor, and its body over that (:class:`WalkerReset`)."""
    joint = _vertical(model)
    return None if joint is None else _heights(model, joint, model.qpos0)


def _vertical(model: mujoco.MjModel) -> int | None:
    """The joint that holds the height of the machine in the world: a free joint, or a slide along z; None without.

    Of several such bodies the machine is the one that moves the most joints: a ball beside it has none of its own.
    """
    found = {}
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if model.body_parentid[body] != 0:
            continue
        upright = np.array_equal(model.jnt_axis[joint], (0, 0, 1)) and np.array_equal(
            model.body_quat[body], (1, 0, 0, 0)
        )
        if model.jnt_type[joint] == _FREE or (model.jnt_type[joint] == _SLIDE and upright):
            found[joint] = int((model.body_rootid[model.jnt_bodyid] == body).sum())
    return max(found, key=found.__getitem__, default=None)


def _address(model: mujoco.MjModel, joint: int) -> int:
    return int(model.jnt_qposadr[joint]) + (2 if model.jnt_type[joint] == _FREE else 0)


def _heights(model: mujoco.MjModel, joint: int, qpos: np.ndarray) -> tuple[float, float] | None:
    """Of its lowest point over the floor, and of the body's origin over that point, m; None without a floor."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    static = model.body_weldid[model.geom_bodyid] == 0
    upright = data.geom_xmat[:, 8] > _UPRIGHT  # a wall is no floor
    floors = np.flatnonzero(static & upright & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE))
    own = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.jnt_bodyid[joint])
    if not len(floors) or not len(own):
        return None
    floor = int(floors[0])
    gap = min(mujoco.mj_geomDistance(model, data, floor, int(g), _FAR, None) for g in own)
    return gap, float(data.xpos[model.jnt_bodyid[joint], 2] - data.geom_xpos[floor, 2]) - gap
