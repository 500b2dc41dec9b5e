"""What can be wrong between a model and the recordings of the machine that it stands for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.ndimage import binary_erosion
from scipy.signal import savgol_filter

from sb3_rpto.effects import Declared, Simulation
from sb3_rpto.effects.actuation import FILTERS
from sb3_rpto.effects.batch import MujocoBatch
from sb3_rpto.effects.names import near, object_id, object_names
from sb3_rpto.effects.simulation import prepare
from sb3_rpto.sysid.data.columns import columns_of, joint_of
from sb3_rpto.sysid.data.inverse_dynamics_terms import actuator_forces, filter_length, filtered_force, required_forces
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.repairs import check_degrees, large_angles
from sb3_rpto.sysid.data.signal_quality import smoothed_velocity
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint
from sb3_rpto.sysid.problem.unsupported_elements import mocap_bodies, moved_by_mocap, of_actuator
from sb3_rpto.sysid.settings import DEFAULTS, ConsistencySettings, Settings
from sb3_rpto.sysid.shooting.windows import command_order, discretised, is_stiff

ALL = "all episodes"
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)  # the first of the scalar ones
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_NO_DYNAMICS, _USER = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_USER)
_STATES = {
    int(mujoco.mjtDyn.mjDYN_INTEGRATOR): "it integrates its command",
    int(mujoco.mjtDyn.mjDYN_PID): "the integral of its regulator",
    int(mujoco.mjtDyn.mjDYN_DCMOTOR): "its current, temperature, friction or the integral of its regulator",
    _USER: "dyntype user",
}
_NO_BIAS, _FIXED = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtGain.mjGAIN_FIXED)


def check_against(model: mujoco.MjModel, data: Measurements, settings: Settings = DEFAULTS) -> list[Finding]:
    """Check recordings against the model that is to explain them.

    Looked at: the names, the sampling, and by inverse dynamics of the smoothed motion whether each joint's actuators
    act when and in the direction that they are told. Samples in contact, at a joint's limit, with an actuator switched
    off, or not usable say nothing about the latter and are left out.

    :param model: of the machine
    :param data: recordings, their names as in the model; the order of the columns does not matter
    :param settings: thresholds
    :return: what was found, nothing is repaired
    :raises ValueError: joints or actuators that are not in both, or a wrong number of coordinates (the message names
        the nearest names), actuators that integrate their commands, a clock that is not in seconds, commands that are
        mostly out of range, angles that are in degrees, ``param`` columns with values that the number cannot have
    """
    check_names(model, data)
    _check_actuators(model)
    limits = settings.consistency
    check_clock(model, data, limits)
    _check_settings(model, data)
    check_degrees(model, data)
    found = _sampling(model, data, settings) + mocap_bodies(model) + _clipped(model, data, limits)
    return found + _responses(model, data, limits)


def check_names(model: mujoco.MjModel, data: Measurements) -> None:
    """Require that data and model have the same joints and actuators.

    :raises ValueError: see :func:`check_against`
    """
    own, given = columns_of(model), data.columns
    for what, prefix, theirs, ours in (
        ("joint", "qpos", given.qpos, own.qpos),
        ("actuator", "ctrl", given.ctrl, own.ctrl),
    ):
        names, known = (list(dict.fromkeys(map(joint_of, columns))) for columns in (theirs, ours))
        for name in names:
            if name not in known:
                raise ValueError(f"column '{prefix}.{name}': the model has no {what} {name!r}; {near(name, known)}")
        for name in known:
            expected, found = ([c for c in columns if joint_of(c) == name] for columns in (ours, theirs))
            if not found:
                raise ValueError(
                    f"the model's {what} {name!r} has no column '{prefix}.{expected[0]}'; "
                    + (
                        "record it, take the joint out of the model or, where an equality constraint ties it to "
                        "others, add the column that follows from theirs"
                        if prefix == "qpos"
                        else "record the command that was sent; a column of 0 is right where the actuator was off alone"
                    )
                )
            if sorted(found) != sorted(expected):
                raise ValueError(
                    f"{what} {name!r} has the columns {', '.join(found)}, the model needs {', '.join(expected)}"
                )


def _check_actuators(model: mujoco.MjModel) -> None:
    """Refuse actuators whose own state at a window's start is in no column."""
    for i, name in enumerate(object_names(model, "actuator")):
        count, dynamics = model.actuator_ctrlnum[i], int(model.actuator_dyntype[i])
        if count != 1:
            raise ValueError(f"actuator {name!r} takes {count} commands; traced are those of one, such as <position>")
        states = int(model.actuator_actnum[i])
        if states > (dynamics in FILTERS) or dynamics == _USER:
            kind = _STATES.get(dynamics, "of a plugin")
            raise ValueError(
                f"actuator {name!r} has a state of its own ({kind}) that no column holds and no commands tell; "
                "model it without, and give what it puts out as its command"
            )


