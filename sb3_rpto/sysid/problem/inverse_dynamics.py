"""The generalised force that a model lacks, by inverse dynamics: for plots and scales; never for decisions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, filtfilt

from sb3_rpto.effects import Declared, Effect, Scales, Simulation
from sb3_rpto.effects.batch import LiveSimulation, MujocoBatch
from sb3_rpto.effects.names import SCALAR_JOINTS
from sb3_rpto.effects.simulation import Active, Switch, collect, filter_commands, names_of, prepare, pushing, settled
from sb3_rpto.sysid.data.coordinates import straight, velocity_addresses
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.shooting.windows import command_order

#: Cut-off of the zero-phase low pass in Hz; lower where the sampling asks for it.
CUTOFF = 15.0
#: Ends are left out over so many periods of the cut-off: filters and differences bend them by more than any effect.
EDGE = 1.5
#: Random features of the regressor that tells what could still be learned.
FEATURES = 200
#: Stretches that it is judged on last so many periods of the cut-off: shorter ones are like their neighbours.
ALIKE = 2.0
#: Speeds below this share of the typical one count as rest, where dry friction has no known sign.
REST = 0.05


@dataclass(frozen=True)
class ForceResidual:
    """What inverse dynamics lacks in one episode, all filtered in the same way.

    :param episode: its name
    :param time: uniform times in s, (T,); the ends of the episode, where filters err, are left out
    :param qpos: rad or m, (T, nv), of scalar joints (others are zero)
    :param qvel: rad/s or m/s, (T, nv)
    :param load: generalised force of the actuators as the model has it, N·m or N, (T, nv)
    :param command: (T, nu)
    :param force: needed by the motion less what the model has, N·m or N, (T, nv)
    :param touches: whether geoms touch at any time
    :param stopped: where a joint's own limit may hold it, whose force is not among those that the model has, (T, nv);
        None: nowhere
    """

    episode: str
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    load: np.ndarray
    command: np.ndarray
    force: np.ndarray
    touches: bool = False
    stopped: np.ndarray | None = None


def force_residuals(simulation: Simulation, values: np.ndarray, data: Measurements) -> list[ForceResidual]:
    """Inverse dynamics of every episode: the force that the motion needed and the model does not know.

    Exact data are not filtered, and their velocities are taken as they are.

    :param simulation: the model with its effects
    :param values: their parameters, (p,)
    :param data: recordings
    """
    return [_residual(simulation, values, data, e) for e in data.episodes if len(e) >= DATA.min_rows]


def _residual(simulation: Simulation, values: np.ndarray, data: Measurements, e: Episode) -> ForceResidual:
    h = float(np.median(np.diff(e.time)))
    time = np.arange(e.time[0], e.time[-1], h)
    low = (lambda signal: signal) if data.whole_states else _low_pass(h, len(time))
    active = simulation.active(values[None])
    qpos, qvel, shown = _motion(simulation.model, data, e, time, h, low)
    for effect, x in reversed([pair for pair in active if pair[0].senses]):
        _undo_sensor(effect, np.repeat(x, len(time), axis=0), time, qpos, qvel)
    commands, enabled = _commands(simulation.model, data, e, time, h)
    commands = filter_commands(active, commands[None], h)[0]
    settings = simulation.from_settings({name: np.array([value]) for name, value in e.params.items()})
    world = MujocoBatch(simulation.model, 1, 1)
    prepare(world, [*settings, *active])
    needed, load, known, touches = _forces(world, pushing(active), qpos, qvel, commands, enabled, h)
    load, known = (np.stack([low(column) for column in forces.T], axis=1) for forces in (load, known))
    force = needed - load - known
    edge = 1 if data.whole_states else min(round(EDGE / (_cutoff(h) * h)), len(time) // 4)
    stopped = _stopped(simulation.model, shown, 0 if data.whole_states else round(1 / (_cutoff(h) * h)))
    time, shown, qvel, load, commands, force, stopped = (
        a[edge : len(time) - edge] for a in (time - time[0], shown, qvel, load, commands, force, stopped)
    )
    return ForceResidual(e.name, time, shown, qvel, load, commands, force, touches, stopped)


def _stopped(model: mujoco.MjModel, shown: np.ndarray, around: int) -> np.ndarray:
    """Where joints are at their limits or beyond, and so many samples around, over which a filter spreads forces.

    :param shown: positions of scalar joints, (T, nv)
    """
    stopped = np.zeros(shown.shape, dtype=bool)
    for joint in np.flatnonzero(model.jnt_limited):
        dof, (low, high) = model.jnt_dofadr[joint], model.jnt_range[joint]
        if model.jnt_type[joint] in SCALAR_JOINTS:
            beyond = (shown[:, dof] <= low) | (shown[:, dof] >= high)
            stopped[:, dof] = maximum_filter1d(beyond, 2 * around + 1, mode="constant")
    return stopped


def _motion(
    model: mujoco.MjModel,
    data: Measurements,
    e: Episode,
    time: np.ndarray,
    h: float,
    low: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Filtered qpos (T, nq) and qvel (T, nv) at uniform times, ``h`` apart, and scalar joints' positions (T, nv)."""
    dof_of = straight(model)
    qpos = np.tile(model.qpos0, (len(time), 1))
    qvel, shown = np.zeros((len(time), model.nv)), np.zeros((len(time), model.nv))
    for column, address in enumerate(names_of(model, data.columns.qpos)):
        path = low(np.interp(time, e.time, e.qpos[:, column]))
        qpos[:, address] = path
        if int(address) in dof_of:
            dof = dof_of[int(address)]
            shown[:, dof] = path
            qvel[:, dof] = np.gradient(path, h)
    for column, dof in enumerate(velocity_addresses(model, data.columns)):
        if data.whole_states or dof not in dof_of.values():  # quaternions are not differentiated
            qvel[:, dof] = low(np.interp(time, e.time, e.qvel[:, column]))
    return qpos, qvel, shown


