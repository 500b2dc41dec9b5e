"""What a hypothesis about recordings is."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_rpto.effects import Declared, Effect
from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult, search


@dataclass(frozen=True)
class Hypothesis:
    """Something that may be otherwise than a search took it for.

    Either the problem is read in another way and searched again, or a reader gets a hint at what may be wrong where
    nothing explains the recordings.

    :param within: hypotheses that are tried on its alternative before that is compared
    """

    within: tuple[Hypothesis, ...] = ()

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Whether what was found speaks for it enough to read the recordings in another way."""
        return False

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem | None:
        """The problem under this hypothesis; None where a closer look denies it."""
        raise NotImplementedError

    def search(
        self, alternative: IdentificationProblem, result: SearchResult
    ) -> tuple[IdentificationProblem, SearchResult]:
        """The problem under this hypothesis, and what is found then.

        :param result: without it
        """
        return alternative, search(alternative)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Whether the alternative result takes the place of the result; where nothing else is said, in any case."""
        return True

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding | None:
        """What the report says of it where it was accepted.

        :param alternative: the problem under this hypothesis
        :param result: of that
        """
        return None

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """What speaks for it where nothing explains the recordings."""
        return []


def kept_effects(result: SearchResult) -> list[Effect]:
    """The effects that are no candidates any more, known or found, as they were fitted."""
    simulation, values = result.on.fine.simulation, result.selection.model.fit.values
    known = [i for i, e in enumerate(simulation.effects) if e.known and not isinstance(e, Declared)]
    kept = (*known, *result.selection.model.effects)
    there = [simulation.effects[i].with_values(values[simulation.slices[i]]) for i in kept]
    return [effect for effect in there if not effect.does_nothing]  # as known ones may, after the fit