def soft_friction(model: mujoco.MjModel, soft: float = DEFAULTS.consistency.soft) -> list[Finding]:
    """Joints that have dry friction in the model, and one that creeps; what is added to others holds."""
    found = []
    for joint, name in enumerate(object_names(model, "joint")):
        dof = model.jnt_dofadr[joint]
        if model.dof_frictionloss[dof] > 0 and model.dof_solref[dof, 0] > soft:
            message = (
                f"dry friction gives way over some {1e3 * model.dof_solref[dof, 0]:g} ms (its solreffriction); a "
                'machine\'s holds: set solreffriction="0.001 1" solimpfriction="0.99 0.99" in the model'
            )
            found.append(Finding(FindingKind.SOFT_FRICTION, f"joint {name}", message))
    return found


def soft_ties(model: mujoco.MjModel, soft: float = DEFAULTS.consistency.soft) -> list[Finding]:
    """Equality constraints that give way as MuJoCo's do where nothing else is said; those of a machine hardly do."""
    found = []
    for tie in np.flatnonzero((model.eq_solref[:, 0] > soft) & (model.eq_active0 != 0)):
        if moved_by_mocap(model, int(tie)):  # which nobody knows to be where it is taken to be
            continue
        message = (
            f"the constraint gives way over some {1e3 * model.eq_solref[tie, 0]:g} ms (its solref); where the "
            f'machine\'s is rigid, set solref="{max(0.002, 2 * model.opt.timestep):g} 1" '
            'solimp="0.99 0.999 0.0001" in the model, or a sensor_bias may be named that makes up for it'
        )
        found.append(Finding(FindingKind.SOFT_TIE, f"equality {model.equality(tie).name or tie}", message))
    return found


def carried_weights(model: mujoco.MjModel) -> list[Finding]:
    """Bodies whose weight the model carries: MuJoCo carries that of what is added to them, too."""
    names = object_names(model, "body")
    bodies = [names[i] for i in np.flatnonzero(model.body_gravcomp * model.body_mass)]
    message = (
        "the model carries its weight (gravcomp), as much as it has: a payload or another mass has inertia there and "
        "no weight, and is hardly found. A controller carries what it was told: take gravcomp out of the model, and "
        "give what the motors put out, the controller's part with it, as the commands"
    )
    return [Finding(FindingKind.GRAVITY_COMPENSATION, f"body {', '.join(bodies)}", message)] if bodies else []


def check_clock(
    model: mujoco.MjModel, data: Measurements, settings: ConsistencySettings = DEFAULTS.consistency
) -> None:
    """Refuse samples so far apart, or so near to each other, that their times can hardly be in seconds.

    :raises ValueError: see :func:`check_against`
    """
    steps = [np.diff(e.time) for e in data.episodes if len(e) > 1]
    step = float(np.median(np.concatenate(steps))) if steps else 0.0
    if not data.exact and step > settings.longest_step:
        raise ValueError(
            f"the median step of column 'time' is {step:g} s, the model's {model.opt.timestep:g} s; give times in "
            "seconds (are these milliseconds?), or sample the machine faster"
        )
    if not data.exact and 0 < step < settings.shortest_step * model.opt.timestep:
        raise ValueError(
            f"the median step of column 'time' is {step:g} s, the model's {model.opt.timestep:g} s; give times in "
            "seconds"
        )


