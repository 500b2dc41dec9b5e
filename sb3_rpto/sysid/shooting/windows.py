"""Windows of multiple shooting: short stretches of a recording, each simulated from its own start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from sb3_rpto.effects import Drive
from sb3_rpto.effects.commands import LONGEST_DELAY
from sb3_rpto.effects.names import object_id
from sb3_rpto.effects.simulation import memory, names_of
from sb3_rpto.sysid.data import signal_quality
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.settings import DEFAULTS, ProblemSettings
from sb3_rpto.sysid.shooting.initial_states import HALF_COUNT, HALF_WIDTH, TRUST, half_step, looseness, start_state

#: Seconds of commands kept from before a window, for effects that delay and filter: four constants of the slowest lag.
MEMORY = 1.0
#: Turns of older commands that come before those, a step each, for what does not forget with time: a play.
REVERSALS = 16
#: After a gap the longest delay of the library is waited for, at most for this share of what is there.
WAITED = 0.25
#: Exact data (from a simulator) count as noisy by this share of a position's standard deviation.
EXACT = 1e-4
#: Orders of the differences that tell the noise of measured positions.
ORDERS = range(3, 8)
#: Samples between changes of commands tell it where there are so many differences of them, and they are less than this
#: share of all: fewer, or others, tell less than they gain.
ENOUGH_HELD, CLEARLY_LESS = 200, 0.85
#: Least length of a block of windows in s; blocks count as independent.
BLOCK = 1.0
#: Some hundred transitions of a simulator are soon over, and no sensor's drift ties them: so many blocks, if shorter.
ENOUGH_BLOCKS = 8
#: The Runge-Kutta method is stable up to 2.8 for the product of a step and the model's fastest rate; poses differ.
STIFF = 2.0


@dataclass(frozen=True)
class Windows:
    """``W`` windows of one length with their starts, their commands and what was measured.

    :param qpos: smoothed positions at the start, as the sensors show them, (W, nq)
    :param qvel: smoothed velocities there, (W, nv)
    :param qacc: and accelerations, which late sensors need, (W, nv)
    :param spread: standard deviation of that start, positions then velocities, (W, 2 nv); zeros for exact data
    :param drive: commands on the grid of the time step
    :param at: samples on that grid, in steps from the start, (W, S); fractional where the clock jitters
    :param measured: positions of the observed columns, (W, S, m)
    :param usable: False for samples that do not count, (W, S)
    :param sigma: measurement noise of each observed column, (m,)
    :param columns: addresses of the observed columns in qpos, (m,)
    :param block: number of the block of neighbouring windows, (W,); blocks are taken as independent
    :param episode: index of the episode, (W,)
    :param time: of the start in the episode, in s, (W,)
    :param exact: whether the samples come from a simulator
    :param touching: whether contacts come and go in measured data
    :param noisy_starts: whether the starts are samples with noise of that spread, not smoothed states
    """

    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    spread: np.ndarray
    drive: Drive
    at: np.ndarray
    measured: np.ndarray
    usable: np.ndarray
    sigma: np.ndarray
    columns: np.ndarray
    block: np.ndarray
    episode: np.ndarray
    time: np.ndarray
    exact: bool
    touching: bool
    noisy_starts: bool

    @property
    def trust(self) -> float:
        """How many times their spread the starts may err by at one standard deviation."""
        return 1.0 if self.noisy_starts else TRUST

    def __len__(self) -> int:
        return len(self.qpos)

    def take(self, index: np.ndarray) -> Windows:
        """The windows at ``index``."""
        shared = ("drive", "sigma", "columns", "exact", "touching", "noisy_starts")
        own = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in shared}
        return replace(self, drive=self.drive.take(index), **own)

    def first(self, samples: int) -> Windows:
        """The windows up to so many samples after their starts."""
        at, measured, usable = (rows[:, :samples] for rows in (self.at, self.measured, self.usable))
        drive, steps = self.drive, max(1, int(np.ceil(at.max())))
        enabled = None if drive.enabled is None else drive.enabled[:, :steps]
        drive = drive._replace(commands=drive.commands[:, : drive.before + steps], enabled=enabled)
        return replace(self, drive=drive, at=at, measured=measured, usable=usable)


def noise_levels(data: Measurements) -> np.ndarray:
    """Standard deviation of the measurement noise of each position column, (m,).

    Where a command changes, an acceleration does, which passes for noise: where stretches between the changes of
    commands tell of clearly less, and are enough to tell, that is the noise.
    """
    levels = []
    for i in range(len(data.columns.qpos)):
        if data.whole_states:
            spread = np.std(np.concatenate([e.qpos[:, i] for e in data.episodes]))
            known = 0.0 if data.noise is None else float(data.noise.qpos[i])
            levels.append(max(known, EXACT * max(float(spread), 1e-3)))
            continue
        level, between = (_difference_noise(data.episodes, i, held) for held in (False, True))
        level = between if 0 < between < CLEARLY_LESS * level else level
        steps = [step for e in data.episodes if (step := signal_quality.rounding(e.qpos[:, i])) is not None]
        # A smooth signal without noise still has the rounding of its file.
        levels.append(max(level, float(np.median(steps or [0.0])) / math.sqrt(12), 1e-7))
    return np.array(levels)


def _difference_noise(episodes: Sequence[Episode], column: int, held: bool) -> float:
    """Noise by divided differences, which vanish on polynomials of a degree below their order on any clock.

    They are scaled to unit variance for white noise. The lowest order from 3 on is used whose successor finds no less:
    then no motion is left in it.

    :param held: of samples between which no command changes alone; 0 where they are too few
    """
    levels: list[float] = []
    for order in ORDERS:
        found = np.concatenate([_differences(e, column, order, held) for e in episodes])
        if held and len(found) < ENOUGH_HELD:
            break
        # The smallest 95 % leave out the peaks of motion; what they lack of a Gaussian's variance is known. A median
        # would know but a few values of a rounded signal.
        squares = np.sort(found**2)[: max(1, round(0.95 * len(found)))]
        levels.append(float(np.sqrt(squares.mean() / 0.7588)) if len(found) else 0.0)
    if not levels:
        return 0.0
    return next((now for now, then in pairwise(levels) if then > 0.93 * now), levels[-1])


def _differences(episode: Episode, column: int, order: int, held: bool) -> np.ndarray:
    """Divided differences of a position, (n,), each of ``order`` + 1 samples."""
    if len(episode) <= order:
        return np.zeros(0)
    found = signal_quality.divided_differences(episode.time, episode.qpos[:, column], order)
    if not held:
        return found
    changes = np.any(np.diff(episode.ctrl, axis=0) != 0, axis=1)  # a command acts from its sample on
    inside = np.lib.stride_tricks.sliding_window_view(changes[:-1], order - 1)
    return found[~inside.any(axis=1)]


def discretised(
    model: mujoco.MjModel, data: Measurements, fine: bool, settings: ProblemSettings = DEFAULTS.problem
) -> mujoco.MjModel:
    """A copy of the model that integrates as the data ask for.

    A simulator's data are met by its own integrator and time step. The world knows no steps: measured data take steps
    of at most 2 ms, with the Runge-Kutta method of fourth order where it is to be ``fine``. A semi-implicit step of
    1 ms errs by about a milliradian in half a second. A model that is too stiff for that method keeps its own implicit
    one, or takes MuJoCo's fast one.
    """
    copy = model.__copy__()
    if data.exact or data.simulated:
        copy.opt.timestep /= data.substeps
    else:
        copy.opt.timestep = step_for(model, data, settings)
        if fine and is_stiff(copy):
            copy.opt.integrator = int(_IMPLICIT.get(model.opt.integrator, _FAST))
        elif fine:
            copy.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
            # The exact filter takes the mean rate of the four stages for that at the step's start, and errs by it.
            exact = copy.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
            copy.actuator_dyntype[exact] = int(mujoco.mjtDyn.mjDYN_FILTER)
    return copy


def step_for(model: mujoco.MjModel, data: Measurements, settings: ProblemSettings) -> float:
    """The time step in s that measured data are simulated with: the model's own, or a whole part of it."""
    longest = min(settings.longest_step, data.step)
    return float(model.opt.timestep / math.ceil(model.opt.timestep / longest - 1e-9))


