"""Contacts that come and go in recordings: an error about a touch-down's moment grows to much in little time."""

from __future__ import annotations

import mujoco

from sb3_rpto.tracing.measurements import Measurements
from sb3_rpto.tracing.windows import names_of

#: Contacts that change this often a second are said to come and go.
OFTEN = 0.5
#: Samples that are looked at, of all runs alike: contacts of one pose after the other.
MOST = 5_000


def contact_changes(model: mujoco.MjModel, data: Measurements) -> float:
    """How often the set of geoms that touch changes, per second of the recordings, by the poses that were measured.

    :param model: of the machine
    :param data: recordings; joints that they do not show are at their reference
    """
    mj, addresses = mujoco.MjData(model), names_of(model, data.columns.qpos)
    changes, seconds = 0, 0.0
    for episode in data.episodes:
        rows = slice(0, MOST // len(data.episodes) + 2)
        before: set[tuple[int, ...]] | None = None
        for row in episode.qpos[rows]:
            mj.qpos[addresses] = row
            mujoco.mj_normalizeQuat(model, mj.qpos)
            mujoco.mj_kinematics(model, mj)
            mujoco.mj_collision(model, mj)
            now = {tuple(pair) for pair in mj.contact.geom[mj.contact.dist < 0].tolist()}
            changes += before is not None and now != before
            before = now
        time = episode.time[rows]
        seconds += float(time[-1] - time[0])
    return changes / seconds if seconds else 0.0
