"""The length of a link: its capsules and the offsets of its children."""

import mujoco
import numpy as np

from sb3_rpto.effects.world import World


def link_length(model: mujoco.MjModel, body: int) -> float:
    """Length in m of the longest capsule of a body, between the centres of its caps; 0 without a capsule."""
    return max((2 * float(model.geom_size[g, 1]) for g in _capsules(model, body)), default=0.0)


def _capsules(model: mujoco.MjModel, body: int) -> list[int]:
    first, count = model.body_geomadr[body], model.body_geomnum[body]
    return [g for g in range(first, first + count) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE]


def write_length(world: World, body: int, values: np.ndarray, nominal: float) -> None:
    """Stretch a link about its body's origin."""
    raise NotImplementedError
