"""Repairs and checks that take the model or all runs: whole turns, even clocks, units."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from scipy.ndimage import binary_erosion

from sb3_rpto.effects.actuation import command_limits, drivers, servo_of
from sb3_rpto.effects.names import hinges, object_names
from sb3_rpto.sysid.data.columns import columns_of
from sb3_rpto.sysid.data.inverse_dynamics_terms import actuator_forces, filter_length, filtered_force, required_forces
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.data.signal_quality import TURN, divided_differences, jitter, smoothed_velocity
from sb3_rpto.sysid.findings import Finding, FindingKind

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)

# --- whole turns ---


def remove_whole_turns(model: mujoco.MjModel, data: Measurements) -> tuple[Measurements, list[Finding]]:
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
                    qpos[:, column] -= TURN * turns
                    message = f"{turns:+d} turn(s) from the joint's {why}; taken off"
                    found.append(Finding.of_run(FindingKind.WHOLE_TURNS, run, place, message))
            over = float(np.maximum(low - qpos[:, column], qpos[:, column] - high).max())
            if over > DATA.beyond_limits and not (data.exact or data.simulated):
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
        return (0 if inside else round((middle - (low + high) / 2) / TURN)), "limits"
    if model.jnt_stiffness[joint]:
        spring = float(model.qpos_spring[model.jnt_qposadr[joint]])
        return (round((middle - spring) / TURN) if wrapped else 0), "spring"
    off = angles - _commanded(model, data, episode, joint)
    off = off[np.isfinite(off)]
    turns = round(float(np.median(off)) / TURN) if len(off) else 0
    # Not where a weak servo, or one under way, is far from its command by other than turns.
    held = turns and np.abs(off).min() > np.pi and np.median(np.abs(off - TURN * turns)) < DATA.servo_holds
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
    if np.ptp(positions) <= DATA.slide_units * (high - low):
        return
    units = [
        unit
        for unit, share in (("cm", 1e-2), ("mm", 1e-3))
        if np.all((share * positions > low - DATA.beyond_limits) & (share * positions < high + DATA.beyond_limits))
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
    inside = np.all((np.deg2rad(angles) > low - DATA.beyond_limits) & (np.deg2rad(angles) < high + DATA.beyond_limits))
    if inside and np.ptp(angles) > high - low + np.pi:
        raise ValueError(
            f"{where} spans {np.ptp(angles):.3g} where the model's limits are {low:.3g} and {high:.3g} rad; give rad, "
            'not degrees (also where the MJCF has angle="degree")'
        )


# --- clocks ---


def use_even_clock(data: Measurements) -> tuple[Measurements, list[Finding]]:
    """Give the samples even times where the stamps jitter and the positions do not follow them.

    A sample that was taken late shows where the joint was then: fast motion is smooth on the stamps. A stamp that was
    written late shows nothing: it is smooth on an even clock.

    :param data: recordings; not changed
    :return: the recordings, and what was found
    """
    if data.exact:
        return data, []
    jittered = {i: even for i, e in enumerate(data.episodes) if (even := _even(e)) is not None}
    if not jittered:
        return data, []
    there = [data.episodes[i] for i in jittered]
    instead = [replace(data.episodes[i], time=time) for i, time in jittered.items()]
    ratios = [_roughness(instead, column) / _roughness(there, column) for column in range(len(data.columns.qpos))]
    if not np.exp(np.mean(np.log(ratios))) < 1 - DATA.even_clock_gain:
        return data, []
    message = (
        f"the stamps jitter and the samples do not: on an even clock the positions have {np.mean(ratios):.0%} of the "
        "noise variance that they have on the stamps, where they move fast; traced with even times"
    )
    episodes = [replace(e, time=jittered[i]) if i in jittered else e for i, e in enumerate(data.episodes)]
    kept = [finding for finding in data.findings if finding.kind != FindingKind.JITTER]
    findings = [Finding.of_run(FindingKind.EVEN_CLOCK, data.episodes[i].name, "time", message) for i in jittered]
    return replace(data, episodes=episodes, findings=kept), findings


def _even(episode: Episode) -> np.ndarray | None:
    """Times of an even clock near the stamps; None where they do not jitter, or no such clock is near."""
    time = episode.time
    if len(time) < 4 * DATA.difference_order or jitter(time) <= DATA.slight_jitter:
        return None
    steps = np.diff(time)
    ticks = np.append(0, np.cumsum(np.maximum(1, np.round(steps / np.median(steps)))))
    interval, begin = np.polyfit(ticks, time, 1)
    even = begin + interval * ticks
    return even if np.abs(even - time).max() < DATA.stamp_offset * interval else None


def _roughness(episodes: list[Episode], column: int) -> float:
    """Mean square of the divided differences of a position in the faster half of the motion."""
    found, moved = [], []
    for e in episodes:
        position = e.qpos[:, column]
        found.append(divided_differences(e.time, position, DATA.difference_order))
        moved.append(np.ptp(np.lib.stride_tricks.sliding_window_view(position, DATA.difference_order + 1), axis=1))
    square, speed = np.concatenate(found) ** 2, np.concatenate(moved)
    fast = np.sort(square[speed >= np.median(speed)])
    return float(fast[: max(1, round(0.95 * len(fast)))].mean()) + 1e-300


# --- units ---


def large_angles(model: mujoco.MjModel, data: Measurements) -> dict[str, float]:
    """Hinges that turn far in a typical run, by name, and over how many turns."""
    found = {}
    for i, name in enumerate(data.columns.qpos):
        if name in hinges(model) and name not in data.unobserved:
            turns = float(np.median([np.ptp(e.qpos[:, i]) for e in data.episodes])) / TURN
            if turns > DATA.large_angle:
                found[name] = turns
    return found


def check_degrees(model: mujoco.MjModel, data: Measurements) -> None:
    """Refuse angles that turn far and are clearly in degrees.

    They are where they jump by nearly 360, or where the forces that the model knows explain the motion if it is read
    in degrees, and not if it is read in rad: then it accelerates 57 times as fast as any of them tells.

    :raises ValueError: with the column
    """
    if not data.episodes or not (large := large_angles(model, data)):
        return
    wrapped = [name for name in large if _wrapped(data, name)]
    told = {} if wrapped else _explained(model, data)
    for name, turns in large.items():
        if name in wrapped:
            why = "it jumps by about 360 within one turn of degrees"
        elif name in told and told[name][1] > DATA.explained_in_degrees and told[name][0] < DATA.explained_in_radians:
            why = (
                f"read in degrees, the forces that the model knows account for {told[name][1]:.0%} of its "
                "acceleration, and read in rad for nothing"
            )
        else:
            continue
        raise ValueError(
            f"column 'qpos.{name}' spans {turns:.0f} turns in a typical run, and {why}: give angles in rad, not "
            'degrees (also where the MJCF has angle="degree")'
        )


def _wrapped(data: Measurements, name: str) -> bool:
    columns = [e.qpos[:, data.columns.qpos.index(name)] for e in data.episodes]
    return all(np.ptp(c) < DATA.degrees_span for c in columns) and any(
        np.abs(np.diff(c)).max() > DATA.degrees_step for c in columns
    )


def _explained(model: mujoco.MjModel, data: Measurements) -> dict[str, tuple[float, float]]:
    """How much of the acceleration of each hinge the model's known forces explain, in rad and in degrees."""
    own = columns_of(model)
    order = {n: [getattr(data.columns, n).index(c) for c in getattr(own, n)] for n in ("qpos", "qvel", "ctrl")}
    turning = {name: own.qvel.index(name) for name in hinges(model)}
    columns = [own.qpos.index(name) for name in turning]
    left, all_of = np.zeros((2, model.nv)), np.zeros((2, model.nv))
    budget = DATA.degrees_rows
    for episode in sorted(data.episodes, key=len, reverse=True):
        rows = slice(0, min(len(episode), budget))
        if rows.stop < DATA.degrees_run:
            break
        budget -= rows.stop
        time = episode.time[rows]
        window = filter_length(float(np.median(np.diff(time))), data.exact)
        usable = episode.usable[rows] & episode.enabled[rows].all(axis=1)
        for reading, factor in enumerate((1.0, np.pi / 180)):
            qpos, qvel = episode.qpos[rows][:, order["qpos"]].copy(), episode.qvel[rows][:, order["qvel"]].copy()
            qpos[:, columns] *= factor
            for column, dof in zip(columns, turning.values()):
                qvel[:, dof] = smoothed_velocity(time, qpos[:, column], window)
            qacc = smoothed_velocity(time, qvel, window)
            needed, free = required_forces(model, qpos, qvel, qacc)
            inertial = needed - required_forces(model, qpos, qvel, np.zeros_like(qacc))[0]
            ctrl = episode.ctrl[rows][:, order["ctrl"]]
            idle = actuator_forces(model, time, qpos, qvel, np.zeros_like(ctrl))
            given = actuator_forces(model, time, qpos, qvel, ctrl) - idle
            clear = binary_erosion(usable & free, np.ones(window), border_value=1)
            for dof in turning.values():
                over = needed[:, dof] - idle[:, dof] - filtered_force(time, given[:, dof], window)
                left[reading, dof] += np.sum(over[clear] ** 2)
                all_of[reading, dof] += np.sum(inertial[clear, dof] ** 2)
    return {
        name: tuple(1 - left[:, dof] / all_of[:, dof]) for name, dof in turning.items() if (all_of[:, dof] > 0).all()
    }
