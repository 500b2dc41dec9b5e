"""Dry friction that gives way near rest, as MuJoCo's own does where nothing else is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_rpto.effects import LIBRARY, Declared, Effect, Simulation
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.settings import HypothesisSettings
from sb3_rpto.sysid.shooting.multiple_shooting import Problem

#: Kinds of dry friction at a joint.
DRY = ("coulomb_friction", "stribeck_friction", "position_friction")


class SoftFriction(Hypothesis):
    """Dry friction that was found or is known creeps, as where ``frictionloss`` alone simulates it."""

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where nothing explains, and dry friction leaves what it would not if it gave way at rest."""
        if result.substeps is not None or result.explains:
            return False
        model = result.selection.model
        settings, tolerance = problem.settings.hypotheses, problem.settings.adequacy.tolerance
        share = share_of_creeping(result.on.fine.all_windows(), model.fit.values, model.effects, settings)[1]
        if share < settings.clear_share:
            return True
        return share < settings.some_share and share * result.after.low <= 1 + tolerance

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """With the same kinds of effects, friction that gives way in the place of the dry ones."""
        asked = problem.inputs.candidates
        kinds = asked if asked is not None else [name for name, kind in LIBRARY.items() if kind.offered]
        others = [kind for kind in kinds if kind not in DRY]
        softer = (*others, "soft_friction") if len(others) < len(kinds) else tuple(others)
        return problem.assuming(kinds=softer, soft_friction=True)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where it explains, or errs less."""
        return alternative.explains or alternative.after.ratio < result.after.ratio

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding:
        """That friction gives way."""
        message = "dry friction gives way near rest, as MuJoCo's frictionloss alone does and a machine's hardly"
        return Finding(FindingKind.SOFT_FRICTION, "fitted runs", message)

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """Whether dry friction of a machine that gives way at rest would leave less."""
        if problem.data.simulated:
            return []
        settings = problem.settings.hypotheses
        firm, share = share_of_creeping(fit.problem, fit.values, fit.named, settings)
        if share > settings.some_share:
            return []
        model = fit.problem.simulation.model
        message = (
            f"dry friction that gives way over {1e3 * model.dof_solref[firm[0].dof, 0]:g} ms, as MuJoCo's does by "
            f"default, leaves {share:.0%} of the error. Is this robot simulated? Set "
            'solreffriction="0.001 1" there, and solimpfriction="0.99 0.99", as that of machines holds; or name '
            "soft_friction among the candidates, or among the known effects"
        )
        bodies = frozenset(int(model.dof_bodyid[e.dof]) for e in firm)
        return [Hint(FindingKind.SOFT_FRICTION, ", ".join(e.label for e in firm), message, bodies=bodies, left=share)]


def share_of_creeping(
    problem: Problem, values: np.ndarray, named: Sequence[int], settings: HypothesisSettings
) -> tuple[list[Effect], float]:
    """Dry friction, named or known, and the share of the error that is left where it is as MuJoCo's own.

    :param values: of the model that leaves something, (p,)
    :param named: indices of its effects that were not known
    :return: those that may creep, at joints without friction in the model; the share is 1 where there are none
    """
    simulation = problem.simulation
    there = [e for i, e in enumerate(simulation.effects) if i in named or e.known]
    dry = [e for e in there if e.kind in DRY or (isinstance(e, Declared) and e.firm)]
    firm = [e for e in dry if simulation.model.dof_frictionloss[e.dof] == 0]
    if not firm:
        return [], 1.0
    places = [s for e, s in zip(simulation.effects, simulation.slices) if e in there]
    free = np.concatenate([np.arange(s.start, s.stop) for s in places])
    model = simulation.model.__copy__()
    # A joint that has some keeps its own constraint, see SimulationBatch.rough.
    model.dof_frictionloss[[e.dof for e in firm]] = settings.little_friction
    soft = Simulation(model, simulation.effects, simulation.nthread)
    fit = Problem(soft, problem.windows, problem.scales).fit(values, free, iterations=settings.iterations)
    return firm, float(np.median(fit.errors) / np.median(problem.score(values).errors))