def _check_settings(model: mujoco.MjModel, data: Measurements) -> None:
    """Refuse known settings that are below what the model's number may be; a motor may turn either way."""
    for name in data.columns.params:
        parameter = Declared(model, name, (-np.inf, np.inf))
        if parameter.owner == "actuator":
            continue
        for episode in data.episodes:
            value = episode.params[name]
            if value < 0 or (parameter.scales and value == 0):
                raise ValueError(
                    f"{episode.name}: column 'param.{name}' holds {value:g}; it must be "
                    f"{'above' if parameter.scales else 'at least'} 0, such as the model's {parameter.nominal:g}"
                )


def _sampling(model: mujoco.MjModel, data: Measurements, settings: Settings) -> list[Finding]:
    if not data.episodes:
        return []
    found = []
    step, timestep = data.step, model.opt.timestep
    whole = max(1, round(step / timestep)) * timestep
    if abs(step - whole) > 0.01 * step:
        message = (
            f"the median step of {step:.4g} s is no whole multiple of the model's timestep of {timestep:.4g} s; "
            f"one of {step / max(1, np.ceil(step / timestep)):.6g} s would be"
        )
        found.append(Finding(FindingKind.SAMPLING, f"{ALL}, time", message))
    if not (data.exact or data.simulated) and is_stiff(discretised(model, data, fine=False, settings=settings.problem)):
        message = "too stiff for the Runge-Kutta method at this timestep: integrated implicitly, less finely"
        found.append(Finding(FindingKind.STIFF_MODEL, "the model", message))
    if step > 1.01 * settings.consistency.slow_step and not data.exact:
        message = (
            f"the median step is {step:.4g} s; effects faster than that, such as a short delay, leave no trace, and "
            "what the motion does between samples passes for an error of the model: log faster, or, of a "
            "simulator's own steps, pass its transitions (Measurements.from_replay)"
        )
        found.append(Finding(FindingKind.SLOW_SAMPLING, f"{ALL}, time", message))
    return found


def _clipped(model: mujoco.MjModel, data: Measurements, settings: ConsistencySettings) -> list[Finding]:
    """Commands outside an actuator's range, where the simulation clips them."""
    found = []
    for column, (name, i) in enumerate(zip(data.columns.ctrl, command_order(model, data))):
        low, high = model.actuator_ctrlrange[i]
        slack = 1e-3 * (high - low)
        commands = np.concatenate([e.ctrl[:, column] for e in data.episodes])
        beyond = float(np.mean((commands < low - slack) | (commands > high + slack)))
        if model.actuator_ctrllimited[i] and beyond > settings.clipped_share:
            raise ValueError(
                f"column 'ctrl.{name}': {beyond:.0%} of the samples are outside the model's ctrlrange [{low:g}, "
                f"{high:g}], where it clips them; give commands in the units of the model's ctrl (a motor's force is "
                "gear times ctrl), widen the range in the MJCF, or clip the column where the machine does"
            )
        if model.actuator_ctrllimited[i] and beyond > 0:
            message = (
                f"{beyond:.1%} of the samples are outside the model's ctrlrange [{low:g}, {high:g}], where it clips "
                "them: other units, or too narrow a range?"
            )
            found.append(Finding(FindingKind.CLIPPED_COMMAND, f"{ALL}, ctrl.{name}", message))
    return found


