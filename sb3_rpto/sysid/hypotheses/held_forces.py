"""Forces that are held for a step of the environment, as where a wrapper writes them."""

from __future__ import annotations

from sb3_rpto.effects import LIBRARY
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.search import SearchResult

#: Kinds that brake a joint in every substep and have a held form.
TWINS = ("coulomb_friction", "soft_friction", "viscous_friction", "asymmetric_damping", "quadratic_drag")


class HeldForces(Hypothesis):
    """Forces stay what they are at the beginning of a step of the environment until its end."""

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where nothing explains recordings of a simulator that holds commands, and candidates were not chosen."""
        return problem.inputs.candidates is None and not result.explains and result.on.fine.train.windows.drive.hold > 1

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """With kinds that are held, and those that were found, but for what would be the same if it were held."""
        there = {effect.kind for effect in result.named} - {*TWINS}
        kinds = tuple(kind for kind, effect in LIBRARY.items() if effect.held or kind in there)
        return problem.assuming(kinds=kinds, soft_friction=False)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where they explain, or halve the excess of the errors."""
        share = result.on.settings.hypotheses.clear_share
        return alternative.explains or alternative.after.ratio < share * result.after.ratio

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding | None:
        """That forces are held, where one that is was found."""
        message = (
            "forces stay what they are at the beginning of a step of the environment until its end, as where a wrapper "
            "writes them, and no machine's do"
        )
        return Finding(FindingKind.HELD_FORCES, "fitted runs", message) if any(e.held for e in result.named) else None
