"""Masses that nobody declared, where nothing explains recordings: a model often has them from a drawing."""

from __future__ import annotations

import numpy as np

from sb3_rpto.effects import Declared, Scales, Simulation
from sb3_rpto.effects.library import candidates
from sb3_rpto.effects.names import object_id
from sb3_rpto.tracing.identify import Problem
from sb3_rpto.tracing.misread import CLEARLY, FITTED, ITERATIONS, WINDOWS
from sb3_rpto.tracing.prepare import SetUp
from sb3_rpto.tracing.search import Found
from sb3_rpto.tracing.unreached import Hint
from sb3_rpto.tracing.windows import cut

#: A body is looked at with these changes of its mass; those that promise most are fitted.
LOOKS = (-0.3, 0.4)


def undeclared_mass(found: Found, set_up: SetUp) -> list[Hint]:
    """The body with another mass of which the model errs far less, with what was found as far as that is needed then.

    Its inertia goes with it. Of a machine's recordings no effect that is looked for does the same: a ``payload`` is a
    point. In exact data ``mass_scale`` is among the candidates.
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
    for mass in candidates(set_up.nominal, declared, {"mass_scale"}):
        wider = Simulation(simulation.model, [*simulation.effects, mass], simulation.nthread)
        there = Problem(wider, windows, [*train.scales, Scales()])
        for values in (np.append(begin, change) for begin in begins for change in LOOKS):
            tried.append((float(np.median(there.score(values).errors)), values, there, mass.on))
    best, share = None, CLEARLY
    for _, values, there, body in sorted(tried, key=lambda one: one[0])[:FITTED]:
        fit = there.fit(values, np.append(free, simulation.size), iterations=ITERATIONS)
        if (now := float(np.median(fit.errors)) / usual) < share:
            best, share = (body, 1 + fit.values[-1]), now
    if best is None:
        return []
    body, times = best
    message = (
        f"with {times:.3g} times its mass the model errs by {share:.0%} of what it does: declare {body}.mass, "
        "and trace again"
    )
    where = frozenset({object_id(set_up.nominal, "body", body)})
    return [Hint("undeclared mass", body, message, bodies=where, left=share)]