def unlikely_columns(model: mujoco.MjModel, data: Measurements) -> list[Hint]:
    """What may be wrong where nothing explains recordings: angles in degrees, constant commands, limits of motors."""
    found: list[Hint] = []
    for name, turns in large_angles(model, data).items():
        message = (
            f"it spans {turns:.0f} turns in a typical run; if it is in degrees, give rad (also where the MJCF has "
            'angle="degree")'
        )
        there = frozenset({int(model.jnt_bodyid[object_id(model, "joint", name)])})
        found.append(Hint(FindingKind.LARGE_ANGLE, f"{ALL}, qpos.{name}", message, bodies=there))
    for column, (name, i) in enumerate(zip(data.columns.ctrl, command_order(model, data))):
        commands = np.concatenate([e.ctrl[:, column] for e in data.episodes])
        if np.ptp(commands) == 0:
            message = f"it is {commands[0]:g} throughout; is that what the actuator was told?"
            found.append(
                Hint(FindingKind.CONSTANT_COMMAND, f"{ALL}, ctrl.{name}", message, bodies=of_actuator(model, i))
            )
    for column, (name, i) in enumerate(zip(data.columns.ctrl, command_order(model, data))):
        plain = model.actuator_biastype[i] == _NO_BIAS and model.actuator_dyntype[i] == _NO_DYNAMICS
        if not (plain and model.actuator_forcelimited[i] and model.actuator_gaintype[i] == _FIXED):
            continue
        forces = model.actuator_gainprm[i, 0] * np.concatenate([e.ctrl[:, column] for e in data.episodes])
        low, high = model.actuator_forcerange[i]
        beyond = float(np.mean((forces < low) | (forces > high)))
        if beyond > 0:
            message = (
                f"{beyond:.1%} of the samples ask for more than the model's forcerange [{low:g}, {high:g}], where it "
                "limits the force: is that the machine's range?"
            )
            found.append(Hint(FindingKind.LIMITED_FORCE, f"{ALL}, ctrl.{name}", message, bodies=of_actuator(model, i)))
    return found


# --- responses ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Force:
    """Two forces on one joint that should agree, in one recording, through the same filter."""

    run: str
    where: str
    needed: np.ndarray  # by the motion, (T,)
    given: np.ndarray  # commanded or measured, (T,)
    clear: np.ndarray  # (T,), bool: nothing else is in the way


def _responses(model: mujoco.MjModel, data: Measurements, settings: ConsistencySettings) -> list[Finding]:
    """Late or reversed forces, judged by the correlation of what moves a joint with what it was told."""
    forces: dict[str, dict[str, list[_Force]]] = {}
    for force in _forces(model, data, settings):
        forces.setdefault(force.where, {}).setdefault(force.run, []).append(force)
    found = []
    for where, runs in forces.items():
        correlations = {run: c for run, parts in runs.items() if (c := _correlate(parts, settings)) is not None}
        if not correlations:
            continue
        strength = np.mean([np.abs(c[0]) for c in correlations.values()], axis=0)
        lag = int(np.argmax(strength))
        slope, certain = settings.slope, settings.certain_correlation
        right = np.mean([c[0][lag] > 0 and 1 / slope <= c[1][lag] <= slope for c in correlations.values()])
        late = lag > settings.lag and right > 0.5
        if late and strength[lag] >= max(certain, strength[0] + settings.lag_gain):
            step = data.step
            message = (
                f"the motion follows about {lag} samples ({lag * step:.3g} s) late: a delay or lag in the actuator, or "
                "channels that were not recorded at the same time"
            )
            found.append(Finding(FindingKind.LATE_RESPONSE, f"{ALL}, {where}", message))
        else:
            lag = int(np.argmax(strength[: settings.lag + 1]))
        found += _signs(where, {run: (c[0][lag], c[1][lag]) for run, c in correlations.items()}, settings)
    return found


def _signs(where: str, fits: dict[str, tuple[float, float]], settings: ConsistencySettings) -> list[Finding]:
    """Runs whose correlation and slope speak for a flipped sign."""
    strong, most = settings.correlation, settings.slope
    flipped = [run for run, (c, slope) in fits.items() if c <= -strong and -most <= slope <= -1 / most]
    right = [run for run, (c, _) in fits.items() if c >= strong]
    mean = np.mean([c for c, _ in fits.values()])
    if len(flipped) == len(fits) and mean <= -settings.certain_correlation:
        message = (
            f"in every run the motion needs the opposite force (correlation {mean:.2f}): "
            "its sign is flipped, or the model lacks a force larger than those it has; kept as it is"
        )
        return [Finding(FindingKind.FLIPPED_SIGN, f"{ALL}, {where}", message)]
    if not right:
        return []
    message = "here, unlike in other runs, the motion needs the opposite force (correlation {:.2f}); kept as it is"
    return [Finding.of_run(FindingKind.FLIPPED_SIGN, run, where, message.format(fits[run][0])) for run in flipped]


