"""The state at a window's start: smoothed from the samples around it, with the spread that the noise leaves it."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from sb3_rpto.sysid.data.coordinates import straight, turning, velocity_addresses
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode

#: Half the time, in s, over which the state at a window's start is smoothed, and the fewest samples on each side.
HALF_WIDTH, HALF_COUNT = 0.025, 4
#: The smoothed start of a window may err by so many times its computed spread: motion is not a cubic.
TRUST = 3.0
#: Samples that lie so many times farther off their cubic than those around other starts: a servo answered to a step.
JUMP = 3.0


def half_step(model: mujoco.MjModel) -> float:
    """By how much, in s, velocities and commands lead positions in the model's integrator.

    Semi-implicit integrators move positions by the new velocity: as in the leapfrog scheme a velocity belongs half a
    step before its position, and a command acts from half a step before its instant. Seen so they are of second order.
    """
    return 0.0 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.5 * float(model.opt.timestep)


def smoothed_state(
    episode: Episode, index: int, sigma: np.ndarray, lead: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration of the scalar columns at a sample by a local cubic in time, and the spread.

    :param index: of the sample
    :param sigma: noise of the position columns, (m,)
    :param lead: velocities are those of so many s before the sample
    :return: positions (m,), velocities (m,), accelerations (m,), standard deviations of the first two (2, m)
    """
    rows, t = _around(episode, index)
    *state, spread, unit = _cubic(t, episode.qpos[rows], lead)
    return *state, spread[:, None] * sigma / unit[:, None]


def misfit(episode: Episode, index: int, sigma: np.ndarray) -> np.ndarray:
    """By how many times the samples around one lie farther from their cubic than noise leaves them, (m,); at least 1.

    A velocity that jumps, as at a touch-down, is no cubic, and the smoothed state there errs by as much more.
    """
    rows, t = _around(episode, index)
    basis = np.vander(t / np.abs(t).max(), 4)
    off = episode.qpos[rows] - basis @ np.linalg.lstsq(basis, episode.qpos[rows], rcond=None)[0]
    return np.asarray(np.maximum(1.0, np.sqrt((off**2).sum(0) / max(1, len(t) - 4)) / sigma))


