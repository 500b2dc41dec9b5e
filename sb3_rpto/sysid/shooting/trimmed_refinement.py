"""Fits that are held in a kink or a valley of the cost, led on by short windows and by those that they predict best."""

from __future__ import annotations

import numpy as np

from sb3_rpto.sysid.settings import DEFAULTS, RefinementSettings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem

#: A parameter shows in nothing where its curvature is this share of the largest.
NOTHING = 1e-12


def refine(problem: Problem, fit: Fit, free: np.ndarray, settings: RefinementSettings = DEFAULTS.refinement) -> Fit:
    """Lengthen and concentrate a fit; where it may still err, begin anew beside the best.

    The last is basin hopping (Wales and Doye 1997): for exact data until they are met, and where contacts come and go
    if little seems to be missing. The starts of other measured data are fitted too and round the kinks off, so there it
    ends with the concentration.

    :param problem: windows
    :param fit: to them
    :param free: indices of the parameters that may move, (f,)
    :return: never of a higher cost than ``fit``
    """
    fit, failed, rng = (
        fit_trimmed(problem, fit_lengthening(problem, fit, free, settings), free, settings),
        0,
        np.random.default_rng(0),
    )
    near = problem.touching and np.median(fit.errors) < settings.hop_error
    hops = settings.hops if len(free) and (problem.exact or near) else 0
    while failed < hops and fit.errors.max() > settings.enough:
        hop = 10 ** rng.uniform(*settings.hop_powers) * rng.standard_normal(len(free))
        beside = fit.values.copy()
        beside[free] = np.clip(beside[free] + hop * problem.size[free], problem.lower[free], problem.upper[free])
        trial = fit_trimmed(problem, problem.fit(beside, free, iterations=2 * settings.iterations), free, settings)
        failed = 0 if trial.cost < settings.worth * fit.cost else failed + 1
        fit = min(fit, trial, key=lambda f: f.cost)
    return fit


def fit_lengthening(
    problem: Problem, fit: Fit, free: np.ndarray, settings: RefinementSettings = DEFAULTS.refinement
) -> Fit:
    """Fit the first samples of exact windows, then twice as many, and so on up to whole ones.

    Over a few samples a motion is nearly linear in the parameters, over long windows it may be chaotic: progressive
    horizons (multiple shooting, Bock 1983) reach the optimum from far away. Noise would hide it in so short windows.

    :param problem: windows
    :param fit: to them
    :param free: indices of the parameters that may move, (f,)
    :return: never of a higher cost than ``fit``
    """
    if not (problem.exact and len(free) and fit.errors.max() > settings.enough):
        return fit
    values, samples = fit.values, settings.first_samples
    while samples < problem.windows.usable.shape[1]:
        values = problem.first(samples).fit(values, free, fit.starts, 2 * settings.iterations).values
        samples *= 2
    return min(fit, problem.fit(values, free, fit.starts, settings.iterations), key=lambda f: f.cost)


def fit_trimmed(
    problem: Problem, fit: Fit, free: np.ndarray, settings: RefinementSettings = DEFAULTS.refinement
) -> Fit:
    """Fit the windows that a fit predicts best, then all of them again, and so on while that pays.

    A window in which a contact opens or a joint comes to rest has a kinked error, and many of them hold a descent
    anywhere; a right model predicts all windows, a nearly right one those without such events. They are the
    concentration steps of least trimmed squares (Rousseeuw and Van Driessen 2006), each followed by a fit to all.

    :param problem: windows
    :param fit: to them
    :param free: indices of the parameters that may move, (f,)
    :return: never of a higher cost than ``fit``
    """
    turn, failed = 0, 0
    for _ in range(settings.steps if len(free) else 0):
        if failed == len(settings.shares) or fit.errors.max() <= settings.enough:
            break
        count = max(1, round(settings.shares[turn] * len(fit.errors)))
        nearest = np.sort(np.argsort(fit.errors)[:count])
        some = problem.on(nearest).fit(_shown(problem, fit, free), free, fit.starts[nearest], settings.iterations)
        starts = fit.starts.copy()
        starts[nearest] = some.starts
        trial = problem.fit(some.values, free, starts, settings.iterations)
        if trial.cost < settings.worth * fit.cost:
            failed = 0
        else:
            turn, failed = (turn + 1) % len(settings.shares), failed + 1
        fit = min(fit, trial, key=lambda f: f.cost)
    return fit


def _shown(problem: Problem, fit: Fit, free: np.ndarray) -> np.ndarray:
    """The values of a fit; what shows in no window goes back to its null value, where it may show again.

    Of two geoms in contact, say, only the rougher one's friction shows.
    """
    curvature = np.einsum("wff->f", problem.linear(fit, free).normal)
    hidden = free[curvature <= NOTHING * curvature.max()]
    values = fit.values.copy()
    values[hidden] = problem.null[hidden]
    return values
