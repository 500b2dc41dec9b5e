"""Covariances of robust estimates by the sandwich, from scores that may be correlated."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

#: What rests on fewer blocks has no interval: one alone does not scatter.
LEAST = 1.5


def sandwich_covariance(hessian: np.ndarray, scatter: np.ndarray, free: np.ndarray, count: float) -> np.ndarray:
    r"""Covariance of an estimate, :math:`H^{-1} S H^{-1}` (Huber 1967), (p, p).

    Scores are too small by what the fit took up of them: as of so many observations fewer as there are parameters.

    :param hessian: of the cost, (p, p)
    :param scatter: covariance of the sum of the scores, (p, p)
    :param free: which parameters move, (p,), bool
    :param count: of observations that weigh alike
    :return: infinite variances of what is not free or has no slope, and of all parameters where ``count`` does not
        exceed their number: nothing tells then how far off they are
    """
    moving = np.flatnonzero((np.diag(hessian) > 0) & free)
    found = np.diag(np.full(len(free), np.inf))
    spare = count - len(moving)
    if spare <= 0:
        return found
    inverse = np.linalg.pinv(hessian[np.ix_(moving, moving)], rcond=1e-10, hermitian=True)
    # Positive in every direction, rounding apart: Newey and West's weights are.
    found[np.ix_(moving, moving)] = inverse @ scatter[np.ix_(moving, moving)] @ inverse * (count / spare)
    found[moving, moving] = np.maximum(found[moving, moving], 0.0)
    return found


def serial_scatter(scores: np.ndarray, before: np.ndarray, lags: int) -> np.ndarray:
    """Covariance of the sum of scores of which neighbours in time may be correlated (Newey and West 1987), (p, p).

    :param scores: (n, p)
    :param before: the row that each follows; -1 where it follows none, (n,)
    :param lags: scores of so many rows in a row may be correlated
    """
    found, past = scores.T @ scores, np.arange(len(scores))
    for lag in range(1, lags + 1):
        past = np.where(past < 0, -1, before[past])
        after = past >= 0
        products = scores[after].T @ scores[past[after]]
        found += (1 - lag / (lags + 1)) * (products + products.T)
    return found


def half_widths(normal: np.ndarray, gradient: np.ndarray, block: np.ndarray, least: float = LEAST) -> np.ndarray:
    r"""Half-widths of 95 % intervals of an estimate from blocks of observations, (f,).

    Errors within a block are correlated, those of different blocks are not. So the estimate's variance is that of the
    sum of the blocks' moves, :math:`H^{-1} \sum_b g_b g_b^T H^{-1}` with the gradients :math:`g_b` (Liang and Zeger
    1986). It rests on few blocks where few of them tell a parameter; then it is uncertain itself, and the interval is
    that of t with Satterthwaite's degrees of freedom (1946), less one for the mean.

    :param normal: Gauss-Newton matrix of each observation at the estimate, (n, f, f)
    :param gradient: likewise, (n, f)
    :param block: number of each observation's block, (n,)
    :param least: blocks that must tell a parameter
    :return: NaN where fewer do
    """
    inverse = regularised_inverse(normal.sum(0))
    members = [block == b for b in np.unique(block)]
    gradients = np.stack([gradient[m].sum(0) for m in members])
    # The mean gradient is not quite zero at a bound; only its scatter matters.
    moves = (gradients - gradients.mean(0)) @ inverse
    told = np.stack([np.einsum("fi,ij,jf->f", inverse, normal[m].sum(0), inverse) for m in members])
    count = told.sum(0) ** 2 / np.maximum((told**2).sum(0), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sqrt((moves**2).sum(0) * count / (count - 1)) * student.ppf(0.975, np.maximum(count - 1, 1))
    return np.where(count < least, np.nan, spread)


def correlations(covariance: np.ndarray) -> np.ndarray:
    """The correlations of a covariance (f, f): symmetric, from -1 to 1, and 1 on the diagonal, whatever its rounding.

    :param covariance: positive on the diagonal
    """
    size = np.sqrt(np.diag(covariance))
    found = np.clip((covariance + covariance.T) / (2 * np.outer(size, size)), -1, 1)
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


def regularised_inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse of a Gauss-Newton matrix (f, f), finite where directions have no slope."""
    return np.linalg.inv(normal + 1e-9 * np.eye(len(normal)) * max(1e-12, float(np.trace(normal))))
