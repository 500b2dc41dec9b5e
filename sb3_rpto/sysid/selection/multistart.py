"""Where fits of an effect may start: a shape may hide what the others do, and a limit beyond reach does nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_rpto.fitting.loss import Loss
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Linear, Problem

#: So many starts of an effect are fitted: those that promise most.
TRIED = 3


@dataclass(frozen=True)
class Begin:
    """Where the fit of an effect may start.

    :param values: all parameters, those of the effect at one of its starts, (p,)
    :param fall: how far the cost would fall from there to first order, with the parameters that were free before;
        infinite for what promises nothing to first order, such as a limit beyond reach
    """

    values: np.ndarray
    fall: float


def beginnings(
    problem: Problem, base: Fit, free: Sequence[int] | np.ndarray, effects: Sequence[int]
) -> dict[int, list[Begin]]:
    """Where the fits of some effects may start: for each effect the few starts that promise most, the best one first.

    What the other parameters and the windows' starts do is the same for all, as an effect does nothing yet.

    :param problem: windows
    :param base: fitted without the effects
    :param free: parameters that were free there
    :param effects: their numbers
    """
    free = np.asarray(free, dtype=int)
    r, jt, jx = problem.linearise(base.values, base.starts, free)
    loss, found = Loss.of(r), {}

    def fall(values: np.ndarray, strengths: np.ndarray) -> float:
        columns, step = [jt], problem.steps(values)
        for k in strengths:
            rows = np.tile(values, (len(r), 1))
            rows[:, k] += step[k]
            there = problem.residuals(rows, base.starts, np.arange(len(r)))
            columns.append(((there - r) * (problem.size[k] / step[k]))[:, :, None])
        reduced = problem.reduce(r, np.concatenate(columns, axis=2), jx, base.starts, loss)
        linear = Linear(reduced.normal, reduced.gradient, np.concatenate([free, strengths]))
        return problem.bounded_fall(linear, values)

    for effect in effects:
        s = problem.simulation.slices[effect]
        strengths = np.arange(s.start, s.stop)[problem.simulation.strength[s]]
        limit = any(p.starts and not p.shape for p in problem.simulation.effects[effect].parameters)
        begins = []
        for own in starts_of(problem, effect):
            values = base.values.copy()
            values[s] = own
            begins.append(Begin(values, np.inf if limit else fall(values, strengths)))
        found[effect] = begins if limit else sorted(begins, key=lambda begin: -begin.fall)[:TRIED]
    return found


def starts_of(problem: Problem, effect: int) -> list[np.ndarray]:
    """The effect's own parameters where a fit of it may start: its nulls, and each other value of one of them."""
    simulation, s = problem.simulation, problem.simulation.slices[effect]
    found = [simulation.null[s]]
    for i, parameter in enumerate(simulation.effects[effect].parameters):
        for value in parameter.starts_for(problem.size[s.start + i]):
            if value != parameter.null:
                found.append(simulation.null[s].copy())
                found[-1][i] = value
    return found