def _correlate(
    parts: list[_Force], settings: ConsistencySettings = DEFAULTS.consistency
) -> tuple[np.ndarray, np.ndarray] | None:
    """Correlation, and slope of needed against given force, by lag in samples; None where there is too little."""
    correlations, slopes = np.zeros((2, settings.most_lag + 1))
    for lag in range(settings.most_lag + 1):
        pairs = [
            (p.needed[lag:][p.clear[lag:]], p.given[: len(p.given) - lag][p.clear[lag:]])
            for p in parts
            if len(p.given) > 3 * lag
        ]
        needed, given = (np.concatenate(x) for x in zip(*pairs)) if pairs else (np.empty(0), np.empty(0))
        # What is constant varies by rounding.
        if len(given) < settings.samples or any(np.std(x) <= 1e-9 * (1 + np.abs(x).max()) for x in (needed, given)):
            if lag == 0:
                return None
            continue
        correlations[lag] = np.corrcoef(needed, given)[0, 1]
        slopes[lag] = correlations[lag] * np.std(needed) / np.std(given)
    return correlations, slopes


def _forces(model: mujoco.MjModel, data: Measurements, settings: ConsistencySettings) -> Iterator[_Force]:
    own = columns_of(model)
    order = {
        name: [getattr(data.columns, name).index(n) for n in getattr(own, name)] for name in ("qpos", "qvel", "ctrl")
    }
    runs = list(dict.fromkeys(e.run for e in data.episodes if len(e) >= settings.samples))
    runs = runs[:: -(-len(runs) // settings.runs) or 1]
    left = dict.fromkeys(runs, settings.samples_in_all // max(1, len(runs)))
    nominal, simulation = model, Simulation(model, [], 1)
    for episode in data.episodes:
        rows = slice(0, left.get(episode.run, 0))
        n = len(episode.time[rows])
        if n < settings.samples:
            continue
        left[episode.run] -= n
        model = nominal
        if episode.params:  # a motor may turn the other way in a run that says so
            known = {name: np.array([value]) for name, value in episode.params.items()}
            world = MujocoBatch(nominal, 1, 1)
            prepare(world, simulation.from_settings(known))
            model = world.engine.get_model(0)
        time = episode.time[rows]
        step = float(np.median(np.diff(time)))
        window = filter_length(step, data.exact)
        qpos, qvel = episode.qpos[rows][:, order["qpos"]], episode.qvel[rows][:, order["qvel"]]
        qacc = smoothed_velocity(time, qvel, window)
        if not data.exact:
            size = min(window, n - (n + 1) % 2)
            qpos, qvel = (savgol_filter(array, size, 3, axis=0) for array in (qpos, qvel))
        needed, free = required_forces(model, qpos, qvel, qacc)
        ctrl = episode.ctrl[rows][:, order["ctrl"]]
        idle = actuator_forces(model, time, qpos, qvel, np.zeros_like(ctrl))
        told = actuator_forces(model, time, qpos, qvel, ctrl) - idle
        usable = free & episode.usable[rows] & episode.enabled[rows].all(axis=1)
        clear = binary_erosion(usable, np.ones(window), border_value=1)
        for j in np.flatnonzero(model.jnt_type >= _SLIDE).tolist():
            dof = model.jnt_dofadr[j]
            if np.any(told[:, dof]):
                given = filtered_force(time, told[:, dof], window)
                yield _Force(episode.run, _label(model, j), (needed - idle)[:, dof], given, clear)
            name = own.qvel[dof]
            if name in data.columns.qfrc:
                measured = episode.qfrc[rows][:, data.columns.qfrc.index(name)]
                yield _Force(episode.run, f"qfrc.{name}", needed[:, dof], filtered_force(time, measured, window), clear)


def _label(model: mujoco.MjModel, joint: int) -> str:
    on_joint = np.isin(model.actuator_trntype, _ON_JOINT)
    actuators = np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint))
    names = [columns_of(model).ctrl[model.actuator_ctrladr[a]] for a in actuators]
    return f"ctrl.{names[0]}" if len(names) == 1 else f"commands on {columns_of(model).qvel[model.jnt_dofadr[joint]]}"
