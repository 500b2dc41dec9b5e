"""Contacts that come and go in recordings: an error about a touch-down's moment grows to much in little time."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.shooting.windows import names_of

#: Samples that are looked at, of all runs alike: contacts of one pose after the other.
MOST = 5_000
#: Geoms that touched have parted where their distance is so many times its noise, at least and at most these shares of
#: the model's extent.
PARTED, LEAST, FARTHEST = 5.0, 1e-4, 1e-2


def contact_changes(model: mujoco.MjModel, data: Measurements, sigma: np.ndarray) -> float:
    """How often the set of geoms that touch changes, per second of the recordings, by the poses that were measured.

    What lies on the floor touches it all the time, though by noisy poses it is now in it and now above.

    :param model: of the machine
    :param data: recordings; joints that they do not show are at their reference
    :param sigma: noise of each position column, rad or m, (m,)
    """
    addresses, model = names_of(model, data.columns.qpos), model.__copy__()
    model.geom_margin[:] = model.pair_margin[:] = _apart(model, addresses, sigma)
    mj = mujoco.MjData(model)
    changes, seconds = 0, 0.0
    for episode in data.episodes:
        rows = slice(0, MOST // len(data.episodes) + 2)
        before: set[tuple[int, ...]] | None = None
        for row in episode.qpos[rows]:
            mj.qpos[addresses] = row
            mujoco.mj_normalizeQuat(model, mj.qpos)
            mujoco.mj_kinematics(model, mj)
            mujoco.mj_collision(model, mj)
            near = zip(map(tuple, mj.contact.geom.tolist()), mj.contact.dist)
            now = {pair for pair, distance in near if distance < 0 or before is None or pair in before}
            changes += before is not None and now != before
            before = now
        time = episode.time[rows]
        seconds += float(time[-1] - time[0])
    return changes / seconds if seconds else 0.0


def _apart(model: mujoco.MjModel, addresses: np.ndarray, sigma: np.ndarray) -> float:
    """Distance in m at which geoms that touched have parted: an angle's noise acts over the model's whole extent."""
    slides = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]
    lengths = np.isin(addresses, [*slides, *_centres(model)])
    extent = float(model.stat.extent)
    along, turned = (float(sigma[kind].max(initial=0.0)) for kind in (lengths, ~lengths))
    return float(np.clip(PARTED * (along + turned * extent), LEAST * extent, FARTHEST * extent))


def _centres(model: mujoco.MjModel) -> np.ndarray:
    """Addresses in qpos of the positions of free joints."""
    free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    return (free[:, None] + np.arange(3)).ravel()
