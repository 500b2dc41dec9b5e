"""Stops of joints elsewhere than the model's, in a simulator's states: looked for from where the motion ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sb3_rpto.sysid.selection.model_comparison import MISSED, NOTHING, SEVERAL, Evidence, compare
from sb3_rpto.sysid.selection.stepwise_selection import JOINT, REFIT, TENTH, Model, Selection, Selector
from sb3_rpto.sysid.shooting.multiple_shooting import Problem

#: Most of the missed windows that beginnings are compared in.
MOST = 20
#: A soft stop gives way: it may lie so many plausible sizes inside of where the motion ended.
INSIDE = (0.0, 0.2, 0.5, 1.0, 2.0)


def with_stops(selector: Selector, selection: Selection) -> Selection:
    """The same with stops of joints that account for windows of exact data which are missed, where some clearly do.

    A stop inside the model's range shows only where the motion reaches it, and has no derivative where the model's is:
    a search that begins there may never see it. Here fits begin with a stop at an end of what a joint was seen to do.
    What was found before and is not needed beside the stops goes.

    :param selector: on the windows
    :param selection: what was found there
    """
    model = selection.model
    while selector.train.exact and (more := _one_more(selector, model)) is not None:
        model = more
    if model is selection.model:
        return selection
    return _needed(selector, replace(selection, model=model))


def _one_more(selector: Selector, model: Model) -> Model | None:
    """The model with the stop that accounts for most of the windows that it misses; None where none does for some."""
    problem, simulation = selector.train, selector.simulation
    missed = np.flatnonzero(model.fit.errors > MISSED)
    if len(np.unique(problem.windows.block[missed])) < SEVERAL:
        return None
    some = missed[np.linspace(0, len(missed) - 1, min(MOST, len(missed))).round().astype(int)]
    part, starts, tried = problem.on(some), model.fit.starts[some], []
    for e, effect in enumerate(simulation.effects):
        if effect.kind == "end_stop" and not effect.known:
            for stop, begins in _beginnings(problem, model.fit.values, e):
                begin = min(begins, key=lambda values: _typical(part.score(values, starts).errors))
                fit = part.fit(begin, np.array([stop]), starts, REFIT)
                tried.append((_typical(fit.errors), e, fit.values))
    error, e, values = min(tried, key=lambda one: one[0], default=(np.inf, 0, model.fit.values))
    if error > (1 - TENTH) * _typical(model.fit.errors[some]):
        return None
    trial = selector.anew([*{*model.effects, e}], replace(model.fit, values=values, linear=None), JOINT)
    trial = selector.led_on(trial)
    return trial if np.sum(trial.fit.errors > MISSED) < len(missed) else None


def _beginnings(problem: Problem, values: np.ndarray, effect: int) -> Iterator[tuple[int, list[np.ndarray]]]:
    """The index of each of a joint's stops, and the values with it about that end of what the joint was seen to do."""
    w, simulation = problem.windows, problem.simulation
    joint = simulation.effects[effect].index
    for column in np.flatnonzero(w.columns == simulation.model.jnt_qposadr[joint]):
        seen = w.measured[:, :, column][w.usable]
        for side, end in enumerate((seen.min(), seen.max())):
            stop = simulation.slices[effect].start + side
            inwards = np.array(INSIDE) * problem.size[stop] * (1 - 2 * side)
            moved = end + inwards - simulation.model.jnt_range[joint, side]
            yield stop, [np.r_[values[:stop], m, values[stop + 1 :]] for m in moved]


def _needed(selector: Selector, selection: Selection) -> Selection:
    """The same without the effects that are not clearly needed, with the evidence for the others."""
    model, evidence = selection.model, dict[int, Evidence]()
    for e in model.effects:
        without = selector.model([i for i in model.effects if i != e], model.fit)
        evidence[e] = compare(without.errors, model.errors, selector.blocks, rare=True)
        # What meets exact data in every window needs no more blocks to speak for it.
        met = selector.met(model) and not selector.met(without)
        if not met and not evidence[e].clear(*selector.limit(model)):
            dropped = {**selection.dropped, e: (0, evidence[e])}
            return _needed(selector, replace(selection, model=without, dropped=dropped))
    alike = {e: others for e, others in selection.alike.items() if e in model.effects}
    return replace(selection, alike=alike, evidence=evidence)


def _typical(errors: np.ndarray) -> float:
    return float(np.exp(np.log(np.maximum(errors, NOTHING)).mean()))
