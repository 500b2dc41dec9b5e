"""Close the loop with measured data: find the residual, trace it to an effect the model lacks, add it, report both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from typing import Any

import numpy as np

from sb3_rpto.effects import Declared, Effect, Simulation
from sb3_rpto.effects.model import file_of
from sb3_rpto.effects.units import units_at
from sb3_rpto.ranges import SEED, THREADS, check, whole
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind, grouped
from sb3_rpto.sysid.hypotheses.column_errors import misread
from sb3_rpto.sysid.hypotheses.conclude import Searched, conclude
from sb3_rpto.sysid.hypotheses.undeclared_mass import undeclared_mass
from sb3_rpto.sysid.problem.data_model_consistency import doubts
from sb3_rpto.sysid.problem.inverse_dynamics import learnable_share, summary
from sb3_rpto.sysid.problem.missing_force import missing_forces
from sb3_rpto.sysid.problem.prepare import Progress, SetUp, prepare
from sb3_rpto.sysid.problem.unsupported_elements import instead
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.diagnostics import (
    above_noise,
    at_bounds,
    brief_delays,
    encoder_zeros,
    finer_steps,
    idle_start,
    missed,
    no_nearer,
    own_steps,
    soft_instead,
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
from sb3_rpto.sysid.selection.confidence_intervals import FINAL, refit
from sb3_rpto.sysid.selection.pipeline import Found, find, worth_a_look
from sb3_rpto.sysid.selection.screening import Screening
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.selection.substitution import Likes
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors, noise_floor

_NEVER = "beside what is kept it lowers the error of unseen windows by nothing clear"
#: Another effect's typical error that is still as good, as a multiple.
AS_WELL = 1.1


def trace(
    model: Any,
    data: Measurements,
    declared: Sequence[str] = (),
    *,
    known: Sequence[Effect] = (),
    seed: int = 0,
    candidates: Sequence[str] | None = None,
    horizon: float | None = None,
    calibrate: int = 0,
    threads: int = 0,
    simulated: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Find out which effect a model lacks to explain measured data.

    The declared parameters are fitted first. Where the errors of the fitted model on unseen windows exceed those that
    the measurement noise alone would leave, all effects of the library are fitted together and eliminated backwards;
    what remains is tested for stability and for likeness with other effects, fitted again and judged on test runs that
    nothing else has seen. The result is the same for the same seed.

    :param model: MJCF path, MJCF text, ``MjSpec``, ``MjModel`` or gymnasium MuJoCo environment
    :param data: recordings
    :param declared: parameters of the model that may be fitted, as :func:`sb3_rpto.effects.declare` takes them
    :param known: effects that the machine is known to have and the model lacks, with their values so far, e.g. those
        that an earlier trace found (``load_corrected(folder).effects``): they are fitted with the declared numbers, and
        nothing asks whether they are needed
    :param seed: of the split, the starts and the resampling
    :param candidates: kinds of effects to look for; default: all that are registered and offered
    :param horizon: length of the windows in s; default: 0.5, or 0.8 where there are less than 15 s of data, shorter
        for short episodes, 0.1 where contacts come and go, and twice that to go on with where what was found leaves
        errors far above the noise
    :param calibrate: recalibrate the threshold of selection on so many sets simulated from the fitted declared model
    :param threads: that simulate; 0: one for each core
    :param simulated: whether the recordings are of the model's own simulator, in its own steps in time; False: that is
        found out where it matters, at the latest when something is left unexplained, which takes a second search
    :param progress: called with the share done and what is being done
    :return: the verdict, the effects, errors before and after, and the corrected model
    :raises ValueError: data and model do not fit together, the data are too few, or an argument is out of range
    :raises TypeError: ``declared`` or ``candidates`` is a string, not a list of them; data that were not read
    """
    _check_arguments(data, seed, candidates, horizon, calibrate, threads)
    say = _steady(progress)

    def prepared(data: Measurements, simulated: bool, kinds: Sequence[str] | None, soft: bool = False) -> SetUp:
        return prepare(model, data, declared, seed, kinds, horizon, threads, known, simulated, soft)

    def search(on: SetUp) -> Found:
        at, finer = partial(on.selectors, say=say), partial(on.finer, say=say)
        stepped = partial(on.in_substeps, say=say)
        return find(at, finer, stepped, on.length, on.longer, seed, calibrate)

    searched = conclude(prepared, search, data, declared, candidates, simulated, threads, seed, say)
    set_up, found, first, zeros = searched.set_up, searched.found, searched.first, searched.zeros
    sigma, fitted = set_up.sigma, set_up.fitted
    selector, selection = found.on.fine, found.selection
    simulation = selector.simulation

    say(0.85, "fitting the final model")
    problem = selector.every_window()
    final, intervals, correlation = refit(selection, problem)
    # Both models are fitted to all these data before they are compared on the test runs, the declared one as recorded.
    recorded = problem if zeros is None else first.on.fine.every_window()
    before = recorded.fit(first.base.fit.values, selector.free(()), iterations=FINAL, crude=0.0)

    say(0.9, "predicting the test runs")
    data = set_up.test if set_up.test.episodes else fitted
    errors_before = horizon_errors(simulation, before.values, data, sigma, seed)
    errors_after = horizon_errors(simulation, final, data, sigma, seed)
    # What an equality constraint transmits is not known from the motion.
    tied = simulation.model.neq > 0
    residuals_before = [] if tied else missing_forces(simulation, before.values, data)
    residuals_after = [] if tied else missing_forces(simulation, final, data)
    unknown = np.full(simulation.model.nv, np.nan)  # where all runs are too short to differentiate
    rounding = data.exact and found.after.adequate  # is all that is left
    floor = noise_floor(simulation, final, data, sigma, seed)
    kept = _kept(selection, simulation, final, intervals, selector.limit(selection.model), seed)
    given = _declared(simulation, final, intervals)
    there = [t.effect for t in (*given, *kept)]
    late = [e for e in there if fitted.idle and e.overrides("command") and e.remembers]
    for effect in late:
        effect.idle = True
    if searched.verdict in SETTLED and found.screening is not None:
        likes = Likes(selector, found.screening)
        fit = problem.score(final)
        kept = [replace(t, stand_ins=_stand_ins(t, selection, likes, problem, fit, intervals)) for t in kept]
    findings = [
        *set_up.findings,
        *_of_the_search(searched),
        *too_short(errors_after, data),
        *_of_the_verdict(searched, problem, final, (errors_before, errors_after, floor), seed),
        *vague_noise(found.after, fitted),
        *undetermined(problem, final, intervals),
        *at_bounds(problem, final, selection.model.effects),
        *strays(selector, final, set_up, found.after, seed),
        *encoder_zeros(simulation.model, [traced.effect for traced in kept]),
        *tied_sensors(simulation.model, [traced.effect for traced in kept]),
        *idle_start(late),
        *brief_delays([traced.effect for traced in kept], fitted.step),
        *unstable(problem, before.values, final),
    ]
    return Report(
        verdict=searched.verdict,
        declared=given,
        effects=kept,
        correlation=_of_these(there, simulation, correlation),
        candidates=_fates(selector, found.screening, selection),
        adequacy_before=first.before,
        adequacy_after=found.after,
        before=errors_before,
        after=errors_after,
        floor=floor,
        force_before=summary(residuals_before) if residuals_before else unknown,
        force_after=summary(residuals_after) if residuals_after else unknown,
        learnable=(
            learnable_share(residuals_after, seed, not data.whole_states)
            if residuals_after and not rounding
            else unknown
        ),
        residuals_before=residuals_before,
        residuals_after=residuals_after,
        findings=grouped(findings),
        zeros=zeros,
        noise=dict(zip(data.columns.qpos, sigma.tolist())),
        runs={
            name: sorted({e.run for e in part.episodes})
            for name, part in (("train", set_up.train), ("select", set_up.select), ("test", set_up.test))
        },
        judged_apart=selector.select is not None,
        threshold=selector.limit(selection.model)[0],
        horizon=selector.horizon,
        seed=seed,
        # As it was: an environment's model may be corrected before the report is saved.
        source=model if set_up.spec is None else (set_up.spec, set_up.nominal),
        file=file_of(model),
        simulation=simulation,
        values_before=before.values,
        values_after=final,
        data=data,
        sigma=sigma,
    )