def _commands(
    model: mujoco.MjModel, data: Measurements, e: Episode, time: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """The commands of the samples nearest to uniform times, ``h`` apart, and which actuators are enabled; (T, nu) each.

    Recorded clocks are rounded: the last sample before such a time may be the one before that which it is of.
    """
    row = np.clip(np.searchsorted(e.time, time + 0.5 * h, side="right") - 1, 0, len(e) - 1)
    commands = np.zeros((len(time), model.nu))
    enabled = np.ones_like(commands)
    order = command_order(model, data)
    commands[:, order], enabled[:, order] = e.ctrl[row] * e.enabled[row], e.enabled[row]
    return commands, enabled


def _forces(
    world: MujocoBatch,
    acting: Active,
    qpos: np.ndarray,
    qvel: np.ndarray,
    commands: np.ndarray,
    enabled: np.ndarray,
    h: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Generalised forces, (T, nv) each: needed by the motion, of the actuators, of effects and friction; any touch.

    :param batch: one world, its model prepared; dry friction and joint limits are taken out of it
    :param acting: effects that push
    """
    qacc = np.gradient(qvel, h, axis=0)
    # The motion at a sample answers to the commands held before and after it alike.
    around = 0.5 * (commands + np.concatenate([commands[:1], commands[:-1]]))
    model = world.engine.get_model(0)
    friction = model.dof_frictionloss.copy()
    # Dry friction as a constraint answers to every ripple of a differentiated position: its level is taken below.
    model.dof_frictionloss[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    mj = mujoco.MjData(model)
    mj.act[:] = settled(model, around[:1])[0]
    # Actuators with a memory are led along the motion by the simulator's own steps.
    substeps = max(1, round(h / model.opt.timestep)) if model.na or model.nhistory else 0
    switch = Switch(LiveSimulation(model, mj), None if enabled.all() else enabled[None])
    needed, load, known = (np.zeros_like(qvel) for _ in range(3))
    touches = False
    for t in range(len(qvel)):
        switch(t)
        mj.qpos[:], mj.qvel[:], mj.ctrl[:] = qpos[t], qvel[t], around[t]
        if substeps:
            mujoco.mj_step(model, mj, substeps)
        else:
            mujoco.mj_forward(model, mj)
        load[t] = mj.qfrc_actuator
        mj.qpos[:], mj.qvel[:], mj.qacc[:] = qpos[t], qvel[t], qacc[t]
        mujoco.mj_inverse(model, mj)
        needed[t] = mj.qfrc_inverse
        touches |= bool((mj.contact.dist < 0).any())
        level = friction.copy()
        if acting:
            world.qpos[:], world.qvel[:] = qpos[t], qvel[t]
            world.ctrl[:] = around[t]
            collect(world, acting)
            known[t] = world.force[0] - world.missed[0]
            for body in np.flatnonzero(world.pull[0].any(axis=1)):
                mujoco.mj_applyFT(model, mj, world.pull[0, body], np.zeros(3), mj.xipos[body], int(body), known[t])
            level = level + world.friction[0]
        known[t] -= level * np.sign(qvel[t])
    return needed, load, known, touches


def _undo_sensor(effect: Effect, x: np.ndarray, time: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """Turn, in place, what a joint's sensor showed into the motion itself, (T, nq) and (T, nv); x is (T, p)."""
    adr, dof = effect.adr, effect.dof
    q, v = effect.unobserve(qpos[:, adr], qvel[:, dof], x)
    then = time + effect.late(x)  # what is true at a time is shown later; at the end it goes on as it was
    qpos[:, adr] = np.interp(then, time, q) + v[-1] * np.maximum(then - time[-1], 0.0)
    qvel[:, dof] = np.interp(then, time, v)


def _cutoff(h: float) -> float:
    return min(CUTOFF, 0.2 / h)


def _low_pass(h: float, length: int) -> Callable[[np.ndarray], np.ndarray]:
    b, a = butter(2, 2 * _cutoff(h) * h)
    pad = min(length - 1, 60)
    return lambda signal: filtfilt(b, a, signal, padlen=pad)


@dataclass(frozen=True)
class Typical:
    """Typical magnitudes in the data, joint by joint and actuator by actuator.

    :param torque: peak generalised force, (nv,)
    :param velocity: peak speed, (nv,)
    :param inertia: diagonal of the mass matrix, (nv,)
    :param span: range of positions, (nv,)
    :param command: peak command, (nu,)
    :param mass: of each body, (nbody,)
    """

    torque: np.ndarray
    velocity: np.ndarray
    inertia: np.ndarray
    span: np.ndarray
    command: np.ndarray
    mass: np.ndarray

    def at(self, effect: Effect) -> Scales:
        """The scales where a bound effect sits."""
        total = float(self.mass.sum())
        names = ("torque", "velocity", "command", "inertia", "span")
        rest = Scales(**{n: float(getattr(self, n).max(initial=1e-9)) for n in names}, mass=total)
        if effect.place in ("joint", "sensor") or (isinstance(effect, Declared) and effect.owner == "joint"):
            at = {n: float(getattr(self, n)[effect.dof]) for n in ("torque", "velocity", "inertia", "span")}
            return replace(rest, **at)
        if effect.place == "actuator":
            return replace(rest, command=float(self.command[effect.ctrl]))
        if effect.place == "body":
            return replace(rest, mass=float(self.mass[effect.index]))
        return rest

    def scales(self, effects: Sequence[Effect]) -> list[Scales]:
        """Those of each of several bound effects."""
        return [self.at(e) for e in effects]


def typical(simulation: Simulation, residuals: list[ForceResidual]) -> Typical:
    """Typical magnitudes, from the residuals of the nominal model (its own load and what it lacks).

    :raises ValueError: there are none
    """
    if not residuals:
        raise ValueError(f"no episode has {DATA.min_rows} samples to find forces from; record longer ones")
    model = simulation.model
    mj = mujoco.MjData(model)
    mujoco.mj_forward(model, mj)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, mj, full)
    rows = {n: np.concatenate([getattr(r, n) for r in residuals]) for n in ("qpos", "qvel", "load", "force", "command")}

    def high(values: np.ndarray) -> np.ndarray:
        return np.maximum(np.quantile(np.abs(values), 0.95, axis=0), 1e-9)

    load, needed = high(rows["load"]), high(rows["load"] + rows["force"])
    touches = any(r.touches for r in residuals)
    return Typical(
        # Feet on the ground need forces that no motor gives: what acts at a driven joint is measured by its motor then.
        torque=np.where(touches & (load > 1e-6), np.minimum(needed, 2 * load), needed),
        velocity=high(rows["qvel"]),
        inertia=np.maximum(np.diag(full), 1e-9),
        span=np.maximum(np.ptp(rows["qpos"], axis=0), 1e-3),
        command=high(rows["command"]),
        mass=np.maximum(model.body_mass, 1e-9),
    )


def summary(residuals: list[ForceResidual]) -> np.ndarray:
    """Root mean squared force residual of each degree of freedom away from rest and its limits, (nv,).

    NaN where it is nowhere else.
    """
    force = np.concatenate([r.force for r in residuals])
    speed = np.abs(np.concatenate([r.qvel for r in residuals]))
    moving = speed > REST * np.quantile(speed, 0.95, axis=0)
    moving &= np.concatenate([np.ones_like(r.force, bool) if r.stopped is None else ~r.stopped for r in residuals])
    return np.array([np.sqrt(np.mean(f[m] ** 2)) if m.any() else np.nan for f, m in zip(force.T, moving.T)])


def learnable_share(residuals: list[ForceResidual], seed: int, filtered: bool = True) -> np.ndarray:
    """Share of the force residual's variance that a small regressor predicts on unseen stretches, (nv,).

    Ridge regression on random tanh features of position, velocity, load and their recent past: the upper bound of
    what a learned correction could still add. Zero when it predicts nothing, NaN where all runs are too short to judge
    on: the stretches, eighths of runs, are to be longer than what a filter makes alike. Samples at limits are left out.

    :param residuals: of all episodes
    :param seed: of the features
    :param filtered: whether they come from measured positions, not from a simulator's exact states
    """
    rng = np.random.default_rng(seed)
    inputs, targets, fold = [], [], []
    for number, r in enumerate(residuals):
        h = float(r.time[-1] - r.time[0]) / max(len(r.time) - 1, 1)
        if not h or (filtered and len(r.time) * h < 8 * ALIKE / _cutoff(h)):
            continue
        lag = max(1, round(0.02 / h))
        now = np.concatenate([np.sin(r.qpos), np.cos(r.qpos), r.qvel, np.sign(r.qvel), r.load], axis=1)
        inputs.append(np.concatenate([now, np.roll(np.concatenate([r.qvel, r.load], 1), lag, axis=0)], axis=1)[lag:])
        targets.append(r.force[lag:])
        half = np.arange(len(r.force) - lag) * 8 // max(1, len(r.force) - lag)
        fold.append((half + number) % 2)
        if r.stopped is not None:
            free = ~r.stopped[lag:].any(axis=1)
            inputs[-1], targets[-1], fold[-1] = inputs[-1][free], targets[-1][free], fold[-1][free]
    if len({part for parts in fold for part in parts.tolist()}) < 2:
        return np.full(residuals[0].force.shape[1], np.nan)
    x, y, part = np.concatenate(inputs), np.concatenate(targets), np.concatenate(fold)
    x = (x - x.mean(0)) / (x.std(0) + 1e-9)
    hidden = np.tanh(
        x @ rng.standard_normal((x.shape[1], FEATURES)) / np.sqrt(x.shape[1]) + rng.uniform(-1, 1, FEATURES)
    )
    design = np.concatenate([np.ones((len(x), 1)), x, hidden], axis=1)
    left = np.zeros_like(y)
    for held in (0, 1):
        a, b = part != held, part == held
        normal = design[a].T @ design[a] + 1e-2 * a.sum() * np.eye(design.shape[1]) / 10
        weights = np.linalg.solve(normal, design[a].T @ (y[a] - y[a].mean(0)))
        left[b] = y[b] - y[a].mean(0) - design[b] @ weights
    total = np.sum((y - y.mean(0)) ** 2, axis=0)
    share = 1 - np.sum(left**2, axis=0) / np.maximum(total, 1e-12)
    return np.where(total > 1e-12, np.clip(share, 0.0, 1.0), 0.0)
