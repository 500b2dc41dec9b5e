"""Masses and inertias that nobody declared, where nothing explains recordings: models have them from drawings."""

from __future__ import annotations

import numpy as np

from sb3_rpto.effects import Declared, Scales, Simulation
from sb3_rpto.effects.library import candidates
from sb3_rpto.effects.names import object_id
from sb3_rpto.sysid.findings import FindingKind, Hint
from sb3_rpto.sysid.hypotheses.column_errors import CLEARLY, FITTED, ITERATIONS, WINDOWS
from sb3_rpto.sysid.problem.prepare import SetUp
from sb3_rpto.sysid.selection.pipeline import Found
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import cut

#: A body is looked at with these changes of each; those that promise most are fitted.
LOOKS = (-0.3, 0.4)
#: The effects that change them, what to declare then, and what says so.
DECLARE = {
    "mass_scale": ("mass", FindingKind.UNDECLARED_MASS),
    "inertia_scale": ("inertia", FindingKind.UNDECLARED_INERTIA),
}


def undeclared_mass(found: Found, set_up: SetUp) -> list[Hint]:
    """The body with another mass or inertia of which the model errs far less, with what was found where it is needed.

    With a mass its inertia goes; a declared mass leaves the inertia that did not go with it. Of a machine's recordings
    no effect that is looked for does the same: a ``payload`` is a point. In exact data both are among the candidates.
    """
    data, train = set_up.fitted, found.on.fine.train
    if data.exact:
        return []
    simulation, selection = train.simulation, found.selection
    windows = cut(simulation.model, data, set_up.sigma, found.on.fine.horizon, WINDOWS)
    begins = (selection.model.fit.values, found.base.fit.values)  # what was found may make up for the mass
    free = found.on.fine.free(selection.model.effects)
    as_it_is = Problem(simulation, windows, train.scales)  # fitted to these windows too, as with another mass
    fits = [as_it_is.fit(values, free, iterations=ITERATIONS) for values in begins]
    usual = min(float(np.median(fit.errors)) for fit in fits)
    declared = [effect.label for effect in simulation.effects if isinstance(effect, Declared)]
    tried = []
    for scale in candidates(set_up.nominal, declared, DECLARE):
        wider = Simulation(simulation.model, [*simulation.effects, scale], simulation.nthread)
        there = Problem(wider, windows, [*train.scales, Scales()])
        for values in (np.append(begin, change) for begin in begins for change in LOOKS):
            tried.append((float(np.median(there.score(values).errors)), values, there, scale))
    best, share = None, CLEARLY
    for _, values, there, scale in sorted(tried, key=lambda one: one[0])[:FITTED]:
        fit = there.fit(values, np.append(free, simulation.size), iterations=ITERATIONS)
        if (now := float(np.median(fit.errors)) / usual) < share:
            best, share = (scale, 1 + fit.values[-1]), now
    if best is None:
        return []
    scale, times = best
    what, kind = DECLARE[scale.kind]
    message = (
        f"with {times:.3g} times its {what} the model errs by {share:.0%} of what it does: declare {scale.on}.{what}, "
        "and trace again"
    )
    where = frozenset({object_id(set_up.nominal, "body", scale.on)})
    return [Hint(kind, scale.on, message, bodies=where, left=share)]