def _of_the_search(searched: Searched) -> list[Finding]:
    """How it was searched, where that is not as usual."""
    selector, found = searched.found.on.fine, []
    step, usual = (1e3 * float(s.model.opt.timestep) for s in (selector.simulation, searched.set_up.fine))
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


def _of_the_verdict(
    searched: Searched,
    problem: Problem,
    values: np.ndarray,
    errors: tuple[list[HorizonError], list[HorizonError], list[HorizonError]],
    seed: int,
) -> list[Finding]:
    """What a settled verdict may have missed, or what speaks for another reason where it is not settled.

    :param values: of the corrected model, (p,)
    :param errors: before and after, and what noise leaves
    """
    set_up, found = searched.set_up, searched.found
    simulation, sigma, fitted = problem.simulation, set_up.sigma, set_up.fitted
    (before, after, floor), horizon = errors, found.on.fine.horizon
    if searched.verdict in SETTLED:
        return [
            *missed(simulation, values, set_up.test, sigma, seed),
            *(above_noise(after, floor, found.after.ratio, horizon) if set_up.test.episodes else []),
            *own_steps(set_up.nominal, simulation, values, fitted, sigma, horizon),
        ]
    named = found.selection.model.effects
    hints = [
        *doubts(set_up.nominal, fitted),
        *misread(found, set_up),
        *undeclared_mass(found, set_up),
        *finer_steps(problem, values, found.on.fine.free(named), fitted, horizon),
        *(soft_instead(problem, values, named) if not fitted.simulated else []),
    ]
    return [*instead(set_up.nominal, hints, found.after.ratio), *(no_nearer(before, after) if named else [])]


