"""Recordings that turn out to come from a simulator's own steps in time."""

from __future__ import annotations

import numpy as np

from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis, kept_effects
from sb3_rpto.sysid.problem.data_origin import are_exact_states, find_origin, may_be_exact
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.search import SearchResult, SelectorPair, resume_search

#: What was assumed of friction and of kinds is asked anew where the recordings are of another origin.
ANEW = {"kinds": None, "soft_friction": False}


class SimulatorSubsteps(Hypothesis):
    """They are of the model's integrator in steps that are a whole part of the model's."""

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where the search met them better in such steps."""
        return result.substeps is not None

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """The recordings read in those steps."""
        return problem.assuming(simulated=True, substeps=result.substeps, **ANEW)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where they explain, or nothing does."""
        return alternative.explains or not result.explains

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding:
        """Which steps."""
        step = 1e3 * alternative.nominal.opt.timestep / alternative.data.substeps
        message = (
            f"from the model's integrator in steps of {step:g} ms, as a simulator's are: it meets them better than the "
            "continuous motion does"
        )
        return Finding(FindingKind.SIMULATED, "fitted runs", message)


class OtherSubsteps(Hypothesis):
    """They are of steps of another length than those that seemed to meet them best before anything was found.

    What was still missing then may have led that choice astray, such as friction that gives way near rest.
    """

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where something was found in a simulator's steps."""
        return problem.data.simulated and bool(result.selection.model.effects)

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem | None:
        """The recordings in the steps that meet them best with what was found; None where they are read so already."""
        settings, found = problem.settings.selection, result.selection.model
        best, least = None, -np.log(1 - settings.substeps_gain)
        for substeps in settings.substeps:
            if substeps == problem.data.substeps:
                continue
            problem.inputs.say(0.0, "judging in a simulator's own steps")
            other = problem.assuming(substeps=substeps)
            windows = SelectorPair.on(other, result.on.horizon, result.on.settings).fine
            begin = windows.train.score(found.fit.values)
            fitted = windows.fit_model(found.effects, begin, iterations=settings.substeps_iterations)
            saved = -float(np.mean(np.log(fitted.fit.errors / found.fit.errors)))
            if saved > least:
                best, least = other, saved
        return best

    def search(
        self, alternative: IdentificationProblem, result: SearchResult
    ) -> tuple[IdentificationProblem, SearchResult]:
        """The search goes on from what was found."""
        return alternative, resume_search(alternative, result)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where they explain as well."""
        return alternative.explains or not result.explains


class SimulatorSteps(Hypothesis):
    """They are of the model's own steps in time.

    What is missing errs as much in one kind of steps as in another; with it in the model they can be told apart.
    """

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where something was found that does not explain, and with it the model's own steps meet them better."""
        if result.explains or not result.selection.model.effects:
            return False
        asked, known = problem.inputs, kept_effects(result)
        parameters = (asked.declared, problem.sigma, problem.length, asked.threads, known, problem.settings)
        return find_origin(problem.nominal, problem.fitted, *parameters) != "machine"

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """The recordings read in the model's own steps."""
        return problem.assuming(simulated=True, **ANEW)

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding:
        """When that showed."""
        message = "from the model's own steps in time, as shows with what was found first; searched again in such steps"
        return Finding(FindingKind.SIMULATED, "fitted runs", message)


class ExactStates(Hypothesis):
    """They are a simulator's states without noise, which slow samples under commands that jump let pass for noisy."""

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where noise cannot be told from motion, and nothing explains them or what does meets them exactly.

        Wrong numbers may explain recordings without noise that were taken for noisy ones.
        """
        if not may_be_exact(problem.inputs.data, problem.settings.consistency.slow_step):
            return False
        if not result.explains:
            return True
        asked = problem.inputs
        parameters = (asked.declared, problem.length, asked.threads, kept_effects(result), problem.settings)
        return are_exact_states(problem.nominal, problem.fitted, *parameters)

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem:
        """The recordings read as exact states."""
        return problem.assuming(exact=True, **ANEW)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where they are explained so."""
        return alternative.explains

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding:
        """When that showed."""
        message = "from the model's own steps in time, without noise, as shows with what was found: searched again"
        return Finding(FindingKind.SIMULATED, "fitted runs", message)
