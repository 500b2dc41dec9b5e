"""Whole turns by which an encoder's angle is off from the model's."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from sb3_rpto.effects.names import object_names
from sb3_rpto.tracing.checks import Finding
from sb3_rpto.tracing.measurements import Measurements

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
#: A slide that moves over so many times what its limits let it is in other units, by whatever zero.
OTHER_UNITS = 10
#: A position this far, in rad or m, beyond a joint's limits is said to be: limits give way a little.
BEYOND = 0.1


def settle_turns(model: mujoco.MjModel, data: Measurements) -> tuple[Measurements, list[Finding]]:
    """Shift angles by whole turns to where the model has limits or a spring: an encoder's zero tells no turns.

    A hinge with limits is shifted where its angles lie outside them; one with a spring only where its angle was
    unwrapped, for a spring may be wound up. Positions that stay outside their limits are said to.

    :param model: of the machine
    :param data: recordings; not changed
    :return: the recordings, and what was found
    """
    wrapped = {finding.where for finding in data.findings if finding.kind == "wrapped angle"}
    joints = object_names(model, "joint")
    found, episodes = [], []
    for episode in data.episodes:
        qpos = episode.qpos.copy()
        for column, name in enumerate(data.columns.qpos):
            if name not in joints:  # a coordinate of a ball or free joint, or a name that is refused later
                continue
            joint = joints.index(name)
            where, limited = f"{episode.name}, qpos.{name}", bool(model.jnt_limited[joint])
            low, high = model.jnt_range[joint] if limited else (-np.inf, np.inf)
            if limited and model.jnt_type[joint] == _HINGE:
                _check_radians(qpos[:, column], low, high, where)
            elif limited:
                _check_metres(qpos[:, column], low, high, where)
            middle = float(np.median(qpos[:, column]))
            if model.jnt_type[joint] == _HINGE and ((not low <= middle <= high) or where in wrapped):
                centre = (low + high) / 2 if limited else float(model.qpos_spring[model.jnt_qposadr[joint]])
                turns = round((middle - centre) / (2 * np.pi)) if limited or model.jnt_stiffness[joint] else 0
                if turns:
                    qpos[:, column] -= 2 * np.pi * turns
                    why = "limits" if limited else "spring"
                    found.append(Finding("whole turns", where, f"{turns:+d} turn(s) from the joint's {why}; taken off"))
            over = float(np.maximum(low - qpos[:, column], qpos[:, column] - high).max())
            if over > BEYOND and not (data.exact or data.simulated):
                message = (
                    f"up to {over:.3g} beyond the joint's limits in the model (rad or m): another zero, or other units"
                )
                found.append(Finding("outside limits", where, message))
        episodes.append(replace(episode, qpos=qpos))
    return replace(data, episodes=episodes), found


def _check_metres(positions: np.ndarray, low: float, high: float, where: str) -> None:
    """Refuse positions that move far further than a slide's limits let it, and are within them if they are in cm or mm.

    :raises ValueError: such positions
    """
    if np.ptp(positions) <= OTHER_UNITS * (high - low):
        return
    units = [
        unit
        for unit, share in (("cm", 1e-2), ("mm", 1e-3))
        if np.all((share * positions > low - BEYOND) & (share * positions < high + BEYOND))
    ]
    if units:
        raise ValueError(
            f"{where} spans {np.ptp(positions):.3g} where the model's limits are {low:.3g} and {high:.3g} m; give m, "
            f"not {' or '.join(units)}"
        )


def _check_radians(angles: np.ndarray, low: float, high: float, where: str) -> None:
    """Refuse angles that move further than a joint's limits let it, and are within them if they are in degrees.

    :raises ValueError: such angles
    """
    inside = np.all((np.deg2rad(angles) > low - BEYOND) & (np.deg2rad(angles) < high + BEYOND))
    if inside and np.ptp(angles) > high - low + np.pi:
        raise ValueError(
            f"{where} spans {np.ptp(angles):.3g} where the model's limits are {low:.3g} and {high:.3g} rad; give rad, "
            'not degrees (also where the MJCF has angle="degree")'
        )