def _steady(progress: Progress | None) -> Progress:
    """Progress that never goes back: steps that come again keep the share that was reached."""
    reached = 0.0

    def say(share: float, what: str) -> None:
        nonlocal reached
        reached = max(reached, share)
        if progress is not None:
            progress(reached, what)

    return say


def _check_arguments(
    data: Measurements, seed: int, candidates: Sequence[str] | None, horizon: Any, calibrate: int, threads: int
) -> None:
    """Refuse what would fail after minutes."""
    if not isinstance(data, Measurements):
        raise TypeError(
            f"data must be Measurements, not {type(data).__name__}; read files by Measurements.from_csv(...)"
        )
    if isinstance(candidates, str):
        raise TypeError(f"candidates must be a list of kinds, not the string {candidates!r}; write [{candidates!r}]")
    number = isinstance(horizon, Real) and not isinstance(horizon, bool)
    if horizon is not None and not (number and 0 < horizon < np.inf):
        raise ValueError(f"horizon is {horizon!r}; give a time in s above 0, or None")
    check({"seed": SEED, "calibrate": whole(0), "threads": THREADS}, locals())


def _declared(simulation: Simulation, values: np.ndarray, intervals: np.ndarray) -> list[Traced]:
    """The declared parameters and the known effects with their fitted values."""
    pairs = zip(simulation.effects, simulation.slices)
    return [
        Traced(e.with_values(values[s]), units_at(e, simulation.model), intervals[:, s], [], 0.0, 0.0, 1.0)
        for e, s in pairs
        if e.known
    ]


def _of_these(effects: Sequence[Effect], simulation: Simulation, correlation: np.ndarray) -> np.ndarray:
    """Rows and columns of the parameters of these effects, in their order."""
    rows = {e.label: range(len(correlation))[s] for e, s in zip(simulation.effects, simulation.slices)}
    order = [row for effect in effects for row in rows[effect.label]]
    return np.asarray(correlation[np.ix_(order, order)])


def _kept(
    selection: Selection,
    simulation: Simulation,
    values: np.ndarray,
    intervals: np.ndarray,
    limit: tuple[float, float],
    seed: int,
) -> list[Traced]:
    """The effects that the model lacks, with their fitted values and the evidence for them."""
    rng = np.random.default_rng(seed)
    found = []
    for i in selection.model.effects:
        evidence, s = selection.evidence[i], simulation.slices[i]
        alike = [simulation.effects[j].label for j in selection.alike.get(i, [])]
        effect = simulation.effects[i].with_values(values[s])
        frequency = evidence.frequency(limit, rng)
        units = units_at(effect, simulation.model)
        found.append(Traced(effect, units, intervals[:, s], alike, evidence.gain, evidence.t, frequency))
    return found


def _stand_ins(
    traced: Traced, selection: Selection, likes: Likes, problem: Problem, final: Fit, intervals: np.ndarray
) -> list[StandIn]:
    """Those of an effect's class that meet the same windows as well, and what else changes with them."""
    simulation = problem.simulation
    (kept,) = (i for i in selection.model.effects if simulation.effects[i].label == traced.label)
    free = {i for i, e in enumerate(simulation.effects) if e.known or i in selection.model.effects} - {kept}
    found = []
    for other in selection.alike.get(kept, []):
        fit = likes.instead(selection.model, kept, other, problem, final.starts)
        if np.median(fit.errors) > AS_WELL * np.median(final.errors):  # led astray, or too rich for these data
            continue
        moved = {}
        for i in sorted(free):
            effect, s = simulation.effects[i], simulation.slices[i]
            for p, value, was, (low, high) in zip(effect.parameters, fit.values[s], final.values[s], intervals[:, s].T):
                # Intervals of exact data are as narrow as rounding.
                if (value < low or value > high) and descriptions.number(value) != descriptions.number(was):
                    moved[effect.label if isinstance(effect, Declared) else f"{effect.label} {p.name}"] = float(value)
        there = simulation.effects[other].with_values(fit.values[simulation.slices[other]])
        found.append(StandIn(there, units_at(there, simulation.model), moved))
    return found


def _fates(selector: Selector, screening: Screening | None, selection: Selection) -> list[Candidate]:
    """What became of each candidate."""
    effects = selector.simulation.effects
    candidates = [(i, e) for i, e in enumerate(effects) if not e.known]
    if screening is None:
        return [Candidate(e.label, "not needed", "the declared model is complete", 0.0) for _, e in candidates]
    labels, tried = [e.label for e in effects], worth_a_look(selector, screening)
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
