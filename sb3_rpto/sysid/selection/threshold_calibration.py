"""The threshold of selection, from data in which nothing is missing."""

from __future__ import annotations

import numpy as np

from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.shooting.multiple_shooting import Fit


def calibrate_threshold(selector: Selector, base: Fit, chosen: list[int], sets: int, seed: int) -> float:
    """t*: the threshold that names no effect in 95 % of complete sets, at least that of a single test.

    Each set is simulated from the fitted declared model in the windows at hand, with the noise of the data; all chosen
    candidates are fitted to it and then eliminated to the last.

    :param selector: with the windows
    :param base: fit of the declared parameters
    :param chosen: indices of the candidates
    :param sets: number of sets; 20 leave one above the threshold
    :param seed: of the noise
    """
    thresholds = [threshold_of_set(selector, base, chosen, seed + i) for i in range(sets)]
    settings = selector.thresholds
    return max(settings.threshold_far, float(np.quantile(thresholds, settings.calibration_level)))


def threshold_of_set(selector: Selector, base: Fit, chosen: list[int], seed: int) -> float:
    """The least threshold that names nothing on one complete set, see :func:`least_threshold`."""
    rng = np.random.default_rng(seed)
    train = selector.train.redrawn(base, rng)
    select = None if selector.select is None else selector.select.redrawn(selector.select.score(base.values), rng)
    return least_threshold(Selector(train, select, selector.say, selector.horizon, selector.settings), base, chosen)


def least_threshold(selector: Selector, base: Fit, chosen: list[int]) -> float:
    """The least threshold with which the elimination, begun with all effects together, leaves none of them.

    Where it is stuck, the threshold rises to the least t of what it tried to drop.

    :param selector: with windows in which nothing is missing
    :param base: fit of the declared parameters
    :param chosen: indices of the candidates
    """
    alone = selector.fit_model((), base).fit
    joint, _ = selector.fit_together(chosen, alone, alone)
    outcome, level = selector.eliminate(Selection(joint), 0.0), 0.0
    while outcome.model.effects:
        current = outcome.model
        rests = [
            [i for i in current.effects if i != e]
            for e in selector.removal_costs(current)[0][: selector.settings.selection.dropped]
        ]
        level = min(selector.evidence(current, selector.fit_model(rest, current.fit)).t for rest in rests)
        outcome = selector.eliminate(outcome, level)
    return level
