"""The search for what a model lacks: what is declared first, then all candidates, in windows of one length or two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sb3_rpto.effects import Effect, Simulation
from sb3_rpto.fitting.loss import FAR
from sb3_rpto.sysid.problem.problem import IdentificationProblem, Progress, silent
from sb3_rpto.sysid.selection.adequacy import SETTLED, Adequacy, adequacy, count_strays_with, judge
from sb3_rpto.sysid.selection.model_comparison import Evidence, compare
from sb3_rpto.sysid.selection.screening import Screening, screen
from sb3_rpto.sysid.selection.stepwise_selection import Model, Selection, Selector
from sb3_rpto.sysid.selection.substitution import Substitution
from sb3_rpto.sysid.selection.threshold_calibration import calibrate_threshold
from sb3_rpto.sysid.settings import Settings
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS, Fit, Problem
from sb3_rpto.sysid.shooting.trimmed_refinement import fit_trimmed, refine


@dataclass(frozen=True)
class SelectorPair:
    """Selectors on windows of one length.

    :param fine: integrates finely, for what is decided in the end
    :param rough: integrates as the model does, for the elimination: it costs most
    :param say: progress
    """

    fine: Selector
    rough: Selector
    say: Progress = silent

    @classmethod
    def on(cls, problem: IdentificationProblem, horizon: float, settings: Settings | None = None) -> SelectorPair:
        """Selectors for a problem.

        :param problem: what is to be explained
        :param horizon: length of the windows in s
        :param settings: thresholds; default: the problem's
        """

        def select(simulation: Simulation) -> Selector:
            train, judging = problem.windows(simulation, horizon)
            scales = problem.scales
            to_fit = Problem(simulation, train, scales)
            to_judge = None if judging is None else Problem(simulation, judging, scales)
            return Selector(to_fit, to_judge, lambda share, what: say(0.2 + 0.5 * share, what), horizon, thresholds)

        say, thresholds = problem.inputs.say, settings or problem.settings
        fine = select(problem.fine)
        return cls(fine, fine if problem.rough is problem.fine else select(problem.rough), say)

    @property
    def horizon(self) -> float:
        """Length of the windows in s."""
        return self.fine.horizon

    @property
    def settings(self) -> Settings:
        """Thresholds of both."""
        return self.fine.settings

    def change_threshold(self, threshold: float) -> None:
        """Let both select by another t*; what they have fitted stays."""
        selection = replace(self.settings.selection, threshold=threshold)
        self.fine.settings = self.rough.settings = replace(self.settings, selection=selection)


@dataclass(frozen=True)
class SearchResult:
    """The outcome of the search.

    :param on: the windows that it ended with
    :param base: the declared parameters alone
    :param before: its adequacy
    :param screening: of the candidates; None where nothing is missing
    :param selection: what is kept
    :param after: its adequacy
    :param substeps: the recordings are to be read as a simulator's own, of so many steps to one of the model's; None:
        they are not
    :param as_recorded: the result of the search before encoder offsets of single runs were taken off, if they were
    """

    on: SelectorPair
    base: Model
    before: Adequacy
    screening: Screening | None
    selection: Selection
    after: Adequacy
    substeps: int | None = None
    as_recorded: SearchResult | None = None

    @property
    def first(self) -> SearchResult:
        """The result on the data as they were recorded."""
        return self.as_recorded or self

    @property
    def named(self) -> list[Effect]:
        """The effects that are kept."""
        return [self.on.fine.simulation.effects[i] for i in self.selection.model.effects]

    @property
    def verdict(self) -> str:
        """See :func:`~sb3_rpto.sysid.selection.adequacy.judge`; encoder offsets of single runs count as named."""
        named = bool(self.selection.model.effects) or self.as_recorded is not None
        return judge(self.first.before, self.after, named)

    @property
    def explains(self) -> bool:
        """Whether the verdict leaves nothing to look for."""
        return self.verdict in SETTLED

    def without_useless_effects(self) -> SearchResult:
        """The same, without effects that lower no error where nothing is explained: they are no hint either."""
        if self.verdict == "unexplained" and not self.after.ratio < self.first.before.ratio:
            return replace(self, selection=Selection(self.base), after=self.before)
        return self


def search(problem: IdentificationProblem) -> SearchResult:
    """Fit what is declared; where that is not enough, search, and where much is left, go on with longer windows."""
    seed, calibrate = problem.inputs.seed, problem.inputs.calibrate
    on = SelectorPair.on(problem, problem.length)
    on.say(0.05, "fitting the declared parameters")
    base = on.fine.fit_model((), fit_declared(on.rough, seed), iterations=10)
    before = assess(on.fine, base, seed)
    closer = retry_finer_steps(problem, on, base, before)
    if closer[2].adequate:
        return _search_joint_limits(problem, *closer)
    substeps = simulator_substeps(problem, on, base, before)
    if substeps is not None:
        return SearchResult(on, base, before, None, Selection(base), before, substeps)
    on = correct_for_discretisation(on, base.fit.values)
    on.say(0.15, "screening the candidates")
    screening = screen(on.fine.train, nominal_at_bounds(on.fine.train, base.fit), on.settings.screening)
    if calibrate:
        on.say(0.2, f"calibrating on {calibrate} complete sets")
        alone = on.rough.fit_model((), base.fit).fit
        t = calibrate_threshold(on.rough, alone, joint_candidates(on.fine, screening), calibrate, seed)
        on.change_threshold(t)
    selection = select_effects(on, base, screening, seed)
    if problem.longer is not None and on.fine.model_error_dominates(selection.model):
        on.say(0.75, "looking at longer windows")
        then = SelectorPair.on(problem, problem.longer, on.settings)
        more = continue_search(then, selection, screening)
        if more.model.effects:
            on, selection = then, more
            base = on.fine.fit_model((), on.fine.train.score(base.fit.values), iterations=10)
            before = assess(on.fine, base, seed)
    then, selection.model, after = retry_finer_steps(
        problem, on, selection.model, assess(on.fine, selection.model, seed)
    )
    if then is not on:
        on, base = then, then.fine.fit_model((), base.fit, iterations=10)
        before = assess(on.fine, base, seed)
    stopped = add_joint_limits(on.fine, selection)
    if stopped is not selection:
        selection, after = stopped, assess(on.fine, stopped.model, seed)
    substeps = simulator_substeps(problem, on, selection.model, after) if selection.model.effects else None
    return SearchResult(on, base, before, screening, selection, after, substeps)


def resume_search(problem: IdentificationProblem, result: SearchResult) -> SearchResult:
    """Go on from a result on another reading of the same windows, with the same candidates.

    :param problem: the recordings as they are read now
    :param result: of the search on them as they were read before
    """
    seed = problem.inputs.seed
    on = SelectorPair.on(problem, result.on.horizon, result.on.settings)
    base = on.fine.fit_model((), on.fine.train.score(result.base.fit.values), iterations=10)
    screening = screen(on.fine.train, nominal_at_bounds(on.fine.train, base.fit), on.settings.screening)
    selection = continue_search(on, result.selection, screening)
    before, after = (assess(on.fine, model, seed) for model in (base, selection.model))
    return SearchResult(on, base, before, screening, selection, after)


def _search_joint_limits(
    problem: IdentificationProblem, on: SelectorPair, base: Model, before: Adequacy
) -> SearchResult:
    """Where declared parameters alone are adequate, only limits of joints are looked for, which few windows show."""
    selection = add_joint_limits(on.fine, Selection(base))
    if not selection.model.effects:
        substeps = simulator_substeps(problem, on, base, before)
        return SearchResult(on, base, before, None, selection, before, substeps)
    screening = screen(on.fine.train, nominal_at_bounds(on.fine.train, base.fit), on.settings.screening)
    return SearchResult(on, base, before, screening, selection, assess(on.fine, selection.model, problem.inputs.seed))


def simulator_substeps(problem: IdentificationProblem, on: SelectorPair, model: Model, seen: Adequacy) -> int | None:
    """How many of a simulator's steps to one of the model's meet recordings better than the continuous motion does.

    None: no number of them does so clearly. Semi-implicit steps of a millisecond err by more than many a sensor does,
    most after commands that jump.

    :param problem: what is to be explained
    :param on: windows
    :param model: fitted there
    :param seen: its adequacy
    """
    settings = on.fine.thresholds
    if seen.ratio > settings.substeps_limit:
        return None
    better = []
    for substeps in settings.substeps:
        stepwise = problem.in_simulator_steps(substeps)
        if stepwise is None:
            return None
        then = SelectorPair.on(stepwise, on.horizon)
        on.say(0.0, "judging in a simulator's own steps")
        stepped = then.fine.fit_model(model.effects, model.fit, iterations=settings.substeps_iterations)
        saved = -float(np.mean(np.log(stepped.fit.errors / model.fit.errors)))
        explains = not seen.adequate and assess(then.fine, stepped, problem.inputs.seed).adequate
        if explains or saved > -np.log(1 - settings.substeps_gain):
            better.append((explains, saved, substeps))
    return max(better)[2] if better else None


def nominal_at_bounds(problem: Problem, fit: Fit) -> Fit:
    """The fit with nominal values for what ends at an upper bound: a joint that is held still excites nothing."""
    held = problem.known & (fit.values >= problem.upper)
    return problem.score(np.where(held, problem.null, fit.values)) if held.any() else fit


def retry_finer_steps(
    problem: IdentificationProblem, on: SelectorPair, model: Model, seen: Adequacy
) -> tuple[SelectorPair, Model, Adequacy]:
    """Judge a model that does not seem adequate with finer steps, and go on with them where they err less.

    At a kink of the motion, where dry friction sets in or a contact, every method is of first order.

    :param problem: what is to be explained
    :param on: windows
    :param model: fitted there
    :param seen: its adequacy
    """
    if seen.adequate:
        return on, model, seen
    on.say(0.0, "judging with shorter steps in time")
    finer = problem.in_finer_steps()
    if finer is None:
        return on, model, seen
    then = SelectorPair.on(finer, on.horizon, on.settings)
    # Values that make up for the longer steps would err with the shorter ones.
    look = then.fine.fit_model(model.effects, model.fit, iterations=4)
    if not assess(then.fine, look, problem.inputs.seed).ratio < (1 - on.fine.thresholds.finer_gain) * seen.ratio:
        return on, model, seen
    model = then.fine.fit_model(model.effects, look.fit, iterations=10)
    return then, model, assess(then.fine, model, problem.inputs.seed)


def correct_for_discretisation(on: SelectorPair, values: np.ndarray) -> SelectorPair:
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
    rough_selector = Selector(less(old.train, on.fine.train), select, old.say, old.horizon, old.settings)
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
    for _ in range(selector.thresholds.starts - 1):
        start = begin.copy()
        step = rng.uniform(-3, 3, len(free)) * problem.size[free]
        start[free] = np.clip(begin[free] + step, problem.lower[free] + margin, problem.upper[free] - margin)
        other = problem.fit(start, free, iterations=20)
        if other.cost < 0.999 * best.cost:
            best = other
    return refine(problem, best, free, selector.settings.refinement)


def joint_candidates(selector: Selector, screening: Screening) -> list[int]:
    """The excited candidates, one of each class."""
    chosen: list[int] = []
    for i, effect in enumerate(selector.simulation.effects):
        if effect.known or not screening.excited(i):
            continue
        if not any(j in chosen for j in screening.alike(i)):
            chosen.append(i)
    return chosen


def single_candidates(selector: Selector, screening: Screening) -> list[int]:
    """Those worth fitting, and the excited ones that have a shape: with another one they may look like no other."""
    effects = selector.simulation.effects
    chosen = joint_candidates(selector, screening)
    shaped = [i for i, e in enumerate(effects) if any(p.shape for p in e.parameters) and screening.excited(i)]
    return sorted({*chosen, *shaped})


def select_effects(on: SelectorPair, base: Model, screening: Screening, seed: int = 0) -> Selection:
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
    rough, looked_at = on.rough, single_candidates(on.fine, screening)
    alone = rough.fit_model((), base.fit)
    stopped = add_joint_limits(rough, Selection(alone))
    if rough.fits_exactly(stopped.model):
        return stopped
    exact = rough.train.exact
    first = add_single_effects(rough, alone, looked_at, screening) if exact else None
    if first is not None and rough.fits_exactly(first.model):
        return finalise(on, first, screening)
    if exact or (rough.train.touching and rough.model_error_dominates(alone)):
        on.say(0.2, "looking for a few kinds")
        one = select_groups(rough, screening, alone.fit)
        if one is not None:
            selection = finalise(on, Selection(one), screening)
            enough = exact or assess(on.fine, selection.model, seed).adequate
            return selection if enough else continue_search(on, selection, screening)
    if first is None:
        first = add_single_effects(rough, alone, looked_at, screening)
    chosen = sorted({*joint_candidates(on.fine, screening), *first.model.effects})
    if first.model.effects:
        on = correct_for_discretisation(on, first.model.fit.values)
        rough, begin = on.rough, first.model
        alone, first.model = rough.fit_model((), base.fit), rough.fit_model(begin.effects, begin.fit)
    # All together could not be clear.
    if rough.fits_exactly(first.model) or rough.predicted_gain(first.model, chosen) < rough.least_gain:
        return finalise(on, first, screening)
    on.say(0.3, f"fitting {len(chosen)} candidates together")
    begins = [model for model in rough.fit_together(chosen, alone.fit, first.model.fit) if model is not None]
    seems = on.fine.thresholds.seems
    nearer = [m for m in begins if not rough.model_error_dominates(m) or rough.evidence(m, alone).clear(seems)]
    nearer = [m for m in nearer if not rough.evidence(first.model, m).clear(seems)]
    if nearer:  # what seems to matter stays while much else may still be wrong
        selection = rough.add_effects(rough.eliminate(Selection(nearer[0]), seems), looked_at)
    else:
        selection = rough.add_effects(first, looked_at, on.fine.thresholds.rounds_instead, screening.alike)
    return finalise(on, selection, screening)


def add_single_effects(selector: Selector, alone: Model, candidates: Sequence[int], screening: Screening) -> Selection:
    """The single effects that are clear one after the other, beside the declared parameters ``alone``."""
    selector.say(0.0, "looking for single effects")
    found = selector.add_effects(Selection(alone), candidates, alike=screening.alike)
    if selector.nearly_fits_exactly(found.model):
        found.model = selector.refine(found.model)
    return found


def continue_search(on: SelectorPair, found: Selection, screening: Screening) -> Selection:
    """Go on from what was found with other windows: what is missing is added, what is not needed goes."""
    on = correct_for_discretisation(on, found.model.fit.values)
    rough = on.rough
    begin = rough.fit_model(found.model.effects, rough.train.score(found.model.fit.values), iterations=10)
    selection = rough.add_effects(Selection(begin, dropped=dict(found.dropped)), single_candidates(on.fine, screening))
    return finalise(on, selection, screening)


def finalise(on: SelectorPair, selection: Selection, screening: Screening) -> Selection:
    """Elimination to what is clearly needed, substitution by like effects, and the evidence for what remains."""
    on = correct_for_discretisation(on, selection.model.fit.values)
    selector, rough = on.fine, on.rough
    selection.model = rough.fit_model(selection.model.effects, selection.model.fit)
    selection = rough.eliminate(selection)
    on.say(0.7, "trying like effects in their place")
    substitution = Substitution(rough, screening)
    selection = substitution.merge(substitution.substitute(selection))
    selection.model = selector.refine(selector.fit_model(selection.model.effects, selection.model.fit, iterations=10))
    if selector.train.exact:  # only now are the fits good enough to tell
        substitution = Substitution(selector, screening)
        selection.model = substitution.make_uniform(selection.model, selection)
        selection.model = substitution.prefer_simplest(selection.model, selection)
    selection = Substitution(selector, screening).find_alike_everywhere(selection)
    return prefer_fewest(selector, selector.judge(selection), single_candidates(selector, screening))


def prefer_fewest(selector: Selector, selection: Selection, candidates: Sequence[int]) -> Selection:
    """Of several sets of effects that meet exact data, the one with fewer effects and parameters.

    What two or three effects meet, one may meet in their place, or in the place of all but one of them.
    """
    model = selection.model
    if not selector.fits_exactly(model) or not 1 < len(model.effects) <= selector.thresholds.several:
        return selection
    keeping: list[list[int]] = [[], *([e] for e in model.effects if len(model.effects) > 2)]
    for rest in keeping:
        fewer = selector.replace_by_one(model, rest, candidates)
        if fewer is not None:
            return selector.judge(Selection(fewer, dropped=dict(selection.dropped)))
    return selection


def assess(selector: Selector, model: Model, seed: int) -> Adequacy:
    """How a model's errors compare with those of the noise alone, on the windows to judge.

    What a robust fit gives up of the windows that it was made to counts, too: the runs to judge on may be few, or move
    as none of the others did. Where they show enough by themselves, one odd run among those fitted is only told.
    """
    settings, values = selector.settings, model.fit.values
    seen = adequacy(selector.judging, selector.judging.score(values, iterations=START_STEPS), seed, settings.adequacy)
    if selector.select is None:
        return seen
    count, train = len(selector.select.windows), selector.train
    fitted = adequacy(train, train.score(values, iterations=START_STEPS), seed, settings.adequacy)
    few = count < settings.selection.few_windows
    return count_strays_with(seen, count, fitted, len(train.windows)) if few or fitted.spread else seen


# --- a few kinds, each at all its places ------------------------------------------------------------------------------


def select_groups(selector: Selector, screening: Screening, base: Fit) -> Model | None:
    """The kinds that account for the data, if so few do: the simplest of the nearest that meets exact data.

    Each is looked at alone; of exact data the simplest of the nearest is kept and looked at with each other one, and
    so on. Beside it others may show that did not before: longer legs, say, slip.

    :param selector: of the windows
    :param screening: of the candidates, beside the declared parameters alone
    :param base: those
    """
    train, effects = selector.train, selector.simulation.effects
    settings, chosen, fit = selector.thresholds, list[int](), base
    for turn in range(settings.kinds_together if train.exact else 1):
        screening = screen(train, fit, selector.settings.screening) if turn else screening
        shown = [i for i, e in enumerate(effects) if not e.known and screening.excited(i) and i not in chosen]
        fits = []
        for (kind, _), places in selector.group_by_kind(shown, apart=True).items():
            selector.say(0.0, f"{kind} at all places")
            together = [*chosen, *places]
            free = selector.free(together)
            fits.append((together, train.fit(fit.values, free, fit.starts, settings.joint_iterations)))
        nearest = sorted(fits, key=lambda found: found[1].cost)[: settings.kinds_refined]
        led = []
        for together, begun in sorted(nearest, key=lambda found: len(selector.free(found[0]))):
            begun = fit_trimmed(train, begun, selector.free(together), selector.settings.refinement)
            # Else kinks are not all that it lacks.
            if np.median(begun.errors) < max(FAR, settings.gain_far * np.median(base.errors)):
                model = selector.refine(selector.fit_model(together, begun))
                if selector.fits_exactly(model) if train.exact else not selector.model_error_dominates(model):
                    return model
            led.append((together, begun))
        lowest = min([begun.cost for _, begun in led], default=np.inf)
        if not lowest < settings.kinds_further * fit.cost:
            return None
        # What has many parameters takes up much of whatever is missing.
        near = [found for found in led if found[1].cost < min(settings.kinds_alike * lowest, fit.cost)]
        chosen, fit = min(near, key=lambda found: len(selector.free(found[0])))
    return None


# --- limits of joints -------------------------------------------------------------------------------------------------


def add_joint_limits(selector: Selector, selection: Selection) -> Selection:
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
    problem, simulation, settings = selector.train, selector.simulation, selector.thresholds
    limit = selector.settings.comparison.missed
    missed = np.flatnonzero(model.fit.errors > limit)
    if len(np.unique(problem.windows.block[missed])) < selector.settings.comparison.rare_blocks:
        return None

    def typical(errors: np.ndarray) -> float:
        return float(np.exp(np.log(np.maximum(errors, selector.settings.comparison.error_floor)).mean()))

    some = missed[np.linspace(0, len(missed) - 1, min(settings.limit_windows, len(missed))).round().astype(int)]
    part, starts, tried = problem.on(some), model.fit.starts[some], []
    for e, effect in enumerate(simulation.effects):
        if effect.kind == "end_stop" and not effect.known:
            for stop, begins in _beginnings(problem, model.fit.values, e, settings.limit_inside):
                begin = min(begins, key=lambda values: typical(part.score(values, starts).errors))
                fit = part.fit(begin, np.array([stop]), starts, settings.refit_iterations)
                tried.append((typical(fit.errors), e, fit.values))
    error, e, values = min(tried, key=lambda one: one[0], default=(np.inf, 0, model.fit.values))
    if error > (1 - settings.gain_far) * typical(model.fit.errors[some]):
        return None
    there = replace(model.fit, values=values, linear=None)
    trial = selector.refine(selector.fit_model_from([*{*model.effects, e}], there, settings.joint_iterations))
    return trial if np.sum(trial.fit.errors > limit) < len(missed) else None


def _beginnings(
    problem: Problem, values: np.ndarray, effect: int, inside: Sequence[float]
) -> Iterator[tuple[int, list[np.ndarray]]]:
    """The index of each of a joint's stops, and the values with it about that end of what the joint was seen to do."""
    w, simulation = problem.windows, problem.simulation
    joint = simulation.effects[effect].index
    for column in np.flatnonzero(w.columns == simulation.model.jnt_qposadr[joint]):
        seen = w.measured[:, :, column][w.usable]
        for side, end in enumerate((seen.min(), seen.max())):
            stop = simulation.slices[effect].start + side
            inwards = np.array(inside) * problem.size[stop] * (1 - 2 * side)
            moved = end + inwards - simulation.model.jnt_range[joint, side]
            yield stop, [np.r_[values[:stop], m, values[stop + 1 :]] for m in moved]


def _needed(selector: Selector, selection: Selection) -> Selection:
    """The same without the effects that are not clearly needed, with the evidence for the others."""
    model, evidence = selection.model, dict[int, Evidence]()
    for e in model.effects:
        without = selector.fit_model([i for i in model.effects if i != e], model.fit)
        evidence[e] = compare(without.errors, model.errors, selector.blocks, True, selector.settings.comparison)
        # What meets exact data in every window needs no more blocks to speak for it.
        met = selector.fits_exactly(model) and not selector.fits_exactly(without)
        if not met and not evidence[e].clear(*selector.limit(model)):
            dropped = {**selection.dropped, e: (0, evidence[e])}
            return _needed(selector, replace(selection, model=without, dropped=dropped))
    alike = {e: others for e, others in selection.alike.items() if e in model.effects}
    return replace(selection, alike=alike, evidence=evidence)
