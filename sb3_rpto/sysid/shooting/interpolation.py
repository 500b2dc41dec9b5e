"""What a simulation shows between its steps."""

from __future__ import annotations

import numpy as np


def interpolate(
    q: np.ndarray, v: np.ndarray, at: np.ndarray, dt: float, columns: np.ndarray, dofs: np.ndarray
) -> np.ndarray:
    """Positions at fractional steps by cubic Hermite interpolation, before the start in a straight line, (n, S, m).

    :param q: (n, K + 1, nq)
    :param v: (n, K + 1, nv)
    :param at: (n, S)
    :param dt: length of a step in s
    :param columns: addresses in q, (m,)
    :param dofs: addresses in v, -1 for a coordinate that is interpolated linearly, (m,)
    """
    past, at = np.minimum(at, 0.0), np.maximum(at, 0.0)
    if past.any():
        straight = np.where(dofs >= 0, dt * v[:, 0][:, dofs], 0.0)[:, None]
        return interpolate(q, v, at, dt, columns, dofs) + past[:, :, None] * straight
    k = np.minimum(at.astype(int), q.shape[1] - 2)
    s = (at - k)[:, :, None]
    rows = np.arange(len(q))[:, None]
    q0, q1 = q[rows, k][:, :, columns], q[rows, k + 1][:, :, columns]
    if not np.any(s % 1):
        return np.where(s == 0, q0, q1)
    slope = q1 - q0
    d0 = np.where(dofs >= 0, dt * v[rows, k][:, :, dofs], slope)
    d1 = np.where(dofs >= 0, dt * v[rows, k + 1][:, :, dofs], slope)
    return q0 + s * (d0 + s * ((3 * slope - 2 * d0 - d1) + s * (d0 + d1 - 2 * slope)))


def between(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (n, K + 1) at fractional steps (n, S), linearly; before the start those of it."""
    at = np.maximum(at, 0.0)
    k = np.minimum(at.astype(int), values.shape[1] - 2)
    rows, part = np.arange(len(values))[:, None], at - k
    return np.asarray((1 - part) * values[rows, k] + part * values[rows, k + 1])
