"""What a reader of a verdict must know beside it: what the fits leave open, and where the data contradict them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sb3_rpto.effects import Declared, Effect, Scales, Simulation
from sb3_rpto.effects.actuation import servo_of
from sb3_rpto.effects.units import joint_of
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind, listed
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.selection.adequacy import Adequacy
from sb3_rpto.sysid.selection.stepwise_selection import Selector
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS, Problem
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors, noise_floor, observed, predictions
from sb3_rpto.sysid.shooting.windows import cut

JOINT, SLIDE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtJoint.mjJNT_SLIDE)
#: Test runs that err by so many times their noise are told; over all of them together none of the benchmark's 187
#: settled sets with noise did by above 2.9, and single runs of 20 complete ones with their true values by at most 1.4.
MISSED = 5.0
#: Windows count as stray, too, only where they err by so many times the typical error.
APART = 3.0
#: A declared number whose interval is wider than this share of itself and of its nominal value is not determined: it
#: spans an order of magnitude. (Where both are next to nothing: of what is plausible.)
VAGUE = 0.9
#: What passes for noise is not all noise where R, at the upper end of its interval, is below this.
LOOSE = 0.9
#: Share by which test runs must be predicted worse to be told.
WORSE = 0.05
#: Most windows that steps in time are compared in.
STEPPED = 40
#: A delay of less than this share of the time between two samples is told: clocks and integrators have such, too.
BRIEF = 0.05


def missed(
    simulation: Simulation, values: np.ndarray, data: Measurements, sigma: np.ndarray, seed: int
) -> list[Finding]:
    """Runs in which a model errs far more than noise would; each for itself, so that others do not hide it.

    The floor knows the noise of smoothed starts, not what smoothing shifts them by where commands change at every
    sample and the joint is light: a run must be missed from fitted starts, too.

    :param values: parameters of a model that accounts for the runs that it was fitted to
    :param data: runs that nothing was fitted to
    """
    found = []
    for run in sorted({e.run for e in data.episodes}):
        one = replace(data, episodes=[e for e in data.episodes if e.run == run])
        floor = noise_floor(simulation, values, one, sigma, seed)
        after = horizon_errors(simulation, values, one, sigma, seed) if floor else []
        errors = {error.horizon: error.rmse for error in after}
        ratios = [errors[level.horizon] / level.rmse for level in floor]
        if not ratios or np.max(ratios) < MISSED:
            continue
        longest = float(floor[-1].horizon)
        if _from_fitted_starts(simulation, values, one, sigma, longest) > MISSED:
            row, column = np.unravel_index(np.argmax(ratios), np.shape(ratios))
            found.append((float(np.max(ratios)), run, floor[row].joints[column], floor[row].horizon))
    runs = sorted(run for _, run, *_ in found)
    if not runs:
        return []
    ratio, _, joint, horizon = max(found)
    message = (
        f"{joint} errs {ratio:.0f} times what noise leaves in {horizon:g} s, though the model accounts for the runs "
        "that it was fitted to: a test run differs (a moved sensor, another load), or moves as none of those did; the "
        "verdict is about those"
    )
    return [Finding(FindingKind.MISSED, listed(runs), message, tuple(runs))]


def _from_fitted_starts(
    simulation: Simulation, values: np.ndarray, data: Measurements, sigma: np.ndarray, horizon: float
) -> float:
    """Root mean squared error over a horizon in units of the noise, the windows' starts fitted."""
    windows = cut(simulation.model, data, sigma, horizon, STEPPED)
    fit = Problem(simulation, windows, [Scales()] * len(simulation.effects)).score(values, iterations=START_STEPS)
    return float(np.sqrt(np.mean(fit.errors**2)))