_FAST = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
_IMPLICIT = {int(i): i for i in (_FAST, mujoco.mjtIntegrator.mjINT_IMPLICIT)}


def is_stiff(model: mujoco.MjModel) -> bool:
    """Whether the Runge-Kutta method would be unstable at the model's time step, near its reference pose.

    Looked at are the eigenvalues of the motion without contacts, limits and dry friction, linearised by differences.
    """
    free = model.__copy__()
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, nv, eps = mujoco.MjData(free), model.nv, 1e-6

    def acceleration(dq: np.ndarray, v: np.ndarray) -> np.ndarray:
        data.qpos[:] = free.qpos0
        mujoco.mj_integratePos(free, data.qpos, dq, 1.0)
        data.qvel[:] = v
        mujoco.mj_forward(free, data)
        return data.qacc.copy()

    none, units = np.zeros(nv), eps * np.eye(nv)
    rates = np.zeros((2 * nv, 2 * nv))
    rates[:nv, nv:] = np.eye(nv)
    for i, unit in enumerate(units):
        rates[nv:, i] = (acceleration(unit, none) - acceleration(-unit, none)) / (2 * eps)
        rates[nv:, nv + i] = (acceleration(none, unit) - acceleration(none, -unit)) / (2 * eps)
    return bool(np.abs(np.linalg.eigvals(rates)).max(initial=0.0) * model.opt.timestep > STIFF)


