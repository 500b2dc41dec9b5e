"""Which effects are needed: a joint fit of all candidates, and elimination backwards."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from sb3_rpto.effects import Scales, Simulation
from sb3_rpto.tracing.box import bounded_step
from sb3_rpto.tracing.concentrate import led_on
from sb3_rpto.tracing.evidence import GAIN, Evidence, compare, folds
from sb3_rpto.tracing.identify import Fit, Problem
from sb3_rpto.tracing.screen import Screening
from sb3_rpto.tracing.windows import Windows

#: t*, between the 3 and 4 that complete data usually give as the 95 % quantile of the largest t; `calibrate` measures
#: it for the data at hand.
THRESHOLD = 3.5
#: Typical window error, in units of the noise, above which it is the model's more than the noise's.
FAR = 2.0
#: t* there: what else lacks, not the noise, spreads the blocks, and the 98 % quantile of one test is the best there is.
LIKELY = 2.0
#: Share of the error that counts there: of the many effects that would fit a little of what lacks, few are named.
TENTH = 0.1
#: Iterations of a refit that begins at the larger model's optimum.
REFIT = 5
#: Iterations of the joint fit of all candidates.
JOINT = 15
#: Effects whose removal raises the cost by less than this share, to second order, may go together.
TRIFLE = 0.01
#: t from which on an effect seems to matter.
SEEMS = 1.5
#: Rounds of the look forward, after a joint fit and in its place, and candidates fitted in each.
ROUNDS, INSTEAD, PROMISING = 3, 8, 4
#: Pairs of kept effects in whose place one is tried.
MERGES = 3
#: Typical window error, in units of the noise, that leaves nothing to look forward to.
ENOUGH = 1.1
#: Candidates for a substitution are the likest so many, of at least this cosine; of a kind that is nowhere kept, which
#: could stand in all places, at least the second.
SUBSTITUTES, LIKE, AKIN = 5, 0.3, 0.6

Say = Callable[[str], None]


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
    :param threshold: t*, see :func:`sb3_rpto.tracing.trace.trace`
    :param say: progress
    :param horizon: length of the windows in s, for the gap between folds
    """

    def __init__(
        self, train: Problem, select: Problem | None, threshold: float, say: Say, horizon: float = 0.0
    ) -> None:
        self.train, self.select, self.threshold, self.say = train, select, threshold, say
        self.horizon = horizon
        self.folds = folds(train.windows, horizon)
        self.blocks = np.concatenate([train.windows.block[b] for _, b in self.folds])
        if select:
            self.blocks = np.concatenate([self.blocks, select.windows.block + self.blocks.max() + 1])
        self.simulation = train.simulation
        self._memory: dict[tuple[int, ...], Model] = {}

    @classmethod
    def on(
        cls,
        simulation: Simulation,
        windows: tuple[Windows, Windows | None],
        scales: Sequence[Scales],
        horizon: float,
        progress: Callable[[float, str], None],
    ) -> Selector:
        """For the shipped threshold and windows to train and to select on."""
        select = None if windows[1] is None else Problem(simulation, windows[1], scales)
        return cls(
            Problem(simulation, windows[0], scales), select, THRESHOLD, lambda what: progress(0.6, what), horizon
        )

    @property
    def judging(self) -> Problem:
        """Where adequacy is judged: the select windows, or all where there are none."""
        return self.select or self.train

    def free(self, effects: Sequence[int]) -> np.ndarray:
        """Indices of the parameters of the declared and of the given effects."""
        keep = [
            s
            for i, s in enumerate(self.simulation.slices)
            if i in effects or self.simulation.effects[i].kind == "declared"
        ]
        return (
            np.concatenate([np.arange(s.start, s.stop) for s in keep]).astype(int) if keep else np.empty(0, dtype=int)
        )

    def together(self, effects: Sequence[int], base: Fit) -> Model:
        """Fit all candidates at once, from the base; where that ends badly, again from the best few of them.

        The cost has local minima where many effects begin at their nulls.
        """
        free = self.free(effects)
        best = self.train.fit(base.values, free, base.starts, JOINT, tolerance=3e-3)
        if np.median(best.errors) > ENOUGH:
            other = self.train.fit(self._best_few(effects, base), free, base.starts, JOINT, tolerance=3e-3)
            best = min(best, other, key=lambda fit: fit.cost)
        return self.model(effects, best)

    def _best_few(self, effects: Sequence[int], base: Fit) -> np.ndarray:
        """Parameters after the kinds that lower the cost of every third window most have joined one by one.

        A kind joins at all its places at once: the joints of a machine are built alike.
        """
        some = np.arange(0, len(self.train.windows), 3)
        part, chosen = self.train.on(some), list[int]()
        fit = part.fit(base.values, self.free(()), base.starts[some], REFIT)
        kinds: dict[str, list[int]] = {}
        for e in effects:
            kinds.setdefault(self.simulation.effects[e].kind, []).append(e)
        for _ in range(min(ROUNDS, len(kinds))):
            self.say(f"another start, with {len(chosen)} of the candidates")
            fits = {k: part.fit(fit.values, self.free([*chosen, *g]), fit.starts, REFIT) for k, g in kinds.items()}
            best = min(fits, key=lambda k: fits[k].cost)
            chosen += kinds.pop(best)
            fit = fits[best]
        return fit.values

    def model(self, effects: Sequence[int], begin: Fit, iterations: int = REFIT) -> Model:
        """Fit a model from the optimum of another, without the effects that it lacks."""
        key = tuple(sorted(effects))
        if key in self._memory:
            return self._memory[key]
        values = begin.values.copy()
        for i, s in enumerate(self.simulation.slices):
            if i not in key and self.simulation.effects[i].kind != "declared":
                values[s] = self.simulation.null[s]
        return self._remembered(key, self.train.fit(values, self.free(key), begin.starts, iterations, tolerance=3e-3))

    def led_on(self, model: Model) -> Model:
        """A model that errs more than need be, out of kinks that may hold its fit; exact data can be met exactly."""
        if not (self.train.exact or self.far(model)):
            return model
        return self._remembered(model.effects, led_on(self.train, model.fit, self.free(model.effects)))

    def _remembered(self, effects: tuple[int, ...], fit: Fit) -> Model:
        fit = replace(fit, linear=self.train.linear(fit, self.free(effects)))
        self._memory[effects] = Model(effects, fit, self._errors(fit, effects))
        return self._memory[effects]

    def _errors(self, fit: Fit, effects: Sequence[int]) -> np.ndarray:
        """Errors on windows that the parameters were not fitted to.

        Each fold's parameters are one Gauss-Newton step away from the fit to all training windows, taken with the
        windows of the fold and beside it left out.
        """
        train, free = self.train, self.free(effects)
        rows = np.tile(fit.values, (len(train.windows), 1))
        if len(free):
            linear = train.linear(fit, free)
            low, high = ((b[free] - fit.values[free]) / train.size[free] for b in (train.lower, train.upper))
            for others, judged in self.folds:
                normal, gradient = linear.normal[others].sum(0), linear.gradient[others].sum(0)
                normal = normal + np.diag(1e-3 * np.diag(normal) + 1e-9)
                move = bounded_step(normal, gradient, low, high) * train.size[free]
                rows[np.ix_(judged, free)] += move
        errors = train.score(rows, fit.starts, iterations=1).errors
        unseen = [errors[judged] for _, judged in self.folds]
        return np.concatenate([*unseen, self.select.score(fit.values).errors] if self.select else unseen)

    def evidence(self, with_: Model, without: Model) -> Evidence:
        """What ``with_`` gains over ``without`` on windows that neither was fitted to."""
        return compare(without.errors, with_.errors, self.blocks)

    def far(self, model: Model) -> bool:
        """Whether what a model lacks, and not the noise, makes its errors."""
        return bool(np.median(model.errors) > FAR)

    def limit(self, model: Model) -> tuple[float, float]:
        """The t and the gain that an effect of a model must exceed to stay."""
        return (min(LIKELY, self.threshold), TENTH) if self.far(model) else (self.threshold, GAIN)

    def eliminate(self, outcome: Selection, limit: float | None = None) -> Selection:
        """Drop the effect whose removal costs least until all that remain have a t above the limit.

        :param limit: default: :meth:`limit` of the model, with its gain
        """
        current, step = outcome.model, max((step for step, _ in outcome.dropped.values()), default=0)
        while current.effects:
            step += 1
            order, costs = self.removal_costs(current)
            trifles = [e for e in order if costs[e] < TRIFLE * current.fit.cost]
            reduced = None
            for drop in _bundles(order, trifles):
                trial = self.model([e for e in current.effects if e not in drop], current.fit)
                evidence = self.evidence(current, trial)
                self.say(f"{len(trial.effects)} effects left")
                if not evidence.clear(*(self.limit(current) if limit is None else (limit, GAIN))):
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

    def substitute(self, selection: Selection, screening: Screening) -> Selection:
        """Try the likest other effects in the place of each kept one; keep the better, name those that do as well."""
        current = self._alike_everywhere(selection.model, screening)
        for e in current.effects:
            others = self._likest(e, current.effects, screening)
            best = e
            alike: list[int] = []
            for other in others:
                self.say(f"{self.simulation.effects[e].label} or {self.simulation.effects[other].label}")
                begin = self._translated(current, best, other)
                trial = self.model([i for i in current.effects if i != best] + [other], begin, REFIT + 3)
                if self._better(trial, current):
                    current, alike, best = trial, [], other
                elif not self._better(current, trial):
                    alike.append(other)
                    if self._simpler(other, best):
                        current, best = trial, other
            selection.alike[best] = sorted({e, *alike} - {best})
        selection.model = current = self.simplest(current, selection, screening)
        selection.alike = {
            e: [i for i in found if i not in current.effects]
            for e, found in selection.alike.items()
            if e in current.effects
        }
        return selection

    def merge(self, selection: Selection, screening: Screening) -> Selection:
        """Try one effect in the place of two: the joint fit may have met its like by a mixture.

        Far from the noise it is not worth its time: neither the two nor the one are right.
        """
        current = selection.model
        if self.far(current):
            return selection
        pairs = sorted(combinations(current.effects, 2), key=lambda pair: -screening.cosine[pair])[:MERGES]
        for pair in pairs:
            rest = [e for e in current.effects if e not in pair]
            if len(rest) != len(current.effects) - 2:
                continue
            without = self.model(rest, current.fit)
            outside = [i for i in range(len(self.simulation.effects)) if i not in rest and screening.excited(i)]
            outside = [i for i in outside if self.simulation.effects[i].kind != "declared"]
            for one in self._promising(without, outside):
                self.say(f"{self.simulation.effects[one].label} in the place of two")
                trial = self.model([*rest, one], without.fit, REFIT + 3)
                if not self.evidence(current, trial).clear(SEEMS):
                    current = trial
                    selection.alike[one] = [i for i in screening.alike(one) if i not in trial.effects]
                    break
        selection.model = current
        return selection

    def uniform(self, model: Model, selection: Selection, screening: Screening) -> Model:
        """Try the kind that is kept most in the place of each odd one that it resembles: joints are built alike.

        An odd one may have been chosen while the others were still wrong.
        """
        kind_of = [e.kind for e in self.simulation.effects]
        count = Counter(kind_of[e] for e in model.effects)
        for e in model.effects:
            kind, places = count.most_common(1)[0]
            same = [i for i, k in enumerate(kind_of) if k == kind and i not in model.effects and screening.excited(i)]
            other = max(same, key=lambda i: screening.cosine[e, i], default=e)
            if places < 2 or kind_of[e] == kind or screening.cosine[e, other] < LIKE:
                continue
            self.say(f"{self.simulation.effects[other].label}, as elsewhere")
            begin = self._translated(model, e, other)
            trial = self.led_on(self.model([i for i in model.effects if i != e] + [other], begin, REFIT + 3))
            if self._better(trial, model):
                model = trial
                selection.alike[other] = sorted({*selection.alike.pop(e, [])} - {other})
        return model

    def simplest(self, model: Model, selection: Selection, screening: Screening) -> Model:
        """Take the simpler ones of a class that do as well now that all else is right: richer ones win by trifles."""
        for e in model.effects:
            for other in sorted(screening.alike(e), key=lambda i: len(self.simulation.effects[i].parameters)):
                if other in model.effects or not self._simpler(other, e):
                    continue
                self.say(f"{self.simulation.effects[other].label} is simpler")
                begin = self._translated(model, e, other)
                trial = self.model([i for i in model.effects if i != e] + [other], begin, REFIT + 3)
                if self.train.exact and not self.far(model):
                    trial = self.led_on(trial)
                if not self._better(model, trial):
                    model = trial
                    selection.alike[other] = sorted({*selection.alike.pop(e, []), e} - {other})
                    break
        return model

    def _alike_everywhere(self, model: Model, screening: Screening) -> Model:
        """Try each kind in the place of all others that it resembles, at once: one alone may look no better."""
        kind_of = [e.kind for e in self.simulation.effects]
        for kind in sorted({*kind_of} - {"declared"}):
            like = LIKE if kind in {kind_of[e] for e in model.effects} else AKIN
            same = [i for i, k in enumerate(kind_of) if k == kind and screening.excited(i)]
            if not same:
                continue
            nearest = {e: max(same, key=lambda i: screening.cosine[e, i]) for e in model.effects}
            swaps = {e: i for e, i in nearest.items() if kind_of[e] != kind and screening.cosine[e, i] > like}
            trial_effects = sorted({swaps.get(e, e) for e in model.effects})
            if len(swaps) < 2 or len(trial_effects) < len(model.effects):
                continue
            self.say(f"{kind} in all places")
            begin = model.fit
            for old, new in swaps.items():
                moved = self._translated(model, old, new).values[self.simulation.slices[new]]
                begin = replace(begin, values=begin.values.copy(), linear=None)
                begin.values[self.simulation.slices[new]] = moved
            trial = self.model(trial_effects, begin, 2 * REFIT)
            if self.evidence(trial, model).clear(SEEMS):
                model = trial
        return model

    def _likest(self, effect: int, kept: Sequence[int], screening: Screening) -> list[int]:
        """What to try in the place of an effect: kinds that are kept elsewhere first, as joints are built alike."""
        kinds = {self.simulation.effects[i].kind for i in kept}
        near = [i for i in np.argsort(-screening.cosine[effect]).tolist() if screening.cosine[effect, i] > LIKE]
        near = [i for i in near if i != effect and i not in kept and screening.excited(i)]
        return sorted(near, key=lambda i: self.simulation.effects[i].kind not in kinds)[:SUBSTITUTES]

    def _translated(self, model: Model, old: int, new: int) -> Fit:
        """Where to begin with ``new`` in the place of ``old``: where it does the likest, to first order."""
        old_free, new_free = self.free([old]), self.free([new])
        old_free, new_free = (f[~self.train.declared[f] & self.simulation.strength[f]] for f in (old_free, new_free))
        normal = self.train.linear(model.fit, np.concatenate([old_free, new_free])).normal.sum(0)
        k = len(old_free)
        z = ((model.fit.values - self.simulation.null) / self.train.size)[old_free]
        inner = normal[k:, k:] + (1e-6 * np.trace(normal[k:, k:]) + 1e-12) * np.eye(len(new_free))
        values = model.fit.values.copy()
        values[new_free] = self.simulation.null[new_free] + self.train.size[new_free] * np.linalg.solve(
            inner, normal[k:, :k] @ z
        )
        return replace(model.fit, values=np.clip(values, self.train.lower, self.train.upper), linear=None)

    def _better(self, a: Model, b: Model) -> bool:
        """Whether one of two likes does better: near the noise that seems so soon, far from it it must be clear."""
        return self.evidence(a, b).clear(*(self.limit(a) if self.far(a) else (SEEMS, GAIN)))

    def _simpler(self, a: int, b: int) -> bool:
        return len(self.simulation.effects[a].parameters) < len(self.simulation.effects[b].parameters)

    def judge(self, selection: Selection) -> Selection:
        """Evidence for each kept effect against the model without it; what is not clear goes."""
        selection = self.eliminate(selection)
        while True:
            current = selection.model
            selection.evidence = {}
            for e in current.effects:
                without = self.model([i for i in current.effects if i != e], current.fit, REFIT + 3)
                selection.evidence[e] = self.evidence(current, without)
            weak = [e for e, evidence in selection.evidence.items() if not evidence.clear(*self.limit(current))]
            if not weak:
                selection.alike = {e: found for e, found in selection.alike.items() if e in current.effects}
                return selection
            worst = min(weak, key=lambda e: selection.evidence[e].t)
            selection.dropped[worst] = (0, selection.evidence[worst])
            selection.model = self.model([i for i in current.effects if i != worst], current.fit)

    def look_forward(self, selection: Selection, candidates: Sequence[int], rounds: int = ROUNDS) -> Selection:
        """Where much is missing, the joint fit may end far from the best: add what is clearly needed.

        Each round fits the effects outside one by one, first roughly, and keeps the best if it is clear.
        """
        for _ in range(rounds):
            current = selection.model
            if np.median(current.errors) < ENOUGH:
                break
            tried: list[tuple[float, Model, int]] = []
            for e in self._promising(current, [c for c in candidates if c not in current.effects]):
                self.say(f"looking at {self.simulation.effects[e].label} again")
                trial = self.model([*current.effects, e], current.fit, REFIT + 3)
                evidence = self.evidence(trial, current)
                if evidence.clear(*self.limit(trial)):
                    tried.append((evidence.gain, trial, e))
            if not tried:
                break
            _, selection.model, added = max(tried, key=lambda found: found[0])
            selection.dropped.pop(added, None)
        return selection

    def _promising(self, model: Model, outside: Sequence[int]) -> list[int]:
        """The effects outside that lower the log errors or the cost most in a short fit to every third window."""
        some = np.arange(0, len(self.train.windows), 3)
        part, begin = self.train.on(some), model.fit.starts[some]
        base = part.fit(model.fit.values, self.free(model.effects), begin, 3)
        gains = {}
        for e in outside:
            fit = part.fit(base.values, self.free([*model.effects, e]), base.starts, REFIT + 1)
            gains[e] = max(float(np.mean(np.log(base.errors) - np.log(fit.errors))), 1 - fit.cost / base.cost)
        best = sorted(outside, key=lambda e: -gains[e])[:PROMISING]
        return [e for e in best if gains[e] > GAIN]


def _bundles(order: list[int], trifles: list[int]) -> list[list[int]]:
    """What to try to drop: those that hardly matter, at most half of all at once, fewer, the cheapest three each."""
    trifles = trifles[: (len(order) + 1) // 2]
    bundles = [trifles, trifles[: len(trifles) // 2], trifles[: len(trifles) // 4]] if len(trifles) > 1 else []
    return [b for b in bundles if len(b) > 1] + [[e] for e in order[:3]]