def smoothed_rotation(
    episode: Episode, index: int, columns: np.ndarray, sigma: np.ndarray, lead: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same of a quaternion, by a local cubic of the rotation vectors from the sample to those around it.

    Noise of s rad about each axis is noise of s / 2 of the three directions in which a unit quaternion may move.

    :param columns: of the quaternion, (4,)
    :param sigma: their noise, (4,)
    :return: unit quaternion (4,), angular velocity in the body's frame (3,), its derivative (3,), standard deviations
        of the rotation in rad and of the angular velocity (2,)
    """
    rows, t = _around(episode, index)
    around = episode.qpos[rows][:, columns]
    around = around / np.linalg.norm(around, axis=1, keepdims=True)
    here = around[index - rows.start]
    turns = np.zeros((len(t), 3))
    for turn, quaternion in zip(turns, around):
        mujoco.mju_subQuat(turn, quaternion, here)
    turn, velocity, acceleration, spread, unit = _cubic(t, turns, lead)
    return turned(here[None], turn[None])[0], velocity, acceleration, spread * _about_an_axis(sigma) / unit


def _about_an_axis(sigma: np.ndarray) -> float:
    """Noise of a rotation about each axis in rad, from that of a unit quaternion's numbers, (4,)."""
    return float(2 * np.sqrt((sigma**2).sum() / 3))


def _around(episode: Episode, index: int) -> tuple[slice, np.ndarray]:
    """The samples around one, and their times from it."""
    step = float(np.median(np.diff(episode.time)))
    half = max(HALF_COUNT, round(HALF_WIDTH / step))
    rows = slice(max(0, index - half), min(len(episode), index + half + 1))
    return rows, episode.time[rows] - episode.time[index]


def _cubic(t: np.ndarray, values: np.ndarray, lead: float) -> tuple[np.ndarray, ...]:
    """Values at time 0, first derivatives ``lead`` before and second ones, (m,), of the cubics nearest to (n, m).

    With the spread of the first two under white noise of unit variance, (2,), and what it is to be divided by, (2,).
    """
    scale = np.abs(t).max()
    inverse = np.linalg.pinv(np.vander(t / scale, 4, increasing=True))
    c = inverse @ values
    z = -lead / scale
    velocity = (c[1] + 2 * z * c[2] + 3 * z**2 * c[3]) / scale
    acceleration = (2 * c[2] + 6 * z * c[3]) / scale**2
    return c[0], velocity, acceleration, np.sqrt(np.sum(inverse[:2] ** 2, axis=1)), np.array([1.0, scale])


def looseness(data: Measurements, starts: Sequence[tuple[int, int]], sigma: np.ndarray) -> np.ndarray:
    """By how many times more than noise leaves it the smoothed state at each of n samples may err, (n, m); at least 1.

    Where contacts come and go, by as much as the samples around are off their cubic. Elsewhere only where they are much
    farther off it than is usual: too slow a log is off it everywhere, and its starts, set free, would fit anything.

    :param starts: number of the episode and index of the sample
    """
    if data.whole_states:  # nothing is smoothed
        return np.ones((len(starts), len(sigma)))
    off = np.array([misfit(data.episodes[number], index, sigma) for number, index in starts])
    return off if data.touching else np.where(off > JUMP * np.median(off, axis=0), off, 1.0)


def start_state(
    model: mujoco.MjModel,
    data: Measurements,
    episode: Episode,
    index: int,
    sigma: np.ndarray,
    addresses: np.ndarray,
    loose: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The state of the model at a sample: qpos (nq,), qvel (nv,), qacc (nv,), spread (2 nv,).

    The spread is of positions as :func:`moved` moves them, then of velocities.

    :param loose: see :func:`looseness`, (m,)
    """
    qpos, (qvel, qacc), spread = model.qpos0.copy(), np.zeros((2, model.nv)), np.zeros(2 * model.nv)
    if data.whole_states:
        dofs = velocity_addresses(model, data.columns)
        qpos[addresses] = episode.qpos[index]
        qvel[dofs] = episode.qvel[index]
        if index + 1 < len(episode):
            after = episode.qvel[index + 1] - episode.qvel[index]
            qacc[dofs] = after / (episode.time[index + 1] - episode.time[index])
        if data.noise is not None:
            if not data.simulated:
                qvel -= half_step(model) * qacc
            spread[model.nv + dofs] = data.noise.qvel
            noise = np.zeros(model.nq)
            noise[addresses] = data.noise.qpos
            for adr, dof in straight(model).items():
                spread[dof] = noise[adr]
            for adr, dof in turning(model).items():
                spread[dof : dof + 3] = _about_an_axis(noise[adr : adr + 4])
        return qpos, qvel, qacc, spread
    lead = half_step(model)
    position, velocity, acceleration, deviation = smoothed_state(episode, index, sigma, lead)
    deviation = deviation * loose
    column = {int(address): i for i, address in enumerate(addresses)}
    for adr, dof in straight(model).items():
        if adr in column:
            i = column[adr]
            qpos[adr], qvel[dof], qacc[dof] = position[i], velocity[i], acceleration[i]
            spread[[dof, model.nv + dof]] = deviation[:, i]
    for adr, dof in turning(model).items():
        if adr in column:
            columns, about = np.array([column[adr + k] for k in range(4)]), slice(dof, dof + 3)
            turn = smoothed_rotation(episode, index, columns, sigma[columns], lead)
            qpos[adr : adr + 4], qvel[about], qacc[about] = turn[:3]
            spread.reshape(2, -1)[:, about] = turn[3][:, None]
    return qpos, qvel, qacc, spread


def moved(model: mujoco.MjModel, qpos: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Positions (n, nq) moved by (n, nv): what is straight is added to, what turns is turned about its body's axes."""
    out = qpos.copy()
    for adr, dof in straight(model).items():
        out[:, adr] += by[:, dof]
    for adr, dof in turning(model).items():
        out[:, adr : adr + 4] = turned(qpos[:, adr : adr + 4], by[:, dof : dof + 3])
    return out


def turned(quaternions: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) turned by rotation vectors in the body's frame, (n, 3), in rad."""
    half = 0.5 * np.linalg.norm(by, axis=1, keepdims=True)
    c, d = np.cos(half), 0.5 * np.sinc(half / np.pi) * by
    w, v = quaternions[:, :1], quaternions[:, 1:]
    return np.concatenate([w * c - (v * d).sum(1, keepdims=True), w * d + c * v + np.cross(v, d)], axis=1)
