"""The search for what a model lacks: what is declared first, then all candidates, in windows of one length or two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sb3_rpto.sysid.selection.adequacy import Adequacy, adequacy, counted_with
from sb3_rpto.sysid.selection.group_selection import few_kinds
from sb3_rpto.sysid.selection.joint_limits import with_stops
from sb3_rpto.sysid.selection.model_comparison import GAIN
from sb3_rpto.sysid.selection.screening import Screening, screen
from sb3_rpto.sysid.selection.stepwise_selection import INSTEAD, SEEMS, Model, Selection, Selector
from sb3_rpto.sysid.selection.substitution import Likes
from sb3_rpto.sysid.selection.threshold_calibration import calibrated
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS, Fit, Problem
from sb3_rpto.sysid.shooting.trimmed_refinement import led_on

#: Declared parameters are fitted from so many starts.
STARTS = 3
#: Fewer windows than these hardly show that one stretch of motion is not accounted for.
FEW = 10
#: So many effects that meet exact data may be in the place of fewer.
SEVERAL = 3
#: Finer steps in time are taken where they lower R by this share: then the steps, not the model, make it.
FINER = 0.03
#: A simulator's steps, so many to one of the model's, are tried where R is no more than the limit, with so few
#: iterations of the fit; they are taken where they lower the windows' errors by this share.
SUBSTEPS, SUBSTEPS_LIMIT, SUBSTEPS_FIT, SUBSTEPS_GAIN = (1, 2, 4), 3.0, 5, 0.05


@dataclass(frozen=True)
class Selectors:
    """Selectors on windows of one length.

    :param fine: integrates finely, for what is decided in the end
    :param rough: integrates as the model does, for the elimination: it costs most
    :param say: progress
    """

    fine: Selector
    rough: Selector
    say: Callable[[float, str], None]


@dataclass(frozen=True)
class Found:
    """The outcome of the search.

    :param on: the windows that it ended with
    :param base: the declared parameters alone
    :param before: its adequacy
    :param screening: of the candidates; None where nothing is missing
    :param selection: what is kept
    :param after: its adequacy
    :param substeps: the recordings are to be read as a simulator's own, of so many steps to one of the model's; None:
        they are not
    """

    on: Selectors
    base: Model
    before: Adequacy
    screening: Screening | None
    selection: Selection
    after: Adequacy
    substeps: int | None = None


def find(
    selectors: Callable[[float], Selectors],
    finer: Callable[[float], Selectors | None],
    in_substeps: Callable[[int, float], Selectors | None],
    length: float,
    longer: float | None,
    seed: int,
    calibrate: int,
) -> Found:
    """Fit what is declared; where that is not enough, search, and where much is left, go on with longer windows.

    :param selectors: on windows of a length in s
    :param finer: the same with finer steps in time; None where there are none to take
    :param in_substeps: the same with so many of a simulator's steps to one of the model's; None: they are such already
    :param length: of the windows
    :param longer: of the windows to go on with; None: there are none
    :param seed: of the starts and the resampling
    :param calibrate: see :func:`sb3_rpto.sysid.trace.trace`
    """
    on = selectors(length)
    on.say(0.05, "fitting the declared parameters")
    base = on.fine.model((), fit_declared(on.rough, seed), iterations=10)
    before = judged(on.fine, base, seed)
    closer = closely(on, base, before, finer, seed)
    if closer[2].adequate:
        on, base, before = closer
        selection = with_stops(on.fine, Selection(base))
        if not selection.model.effects:
            substeps = simulator_substeps(on, base, before, in_substeps, seed)
            return Found(on, base, before, None, selection, before, substeps)
        screening = screen(on.fine.train, within_bounds(on.fine.train, base.fit))
        return Found(on, base, before, screening, selection, judged(on.fine, selection.model, seed))
    substeps = simulator_substeps(on, base, before, in_substeps, seed)
    if substeps is not None:
        return Found(on, base, before, None, Selection(base), before, substeps)
    on = aligned(on, base.fit.values)
    on.say(0.15, "screening the candidates")
    screening = screen(on.fine.train, within_bounds(on.fine.train, base.fit))
    if calibrate:
        on.say(0.2, f"calibrating on {calibrate} complete sets")
        t = calibrated(on.rough, on.rough.model((), base.fit).fit, worth_fitting(on.fine, screening), calibrate, seed)
        on.fine.threshold = on.rough.threshold = t
    selection = search(on, base, screening, seed)
    if longer is not None and on.fine.far(selection.model):
        on.say(0.75, "looking at longer windows")
        then = selectors(longer)
        then.fine.threshold = then.rough.threshold = on.fine.threshold
        more = go_on(then, selection, screening)
        if more.model.effects:
            on, selection = then, more
            base = on.fine.model((), on.fine.train.score(base.fit.values), iterations=10)
            before = judged(on.fine, base, seed)
    then, selection.model, after = closely(on, selection.model, judged(on.fine, selection.model, seed), finer, seed)
    if then is not on:
        on, base = then, then.fine.model((), base.fit, iterations=10)
        before = judged(on.fine, base, seed)
    stopped = with_stops(on.fine, selection)
    if stopped is not selection:
        selection, after = stopped, judged(on.fine, stopped.model, seed)
    substeps = simulator_substeps(on, selection.model, after, in_substeps, seed) if selection.model.effects else None
    return Found(on, base, before, screening, selection, after, substeps)


def simulator_substeps(
    on: Selectors, model: Model, seen: Adequacy, in_substeps: Callable[[int, float], Selectors | None], seed: int
) -> int | None:
    """How many of a simulator's steps to one of the model's meet recordings better than the continuous motion does.

    None: no number of them does so clearly. Semi-implicit steps of a millisecond err by more than many a sensor does,
    most after commands that jump.

    :param on: windows
    :param model: fitted there
    :param seen: its adequacy
    :param in_substeps: as in :func:`find`
    :param seed: of the resampling
    """
    if seen.ratio > SUBSTEPS_LIMIT:
        return None
    better = []
    for substeps in SUBSTEPS:
        then = in_substeps(substeps, on.fine.horizon)
        if then is None:
            return None
        on.say(0.0, "judging in a simulator's own steps")
        stepped = then.fine.model(model.effects, model.fit, iterations=SUBSTEPS_FIT)
        saved = -float(np.mean(np.log(stepped.fit.errors / model.fit.errors)))
        explains = not seen.adequate and judged(then.fine, stepped, seed).adequate
        if explains or saved > -np.log(1 - SUBSTEPS_GAIN):
            better.append((explains, saved, substeps))
    return max(better)[2] if better else None


def within_bounds(problem: Problem, fit: Fit) -> Fit:
    """The fit with nominal values for what ends at an upper bound: a joint that is held still excites nothing."""
    held = problem.known & (fit.values >= problem.upper)
    return problem.score(np.where(held, problem.null, fit.values)) if held.any() else fit


def closely(
    on: Selectors, model: Model, seen: Adequacy, finer: Callable[[float], Selectors | None], seed: int
) -> tuple[Selectors, Model, Adequacy]:
    """Judge a model that does not seem adequate with finer steps, and go on with them where they err less.

    At a kink of the motion, where dry friction sets in or a contact, every method is of first order.

    :param on: windows
    :param model: fitted there
    :param seen: its adequacy
    :param finer: as in :func:`find`
    :param seed: of the resampling
    """
    if seen.adequate:
        return on, model, seen
    on.say(0.0, "judging with shorter steps in time")
    then = finer(on.fine.horizon)
    if then is None:
        return on, model, seen
    # Values that make up for the longer steps would err with the shorter ones.
    look = then.fine.model(model.effects, model.fit, iterations=4)
    if not judged(then.fine, look, seed).ratio < (1 - FINER) * seen.ratio:
        return on, model, seen
    then.fine.threshold = then.rough.threshold = on.fine.threshold
    model = then.fine.model(model.effects, look.fit, iterations=10)
    return then, model, judged(then.fine, model, seed)


def aligned(on: Selectors, values: np.ndarray) -> Selectors:
    """The same with the recordings of the rough selector less what its steps in time err by.

    Long semi-implicit steps err by about a milliradian in half a second, as much as noise, and effects would be found
    to make up for it. The error hardly depends on the parameters, so one set of them tells it.

    :param on: windows
    :param values: parameters near the best ones, (p,)
    """
    fine, rough = (s.simulation.model.opt for s in (on.fine, on.rough))
    if (fine.timestep, fine.integrator) == (rough.timestep, rough.integrator):
        return on

    def less(problem: Problem, exact: Problem) -> Problem:
        count, starts = np.arange(len(exact.windows)), exact.score(values).starts
        rows = np.tile(values, (len(count), 1))
        error = problem.predict(rows, starts, count) - exact.predict(rows, starts, count)
        measured = exact.windows.measured + np.nan_to_num(error)
        return Problem(problem.simulation, replace(problem.windows, measured=measured), problem.scales)

    old, select = on.rough, None
    if old.select is not None and on.fine.select is not None:
        select = less(old.select, on.fine.select)
    rough_selector = Selector(less(old.train, on.fine.train), select, old.threshold, old.say, old.horizon)
    return replace(on, rough=rough_selector)


def fit_declared(selector: Selector, seed: int) -> Fit:
    """Fit the declared parameters from several starts, none at a bound, and lead the best one on."""
    problem, free = selector.train, selector.free(())
    begin = problem.simulation.null.copy()
    margin = np.minimum(0.5 * problem.size[free], 0.25 * (problem.upper - problem.lower)[free])
    begin[free] = np.clip(begin[free], problem.lower[free] + margin, problem.upper[free] - margin)
    best = problem.fit(begin, free, iterations=20)
    if not len(free):
        return best
    rng = np.random.default_rng(seed)
    for _ in range(STARTS - 1):
        start = begin.copy()
        step = rng.uniform(-3, 3, len(free)) * problem.size[free]
        start[free] = np.clip(begin[free] + step, problem.lower[free] + margin, problem.upper[free] - margin)
        other = problem.fit(start, free, iterations=20)
        if other.cost < 0.999 * best.cost:
            best = other
    return led_on(problem, best, free)


def worth_fitting(selector: Selector, screening: Screening) -> list[int]:
    """The excited candidates, one of each class."""
    chosen: list[int] = []
    for i, effect in enumerate(selector.simulation.effects):
        if effect.known or not screening.excited(i):
            continue
        if not any(j in chosen for j in screening.alike(i)):
            chosen.append(i)
    return chosen


def worth_a_look(selector: Selector, screening: Screening) -> list[int]:
    """Those worth fitting, and the excited ones that have a shape: with another one they may look like no other."""
    effects = selector.simulation.effects
    chosen = worth_fitting(selector, screening)
    shaped = [i for i, e in enumerate(effects) if any(p.shape for p in e.parameters) and screening.excited(i)]
    return sorted({*chosen, *shaped})


def search(on: Selectors, base: Model, screening: Screening, seed: int = 0) -> Selection:
    """Looks for single effects and for few kinds, joint fit of all candidates, elimination, substitution by like ones.

    The joint fit begins where the single effects that are clear have led, if it promises more than a trifle there.
    Where stops of joints, single effects or a few kinds meet exact data, nothing else is needed. One kind is looked
    for in measured data too, where contacts hold larger fits in kinks and the declared parameters alone are far from
    the noise.

    Where the joint fit ends far from the noise and no nearer than the declared parameters alone, or worse than those,
    the best few kinds at all their places take its place, and where they do no better either, effects are added one by
    one.

    :param on: windows
    :param base: the declared parameters alone
    :param screening: of the candidates
    :param seed: of the resampling
    """
    rough, looked_at = on.rough, worth_a_look(on.fine, screening)
    alone = rough.model((), base.fit)
    stopped = with_stops(rough, Selection(alone))
    if rough.met(stopped.model):
        return stopped
    exact = rough.train.exact
    first = one_by_one(rough, alone, looked_at, screening) if exact else None
    if first is not None and rough.met(first.model):
        return settle(on, first, screening)
    if exact or (rough.train.touching and rough.far(alone)):
        on.say(0.2, "looking for a few kinds")
        one = few_kinds(rough, screening, alone.fit)
        if one is not None:
            selection = settle(on, Selection(one), screening)
            enough = exact or judged(on.fine, selection.model, seed).adequate
            return selection if enough else go_on(on, selection, screening)
    if first is None:
        first = one_by_one(rough, alone, looked_at, screening)
    chosen = sorted({*worth_fitting(on.fine, screening), *first.model.effects})
    if first.model.effects:
        on = aligned(on, first.model.fit.values)
        rough, begin = on.rough, first.model
        alone, first.model = rough.model((), base.fit), rough.model(begin.effects, begin.fit)
    if rough.met(first.model) or rough.promise(first.model, chosen) < GAIN:  # all together could not be clear
        return settle(on, first, screening)
    on.say(0.3, f"fitting {len(chosen)} candidates together")
    begins = [model for model in rough.together(chosen, alone.fit, first.model.fit) if model is not None]
    nearer = [m for m in begins if not rough.far(m) or rough.evidence(m, alone).clear(SEEMS)]
    nearer = [m for m in nearer if not rough.evidence(first.model, m).clear(SEEMS)]
    if nearer:  # what seems to matter stays while much else may still be wrong
        selection = rough.look_forward(rough.eliminate(Selection(nearer[0]), SEEMS), looked_at)
    else:
        selection = rough.look_forward(first, looked_at, INSTEAD, screening.alike)
    return settle(on, selection, screening)


def one_by_one(selector: Selector, alone: Model, candidates: Sequence[int], screening: Screening) -> Selection:
    """The single effects that are clear one after the other, beside the declared parameters ``alone``."""
    selector.say(0.0, "looking for single effects")
    found = selector.look_forward(Selection(alone), candidates, alike=screening.alike)
    if selector.nearly_met(found.model):
        found.model = selector.led_on(found.model)
    return found


def go_on(on: Selectors, found: Selection, screening: Screening) -> Selection:
    """Go on from what was found with other windows: what is missing is added, what is not needed goes."""
    on = aligned(on, found.model.fit.values)
    rough = on.rough
    begin = rough.model(found.model.effects, rough.train.score(found.model.fit.values), iterations=10)
    selection = rough.look_forward(Selection(begin, dropped=dict(found.dropped)), worth_a_look(on.fine, screening))
    return settle(on, selection, screening)


def settle(on: Selectors, selection: Selection, screening: Screening) -> Selection:
    """Elimination to what is clearly needed, substitution by like effects, and the evidence for what remains."""
    on = aligned(on, selection.model.fit.values)
    selector, rough = on.fine, on.rough
    selection.model = rough.model(selection.model.effects, selection.model.fit)
    selection = rough.eliminate(selection)
    on.say(0.7, "trying like effects in their place")
    likes = Likes(rough, screening)
    selection = likes.merge(likes.substitute(selection))
    selection.model = selector.led_on(selector.model(selection.model.effects, selection.model.fit, iterations=10))
    if selector.train.exact:  # only now are the fits good enough to tell
        likes = Likes(selector, screening)
        selection.model = likes.uniform(selection.model, selection)
        selection.model = likes.simplest(selection.model, selection)
    selection = Likes(selector, screening).in_all_places(selection)
    return fewest(selector, selector.judge(selection), worth_a_look(selector, screening))


def fewest(selector: Selector, selection: Selection, candidates: Sequence[int]) -> Selection:
    """Of several sets of effects that meet exact data, the one with fewer effects and parameters.

    What two or three effects meet, one may meet in their place, or in the place of all but one of them.
    """
    model = selection.model
    if not selector.met(model) or not 1 < len(model.effects) <= SEVERAL:
        return selection
    keeping: list[list[int]] = [[], *([e] for e in model.effects if len(model.effects) > 2)]
    for rest in keeping:
        fewer = selector.in_place_of(model, rest, candidates)
        if fewer is not None:
            return selector.judge(Selection(fewer, dropped=dict(selection.dropped)))
    return selection


def judged(selector: Selector, model: Model, seed: int) -> Adequacy:
    """How a model's errors compare with those of the noise alone, on the windows to judge.

    What a robust fit gives up of the windows that it was made to counts, too: the runs to judge on may be few, or move
    as none of the others did. Where they show enough by themselves, one odd run among those fitted is only told.
    """
    seen = adequacy(selector.judging, selector.judging.score(model.fit.values, iterations=START_STEPS), seed)
    if selector.select is None:
        return seen
    count, train = len(selector.select.windows), selector.train
    fitted = adequacy(train, train.score(model.fit.values, iterations=START_STEPS), seed)
    return counted_with(seen, count, fitted, len(train.windows)) if count < FEW or fitted.spread else seen
