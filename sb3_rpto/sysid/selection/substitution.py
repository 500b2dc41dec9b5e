"""Effects that could stand for one another: which of them a model keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sb3_rpto.sysid.selection.model_comparison import compare
from sb3_rpto.sysid.selection.screening import Screening
from sb3_rpto.sysid.selection.stepwise_selection import Model, Selection, Selector
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem


class Substitution:
    """Exchanges effects of a model for others that could stand for them.

    :param selector: fits and compares the models
    :param screening: what looks like what
    """

    def __init__(self, selector: Selector, screening: Screening) -> None:
        self.selector, self.screening, self.settings = selector, screening, selector.settings.substitution
        self.seems = selector.settings.selection.seems
        self.effects = selector.simulation.effects
        self.kinds = [effect.kind for effect in self.effects]

    def substitute(self, selection: Selection) -> Selection:
        """Try the likest other effects in the place of each kept one; keep the better, name those that do as well.

        One that was there before is of the class unless the better one is clearly so.
        """
        current = self._kind_everywhere(selection.model)
        for e in current.effects:
            best, alike = e, list[int]()
            for other in self._likest(e, current.effects):
                self.selector.say(1.0, f"{self.effects[e].label} or {self.effects[other].label}")
                trial = self._exchanged(current, best, other)
                if self._better(trial, current):
                    clear = self.selector.evidence(trial, current).clear(*self.selector.limit(trial))
                    current, best, alike = trial, other, [] if clear else [*alike, best]
                elif self._twins(best, other):
                    if not self._clearly_worse(trial, current):
                        alike.append(other)
                elif not self._better(current, trial):
                    alike.append(other)
                    if self._simpler(other, best):
                        alike.append(best)
                        current, best = trial, other
            selection.alike[best] = sorted({*alike} - {best})
        selection.model = current = self.prefer_simplest(current, selection)
        selection.alike = {
            e: [i for i in found if i not in current.effects]
            for e, found in selection.alike.items()
            if e in current.effects
        }
        return selection

    def merge(self, selection: Selection) -> Selection:
        """Try one effect in the place of two: the joint fit may have met its like by a mixture.

        Far from the noise it is not worth its time: neither the two nor the one are right. No mixture meets exact data.
        """
        current, selector = selection.model, self.selector
        if selector.model_error_dominates(current) or selector.fits_exactly(current):
            return selection
        most = self.settings.pairs
        pairs = sorted(combinations(current.effects, 2), key=lambda pair: -self.screening.cosine[pair])[:most]
        for pair in pairs:
            rest = [e for e in current.effects if e not in pair]
            if len(rest) != len(current.effects) - 2:
                continue
            for one, trial in self._in_place_of_two(current, pair, rest, selection):
                selector.say(1.0, f"{self.effects[one].label} in the place of two")
                if not selector.evidence(current, trial).clear(self.seems):
                    current = trial
                    selection.alike[one] = [i for i in self.screening.alike(one) if i not in trial.effects]
                    break
        selection.model = current
        return selection

    def _in_place_of_two(
        self, model: Model, pair: tuple[int, int], rest: Sequence[int], selection: Selection
    ) -> Iterator[tuple[int, Model]]:
        """Models with one effect in the place of a pair: first what can stand for one of the two, the simple before.

        With such a one the other may have become needless: its fit begins there, as one from elsewhere may have failed.
        """
        stands = [(e, one) for e in pair for one in selection.alike.get(e, []) if one not in model.effects]
        for e, one in sorted(stands, key=lambda stand: len(self.effects[stand[1]].parameters)):
            begin = self._exchanged(model, e, one).fit
            yield one, self.selector.fit_model_from([*rest, one], begin, self.settings.iterations)
        outside = [i for i in range(len(self.effects)) if i not in rest and self.screening.excited(i)]
        outside = [i for i in outside if not self.effects[i].known]
        for one, begin in self.selector.most_promising(self.selector.fit_model(rest, model.fit), outside):
            yield one, self.selector.fit_model([*rest, one], begin, self.settings.iterations)

    def make_uniform(self, model: Model, selection: Selection) -> Model:
        """Try the kind that is kept most in the place of each odd one that it resembles: joints are built alike.

        An odd one may have been chosen while the others were still wrong.
        """
        if self.selector.fits_exactly(model):
            return model
        usual = Counter(self.kinds[e] for e in model.effects).most_common(1)
        for e in model.effects:
            kind, places = usual[0]
            same = [i for i in self._excited(kind) if i not in model.effects]
            other = max(same, key=lambda i: self.screening.cosine[e, i], default=e)
            if places < 2 or self.kinds[e] == kind or self.screening.cosine[e, other] < self.settings.like:
                continue
            self.selector.say(1.0, f"{self.effects[other].label}, as elsewhere")
            trial = self.selector.refine(self._exchanged(model, e, other))
            if self._better(trial, model):
                model = trial
                selection.alike[other] = sorted({*selection.alike.pop(e, [])} - {other})
        return model

    def prefer_simplest(self, model: Model, selection: Selection) -> Model:
        """Take the simpler ones of a class that do as well now that all else is right: richer ones win by trifles."""
        for e in model.effects:
            for other in sorted(self.screening.alike(e), key=lambda i: len(self.effects[i].parameters)):
                if other in model.effects or not self._simpler(other, e):
                    continue
                self.selector.say(1.0, f"{self.effects[other].label} is simpler")
                trial = self._exchanged(model, e, other)
                if self.selector.train.exact and not self.selector.model_error_dominates(model):
                    trial = self.selector.refine(trial)
                if not self._better(model, trial):
                    model = trial
                    selection.alike[other] = sorted({*selection.alike.pop(e, []), e} - {other})
                    break
        return model

    def fit_instead(self, model: Model, old: int, new: int, problem: Problem, starts: np.ndarray) -> Fit:
        """Fit ``new`` in the place of ``old`` to other windows from their ``starts``, all else of the model with it."""
        values, simulation = self._translated(model, old, new).values, self.selector.simulation
        values[simulation.slices[old]] = simulation.null[simulation.slices[old]]
        free = self.selector.free([*(i for i in model.effects if i != old), new])
        return problem.fit(values, free, starts, self.settings.iterations, tolerance=3e-3)

    def find_alike_everywhere(self, selection: Selection) -> Selection:
        """Name kinds that do as well in the place of all of a kind at once, though one of them alone would not.

        Late sensors of all joints answer to late commands of all of them, where only the commands move the joints.
        """
        model = selection.model
        if self.selector.fits_exactly(model):  # as only what is right does
            return selection
        counts = Counter(self.kinds[e] for e in model.effects)
        for usual in sorted(kind for kind, places in counts.items() if places > 1):
            for kind in sorted({*self.kinds} - {"declared", usual}):
                swaps = self._swaps(model, kind, self.settings.akin)
                swaps = {e: i for e, i in swaps.items() if self.kinds[e] == usual}
                if len(swaps) < counts[usual] or any(i in selection.alike.get(e, []) for e, i in swaps.items()):
                    continue
                self.selector.say(1.0, f"{kind} in all places of {usual}")
                if not self.selector.evidence(model, self._swapped(model, swaps)).clear(*self.selector.limit(model)):
                    for e, i in swaps.items():
                        selection.alike[e] = sorted({*selection.alike.get(e, []), i})
        return selection

    def _kind_everywhere(self, model: Model) -> Model:
        """Try each kind in the place of all others that it resembles, at once: one alone may look no better.

        They may be fewer then: sensors of many joints that look late answer to a few commands that are.
        """
        if self.selector.fits_exactly(model):  # nothing could be better
            return model
        for kind in sorted({*self.kinds} - {"declared"}):
            kept = kind in {self.kinds[e] for e in model.effects}
            swaps = self._swaps(model, kind, self.settings.like if kept else self.settings.akin)
            if len(swaps) < 2:
                continue
            self.selector.say(1.0, f"{kind} in all places")
            trial = self._swapped(model, swaps)
            if self.selector.nearly_fits_exactly(trial):  # where all places change at once, kinks hold the fit
                trial = self.selector.refine(trial)
            if self.selector.evidence(trial, model).clear(self.seems):
                model = trial
        return model

    def _swaps(self, model: Model, kind: str, like: float) -> dict[int, int]:
        """The likest place of a kind for each effect of another one that it resembles."""
        same = self._excited(kind)
        if not same:
            return {}
        nearest = {e: max(same, key=lambda i: self.screening.cosine[e, i]) for e in model.effects}
        return {e: i for e, i in nearest.items() if self.kinds[e] != kind and self.screening.cosine[e, i] > like}

    def _swapped(self, model: Model, swaps: dict[int, int]) -> Model:
        """The model with others in the place of several effects, fitted."""
        slices, begin = self.selector.simulation.slices, replace(model.fit, values=model.fit.values.copy(), linear=None)
        for old, new in swaps.items():
            begin.values[slices[new]] = self._translated(model, old, new).values[slices[new]]
        effects = sorted({swaps.get(e, e) for e in model.effects})
        return self.selector.fit_model(effects, begin, 2 * self.selector.thresholds.refit_iterations)

    def _excited(self, kind: str) -> list[int]:
        """The places of a kind that the data could show."""
        return [i for i, k in enumerate(self.kinds) if k == kind and self.screening.excited(i)]

    def _likest(self, effect: int, kept: Sequence[int]) -> list[int]:
        """What to try in the place of an effect: kinds that are kept elsewhere first, as joints are built alike."""
        kinds, cosine = {self.kinds[i] for i in kept}, self.screening.cosine[effect]
        near = [i for i in np.argsort(-cosine, kind="stable").tolist() if cosine[i] > self.settings.like]
        near = [i for i in near if i != effect and i not in kept and self.screening.excited(i)]
        return sorted(near, key=lambda i: self.kinds[i] not in kinds)[: self.settings.candidates]

    def _exchanged(self, model: Model, old: int, new: int) -> Model:
        """The model with ``new`` in the place of ``old``, fitted.

        One of the same kind that acts alike is fitted from the same values, too: at a kink, as of dry friction, what is
        the likest to first order is far from what is.
        """
        effects = [*(i for i in model.effects if i != old), new]
        found = self.selector.fit_model(effects, self._translated(model, old, new), self.settings.iterations)
        if self._twins(old, new) and found.fit.cost > model.fit.cost:
            slices, values = self.selector.simulation.slices, model.fit.values.copy()
            values[slices[new]] = values[slices[old]]
            begin = replace(model.fit, values=values, linear=None)
            return self.selector.fit_model_from(effects, begin, self.settings.iterations)
        return found

    def _twins(self, a: int, b: int) -> bool:
        """Whether two are of one kind and act alike, as friction at either end of a linkage."""
        return self.kinds[a] == self.kinds[b] and b in self.screening.alike(a)

    def _clearly_worse(self, twin: Model, model: Model) -> bool:
        """Whether a twin in place of an effect fits clearly worse, by the fitted windows: it has as many parameters.

        What windows err by that were not fitted is known to first order, and at a kink by less than tells twins apart.
        """
        train, settings = self.selector.train, self.selector.settings.comparison
        gained = compare(twin.fit.errors, model.fit.errors, train.windows.block, not train.exact, settings)
        return gained.clear(*self.selector.limit(model))

    def _translated(self, model: Model, old: int, new: int) -> Fit:
        """Where to begin with ``new`` in the place of ``old``: where it does the likest, to first order."""
        train, simulation = self.selector.train, self.selector.simulation
        old_free, new_free = self.selector.free([old]), self.selector.free([new])
        old_free, new_free = (f[~train.known[f] & simulation.strength[f]] for f in (old_free, new_free))
        normal = train.linear(model.fit, np.concatenate([old_free, new_free])).normal.sum(0)
        k = len(old_free)
        z = ((model.fit.values - simulation.null) / train.size)[old_free]
        inner = normal[k:, k:] + (1e-6 * np.trace(normal[k:, k:]) + 1e-12) * np.eye(len(new_free))
        values = model.fit.values.copy()
        values[new_free] = simulation.null[new_free] + train.size[new_free] * np.linalg.solve(inner, normal[k:, :k] @ z)
        return replace(model.fit, values=np.clip(values, train.lower, train.upper), linear=None)

    def _better(self, a: Model, b: Model) -> bool:
        """Whether one of two does better: near the noise that seems so soon, far from it, it must be clear.

        Where the other meets exact data, one that is far nearer still is right, though no window denies the other.
        """
        worst, least = b.fit.errors.max(), a.fit.errors.max() / self.settings.right
        if self.selector.fits_exactly(b) and self.settings.errs < worst > least:
            return True
        far = self.selector.model_error_dominates(a)
        limit = self.selector.limit(a) if far else (self.seems, self.selector.least_gain)
        return self.selector.evidence(a, b).clear(*limit)

    def _simpler(self, a: int, b: int) -> bool:
        return len(self.effects[a].parameters) < len(self.effects[b].parameters)
