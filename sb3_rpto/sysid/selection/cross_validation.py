"""Errors on windows that parameters were not fitted to, without a fit for each part of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_rpto.fitting.gauss_newton import add_step, bounded_step
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem

#: Windows left out move a parameter as if it were known beforehand to this many plausible sizes, to the power of -2:
#: what they hardly show, like a tilt that acts to second order, would go astray.
UNTOLD = 1.0


def unseen_errors(
    problem: Problem, fit: Fit, free: np.ndarray, folds: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Errors of all windows, each by parameters that were fitted without it, (W,).

    Each fold's parameters are one Gauss-Newton step away from the fit to all windows, taken with the windows of the
    fold and beside it left out.

    :param problem: windows
    :param fit: to all of them
    :param free: indices of the parameters that were fitted, (f,)
    :param folds: windows to fit and to judge on, see :func:`sb3_rpto.sysid.selection.model_comparison.folds`
    """
    rows = np.tile(fit.values, (len(problem.windows), 1))
    if len(free):
        linear = problem.linear(fit, free)
        low, high = ((b[free] - fit.values[free]) / problem.size[free] for b in (problem.lower, problem.upper))
        for others, judged in folds:
            normal, gradient = linear.normal[others].sum(0), linear.gradient[others].sum(0)
            normal = normal + np.diag(1e-3 * np.diag(normal) + UNTOLD)
            step = bounded_step(normal, gradient, low, high) * problem.size[free]
            begin, lower, upper = (x[free] for x in (fit.values, problem.lower, problem.upper))
            rows[np.ix_(judged, free)] = add_step(begin, step, lower, upper)
    return problem.score(rows, fit.starts, iterations=1).errors
