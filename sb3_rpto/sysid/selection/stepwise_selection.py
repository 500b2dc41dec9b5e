"""Which effects are needed: a joint fit of all candidates, and elimination backwards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from sb3_rpto.fitting.loss import FAR, Loss
from sb3_rpto.sysid.problem.problem import Progress, silent
from sb3_rpto.sysid.selection.model_comparison import Evidence, compare, folds, several_missed, unseen_errors
from sb3_rpto.sysid.settings import DEFAULTS, SelectionSettings, Settings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Linear, Problem
from sb3_rpto.sysid.shooting.trimmed_refinement import refine
from sb3_rpto.sysid.shooting.windows import join


@dataclass(frozen=True)
class Model:
    """A set of effects with its fit and its errors on the select windows.

    :param effects: indices in the simulation, declared ones not among them
    """

    effects: tuple[int, ...]
    fit: Fit
    errors: np.ndarray


@dataclass
class Selection:
    """The outcome of the elimination.

    :param model: what is kept
    :param evidence: for each kept effect, by index
    :param alike: effects that could stand for a kept one, by index
    :param dropped: the step, and the gain and t of what was dropped in it, by index
    """

    model: Model
    evidence: dict[int, Evidence] = field(default_factory=dict)
    alike: dict[int, list[int]] = field(default_factory=dict)
    dropped: dict[int, tuple[int, Evidence]] = field(default_factory=dict)


class Selector:
    """Fits models to training windows and compares them on windows that they were not fitted to.

    Those are the select windows, and the training windows by cross-validation: they are parted into folds of blocks,
    each judged by a fit to the others.

    :param train: windows to fit
    :param select: windows of runs set apart; None where there are none
    :param say: progress: the share of the search that is done, and what is being done
    :param horizon: length of the windows in s, for the gap between folds
    :param settings: thresholds
    """

    def __init__(
        self,
        train: Problem,
        select: Problem | None = None,
        say: Progress = silent,
        horizon: float = 0.0,
        settings: Settings = DEFAULTS,
    ) -> None:
        self.train, self.select, self.say, self.horizon, self.settings = train, select, say, horizon, settings
        self.folds = folds(train.windows, horizon, settings.comparison.folds)
        self.blocks = np.concatenate([train.windows.block[b] for _, b in self.folds])
        if select:
            self.blocks = np.concatenate([self.blocks, select.windows.block + self.blocks.max() + 1])
        self.simulation = train.simulation
        self._memory: dict[tuple[int, ...], Model] = {}

    @property
    def thresholds(self) -> SelectionSettings:
        """Those of the selection."""
        return self.settings.selection

    @property
    def judging(self) -> Problem:
        """Where adequacy is judged: the select windows, or all where there are none."""
        return self.select or self.train

    def all_windows(self) -> Problem:
        """All windows together, those to fit first."""
        if self.select is None:
            return self.train
        return Problem(self.simulation, join(self.train.windows, self.select.windows), self.train.scales)

    def free(self, effects: Sequence[int]) -> np.ndarray:
        """Indices of the parameters of what is known and of the given effects.

        Of effects that are known the shapes stay as they are: while something else is missing, fits bend them to that.
        """
        chosen = np.zeros(self.simulation.size, dtype=bool)
        for i in effects:
            chosen[self.simulation.slices[i]] = True
        return np.flatnonzero(chosen | (self.train.known & self.simulation.strength))

    def fit_together(self, effects: Sequence[int], base: Fit, begin: Fit) -> tuple[Model, Model | None]:
        """Fit all candidates at once; where that ends badly, again from the best few of their kinds.

        The cost has local minima where many effects begin at their nulls. From the best few it may end in a lower one,
        even where they alone are no better: beside them, an effect that acts in few windows shows.

        :param effects: indices of the candidates
        :param base: the declared parameters alone
        :param begin: where the fit begins
        :return: the model of all, and that of the best few kinds where it was needed
        """
        free, iterations, few = self.free(effects), self.thresholds.joint_iterations, None
        best = self.train.fit(begin.values, free, begin.starts, iterations, tolerance=3e-3)
        if np.median(best.errors) > self.thresholds.enough:
            few = self._best_few(effects, base)
            other = self.train.fit(few.fit.values, free, base.starts, iterations, tolerance=3e-3)
            best = min(best, other, key=lambda fit: fit.cost)
        return self.fit_model(effects, best), few

    def group_by_kind(self, effects: Sequence[int], apart: bool = False) -> dict[tuple[str, bool], list[int]]:
        """Effects by their kind, those on driven joints ``apart`` or not: the drives of a machine are built alike."""
        model = self.simulation.model
        driven = set(model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0].tolist())
        kinds: dict[tuple[str, bool], list[int]] = {}
        for e in effects:
            effect = self.simulation.effects[e]
            on = apart and effect.place in ("joint", "sensor") and effect.index in driven
            kinds.setdefault((effect.kind, on), []).append(e)
        return kinds

    def _best_few(self, effects: Sequence[int], base: Fit) -> Model:
        """The kinds that lower the cost of every third window most join one by one.

        A kind joins at all its places at once: the joints of a machine are built alike.
        """
        some = np.arange(0, len(self.train.windows), 3)
        part, chosen = self.train.on(some), list[int]()
        iterations, kinds = self.thresholds.refit_iterations, self.group_by_kind(effects)
        fit = part.fit(base.values, self.free(()), base.starts[some], iterations)
        for _ in range(min(self.thresholds.rounds, len(kinds))):
            self.say(0.0, f"another start, with {len(chosen)} of the candidates")
            free = {kind: self.free([*chosen, *places]) for kind, places in kinds.items()}
            fits = {kind: part.fit(fit.values, free[kind], fit.starts, iterations) for kind in kinds}
            best = min(fits, key=lambda k: fits[k].cost)
            chosen += kinds.pop(best)
            fit = fits[best]
        return self.fit_model(chosen, replace(fit, starts=base.starts), 2 * iterations)

    def fit_model(self, effects: Sequence[int], begin: Fit, iterations: int | None = None) -> Model:
        """Fit a model from the optimum of another, without the effects that it lacks.

        Where it ends worse than a smaller one is known to be, it begins again from that.
        """
        key, iterations = tuple(sorted(effects)), iterations or self.thresholds.refit_iterations
        if key in self._memory:
            return self._memory[key]
        free = self.free(key)
        fit = self.train.fit(self._less(begin.values, key), free, begin.starts, iterations, tolerance=3e-3)
        known = [m.fit for m in self._memory.values() if {*m.effects} < {*key} and m.fit.cost < fit.cost]
        if known:
            smaller = min(known, key=lambda f: f.cost)
            again = self.train.fit(smaller.values, free, smaller.starts, iterations, tolerance=3e-3)
            fit = min(fit, again, key=lambda f: f.cost)
        return self._remembered(key, fit)

    def fit_model_from(self, effects: Sequence[int], begin: Fit, iterations: int) -> Model:
        """As :meth:`fit_model`, but from this beginning even where another fit is remembered; the better of both."""
        key = tuple(sorted(effects))
        begun = self._less(begin.values, key)
        fit = self.train.fit(begun, self.free(key), begin.starts, iterations, tolerance=3e-3)
        known = self._memory.get(key)
        return known if known is not None and known.fit.cost <= fit.cost else self._remembered(key, fit)

    def _unbent(self, model: Model, begin: Fit) -> Model:
        """As :meth:`fit_model`, but with shapes fitted from their nulls: what was there beside them may have bent them.

        A spring about another reference is one about its own and an offset, say.
        """
        shapes = np.isin(np.arange(self.simulation.size), self.free(model.effects)) & ~self.simulation.strength
        if not shapes.any():
            return model
        values = np.where(shapes, self.simulation.null, begin.values)
        begin = replace(begin, values=values, linear=None)
        return self.fit_model_from(model.effects, begin, self.thresholds.refit_iterations)

    def _less(self, values: np.ndarray, key: Sequence[int]) -> np.ndarray:
        """Parameters at which all effects but the given and the known ones have no influence."""
        less = values.copy()
        for i, s in enumerate(self.simulation.slices):
            if i not in key and not self.simulation.effects[i].known:
                less[s] = self.simulation.null[s]
        return less

    def refine(self, model: Model) -> Model:
        """A model that errs more than need be, out of kinks that may hold its fit; exact data can be met exactly."""
        if not (self.train.exact or self.train.touching or self.model_error_dominates(model)):
            return model
        fit = refine(self.train, model.fit, self.free(model.effects), self.settings.refinement)
        return self._remembered(model.effects, fit)

    def _remembered(self, effects: tuple[int, ...], fit: Fit) -> Model:
        fit = replace(fit, linear=self.train.linear(fit, self.free(effects)))
        self._memory[effects] = Model(effects, fit, self._errors(fit, effects))
        return self._memory[effects]

    def _errors(self, fit: Fit, effects: Sequence[int]) -> np.ndarray:
        """Errors on windows that the parameters were not fitted to."""
        errors = unseen_errors(self.train, fit, self.free(effects), self.folds, self.settings.comparison.prior)
        apart = [self.select.score(fit.values).errors] if self.select else []
        return np.concatenate([*(errors[judged] for _, judged in self.folds), *apart])

    def evidence(self, with_: Model, without: Model) -> Evidence:
        """What ``with_`` gains over ``without`` on windows that neither was fitted to."""
        return compare(without.errors, with_.errors, self.blocks, not self.train.exact, self.settings.comparison)

    def model_error_dominates(self, model: Model) -> bool:
        """Whether what a model lacks, and not the noise, makes its errors."""
        return bool(np.median(model.errors) > FAR)

    def fits_exactly(self, model: Model) -> bool:
        """Whether a model meets exact data in every window, as only what is right does."""
        return self.train.exact and bool(model.fit.errors.max() < self.settings.refinement.enough)

    def nearly_fits_exactly(self, model: Model) -> bool:
        """Whether exact data may be met by leading a model on."""
        return self.train.exact and bool(np.median(model.errors) < self.thresholds.nearly_exact)

    def limit(self, model: Model) -> tuple[float, float]:
        """The t and the gain that an effect of a model must exceed to stay."""
        s = self.thresholds
        far = self.model_error_dominates(model)
        return (min(s.threshold_far, s.threshold), s.gain_far) if far else (s.threshold, self.least_gain)

    @property
    def least_gain(self) -> float:
        """Share of the error that an effect must save to stay."""
        return self.settings.comparison.least_gain

    def eliminate(self, outcome: Selection, limit: float | None = None) -> Selection:
        """Drop the effect whose removal costs least until all that remain have a t above the limit.

        Of what meets exact data, kinds are tried as a whole, too: all places of one may cancel bent shapes of others.

        :param limit: default: :meth:`limit` of the model, with its gain
        """
        current, step = outcome.model, max((step for step, _ in outcome.dropped.values()), default=0)
        begun = len(current.effects)
        while current.effects:
            step += 1
            order, costs = self.removal_costs(current)
            trifles = [e for e in order if costs[e] < self.thresholds.trifle * current.fit.cost]
            reduced = None
            met = self.fits_exactly(current)
            bundles = _bundles(order, trifles, self.thresholds.dropped)
            if met:
                bundles += [kind for kind in self.group_by_kind(order).values() if 1 < len(kind) < len(order)]
            for drop in bundles:
                trial = self.fit_model([e for e in current.effects if e not in drop], current.fit)
                if met and not self.fits_exactly(trial):
                    trial = self._unbent(trial, current.fit)
                evidence = self.evidence(current, trial)
                self.say(1 - len(trial.effects) / begun, f"{len(current.effects)} effects left, trying without some")
                if not evidence.clear(*(self.limit(current) if limit is None else (limit, self.least_gain))):
                    reduced = trial
                    for e in drop:
                        outcome.dropped[e] = (step, evidence)
                    break
            if reduced is None:
                break
            current = reduced
        outcome.model = current
        return outcome

    def removal_costs(self, model: Model) -> tuple[list[int], dict[int, float]]:
        """Effects by the rise of the cost that their removal causes, to second order, cheapest first."""
        free = self.free(model.effects)
        linear = self.train.linear(model.fit, free)
        normal = linear.normal.sum(0)
        normal = normal + 1e-8 * np.diag(np.diag(normal)) + 1e-9 * np.eye(len(free))
        inverse = np.linalg.pinv(normal)
        costs = {}
        for e in model.effects:
            s = self.simulation.slices[e]
            rows = np.flatnonzero((free >= s.start) & (free < s.stop) & self.simulation.strength[free])
            z = ((model.fit.values - self.simulation.null) / self.train.size)[free[rows]]
            costs[e] = float(z @ np.linalg.pinv(inverse[np.ix_(rows, rows)]) @ z)
        return sorted(costs, key=lambda e: costs[e]), costs

    def judge(self, selection: Selection) -> Selection:
        """Evidence for each kept effect against the model without it; what is not clear goes."""
        selection = self.eliminate(selection)
        while True:
            current, iterations = selection.model, self.thresholds.refit_iterations + 3
            selection.evidence = {}
            for e in current.effects:
                without = self.fit_model([i for i in current.effects if i != e], current.fit, iterations)
                selection.evidence[e] = self.evidence(current, without)
            weak = [e for e, evidence in selection.evidence.items() if not evidence.clear(*self.limit(current))]
            if not weak:
                selection.alike = {e: found for e, found in selection.alike.items() if e in current.effects}
                return selection
            worst = min(weak, key=lambda e: selection.evidence[e].t)
            selection.dropped[worst] = (0, selection.evidence[worst])
            selection.model = self.fit_model([i for i in current.effects if i != worst], current.fit)

    def add_effects(
        self,
        selection: Selection,
        candidates: Sequence[int],
        rounds: int | None = None,
        alike: Callable[[int], Sequence[int]] = lambda effect: (),
    ) -> Selection:
        """Add the effects that are clearly needed one by one, as long as much is missing.

        Each round fits the effects outside, first roughly, and keeps the best if it is clear, or one of its class that
        seems better.

        :param selection: begun with
        :param candidates: of each class one
        :param rounds: most effects to add; default: see the settings
        :param alike: the others of the class of an effect
        """
        for _ in range(self.thresholds.rounds if rounds is None else rounds):
            current = selection.model
            missed = several_missed(current.errors, self.blocks, self.settings.comparison)
            if np.median(current.errors) < self.thresholds.enough and not missed:
                break
            tried: list[tuple[float, Model, int]] = []
            for e, begin in self.most_promising(current, [c for c in candidates if c not in current.effects]):
                trial = self._with(current, e, begin)
                evidence = self.evidence(trial, current)
                if evidence.clear(*self.limit(trial)):
                    tried.append((evidence.gain, trial, e))
            if not tried:
                break
            best, added = self._simplest_of(tried)
            seen = [added, *current.effects, *(e for _, _, e in tried)]
            for other in [e for e in alike(added) if e not in seen]:
                trial = self._with(current, other, current.fit)
                if self.evidence(trial, best).clear(self.thresholds.seems):
                    best, added = trial, other
            selection.model = best
            selection.dropped.pop(added, None)
        return selection

    def _simplest_of(self, tried: list[tuple[float, Model, int]]) -> tuple[Model, int]:
        """Of models with their gains and what was added, the simplest that the best does not seem to beat."""
        _, best, added = max(tried, key=lambda found: found[0])
        for _, model, e in sorted(tried, key=lambda found: len(self.simulation.effects[found[2]].parameters)):
            if not self.evidence(best, model).clear(self.thresholds.seems):
                return model, e
        return best, added

    def _with(self, model: Model, effect: int, begin: Fit) -> Model:
        self.say(0.0, f"looking at {self.simulation.effects[effect].label}")
        return self.fit_model([*model.effects, effect], begin, self.thresholds.joint_iterations)

    def predicted_gain(self, model: Model, effects: Sequence[int]) -> float:
        """Share of the error that a model would save with all of some effects, if the cost were quadratic."""
        free = self.free([*effects, *model.effects])
        saved = self.train.linear(model.fit, free).fall(np.arange(len(free))) / model.fit.cost
        return 1 - float(np.sqrt(max(0.0, 1 - saved)))

    def most_promising(self, model: Model, outside: Sequence[int]) -> list[tuple[int, Fit]]:
        """The effects outside that lower the log errors or the cost most in a short fit to every third window.

        :return: each with where a fit may begin: the model's, with the effect's own start that did best
        """
        some = np.arange(0, len(self.train.windows), 3)
        part, begin = self.train.on(some), model.fit.starts[some]
        base = part.fit(model.fit.values, self.free(model.effects), begin, 3)
        gains, fits, starts, iterations = {}, {}, {}, self.thresholds.refit_iterations + 1
        for e, begins in self._promised(part, base, model.effects, outside).items():
            free = self.free([*model.effects, e])
            trials = [(b.values, part.fit(b.values, free, base.starts, iterations)) for b in begins]
            starts[e], fits[e] = min(trials, key=lambda trial: trial[1].cost)
            gained = float(np.mean(np.log(base.errors) - np.log(fits[e].errors)))
            gains[e] = max(gained, 1 - fits[e].cost / base.cost)
        best = sorted(gains, key=lambda e: -gains[e])[: self.thresholds.candidates_to_all]
        return [(e, self._begun(model, e, starts[e], fits[e].values)) for e in best if gains[e] > self.least_gain]

    def _begun(self, model: Model, effect: int, start: np.ndarray, fitted: np.ndarray) -> Fit:
        """Where the fit of a model with one more effect begins: at what some windows led to where all err less there.

        :param start: parameters with those of the effect where the fit to some windows began, (p,)
        :param fitted: where it ended, (p,)
        """
        there = self.train.score(fitted, model.fit.starts)
        if there.cost < model.fit.cost:
            return replace(there, linear=None)
        s, values = self.simulation.slices[effect], model.fit.values.copy()
        values[s] = start[s]
        return replace(model.fit, values=values, linear=None)

    def replace_by_one(self, model: Model, rest: Sequence[int], candidates: Sequence[int]) -> Model | None:
        """A model of exact data with one effect in the place of all but the ``rest`` that meets them as well, if any.

        :param model: that meets them
        :param rest: effects of it that stay
        :param candidates: what may take the place of the others
        """
        smaller = self.fit_model(rest, model.fit)
        outside = [e for e in candidates if e not in model.effects]
        for e, begins in self._promised(self.train, smaller.fit, rest, outside).items():
            effects, iterations = sorted([*rest, e]), self.thresholds.joint_iterations
            free = self.free(effects)
            if len(free) >= len(self.free(model.effects)):
                continue
            self.say(1.0, f"{self.simulation.effects[e].label} in the place of several")
            fits = [self.train.fit(b.values, free, smaller.fit.starts, iterations) for b in begins]
            trial = self._remembered(tuple(effects), min(fits, key=lambda fit: fit.cost))
            if self.nearly_fits_exactly(trial) and not self.fits_exactly(trial):
                trial = self.refine(trial)
            if self.fits_exactly(trial):
                return trial
        return None

    def _promised(
        self, part: Problem, base: Fit, kept: Sequence[int], outside: Sequence[int]
    ) -> dict[int, list[Start]]:
        """The effects outside that promise most to first order from any of their starts, with the best of those."""
        begins = rank_starts(part, base, self.free(kept), outside, self.thresholds.starts)
        best = sorted(outside, key=lambda e: -begins[e][0].fall)
        sure = sum(begins[e][0].fall == np.inf for e in outside)
        return {e: begins[e] for e in best[: self.thresholds.candidates_to_some + sure]}


def _bundles(order: list[int], trifles: list[int], alone: int) -> list[list[int]]:
    """What to try to drop: those that hardly matter, at most half of all at once, fewer, the cheapest few alone."""
    trifles = trifles[: (len(order) + 1) // 2]
    bundles = [trifles, trifles[: len(trifles) // 2], trifles[: len(trifles) // 4]] if len(trifles) > 1 else []
    return [b for b in bundles if len(b) > 1] + [[e] for e in order[:alone]]


# --- where fits may start ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Start:
    """Where the fit of an effect may start.

    :param values: all parameters, those of the effect at one of its starts, (p,)
    :param fall: how far the cost would fall from there to first order, with the parameters that were free before;
        infinite for what promises nothing to first order, such as a limit beyond reach
    """

    values: np.ndarray
    fall: float


def rank_starts(
    problem: Problem, base: Fit, free: Sequence[int] | np.ndarray, effects: Sequence[int], most: int
) -> dict[int, list[Start]]:
    """Where the fits of some effects may start: for each effect the few starts that promise most, the best one first.

    What the other parameters and the windows' starts do is the same for all, as an effect does nothing yet.

    :param problem: windows
    :param base: fitted without the effects
    :param free: parameters that were free there
    :param effects: their numbers
    :param most: starts of each effect
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
            begins.append(Start(values, np.inf if limit else fall(values, strengths)))
        found[effect] = begins if limit else sorted(begins, key=lambda begin: -begin.fall)[:most]
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