def above_noise(after: list[HorizonError], floor: list[HorizonError], ratio: float, length: float) -> list[Finding]:
    """Whether a model that passes for adequate, as its few windows say little, errs clearly more than noise would.

    :param after: errors of the model on the test runs
    :param floor: what noise alone leaves there
    :param ratio: R, the same on the windows that decided
    :param length: of those windows in s. Over much shorter ones counts what smoothing shifts the starts by, which is
        no part of the floor
    """
    errors = {error.horizon: error.low for error in after}
    long = [level for level in floor if float(level.horizon) >= length / 2]
    clear = [level for level in long if np.any(errors[level.horizon] > level.high)]
    if ratio <= 1 + DEFAULTS.adequacy.tolerance or not clear:
        return []
    message = (
        f"R is {ratio:.2f}, and in {clear[0].horizon:g} s the test runs err clearly more than noise leaves: so few "
        "windows cannot rule out that something small is missing, or that what is named stands in for it; record more"
    )
    return [Finding(FindingKind.FEW_WINDOWS, "test runs", message)]


def vague_noise(after: Adequacy, data: Measurements) -> list[Finding]:
    """Whether what passes for noise is mostly something else, so that an adequate model may lack what it hides.

    :param after: of the final model
    :param data: to fit to
    """
    if data.whole_states or after.high >= LOOSE:
        return []
    message = (
        f"predictions err by far less than the sensors' noise as it was estimated ({after}): motion between samples "
        "passes for noise, as after commands that change every few of them, and what is missing may hide below it; "
        "sample faster, or hold commands for more samples"
    )
    return [Finding(FindingKind.VAGUE_NOISE, "fitted runs", message)]


def strays(
    selector: Selector, values: np.ndarray, task: IdentificationProblem, after: Adequacy, seed: int
) -> list[Finding]:
    """Windows that the final model misses by far, run by run: one that stalled or was touched leaves them.

    :param values: of that model, (p,)
    :param after: its adequacy
    """
    parts = [(selector.train, task.fitted)] + ([(selector.select, task.select)] if selector.select else [])
    fits = [problem.score(values) for problem, _ in parts]
    errors = np.concatenate([fit.errors for fit in fits])
    noise = np.concatenate([problem.noise_errors(fit, seed).ravel() for (problem, _), fit in zip(parts, fits)])
    limit = max(after.settings.stray_factor * float(np.quantile(noise, 0.99)), APART * float(np.median(errors)))
    runs = np.array([data.episodes[i].run for problem, data in parts for i in problem.windows.episode])
    stray = errors > limit
    whole = [run for run in sorted({*runs[stray]}) if stray[runs == run].mean() > 0.5]
    groups = [(run, runs == run) for run in whole] + [("", ~np.isin(runs, whole))]
    times = np.concatenate([problem.windows.time for problem, _ in parts])
    found = []
    for run, rows in groups:
        if stray[rows].any():
            worst = int(np.flatnonzero(rows)[errors[rows].argmax()])
            message = (
                f"{stray[rows].sum()} of {rows.sum()} windows err far more than the others, most the one at "
                f"{times[worst]:.3g} s{'' if run else f' of {runs[worst]}'}; fits give them little weight (robust loss)"
            )
            if after.denied_by_strays:
                message += "; such windows alone deny that the model accounts for the data: see what happens there"
            kind, where = FindingKind.STRAY_WINDOWS, "fitted runs"
            found.append(Finding.of_run(kind, run, "", message) if run else Finding(kind, where, message))
    return found


def undetermined(problem: Problem, values: np.ndarray, intervals: np.ndarray) -> list[Finding]:
    """What was given of which the data say next to nothing: where nothing moves, or where several act alike."""
    found = []
    owners = [(e, p) for e in problem.simulation.effects for p in e.parameters]
    for i in np.flatnonzero(problem.known & problem.simulation.strength):
        (effect, parameter), value, (low, high) = owners[i], float(values[i]), intervals[:, i]
        scale = max(abs(value), abs(float(problem.null[i])) or float(problem.size[i]))
        if not high - low <= VAGUE * scale:  # nor where there is no interval
            is_number = isinstance(effect, Declared)
            where = f"declared {effect.label}" if is_number else f"known {effect.label}, {parameter.name}"
            message = (
                f"{value:.4g} {descriptions.interval(low, high)}: these data do not tell it; move so that it matters, "
                f"do not {'declare it, or declare' if is_number else 'give it, or give'} fewer that act alike"
            )
            found.append(Finding(FindingKind.UNDETERMINED, where, message))
    return found


