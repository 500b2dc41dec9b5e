"""The fit that is reported, and how far it may be off, from how the blocks of the recordings scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_rpto.fitting.covariance import correlations, half_widths, regularised_inverse
from sb3_rpto.fitting.identifiability import confounded_parameters, null_directions, parameters_to_fix
from sb3_rpto.fitting.loss import Loss
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.settings import DEFAULTS, SelectionSettings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.trimmed_refinement import NOTHING


@dataclass(frozen=True)
class FinalFit:
    """The models that are reported, fitted to all windows.

    :param problem: all windows
    :param declared: parameters of the declared model, (p,)
    :param values: of the corrected model, (p,)
    :param intervals: bounds of their 95 % intervals, (2, p), see :func:`fit_with_intervals`
    :param correlation: of the parameters, (p, p)
    :param named: indices of the effects that the declared model lacked
    :param free: indices of the parameters that were fitted
    :param horizon: length of the windows in s
    """

    problem: Problem
    declared: np.ndarray
    values: np.ndarray
    intervals: np.ndarray
    correlation: np.ndarray
    named: tuple[int, ...]
    free: np.ndarray
    horizon: float


def refit(problem: IdentificationProblem, result: SearchResult) -> FinalFit:
    """Fit the declared and the corrected model to all windows, train and select together."""
    problem.inputs.say(0.85, "fitting the final model")
    selector, named = result.on.fine, result.selection.model.effects
    windows = selector.all_windows()
    settings = problem.settings.selection
    values, intervals, correlation = fit_with_intervals(result.selection, windows, settings)
    # Both models are fitted to all these data before they are compared on the test runs, the declared one as recorded.
    recorded = windows if result.as_recorded is None else result.first.on.fine.all_windows()
    begin, iterations = result.first.base.fit.values, settings.final_iterations
    declared = recorded.fit(begin, selector.free(()), iterations=iterations, crude=0.0).values
    free = selector.free(named)
    return FinalFit(windows, declared, values, intervals, correlation, named, free, selector.horizon)


def fit_with_intervals(
    selection: Selection, problem: Problem, settings: SelectionSettings = DEFAULTS.selection
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit on train and select together.

    Of what was given and only shows together, the last one stays what it was.

    :return: all parameters (p,); the bounds of their 95 % intervals (2, p), NaN where nothing was fitted, where only
        several together are told, and where nothing shows in any window, which is what it was; their correlations
        (p, p), by the curvature: blocks are too few to tell them
    """
    joined = problem.windows
    free = Selector(problem, problem).free(selection.model.effects)
    fit = problem.fit(selection.model.fit.values, free, iterations=settings.final_iterations, crude=0.0)
    alike, held = not_told_apart(problem, fit, free)
    if len(held):
        begin = fit.values.copy()
        begin[held] = problem.null[held]
        free = np.setdiff1d(free, held)
        fit = problem.fit(begin, free, iterations=settings.final_iterations, crude=0.0)
    values, intervals = fit.values.copy(), np.full((2, len(fit.values)), np.nan)
    correlation = np.eye(len(values))
    if len(free):
        linear = problem.linear(fit, free)
        curvature = np.einsum("wff->f", linear.normal)
        hidden = free[curvature <= NOTHING * curvature.max()]
        values[hidden] = problem.null[hidden]
        r = problem.residuals(np.tile(fit.values, (len(joined), 1)), fit.starts, np.arange(len(joined)))
        r = r[np.repeat(joined.usable, joined.measured.shape[2], axis=1)]
        widths = half_widths(linear.normal, linear.gradient, joined.block, settings.interval_blocks)
        half = widths * problem.size[free] / Loss.of(r).curvature(r)
        intervals[:, free] = fit.values[free] + np.array([-1, 1])[:, None] * half
        intervals = np.clip(intervals, problem.lower, problem.upper)
        intervals[:, hidden] = intervals[:, alike] = np.nan
        correlation[np.ix_(free, free)] = correlations(regularised_inverse(linear.normal.sum(0)))
    return values, intervals, correlation


def not_told_apart(problem: Problem, fit: Fit, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free parameters that only move the predictions together with others, such as a motor's gear and its gain.

    :param fit: of all windows
    :param free: indices, (f,)
    :return: indices of them, those that are effects to be found included; and of one that was given for each direction
        in which nothing moves: with these held the others are determined
    """
    given = problem.known[free]
    if given.sum() < 2:
        return free[:0], free[:0]
    # One-sided differences of products such as gear x gain would leave a trace of the direction.
    (r, up, jx), (_, down, _) = (problem.linearise(fit.values, fit.starts, free, down=d) for d in (False, True))
    normal = problem.reduce(r, (up + down) / 2, jx, fit.starts, Loss.of(r)).normal.sum(0)
    order = np.argsort(given, kind="stable")  # the last is held: something that was given, where there is one
    size = np.diag(normal)[order]
    directions = null_directions(normal[np.ix_(order, order)], size > NOTHING * size.max())
    held = parameters_to_fix(directions) & given[order]
    return free[order[confounded_parameters(directions)]], free[order[held]]
