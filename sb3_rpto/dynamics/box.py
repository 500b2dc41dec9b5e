"""Steps of parameters within their bounds."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

#: What misses a bound by less than this share of it, or of the step, does so by rounding.
ROUNDING = 1e-12


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


def stepped(values: np.ndarray, step: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Parameters after a step within their bounds, (p,); what comes to a bound up to rounding is exactly there.

    Steps are solved for in scaled units, and what ended at a bound is found by comparison with it.

    :param values: before, within the bounds, (p,)
    :param step: (p,)
    :param lower: bounds, (p,), may be -inf
    :param upper: (p,)
    """
    found = np.clip(values + step, lower, upper)
    for bound in (lower, upper):
        found = np.where(np.isclose(found, bound, rtol=ROUNDING, atol=ROUNDING * np.abs(step)), bound, found)
    return np.asarray(found)