def first_sample(model: mujoco.MjModel, episode: Episode, whole_states: bool) -> int:
    """Where the first window may begin: what its actuators remember is recorded, and smoothing has both its sides.

    After a gap an effect that is not in the model may remember, too: commands are waited for there.
    """
    duration = float(episode.time[-1] - episode.time[0])
    wait = max(memory(model), min(LONGEST_DELAY, WAITED * duration) if episode.after_gap else 0.0)
    known = int(np.searchsorted(episode.time, episode.time[0] + wait - 1e-9))
    step = float(np.median(np.diff(episode.time)))
    return min(max(known, 0 if whole_states else max(HALF_COUNT, round(HALF_WIDTH / step))), len(episode) - 1)


def cut(
    model: mujoco.MjModel,
    data: Measurements,
    sigma: np.ndarray,
    horizon: float,
    most: int,
    overlap: float = 0.0,
) -> Windows:
    """Lay windows side by side over all episodes, or let them overlap.

    :param model: gives the time step and the order of the coordinates
    :param data: recordings
    :param sigma: noise of each position column of the data
    :param horizon: length of a window in s
    :param most: at most so many windows, evenly chosen
    :param overlap: share of a window that the next one covers too, in [0, 1)
    :raises ValueError: no episode is as long as a window
    """
    step = data.step
    if horizon < 1.99 * step:
        raise ValueError(f"a window of {horizon:g} s holds fewer than two steps of {step:.4g} s; raise horizon")
    starts = []
    for number, e in enumerate(data.episodes):
        begin = first_sample(model, e, data.whole_states)
        while True:
            end = int(np.searchsorted(e.time, e.time[begin] + horizon + 1e-9, side="right"))
            if e.time[-1] < e.time[begin] + horizon - 1e-9 or end - begin < 3:
                break
            if e.usable[begin] and e.placed[begin:end].mean() > 0.5:
                starts.append((number, begin, end))
                follow = e.time[begin] + (1 - overlap) * (e.time[end - 1] - e.time[begin])
                begin = max(begin + 1, int(np.searchsorted(e.time, follow - 1e-9)))
            else:
                begin += 1
    if not starts:
        whole, left = (
            max(e.time[-1] - e.time[begin(e)] for e in data.episodes)
            for begin in (lambda e: 0, lambda e: first_sample(model, e, data.whole_states))
        )
        waits = f", {left:.3g} s after what actuators remember and smoothing needs" if left < whole else ""
        remedy = "lower horizon" if left > 2.5 * step else "record longer runs"
        raise ValueError(f"no episode holds a window of {horizon:g} s (the longest has {whole:.3g} s{waits}); {remedy}")
    if len(starts) > most:
        starts = [starts[i] for i in np.linspace(0, len(starts) - 1, most).round().astype(int)]
    return _build(model, data, sigma, horizon, starts)


