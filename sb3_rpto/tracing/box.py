"""Quadratic steps within bounds."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear


def bounded_step(normal: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimise the quadratic z' N z / 2 + g' z within a box.

    :param normal: positive semi-definite, (f, f)
    :param gradient: (f,)
    :param low: (f,), may be -inf
    :param high: (f,)
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale[:, None] / scale
    values, vectors = np.linalg.eigh(scaled)
    # Half of it as a least-squares problem: root' root = N, root' rhs = -g.
    root = np.sqrt(np.maximum(values, 1e-12 * values.max()))[:, None] * vectors.T
    rhs = -(vectors.T @ (gradient / scale)) / np.sqrt(np.maximum(values, 1e-12 * values.max()))
    step = np.linalg.lstsq(root, rhs, rcond=None)[0] / scale
    if np.all((step >= low) & (step <= high)):
        return step
    # The solver wants boxes with an inside.
    least = np.nan_to_num(low, neginf=-1e9)
    top = np.maximum(high, least + 1e-9 * (1 + np.abs(least)))
    found = lsq_linear(root, rhs, (low * scale, top * scale), method="bvls")
    return np.clip(found.x / scale, low, high)
