"""Columns that look as of other units, or of nothing: angles in degrees, constant commands, limits of motors."""

from __future__ import annotations

from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.data_model_consistency import unlikely_columns
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult


class UnlikelyData(Hypothesis):
    """A column holds something else than it says."""

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """See :func:`~sb3_rpto.sysid.problem.data_model_consistency.unlikely_columns`."""
        return [*unlikely_columns(problem.nominal, problem.fitted)]