def _build(
    model: mujoco.MjModel,
    data: Measurements,
    sigma: np.ndarray,
    horizon: float,
    starts: Sequence[tuple[int, int, int]],
) -> Windows:
    h = float(model.opt.timestep)
    steps, before = math.ceil(horizon / h - 1e-6), math.ceil(max(MEMORY, memory(model)) / h)
    count, samples = len(starts), max(end - begin for _, begin, end in starts) - 1
    observed = [i for i, name in enumerate(data.columns.qpos) if name not in data.unobserved]
    addresses = names_of(model, data.columns.qpos)
    actuators = command_order(model, data)
    qpos, qvel, qacc = np.tile(model.qpos0, (count, 1)), *np.zeros((2, count, model.nv))
    spread = np.zeros((count, 2 * model.nv))
    commands = np.zeros((count, before + steps, model.nu))
    enabled = np.ones((count, steps, model.nu))
    at, usable = np.zeros((count, samples)), np.zeros((count, samples), dtype=bool)
    measured = np.zeros((count, samples, len(observed)))
    block = np.zeros(count, dtype=int)
    last: tuple[int, float] = (-1, 0.0)
    least = block_length(data, horizon)
    loose = looseness(data, [(number, begin) for number, begin, _ in starts], sigma)
    for w, (number, begin, end) in enumerate(starts):
        e = data.episodes[number]
        t0 = e.time[begin]
        qpos[w], qvel[w], qacc[w], spread[w] = start_state(model, data, e, begin, sigma, addresses, loose[w])
        grid = t0 + h * np.arange(-before, steps)
        # Clocks are rounded, by up to microseconds: a sample is of the step of the grid that it lies nearest to.
        row = np.clip(np.searchsorted(e.time, grid + 0.5 * h, side="right") - 1, 0, len(e) - 1)
        commands[w][:, actuators] = (
            e.ctrl[row]
            if data.exact or data.simulated
            else held(e.time, e.ctrl, np.append(grid, grid[-1] + h) - half_step(model))
        )
        if data.idle and not e.after_gap:
            commands[w][grid < e.time[0] - 0.5 * h] = 0
        older = e.ctrl[: np.searchsorted(e.time, grid[0])]
        for column, values in zip(actuators, older.T if len(older) else ()):
            turns = reversals(values, min(REVERSALS, before // 4))
            commands[w][: len(turns), column] = turns
        enabled[w][:, actuators] = e.enabled[row[before:]]
        n = end - begin - 1
        at[w, :n] = np.minimum((e.time[begin + 1 : end] - t0) / h, steps)
        # The model's grid is the clock's where both agree to a thousandth of a step.
        whole = np.round(at[w])
        at[w] = np.where(np.abs(at[w] - whole) < 1e-3, whole, at[w])
        measured[w, :n] = e.qpos[begin + 1 : end][:, observed]
        usable[w, :n] = e.placed[begin + 1 : end]
        if number != last[0] or t0 - last[1] >= least - 1e-9:
            last = (number, t0)
            block[w] = block[w - 1] + 1 if w else 0
        else:
            block[w] = block[w - 1]
    settings = {name: np.array([data.episodes[n].params[name] for n, _, _ in starts]) for name in data.columns.params}
    hold = max(1, round(data.step / h)) if data.exact or data.simulated else 1
    drive = Drive(commands, before, None if enabled.all() else enabled, settings, hold)
    return Windows(
        qpos,
        qvel,
        qacc,
        spread,
        drive,
        at,
        measured,
        usable,
        sigma[observed],
        addresses[observed],
        block,
        np.array([number for number, _, _ in starts]),
        np.array([data.episodes[number].time[begin] for number, begin, _ in starts]),
        data.exact,
        data.touching,
        data.noise is not None,
    )


def reversals(values: np.ndarray, most: int) -> np.ndarray:
    """What a play remembers of commands, however long ago: the first, and extrema of which none is beyond an earlier.

    :param values: commands in their order, (n,), n > 0
    :param most: of the first, largest ones, so many are kept
    :return: at most ``most`` commands that leave a play of any width where all of them do, up to the last command
    """
    last = len(values) - 1
    at, other = sorted(last - int(np.argmax(x[::-1])) for x in (values, -values))
    found = [0, at, other]
    at, sign = other, 1.0 if values[other] > values[at] else -1.0
    while at < last and len(found) < most:
        rest = sign * values[at:]
        at += len(rest) - 1 - int(np.argmin(rest[::-1]))
        sign = -sign
        found.append(at)
    return np.asarray(values[found[:most]])


def join(a: Windows, b: Windows) -> Windows:
    """All windows of both, as blocks of their own."""
    columns = max(a.at.shape[1], b.at.shape[1])

    def pad(values: np.ndarray) -> np.ndarray:
        return np.pad(values, [(0, 0), (0, columns - values.shape[1])] + [(0, 0)] * (values.ndim - 2))

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(a, name), getattr(b, name)])

    enabled = None
    if a.drive.enabled is not None or b.drive.enabled is not None:
        parts = [
            w.drive.enabled if w.drive.enabled is not None else np.ones_like(w.drive.commands[:, w.drive.before :])
            for w in (a, b)
        ]
        enabled = np.concatenate(parts)
    drive = a.drive._replace(
        commands=np.concatenate([a.drive.commands, b.drive.commands]),
        enabled=enabled,
        settings={k: np.concatenate([v, b.drive.settings[k]]) for k, v in a.drive.settings.items()},
    )
    arrays: dict[str, Any] = {n: both(n) for n in ("qpos", "qvel", "qacc", "spread", "time")}
    arrays |= {n: np.concatenate([pad(getattr(w, n)) for w in (a, b)]) for n in ("at", "measured", "usable")}
    for name in ("block", "episode"):  # each its own
        arrays[name] = np.concatenate([getattr(a, name), getattr(b, name) + getattr(a, name).max() + 1])
    return replace(a, drive=drive, **arrays)


