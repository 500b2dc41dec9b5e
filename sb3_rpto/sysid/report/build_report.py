"""From what was found to the report on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sb3_rpto.effects import Declared, Effect
from sb3_rpto.effects.model import file_of
from sb3_rpto.effects.units import units_at
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind, grouped
from sb3_rpto.sysid.hypotheses.alternatives import hints
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual, learnable_share, summary
from sb3_rpto.sysid.problem.missing_force import missing_forces
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.problem.unsupported_elements import weigh_hints
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.diagnostics import (
    above_noise,
    at_bounds,
    brief_delays,
    encoder_zeros,
    idle_start,
    missed,
    no_nearer,
    own_steps,
    strays,
    tied_sensors,
    too_short,
    undetermined,
    unstable,
    vague_noise,
)
from sb3_rpto.sysid.report.report import Report
from sb3_rpto.sysid.report.results import Candidate, StandIn, Traced
from sb3_rpto.sysid.selection.adequacy import SETTLED
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.screening import Screening
from sb3_rpto.sysid.selection.search import SearchResult, single_candidates
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.selection.substitution import Substitution
from sb3_rpto.sysid.shooting.multiple_shooting import Fit
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors, noise_floor

_NEVER = "beside what is kept it lowers the error of unseen windows by nothing clear"
#: Another effect's typical error that is still as good, as a multiple.
AS_WELL = 1.1


@dataclass(frozen=True)
class Predictions:
    """Errors on runs that nothing was fitted to, or on the fitted ones where none is set apart.

    :param data: those runs
    :param before: errors of the declared model
    :param after: of the corrected model
    :param floor: what noise alone leaves
    :param forces_before: that the declared model lacks; empty where they do not show
    :param forces_after: that the corrected model lacks
    """

    data: Measurements
    before: list[HorizonError]
    after: list[HorizonError]
    floor: list[HorizonError]
    forces_before: list[ForceResidual]
    forces_after: list[ForceResidual]


def predict(problem: IdentificationProblem, fit: FinalFit) -> Predictions:
    """Predict the test runs by the declared and by the corrected model."""
    problem.inputs.say(0.9, "predicting the test runs")
    simulation, sigma, seed = fit.problem.simulation, problem.sigma, problem.inputs.seed
    data = problem.test if problem.test.episodes else problem.fitted
    before, after = (horizon_errors(simulation, values, data, sigma, seed) for values in (fit.declared, fit.values))
    # What an equality constraint transmits is not known from the motion.
    tied = simulation.model.neq > 0
    forces = ([] if tied else missing_forces(simulation, values, data) for values in (fit.declared, fit.values))
    return Predictions(data, before, after, noise_floor(simulation, fit.values, data, sigma, seed), *forces)


def build_report(
    problem: IdentificationProblem, result: SearchResult, verdict: str, fit: FinalFit, predictions: Predictions
) -> Report:
    """The report on a problem, with what a reader of its verdict must know."""
    selector, selection, simulation = result.on.fine, result.selection, fit.problem.simulation
    data, seed = predictions.data, problem.inputs.seed
    limit = selector.limit(selection.model)
    kept, given = _kept(selection, fit, limit, seed), _declared(fit)
    there = [traced.effect for traced in (*given, *kept)]
    late = [e for e in there if problem.data.idle and e.overrides("command") and e.remembers]
    for effect in late:
        effect.idle = True
    if verdict in SETTLED and result.screening is not None:
        substitution, scored = Substitution(selector, result.screening), fit.problem.score(fit.values)
        kept = [replace(t, stand_ins=_stand_ins(t, selection, substitution, fit, scored)) for t in kept]
    named = [traced.effect for traced in kept]
    findings = [
        *problem.findings,
        *_about_the_search(problem, result),
        *too_short(predictions.after, data),
        *_about_the_verdict(problem, result, verdict, fit, predictions),
        *vague_noise(result.after, problem.fitted),
        *undetermined(fit.problem, fit.values, fit.intervals),
        *at_bounds(fit.problem, fit.values, fit.named),
        *strays(selector, fit.values, problem, result.after, seed),
        *encoder_zeros(simulation.model, named),
        *tied_sensors(simulation.model, named),
        *idle_start(late),
        *brief_delays(named, problem.fitted.step),
        *unstable(fit.problem, fit.declared, fit.values),
    ]
    unknown = np.full(simulation.model.nv, np.nan)  # where all runs are too short to differentiate
    before, after = predictions.forces_before, predictions.forces_after
    rounding = data.exact and result.after.adequate  # is all that is left
    return Report(
        verdict=verdict,
        declared=given,
        effects=kept,
        correlation=_of_these(there, fit),
        candidates=_fates(selector, result.screening, selection),
        adequacy_before=result.first.before,
        adequacy_after=result.after,
        before=predictions.before,
        after=predictions.after,
        floor=predictions.floor,
        force_before=summary(before) if before else unknown,
        force_after=summary(after) if after else unknown,
        learnable=learnable_share(after, seed, not data.whole_states) if after and not rounding else unknown,
        residuals_before=before,
        residuals_after=after,
        findings=grouped(findings),
        zeros=problem.offsets,
        noise=dict(zip(data.columns.qpos, problem.sigma.tolist())),
        runs={name: sorted({e.run for e in part}) for name, part in problem.split._asdict().items()},
        judged_apart=selector.select is not None,
        threshold=limit[0],
        horizon=selector.horizon,
        seed=seed,
        # As it was: an environment's model may be corrected before the report is saved.
        source=problem.inputs.model if problem.spec is None else (problem.spec, problem.nominal),
        file=file_of(problem.inputs.model),
        simulation=simulation,
        values_before=fit.declared,
        values_after=fit.values,
        data=data,
        sigma=problem.sigma,
    )


def _about_the_search(problem: IdentificationProblem, result: SearchResult) -> list[Finding]:
    """How it was searched, where that is not as usual."""
    selector, found = result.on.fine, []
    step, usual = (1e3 * float(s.model.opt.timestep) for s in (selector.simulation, problem.fine))
    if step < usual:
        message = (
            f"judged with steps of {step:g} ms: longer ones err by a good part of what is left (dry friction and "
            "contacts are kinks); the corrected simulator errs less with a smaller timestep, too"
        )
        found.append(Finding(FindingKind.TIME_STEP, "model", message))
    if selector.select is None:
        count = len(selector.train.windows)
        message = f"selected on {count} windows of the training runs by cross-validation over blocks"
        found.append(Finding(FindingKind.SPLIT, "training runs", message))
    return found


def _about_the_verdict(
    problem: IdentificationProblem, result: SearchResult, verdict: str, fit: FinalFit, predictions: Predictions
) -> list[Finding]:
    """What a settled verdict may have missed, or what speaks for another reason where it is not settled."""
    simulation, sigma, seed, horizon = fit.problem.simulation, problem.sigma, problem.inputs.seed, fit.horizon
    if verdict in SETTLED:
        after, floor = predictions.after, predictions.floor
        return [
            *missed(simulation, fit.values, problem.test, sigma, seed),
            *(above_noise(after, floor, result.after.ratio, horizon) if problem.test.episodes else []),
            *own_steps(problem.nominal, simulation, fit.values, problem.fitted, sigma, horizon),
        ]
    small = problem.settings.adequacy.small
    found = weigh_hints(problem.nominal, hints(problem, result, fit), result.after.ratio, small)
    return [*found, *(no_nearer(predictions.before, predictions.after) if fit.named else [])]


def _declared(fit: FinalFit) -> list[Traced]:
    """The declared parameters and the known effects with their fitted values."""
    simulation = fit.problem.simulation
    return [
        Traced(e.with_values(fit.values[s]), units_at(e, simulation.model), fit.intervals[:, s], [], 0.0, 0.0, 1.0)
        for e, s in zip(simulation.effects, simulation.slices)
        if e.known
    ]


def _of_these(effects: Sequence[Effect], fit: FinalFit) -> np.ndarray:
    """Rows and columns of the correlations of the parameters of these effects, in their order."""
    simulation, correlation = fit.problem.simulation, fit.correlation
    rows = {e.label: range(len(correlation))[s] for e, s in zip(simulation.effects, simulation.slices)}
    order = [row for effect in effects for row in rows[effect.label]]
    return np.asarray(correlation[np.ix_(order, order)])


def _kept(selection: Selection, fit: FinalFit, limit: tuple[float, float], seed: int) -> list[Traced]:
    """The effects that the model lacks, with their fitted values and the evidence for them."""
    rng, simulation = np.random.default_rng(seed), fit.problem.simulation
    found = []
    for i in selection.model.effects:
        evidence, s = selection.evidence[i], simulation.slices[i]
        alike = [simulation.effects[j].label for j in selection.alike.get(i, [])]
        effect = simulation.effects[i].with_values(fit.values[s])
        frequency = evidence.frequency(limit, rng)
        units = units_at(effect, simulation.model)
        found.append(Traced(effect, units, fit.intervals[:, s], alike, evidence.gain, evidence.t, frequency))
    return found


def _stand_ins(
    traced: Traced, selection: Selection, substitution: Substitution, fit: FinalFit, final: Fit
) -> list[StandIn]:
    """Those of an effect's class that meet the same windows as well, and what else changes with them."""
    simulation = fit.problem.simulation
    (kept,) = (i for i in selection.model.effects if simulation.effects[i].label == traced.label)
    free = {i for i, e in enumerate(simulation.effects) if e.known or i in selection.model.effects} - {kept}
    found = []
    for other in selection.alike.get(kept, []):
        swapped = substitution.fit_instead(selection.model, kept, other, fit.problem, final.starts)
        if np.median(swapped.errors) > AS_WELL * np.median(final.errors):  # led astray, or too rich for these data
            continue
        moved = {}
        for i in sorted(free):
            effect, s = simulation.effects[i], simulation.slices[i]
            bounds = fit.intervals[:, s].T
            for p, value, was, (low, high) in zip(effect.parameters, swapped.values[s], final.values[s], bounds):
                # Intervals of exact data are as narrow as rounding.
                if (value < low or value > high) and descriptions.number(value) != descriptions.number(was):
                    moved[effect.label if isinstance(effect, Declared) else f"{effect.label} {p.name}"] = float(value)
        there = simulation.effects[other].with_values(swapped.values[simulation.slices[other]])
        found.append(StandIn(there, units_at(there, simulation.model), moved))
    return found


