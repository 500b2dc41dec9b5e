"""The threshold of selection, from data in which nothing is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sb3_rpto.tracing.evidence import Evidence
from sb3_rpto.tracing.identify import Fit, Problem
from sb3_rpto.tracing.select import Selection, Selector

#: t* is this quantile of the largest t on complete data.
LEVEL = 0.95


def calibrated(selector: Selector, base: Fit, chosen: list[int], sets: int, seed: int) -> float:
    """t*: what the largest t of an effect that is not there stays below in 95 % of complete sets.

    Each set is simulated from the fitted declared model in the windows at hand, with the estimated noise; all chosen
    candidates are fitted to it and then eliminated to the last.

    :param selector: with the windows
    :param base: fit of the declared parameters
    :param chosen: indices of the candidates
    :param sets: number of sets; 20 leave one above the threshold
    :param seed: of the noise
    """
    return float(np.quantile([largest_t(selector, base, chosen, seed + i) for i in range(sets)], LEVEL))


def largest_t(selector: Selector, base: Fit, chosen: list[int], seed: int) -> float:
    """The largest t of any effect on one complete set."""
    rng = np.random.default_rng(seed)
    train = complete(selector.train, base, rng)
    select = None if selector.select is None else complete(selector.select, selector.select.score(base.values), rng)
    return strongest(Selector(train, select, selector.threshold, selector.say, selector.horizon), base, chosen)


def strongest(selector: Selector, base: Fit, chosen: list[int]) -> float:
    """The largest t of any effect, all of them fitted together and eliminated to the last.

    :param selector: with windows in which nothing is missing
    :param base: fit of the declared parameters
    :param chosen: indices of the candidates
    """
    joint, _ = selector.together(chosen, selector.model((), base).fit)
    outcome = selector.eliminate(Selection(joint), np.inf)
    found = [e.t for _, e in outcome.dropped.values() if isinstance(e, Evidence) and e.gain > 0]
    return max(found, default=0.0)


def complete(problem: Problem, fit: Fit, rng: np.random.Generator) -> Problem:
    """The same windows as the model itself would have been measured."""
    w = problem.windows
    values = np.tile(fit.values, (len(w), 1))
    true = problem.predict(values, fit.starts, np.arange(len(w)))
    measured = np.where(np.isfinite(true), true, w.measured) + rng.standard_normal(true.shape) * w.sigma
    return Problem(problem.simulation, replace(w, measured=measured), problem.scales)
