"""Where fits of an effect may start: a shape may hide what the others do, and a limit beyond reach does nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_rpto.tracing.identify import Fit, Linear, Problem
from sb3_rpto.tracing.loss import Loss

#: Of more starts than these beside the null, such as all counts of a cogging motor's poles, so many are tried: those
#: that promise most. They must be of a shape.
TRIED = 3


def places_to_begin(problem: Problem, base: Fit, free: Sequence[int] | np.ndarray, effect: int) -> list[np.ndarray]:
    """The parameters with an effect's own where fits may start.

    :param problem: windows
    :param base: fitted without the effect
    :param free: parameters that were free there
    :param effect: its number
    """
    found, simulation = [base.values], problem.simulation
    s = simulation.slices[effect]
    for i, parameter in enumerate(simulation.effects[effect].parameters, s.start):
        for start in parameter.starts:
            found.append(base.values.copy())
            found[-1][i] = simulation.null[i] + start * problem.size[i]
    if len(found) <= TRIED + 1:
        return found
    falls = _promised(problem, base, np.asarray(free), s, found)
    return [found[i] for i in np.argsort(-falls)[:TRIED]]


def _promised(problem: Problem, base: Fit, free: np.ndarray, own: slice, found: list[np.ndarray]) -> np.ndarray:
    """How far the cost would fall to first order from each start that differs in shapes alone.

    What the other parameters and the windows' starts do is the same for all, as the effect does nothing yet.
    """
    every = np.arange(len(problem.windows))
    r, jt, jx = problem.linearise(base.values, base.starts, free)
    loss, falls = Loss.of(r), []
    for values in found:
        step, columns = problem.steps(values), [jt]
        for k in np.arange(own.start, own.stop)[problem.simulation.strength[own]]:
            moved = values.copy()
            moved[k] += step[k]
            there = problem.residuals(np.tile(moved, (len(every), 1)), base.starts, every)
            columns.append(((there - r) * (problem.size[k] / step[k]))[:, :, None])
        reduced = problem.reduce(r, np.concatenate(columns, axis=2), jx, base.starts, loss)
        rows = np.arange(reduced.gradient.shape[1])
        falls.append(Linear(reduced.normal, reduced.gradient, rows).fall(rows))
    return np.array(falls)
