"""Transitions that pass for the model's own steps in time were made by finer ones."""

from __future__ import annotations

import numpy as np

from sb3_rpto.effects import Simulation
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import cut, noise_levels


class FinerSteps(Hypothesis):
    """Exact states come from a simulator that moves more finely than the model does."""

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """Whether the model errs far less with shorter steps in time."""
        data, own, settings = problem.fitted, fit.problem.simulation, problem.settings.hypotheses
        if not data.exact:
            return []
        model = own.model.__copy__()
        model.opt.timestep /= problem.settings.problem.finer_steps
        finer = Simulation(model, own.effects, own.nthread)
        windows = cut(model, data, noise_levels(data), fit.horizon, settings.step_windows)
        with_finer = Problem(finer, windows, fit.problem.scales).fit(
            fit.values, fit.free, iterations=settings.iterations
        )
        fits = with_finer, fit.problem.score(fit.values)
        finer_error, error = (float(np.median(found.errors)) for found in fits)
        if finer_error >= settings.told_share * error:
            return []
        message = (
            f"with steps of {1e3 * model.opt.timestep:.3g} ms in place of {1e3 * own.model.opt.timestep:.3g} ms the "
            f"model errs by {finer_error / error:.0%} of what it does: the target moves more finely than the model "
            "does, as a machine or another simulator; shorten the timestep in the MJCF's <option>, and raise "
            "frame_skip in proportion"
        )
        return [Finding(FindingKind.TIME_STEP, "the model", message)]
