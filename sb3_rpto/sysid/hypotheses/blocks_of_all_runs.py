"""The runs set apart to select on cannot tell what is missing in the others."""

from __future__ import annotations

from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.adequacy import adequacy
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS


class BlocksOfAllRuns(Hypothesis):
    """Runs set apart to judge on pass what fails on those fitted to: blocks of all runs take turns instead."""

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Whether the runs set apart are adequate by themselves, and all together are not."""
        select, values = result.on.fine.select, result.selection.model.fit.values
        if result.substeps is not None or select is None or result.after.adequate:
            return False
        fit, settings = select.score(values, iterations=START_STEPS), problem.settings.adequacy
        return adequacy(select, fit, problem.inputs.seed, settings).adequate

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """The same with no run set apart to select on."""
        return problem.with_blocks_of_all_runs()

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding:
        """How the data are split."""
        message = (
            "the runs set apart to select on do not show what is missing in the others: blocks of all of them take "
            "turns"
        )
        return Finding(FindingKind.SPLIT, "fitted runs", message)
