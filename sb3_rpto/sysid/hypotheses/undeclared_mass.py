"""Masses and inertias that nobody declared, where nothing explains recordings: models have them from drawings."""

from __future__ import annotations

import numpy as np

from sb3_rpto.effects import Declared, Scales, Simulation
from sb3_rpto.effects.library import candidates
from sb3_rpto.effects.names import object_id
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import cut

#: The effects that change a body's mass and inertia, and what to declare then.
DECLARE = {
    "mass_scale": ("mass", FindingKind.UNDECLARED_MASS),
    "inertia_scale": ("inertia", FindingKind.UNDECLARED_INERTIA),
}


class UndeclaredMass(Hypothesis):
    """A body has another mass or inertia than the model, which nobody declared."""

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """The body with which the model errs far less, with what was found where it is needed.

        With a mass its inertia goes; a declared mass leaves the inertia that did not go with it. Of a machine's
        recordings no effect that is looked for does the same: a ``payload`` is a point. In exact data both are among
        the candidates.
        """
        if problem.data.exact:
            return []
        settings = problem.settings.hypotheses
        selector, model = result.on.fine, result.selection.model
        simulation, scales = selector.simulation, selector.train.scales
        windows = cut(simulation.model, problem.fitted, problem.sigma, selector.horizon, settings.windows)
        begins = (model.fit.values, result.base.fit.values)  # what was found may make up for the mass
        free = selector.free(model.effects)
        as_it_is = Problem(simulation, windows, scales)  # fitted to these windows too, as with another mass
        fits = [as_it_is.fit(values, free, iterations=settings.fitted_iterations) for values in begins]
        usual = min(float(np.median(fit.errors)) for fit in fits)
        declared = [effect.label for effect in simulation.effects if isinstance(effect, Declared)]
        tried = []
        for scale in candidates(problem.nominal, declared, DECLARE):
            wider = Simulation(simulation.model, [*simulation.effects, scale], simulation.nthread)
            there = Problem(wider, windows, [*scales, Scales()])
            for values in (np.append(begin, change) for begin in begins for change in settings.mass_changes):
                tried.append((float(np.median(there.score(values).errors)), values, there, scale))
        best, share = None, settings.told_share
        for _, values, there, scale in sorted(tried, key=lambda one: one[0])[: settings.fitted]:
            tuned = there.fit(values, np.append(free, simulation.size), iterations=settings.fitted_iterations)
            if (now := float(np.median(tuned.errors)) / usual) < share:
                best, share = (scale, 1 + tuned.values[-1]), now
        if best is None:
            return []
        scale, times = best
        what, kind = DECLARE[scale.kind]
        message = (
            f"with {times:.3g} times its {what} the model errs by {share:.0%} of what it does: declare "
            f"{scale.on}.{what}, and trace again"
        )
        where = frozenset({object_id(problem.nominal, "body", scale.on)})
        return [Hint(kind, scale.on, message, bodies=where, left=share)]
