"""The hypotheses about recordings, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.hypotheses.blocks_of_all_runs import BlocksOfAllRuns
from sb3_rpto.sysid.hypotheses.column_errors import ColumnErrors
from sb3_rpto.sysid.hypotheses.encoder_offsets import OffsetsOfRuns
from sb3_rpto.sysid.hypotheses.finer_steps import FinerSteps
from sb3_rpto.sysid.hypotheses.held_forces import HeldForces
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.hypotheses.simulated_data import ExactStates, OtherSubsteps, SimulatorSteps, SimulatorSubsteps
from sb3_rpto.sysid.hypotheses.soft_friction import SoftFriction
from sb3_rpto.sysid.hypotheses.undeclared_mass import UndeclaredMass
from sb3_rpto.sysid.hypotheses.unlikely_data import UnlikelyData
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult

#: How runs are judged on.
_JUDGING: tuple[Hypothesis, ...] = (BlocksOfAllRuns(),)
#: Which forces act.
_SOFT, _HELD = SoftFriction(_JUDGING), HeldForces(_JUDGING)
_FORCES: tuple[Hypothesis, ...] = (_SOFT, _HELD)
#: Where the recordings come from.
_ORIGIN: tuple[Hypothesis, ...] = (
    SimulatorSubsteps((*_JUDGING, _SOFT, OtherSubsteps(), _HELD)),
    SimulatorSteps((*_JUDGING, *_FORCES)),
    ExactStates((*_JUDGING, *_FORCES)),
)
#: What gives hints alone.
_HINTS: tuple[Hypothesis, ...] = (UnlikelyData(), ColumnErrors(), UndeclaredMass(), FinerSteps())
#: All of them, in their turn.
HYPOTHESES = (*_JUDGING, *_FORCES, *_ORIGIN, OffsetsOfRuns(), *_HINTS)


def try_alternatives(
    problem: IdentificationProblem, result: SearchResult, hypotheses: Sequence[Hypothesis] = HYPOTHESES
) -> tuple[IdentificationProblem, SearchResult]:
    """Read the recordings in other ways where what was found speaks for them, and keep what explains them better.

    :param result: of the search on the problem
    :param hypotheses: in their turn
    :return: the problem as it was read at last, and what was found then
    """
    for hypothesis in hypotheses:
        other = hypothesis.alternative(problem, result) if hypothesis.applies(problem, result) else None
        if other is None:
            continue
        other, found = try_alternatives(*hypothesis.search(other, result), hypothesis.within)
        if hypothesis.accepts(result, found):
            finding = hypothesis.finding(other, found)
            problem, result = other if finding is None else other.with_finding(finding), found
    return problem, result


def hints(problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
    """What all hypotheses hint at where nothing explains the recordings."""
    return [hint for hypothesis in HYPOTHESES for hint in hypothesis.hints(problem, result, fit)]
