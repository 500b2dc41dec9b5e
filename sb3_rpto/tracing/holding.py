"""Forces that a wrapper holds for a step of the environment: do they leave less than what was found?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_rpto.effects import LIBRARY, Simulation
from sb3_rpto.tracing.identify import Problem

#: Kinds that brake a joint in every substep; as many of them as a wrapper is likely to write have a held form.
HELD = [kind for kind, effect in LIBRARY.items() if effect.held]
TWINS = ("coulomb_friction", "soft_friction", "viscous_friction", "asymmetric_damping", "quadratic_drag")
BRAKES = (*TWINS, "stribeck_friction", "position_friction", "load_friction", "directional_load_friction")
ITERATIONS = 12


def kinds_when_held(exact: bool) -> list[str]:
    """Kinds to look for where forces seem to be held: those that were looked for, with held ones for their twins.

    :param exact: whether recordings are a simulator's exact states
    """
    return [kind for kind, e in LIBRARY.items() if e.held or ((e.offered or exact) and kind not in TWINS)]


def share_left(problem: Problem, values: np.ndarray, named: Sequence[int]) -> float:
    """Share of the error that is left with held forces in the place of all that brakes a joint in every substep.

    :param problem: that a model was fitted to
    :param values: of that model, (p,)
    :param named: indices of the effects that it has beside the known ones
    :return: 1 where nothing of the kind was named, or a step of the recordings is one of the simulation
    """
    simulation = problem.simulation
    brakes = {e.on: i for i in named if (e := simulation.effects[i]).kind in BRAKES}
    if not brakes or problem.windows.drive.hold == 1:
        return 1.0
    kept = [i for i, e in enumerate(simulation.effects) if e.known or (i in named and e.on not in brakes)]
    held = [(LIBRARY[kind](on), problem.scales[i]) for on, i in brakes.items() for kind in HELD]
    other = Simulation(
        simulation.model, [*(simulation.effects[i] for i in kept), *(e for e, _ in held)], simulation.nthread
    )
    begin = np.concatenate([*(values[simulation.slices[i]] for i in kept), np.zeros(len(held))])
    instead = Problem(other, problem.windows, [*(problem.scales[i] for i in kept), *(s for _, s in held)])
    fit = instead.fit(begin, np.arange(other.size), iterations=ITERATIONS)
    return float(np.median(fit.errors) / np.median(problem.score(values).errors))