def _fates(selector: Selector, screening: Screening | None, selection: Selection) -> list[Candidate]:
    """What became of each candidate."""
    effects = selector.simulation.effects
    candidates = [(i, e) for i, e in enumerate(effects) if not e.known]
    if screening is None:
        return [Candidate(e.label, "not needed", "the declared model is complete", 0.0) for _, e in candidates]
    labels, tried = [e.label for e in effects], single_candidates(selector, screening)
    return [_candidate(i, e, screening, selection, labels, tried) for i, e in candidates]


def _candidate(
    i: int, effect: Effect, screening: Screening, selection: Selection, labels: list[str], tried: list[int]
) -> Candidate:
    sensitivity = float(screening.sensitivity[i])
    alike = [labels[j] for j in screening.alike(i)]
    if i in selection.model.effects:
        return Candidate(effect.label, "kept", "its removal raises the error of the select windows", sensitivity, alike)
    for kept, others in selection.alike.items():
        if i in others:
            return Candidate(effect.label, "alike", f"explains the data as well as {labels[kept]}", sensitivity, alike)
    declared = screening.taken[i]
    if declared is not None:
        return Candidate(effect.label, "alike", f"{labels[declared]} does the same", sensitivity, alike)
    if not screening.excited(i):
        return Candidate(effect.label, "not excited", f"to see it: {effect.excite}", sensitivity, alike)
    if i in selection.dropped:
        step, evidence = selection.dropped[i]
        together = sum(of == step for of, _ in selection.dropped.values()) - 1
        what = "removal" if not step or not together else f"removal together with {together} other(s)"
        why = f"{what} costs {evidence.gain:+.1%} of the error (t = {evidence.t:.1f})"
        when = f"step {step}" if step else "at the end"
        return Candidate(effect.label, "dropped", f"{when}: {why}", sensitivity, alike)
    in_its_place = [labels[j] for j in screening.alike(i) if j in tried]
    why = _NEVER if i in tried else f"looks like {in_its_place[0]}, which was tried"
    return Candidate(effect.label, "dropped", why, sensitivity, alike)