def at_bounds(problem: Problem, values: np.ndarray, named: Sequence[int]) -> list[Finding]:
    """What was fitted and ends at a bound that it did not begin at; nothing is below 0 of what cannot be negative.

    :param named: indices of the effects that are kept
    """
    found = []
    effects = problem.simulation.effects
    owners = [(i, e, p) for i, e in enumerate(effects) for p in e.parameters]
    there = (values <= problem.lower) | (values >= problem.upper)
    for at in np.flatnonzero(there & (values != 0) & (values != problem.null)):
        i, effect, parameter = owners[at]
        if not (effect.known or i in named):
            continue
        message = f"{values[at]:.4g} is its bound; "
        if isinstance(effect, Declared):
            where = f"declared {effect.label}"
            message += f"where the machine may lie beyond, give wider ones ({effect.label}=low:high)"
        elif effect.known:
            where = f"known {effect.label}, {parameter.name}"
            message += "where the machine may lie beyond, give wider ones"
        else:
            where = f"{effect.label}, {parameter.name}"
            message += "the machine may lie beyond, or it stands in for something else"
        found.append(Finding(FindingKind.AT_ITS_BOUND, where, message))
    return found


def own_steps(
    nominal: mujoco.MjModel,
    simulation: Simulation,
    values: np.ndarray,
    data: Measurements,
    sigma: np.ndarray,
    horizon: float,
) -> list[Finding]:
    """Where the corrected simulator errs by its own steps in time more than the sensors do.

    :param nominal: the model as it was given, which integrates as the saved one will
    :param simulation: integrates finely, as a machine does
    :param values: parameters, (p,)
    :param horizon: length of the predictions in s
    """
    if data.exact or (data.simulated and data.substeps == 1):
        return []
    predicted = []
    for one in (simulation, Simulation(nominal, simulation.effects, simulation.nthread)):
        windows = cut(one.model, data, sigma, horizon, STEPPED)
        predicted.append(predictions(one, values, windows)[0])
    apart, noise = np.sqrt(np.mean((predicted[1] - predicted[0]) ** 2, axis=(0, 1))), windows.sigma
    worst = int(np.argmax(apart / noise))
    if apart[worst] <= noise[worst]:
        return []
    integrator = mujoco.mjtIntegrator(nominal.opt.integrator).name.removeprefix("mjINT_")
    message = (
        f"with its own ({integrator}, {nominal.opt.timestep:g} s) the corrected simulator goes {apart[worst]:.2g} "
        f"astray in {horizon:g} s at {observed(data)[worst]}, where the noise is {noise[worst]:.2g}; the errors "
        'after are of finer ones: integrator="RK4" or a shorter timestep in the MJCF\'s <option> keeps them'
    )
    return [Finding(FindingKind.OWN_STEPS, "corrected simulator", message)]


def no_nearer(before: Sequence[HorizonError], after: Sequence[HorizonError]) -> list[Finding]:
    """Effects that do not explain, and with which runs that nothing was fitted to are predicted worse."""
    pairs = [(b, a) for b, a in zip(before, after) if isinstance(b.horizon, float)]
    if not pairs or not np.mean([np.log(a.rmse / b.rmse).mean() for b, a in pairs]) > np.log(1 + WORSE):
        return []
    b, a = max(pairs, key=lambda pair: float((pair[1].rmse / pair[0].rmse).max()))
    worst = int(np.argmax(a.rmse / b.rmse))
    message = (
        f"predicted worse with what is listed (worst for {b.joints[worst]}, {b.horizon:g} s ahead: {b.rmse[worst]:.3g} "
        f"before, {a.rmse[worst]:.3g} after): it stands in for something else; do not use the corrected simulator"
    )
    return [Finding(FindingKind.NO_NEARER, "test runs", message)]


