"""How far fitted parameters may be off, from how the blocks of the recordings scatter."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from sb3_rpto.tracing.identify import Linear

#: What rests on fewer blocks has no interval: one alone does not scatter.
LEAST = 1.5


def half_widths(linear: Linear, block: np.ndarray) -> np.ndarray:
    r"""Half-widths of 95 % intervals of the free parameters at a fit, in plausible sizes, (f,).

    Errors within a block go together, those of different blocks do not. So the estimate's variance is that of the sum
    of the blocks' moves, :math:`H^{-1} \sum_b g_b g_b^T H^{-1}` with the gradients :math:`g_b` (Liang and Zeger 1986).
    It rests on few blocks where few of them tell a parameter; then it is uncertain itself, and the interval is that of
    t with Satterthwaite's degrees of freedom (1946), less one for the mean.

    :param linear: the cost around the fit
    :param block: number of the block of each window, (W,)
    :return: NaN where fewer than :data:`LEAST` blocks tell a parameter
    """
    normal = linear.normal.sum(0)
    inverse = np.linalg.inv(normal + 1e-9 * np.eye(len(normal)) * max(1e-12, float(np.trace(normal))))
    members = [block == b for b in np.unique(block)]
    gradients = np.stack([linear.gradient[m].sum(0) for m in members])
    # The mean gradient is not quite zero at a bound; only its scatter matters.
    moves = (gradients - gradients.mean(0)) @ inverse
    told = np.stack([np.einsum("fi,ij,jf->f", inverse, linear.normal[m].sum(0), inverse) for m in members])
    count = told.sum(0) ** 2 / np.maximum((told**2).sum(0), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sqrt((moves**2).sum(0) * count / (count - 1)) * student.ppf(0.975, np.maximum(count - 1, 1))
    return np.where(count < LEAST, np.nan, spread)
