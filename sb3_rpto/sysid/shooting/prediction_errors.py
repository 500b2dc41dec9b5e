"""Errors of predictions from measured states, per joint and horizon."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sb3_rpto.effects import Scales, Simulation
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import Windows, cut, first_sample

#: Horizons in s; the whole run comes after them.
HORIZONS = (0.1, 0.5, 1.0)
#: Predictions begin every fifth of a horizon: of few that lie side by side, where the first begins decides too much.
OVERLAP = 0.8
#: Most predictions of a horizon.
MOST = 200
RESAMPLES = 400
#: Draws of the noise for each window of the floor: few windows of a long horizon say little by one draw each.
DRAWS = 8


@dataclass(frozen=True)
class HorizonError:
    """Errors of predictions over one horizon.

    :param horizon: in s, or ``"whole run"``
    :param joints: names of the columns
    :param rmse: root mean squared error of each, rad or m, (m,)
    :param low: 2.5 % quantile over resampled blocks, (m,); of whole runs the smallest; NaN where there is but one
    :param high: 97.5 % quantile, (m,); of whole runs the largest
    :param mae: mean absolute error, (m,)
    :param windows: number of predictions
    """

    horizon: float | str
    joints: tuple[str, ...]
    rmse: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mae: np.ndarray
    windows: int


def horizon_errors(
    simulation: Simulation, values: np.ndarray, data: Measurements, sigma: np.ndarray, seed: int
) -> list[HorizonError]:
    """Predict from smoothed measured states under the recorded commands.

    :param simulation: with the effects
    :param values: their parameters, (p,)
    :param data: recordings that nothing was fitted to
    :param sigma: noise of the position columns, (m,)
    :return: one entry for each horizon that the data are long enough for, and one for whole runs
    """
    found = []
    for horizon in HORIZONS:
        try:
            windows = cut(simulation.model, data, sigma, horizon, MOST, OVERLAP)
        except ValueError:
            continue
        _, difference, usable = predictions(simulation, values, windows)
        found.append(_pool(difference, usable, windows, observed(data), horizon, seed))
    whole = whole_runs(simulation, values, data, sigma)
    if whole is not None:
        found.append(whole)
    return found


def _pool(
    difference: np.ndarray, usable: np.ndarray, windows: Windows, joints: tuple[str, ...], horizon: float, seed: int
) -> HorizonError:
    """Pool the differences of all windows; intervals by resampling blocks."""
    squares = np.where(usable[:, :, None], difference**2, 0).sum(1)
    absolute = np.where(usable[:, :, None], np.abs(difference), 0).sum(1)
    counts = usable.sum(1)[:, None]
    blocks = [np.flatnonzero(windows.block == b) for b in np.unique(windows.block)]
    rng = np.random.default_rng(seed)
    resampled = []
    for _ in range(RESAMPLES):
        rows = np.concatenate([blocks[i] for i in rng.integers(len(blocks), size=len(blocks))])
        resampled.append(np.sqrt(squares[rows].sum(0) / counts[rows].sum(0)))
    low, high = _bounds(np.quantile(resampled, [0.025, 0.975], axis=0), len(blocks))
    rmse, mae = np.sqrt(squares.sum(0) / counts.sum(0)), absolute.sum(0) / counts.sum(0)
    return HorizonError(horizon, joints, rmse, low, high, mae, len(windows))


def _bounds(interval: np.ndarray, count: int) -> np.ndarray:
    """An interval (2, m) over so many blocks or runs: one of them tells nothing of the others."""
    return interval if count > 1 else np.full_like(interval, np.nan)


def predictions(
    simulation: Simulation, values: np.ndarray, windows: Windows
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted positions, predicted minus measured (both (W, S, m)), and what counts, (W, S).

    A prediction that became unstable stays where the measured values end, as far off as anything measured.
    """
    problem = Problem(simulation, windows, [Scales()] * len(simulation.effects))
    count = len(windows)
    starts = np.zeros((count, windows.spread.shape[1]))
    q = problem.predict(np.tile(values, (count, 1)), starts, np.arange(count))
    away = np.abs(windows.measured).max(axis=(0, 1)) + 10.0
    q = np.where(np.isfinite(q), q, windows.measured + away)
    return q, q - windows.measured, windows.usable


def whole_runs(
    simulation: Simulation, values: np.ndarray, data: Measurements, sigma: np.ndarray
) -> HorizonError | None:
    """Predict each episode from its first usable state to its end."""
    differences = []
    for e in data.episodes:
        one = replace(data, episodes=[e])
        begin = first_sample(simulation.model, e, data.whole_states)
        begin += int(np.argmax(e.usable[begin:]))
        length = float(e.time[-1] - e.time[begin]) * 0.999
        try:
            windows = cut(simulation.model, one, sigma, length, 1)
        except ValueError:
            continue
        _, d, usable = predictions(simulation, values, windows)
        differences.append(d[0][usable[0]])
    if not differences:
        return None
    rmses = np.array([np.sqrt(np.mean(d**2, axis=0)) for d in differences])
    pooled = np.concatenate(differences)
    # Runs are few: their own range stands for the interval.
    low, high = _bounds(np.stack([rmses.min(0), rmses.max(0)]), len(rmses))
    return HorizonError(
        "whole run",
        observed(data),
        np.sqrt(np.mean(pooled**2, axis=0)),
        low,
        high,
        np.mean(np.abs(pooled), axis=0),
        len(differences),
    )


def noise_floor(
    simulation: Simulation, values: np.ndarray, data: Measurements, sigma: np.ndarray, seed: int
) -> list[HorizonError]:
    """The errors that a true model would have: those of the measured positions and of the smoothed starts.

    Each window is predicted from its start and from several that err as smoothing noise lets them err.

    :return: as :func:`horizon_errors`, whole runs left out; empty for exact data
    """
    if data.exact:
        return []
    rng = np.random.default_rng(seed)
    found = []
    for horizon in HORIZONS:
        try:
            windows = cut(simulation.model, data, sigma, horizon, MOST, OVERLAP)
        except ValueError:
            continue
        problem = Problem(simulation, windows, [Scales()] * len(simulation.effects))
        count, index = len(windows), np.tile(np.arange(len(windows)), DRAWS)
        starts = rng.standard_normal((len(index), windows.spread.shape[1])) / windows.trust
        true = problem.predict(np.tile(values, (count, 1)), np.zeros_like(starts[:count]), np.arange(count))[index]
        off = problem.predict(np.tile(values, (len(index), 1)), starts, index)
        noise = rng.standard_normal(true.shape) * windows.sigma
        usable = windows.usable[index] & np.isfinite(true).all(-1) & np.isfinite(off).all(-1)
        pooled = _pool(off - true + noise, usable, windows.take(index), observed(data), horizon, seed)
        found.append(replace(pooled, windows=count))
    return found


def observed(data: Measurements) -> tuple[str, ...]:
    """The position columns that are compared with predictions."""
    return tuple(name for name in data.columns.qpos if name not in data.unobserved)