def block_length(data: Measurements, horizon: float) -> float:
    """Least length of a block of windows of length ``horizon``, in s."""
    if not data.whole_states:
        return BLOCK
    duration = sum(float(e.time[-1] - e.time[0]) for e in data.episodes)
    return min(BLOCK, max(horizon, duration / ENOUGH_BLOCKS))


def held(time: np.ndarray, ctrl: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean over each step of commands that hold until the next sample: its impulse, wherever in the step they change.

    :param time: of the samples in s, (T,)
    :param ctrl: from each sample on, (T, nu); the first held before, the last after
    :param edges: of the steps in s, (K + 1,)
    :return: (K, nu)
    """
    if not ctrl.shape[1]:
        return np.empty((len(edges) - 1, 0))
    ends = min(time[0], edges[0]) - 1.0, max(time[-1], edges[-1]) + 1.0
    knots = np.concatenate([[ends[0]], time, [ends[1]]])
    levels = np.concatenate([ctrl[:1], ctrl])
    impulse = np.concatenate([np.zeros((1, ctrl.shape[1])), np.cumsum(levels * np.diff(knots)[:, None], axis=0)])
    reached = np.stack([np.interp(edges, knots, column) for column in impulse.T], axis=1).reshape(len(edges), -1)
    return np.diff(reached, axis=0) / np.diff(edges)[:, None]


def command_order(model: mujoco.MjModel, data: Measurements) -> list[int]:
    """Ids of the data's actuators in the model."""
    return [object_id(model, "actuator", name) for name in data.columns.ctrl]
