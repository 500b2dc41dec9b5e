"""Whole turns by which an encoder's angle is off from the model's."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import command_limits, drivers, servo_of
from sb3_rpto.effects.names import object_names
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.findings import Finding, FindingKind

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
#: A slide that moves over so many times what its limits let it is in other units, by whatever zero.
OTHER_UNITS = 10
#: A position this far, in rad or m, beyond a joint's limits is said to be: limits give way a little.
BEYOND = 0.1
#: A servo that is, but for whole turns, this near to its command in half of the samples, in rad, holds it.
HELD = 0.5


def settle_turns(model: mujoco.MjModel, data: Measurements) -> tuple[Measurements, list[Finding]]:
    """Shift angles by whole turns to where the model has limits, a spring or a servo: an encoder's zero tells no turns.

    A hinge with limits is shifted where its angles lie outside them; one with a spring only where its angle was
    unwrapped, for a spring may be wound up; any other that a servo holds where it never comes within half a turn of
    its command. Positions that stay outside their limits are said to.

    :param model: of the machine
    :param data: recordings; not changed
    :return: the recordings, and what was found
    """
    wrapped = {finding.where for finding in data.findings if finding.kind == FindingKind.WRAPPED_ANGLE}
    joints = object_names(model, "joint")
    found, episodes = [], []
    for episode in data.episodes:
        qpos = episode.qpos.copy()
        for column, name in enumerate(data.columns.qpos):
            if name not in joints:  # a coordinate of a ball or free joint, or a name that is refused later
                continue
            joint = joints.index(name)
            run, place, limited = episode.name, f"qpos.{name}", bool(model.jnt_limited[joint])
            where = f"{run}, {place}"
            low, high = model.jnt_range[joint] if limited else (-np.inf, np.inf)
            if limited and model.jnt_type[joint] == _HINGE:
                _check_radians(qpos[:, column], low, high, where)
            elif limited:
                _check_metres(qpos[:, column], low, high, where)
            if model.jnt_type[joint] == _HINGE:
                turns, why = _turns_off(model, data, episode, joint, qpos[:, column], where in wrapped)
                if turns:
                    qpos[:, column] -= 2 * np.pi * turns
                    message = f"{turns:+d} turn(s) from the joint's {why}; taken off"
                    found.append(Finding.of_run(FindingKind.WHOLE_TURNS, run, place, message))
            over = float(np.maximum(low - qpos[:, column], qpos[:, column] - high).max())
            if over > BEYOND and not (data.exact or data.simulated):
                message = (
                    f"up to {over:.3g} beyond the joint's limits in the model (rad or m): another zero, or other units"
                )
                found.append(Finding.of_run(FindingKind.OUTSIDE_LIMITS, run, place, message))
        episodes.append(replace(episode, qpos=qpos))
    return replace(data, episodes=episodes), found


def _turns_off(
    model: mujoco.MjModel, data: Measurements, episode: Episode, joint: int, angles: np.ndarray, wrapped: bool
) -> tuple[int, str]:
    """By how many turns a hinge's angles, (T,) in rad, are off from the model's, and what tells it."""
    middle = float(np.median(angles))
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]
        inside = low <= middle <= high and not wrapped
        return (0 if inside else round((middle - (low + high) / 2) / (2 * np.pi))), "limits"
    if model.jnt_stiffness[joint]:
        spring = float(model.qpos_spring[model.jnt_qposadr[joint]])
        return (round((middle - spring) / (2 * np.pi)) if wrapped else 0), "spring"
    off = angles - _commanded(model, data, episode, joint)
    off = off[np.isfinite(off)]
    turns = round(float(np.median(off)) / (2 * np.pi)) if len(off) else 0
    # Not where a weak servo, or one under way, is far from its command by other than turns.
    held = turns and np.abs(off).min() > np.pi and np.median(np.abs(off - 2 * np.pi * turns)) < HELD
    return (turns if held else 0), "command"


def _commanded(model: mujoco.MjModel, data: Measurements, episode: Episode, joint: int) -> np.ndarray:
    """Angles, (T,) in rad, that a joint's one position servo is told to hold; NaN where it is off, or there is none."""
    servos = [a for a in drivers(model, joint) if servo_of(model, a) == "position"]
    names = [object_names(model, "actuator")[a] for a in servos]
    if len(servos) != 1 or names[0] not in data.columns.ctrl:
        return np.full(len(episode.time), np.nan)
    low, high = (limits[model.actuator_ctrladr[servos[0]]] for limits in command_limits(model))
    column = data.columns.ctrl.index(names[0])
    command = np.clip(episode.ctrl[:, column], low, high)
    return np.where(episode.enabled[:, column] > 0, command / model.actuator_gear[servos[0], 0], np.nan)


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
