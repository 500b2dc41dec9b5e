"""Angles in degrees: refused before a search where the data show clearly that they are."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.ndimage import binary_erosion

from sb3_rpto.effects.names import hinges
from sb3_rpto.sysid.data.columns import columns_of
from sb3_rpto.sysid.data.inverse_dynamics_terms import actuation, inverse, through, window_of
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.signal_quality import smoothed_velocity

#: Hinges that move over more turns than this may be in degrees.
TURNS = 2
#: Shares of the acceleration's square that the model's known forces explain, read in degrees and read in rad.
WELL, NOT = 0.7, 0.0
#: Samples that are looked at in all, and fewest of them in one run.
MOST, FEWEST = 3000, 30
#: Steps of an angle in degrees, and what it spans, where it is wrapped to one turn.
STEP, SPAN = 270.0, 363.6


def large_angles(model: mujoco.MjModel, data: Measurements) -> dict[str, float]:
    """Hinges that turn far in a typical run, by name, and over how many turns."""
    found = {}
    for i, name in enumerate(data.columns.qpos):
        if name in hinges(model) and name not in data.unobserved:
            turns = float(np.median([np.ptp(e.qpos[:, i]) for e in data.episodes])) / (2 * np.pi)
            if turns > TURNS:
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
        elif name in told and told[name][1] > WELL and told[name][0] < NOT:
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
    return all(np.ptp(c) < SPAN for c in columns) and any(np.abs(np.diff(c)).max() > STEP for c in columns)


def _explained(model: mujoco.MjModel, data: Measurements) -> dict[str, tuple[float, float]]:
    """How much of the acceleration of each hinge the model's known forces explain, in rad and in degrees."""
    own = columns_of(model)
    order = {n: [getattr(data.columns, n).index(c) for c in getattr(own, n)] for n in ("qpos", "qvel", "ctrl")}
    turning = {name: own.qvel.index(name) for name in hinges(model)}
    columns = [own.qpos.index(name) for name in turning]
    left, all_of = np.zeros((2, model.nv)), np.zeros((2, model.nv))
    budget = MOST
    for episode in sorted(data.episodes, key=len, reverse=True):
        rows = slice(0, min(len(episode), budget))
        if rows.stop < FEWEST:
            break
        budget -= rows.stop
        time = episode.time[rows]
        window = window_of(float(np.median(np.diff(time))), data.exact)
        usable = episode.usable[rows] & episode.enabled[rows].all(axis=1)
        for reading, factor in enumerate((1.0, np.pi / 180)):
            qpos, qvel = episode.qpos[rows][:, order["qpos"]].copy(), episode.qvel[rows][:, order["qvel"]].copy()
            qpos[:, columns] *= factor
            for column, dof in zip(columns, turning.values()):
                qvel[:, dof] = smoothed_velocity(time, qpos[:, column], window)
            qacc = smoothed_velocity(time, qvel, window)
            needed, free = inverse(model, qpos, qvel, qacc)
            inertial = needed - inverse(model, qpos, qvel, np.zeros_like(qacc))[0]
            ctrl = episode.ctrl[rows][:, order["ctrl"]]
            idle = actuation(model, time, qpos, qvel, np.zeros_like(ctrl))
            given = actuation(model, time, qpos, qvel, ctrl) - idle
            clear = binary_erosion(usable & free, np.ones(window), border_value=1)
            for dof in turning.values():
                over = needed[:, dof] - idle[:, dof] - through(time, given[:, dof], window)
                left[reading, dof] += np.sum(over[clear] ** 2)
                all_of[reading, dof] += np.sum(inertial[clear, dof] ** 2)
    return {
        name: tuple(1 - left[:, dof] / all_of[:, dof]) for name, dof in turning.items() if (all_of[:, dof] > 0).all()
    }