def encoder_zeros(model: mujoco.MjModel, named: Sequence[Effect]) -> list[Finding]:
    """Constant torques that may be a zero of the recording's own: a position servo regulates its encoder.

    Effects of sensors are the encoder's. Where something else measured the joint, with a zero that is off by b, the
    servo seems to pull by g² kp b, with g the gear.
    """
    found = []
    for effect in named:
        joint = joint_of(effect, model)
        there = (model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == JOINT)
        servos = [i for i in range(model.nu) if there[i] and servo_of(model, i) == "position"]
        if effect.kind != "torque_offset" or not servos:
            continue
        stiffness = sum(model.actuator_gear[i, 0] ** 2 * model.actuator_gainprm[i, 0] for i in servos)
        message = (
            "a position servo acts there: where the recorded position is not of the servo's own encoder, two zeros "
            f"that differ by {float(effect.values[0]) / stiffness:.3g} "
            f"{'m' if model.jnt_type[joint] == SLIDE else 'rad'} look like this, too, with nothing wrong with the "
            "torque; check the zeros"
        )
        found.append(Finding(FindingKind.ENCODER_ZERO, effect.label, message))
    return found


def tied_sensors(model: mujoco.MjModel, named: Sequence[Effect]) -> list[Finding]:
    """Faults of sensors at joints that an equality ties: another ratio or offset of the tie shows as such ones do."""
    tied = {
        int(joint)
        for i in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & model.eq_active0.astype(bool))
        for joint in (model.eq_obj1id[i], model.eq_obj2id[i])
    }
    message = (
        "an equality constraint ties this joint: where its polycoef is off, the sensors seem to be, and declared "
        "numbers beside them lie outside of their intervals; check the tie"
    )
    return [
        Finding(FindingKind.TIED_SENSOR, effect.label, message)
        for effect in named
        if effect.overrides("observe") and joint_of(effect, model) in tied
    ]


def idle_start(late: Sequence[Effect]) -> list[Finding]:
    """What is late acts on zeros when a run begins, see :func:`sb3_rpto.sysid.problem.data_origin.begins_idle`.

    :param late: effects that are so
    """
    message = "the runs begin as if zeros had been sent before, and so do episodes of the corrected simulator"
    return [Finding(FindingKind.IDLE_START, ", ".join(e.label for e in late), message)] if late else []


def brief_delays(named: Sequence[Effect], step: float) -> list[Finding]:
    """Delays that are small beside the time between two samples: time stamps and steps in time look like them.

    :param step: time between two samples in s
    """
    found = []
    for effect in named:
        delay = effect.to_json()["values"].get("delay", np.inf)
        if delay < BRIEF * step:
            message = (
                f"{1e3 * delay:.2g} ms are {delay / step:.1%} of the {1e3 * step:.3g} ms between two samples: time "
                f"stamps that are late by as much look like this, and a simulator that steps {2e3 * delay:.2g} ms"
            )
            found.append(Finding(FindingKind.BRIEF_DELAY, effect.label, message))
    return found


def too_short(errors: list[HorizonError], data: Measurements) -> list[Finding]:
    """That no run is long enough to tell an error."""
    if errors:
        return []
    length = 1e3 * max((float(np.ptp(e.time)) for e in data.episodes), default=0.0)
    message = f"no error on unseen runs: the longest stretch of theirs has {length:.3g} ms; set longer runs apart"
    return [Finding(FindingKind.SPLIT, "test runs", message)]


def unstable(problem: Problem, before: np.ndarray, after: np.ndarray) -> list[Finding]:
    """Windows in which a model became unstable, with the values (p,) of the declared and of the corrected one."""
    found = []
    for which, values, remedy in (
        ("fitted declared", before, "its errors before say no more; give bounds to what you declare"),
        ("corrected", after, "lower its timestep"),
    ):
        count = problem.unstable(values)
        if count:
            message = f"in {count} of {len(problem.windows)} the {which} model became unstable; {remedy}"
            found.append(Finding(FindingKind.UNSTABLE, "fitted windows", message))
    return found
