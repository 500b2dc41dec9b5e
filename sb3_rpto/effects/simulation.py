"""Many simulations of one model side by side, each with effects of its own strength."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import FILTERS, command_limits
from sb3_rpto.effects.batch import MujocoBatch, SimulationBatch
from sb3_rpto.effects.declared import Declared
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.engine import lean, quiet, untimed
from sb3_rpto.effects.names import object_names

#: After so many time constants a filter has forgotten.
CONSTANTS = 5
#: Batches that are kept for further rollouts, and as many of the few kinds that their simulations are of.
KEPT = 4


class Drive(NamedTuple):
    """What drives ``n`` simulations, on the grid of the model's time step.

    :param commands: (n, before + steps, nu), constant between two steps; the first ``before`` come before the start
    :param before: steps of commands from before the start, for delays and filters
    :param enabled: (n, steps, nu), 0 where an actuator is off: no command and no back-EMF; None: always on
    :param settings: parameters of the model known for each simulation, by declared name, (n,)
    :param hold: steps for which a held force is that of their beginning, see ``held`` of
        :class:`~sb3_rpto.effects.Effect`; the first begin at the start
    """

    commands: np.ndarray
    before: int = 0
    enabled: np.ndarray | None = None
    settings: Mapping[str, np.ndarray] = {}
    hold: int = 1

    def take(self, index: np.ndarray) -> Drive:
        """The drive of the simulations at ``index``, which may repeat."""
        enabled = None if self.enabled is None else self.enabled[index]
        settings = {k: v[index] for k, v in self.settings.items()}
        return self._replace(commands=self.commands[index], enabled=enabled, settings=settings)


class Simulation:
    """A compiled model with a list of effects; every rollout says how strong each is in each simulation.

    Nothing is compiled again: parameters are fields of the batch, forces are written in every substep, and commands
    are transformed before.

    :param model: the nominal model; a copy is kept
    :param effects: all that may act, declared parameters among them; copies are kept
    :param nthread: threads of the batch; 0: as many as there are cores
    """

    def __init__(self, model: mujoco.MjModel, effects: Sequence[Effect], nthread: int = 0) -> None:
        self.model = lean(model)
        # A simulation that blows up must show, not start anew.
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.effects = [copy.copy(effect) for effect in effects]  # bound to this model, which may be another one's
        self.nthread = nthread
        for effect in self.effects:
            effect.bind(self.model)
        ends = np.cumsum([len(e.parameters) for e in self.effects]).astype(int).tolist()
        self.slices = [slice(end - len(e.parameters), end) for e, end in zip(self.effects, ends)]
        self.size = ends[-1] if ends else 0
        self.null = np.array([p.null for e in self.effects for p in e.parameters])
        #: bounds of the parameters in this model, (p,)
        self.lower = np.concatenate([e.lowest(self.model) for e in self.effects] or [np.empty(0)])
        self.upper = np.array([p.upper for e in self.effects for p in e.parameters])
        #: (p,) False for parameters of shape, which do nothing by themselves
        self.strength = np.array([not p.shape for e in self.effects for p in e.parameters], dtype=bool)
        self._settings: dict[str, Declared] = {}
        self._batches: dict[tuple[int, ...], MujocoBatch] = {}
        self._kinds: dict[tuple[int, ...], MujocoBatch] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_batches": {}, "_kinds": {}}  # batches are made anew

    def values(self) -> np.ndarray:
        """The effects' own values, (p,)."""
        return np.concatenate([e.values for e in self.effects]) if self.effects else np.empty(0)

    def rollout(
        self, values: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, drive: Drive
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate.

        :param values: (n, p), the effects' parameters in each simulation
        :param qpos: (n, nq), where each starts
        :param qvel: (n, nv)
        :param drive: what drives them
        :return: positions (n, steps + 1, nq) and velocities (n, steps + 1, nv), the start included; NaN after a
            simulation has become unstable
        """
        n, total, _ = drive.commands.shape
        steps = total - drive.before
        known, active = self.from_settings(drive.settings), self.active(values)
        commands = filter_commands(active, drive.commands, self.model.opt.timestep)
        batch = self._batch(self._batches, n, [*known, *active])
        batch.engine.reset(stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._prepare(batch, [*known, *active])
        out_q = np.empty((n, steps + 1, self.model.nq))
        out_v = np.empty((n, steps + 1, self.model.nv))
        out_q[:, 0], out_v[:, 0] = qpos, qvel
        with quiet(), untimed():
            if self.model.na or self.model.nhistory:
                # Declared filters may remember for longer than the model's own.
                slow = [float(x.max()) for e, x in active if isinstance(e, Declared) and e.number[2] == "timeconst"]
                seconds = max([memory(self.model), *(CONSTANTS * x for x in slow)])
                self._lead(batch, commands[:, : drive.before], qpos, qvel, seconds)
            batch.qpos[:], batch.qvel[:] = qpos, qvel
            self._run(batch, active, drive._replace(commands=commands[:, drive.before :]), out_q, out_v)
        bad = ~(np.isfinite(out_q).all(-1) & (np.abs(out_v) < 1e6).all(-1))
        if bad.any():
            bad = np.maximum.accumulate(bad, axis=1)
            out_q[bad], out_v[bad] = np.nan, np.nan
        return out_q, out_v

    def active(self, values: np.ndarray) -> Active:
        """The effects that do anything, with their parameters, of ``values`` (n, p)."""
        return [
            (effect, values[:, s])
            for effect, s in zip(self.effects, self.slices)
            if effect.known or np.any((values[:, s] != self.null[s])[:, self.strength[s]])
        ]

    def sensing(self, values: np.ndarray) -> Active:
        """The effects on sensors with their parameters, of ``values`` (n, p)."""
        return [(effect, values[:, s]) for effect, s in zip(self.effects, self.slices) if effect.senses]

    def unobserve(self, values: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Take back, in place, what the sensors make of states, but for delays.

        :param values: (n, p)
        :param qpos: as the sensors show it, (n, nq)
        :param qvel: likewise, (n, nv)
        """
        for effect, x in reversed(self.sensing(values)):
            qpos[:, effect.adr], qvel[:, effect.dof] = effect.unobserve(qpos[:, effect.adr], qvel[:, effect.dof], x)

    def undo_sensors(
        self, values: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray | None = None
    ) -> None:
        """Take back, in place, what the sensors make of states; the joint of a late one is carried on from then to now.

        A sensor is late before anything else happens to what it shows. So what was done last is undone first, and
        delays come at the end.

        :param values: (n, p)
        :param qpos: as the sensors show it, (n, nq)
        :param qvel: likewise, (n, nv)
        :param qacc: how fast the speeds change, (n, nv); None: not at all
        """
        self.unobserve(values, qpos, qvel)
        for effect, x in self.sensing(values):
            age, a = effect.late(x), 0.0 if qacc is None else qacc[:, effect.dof]
            qpos[:, effect.adr] += age * (qvel[:, effect.dof] + 0.5 * age * a)
            qvel[:, effect.dof] += age * a

    def _run(
        self,
        batch: MujocoBatch,
        active: Active,
        drive: Drive,
        out_q: np.ndarray,
        out_v: np.ndarray,
    ) -> None:
        """Step through all commands and write what was reached after the start."""
        commands, enabled = drive.commands, drive.enabled
        steps = commands.shape[1]
        acting = pushing(active)
        if acting or enabled is not None:
            switch, push = Switch(batch, enabled), Push(batch, acting)
            for k in range(steps):
                batch.ctrl[:] = commands[:, k]
                switch(k)
                push(begins=k % drive.hold == 0)
                batch.engine.step()
                out_q[:, k + 1], out_v[:, k + 1] = batch.qpos, batch.qvel
        else:
            batch.force[:], batch.pull[:], batch.friction[:] = 0, 0, 0
            batch.commit()
            record = batch.engine.rollout(steps, commands, record=("qpos", "qvel"))
            out_q[:, 1:], out_v[:, 1:] = record["qpos"], record["qvel"]
            # A rollout holds a simulation at its first warning; here that is the end of it.
            for i in np.flatnonzero(batch.engine.warning[:, :, 1].any(axis=1)):
                out_q[i, (out_q[i] == out_q[i, -1]).all(axis=-1)] = np.nan

    def _lead(self, batch: MujocoBatch, past: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, seconds: float) -> None:
        """Lead the actuators' own filters and delays through the last commands before the start, the motion held."""
        past = past[:, max(0, past.shape[1] - math.ceil(seconds / self.model.opt.timestep)) :]
        if not past.shape[1]:
            return
        batch.engine.bind("act")[:] = settled(self.model, past[:, 0])
        for k in range(past.shape[1]):
            batch.qpos[:], batch.qvel[:], batch.ctrl[:] = qpos, qvel, past[:, k]
            batch.engine.step()

    def _prepare(self, batch: MujocoBatch, active: Active) -> None:
        """As :func:`prepare`, but once for all simulations that are alike, as most are in a fit."""
        first, kind = alike(active, batch.n)
        if 2 * len(first) > batch.n:
            prepare(batch, active)
        else:
            few = self._batch(self._kinds, len(first), active)
            prepare(few, [(effect, x[first]) for effect, x in active])
            batch.settle_as(few, kind)

    def _batch(self, kept: dict[tuple[int, ...], MujocoBatch], n: int, active: Active) -> MujocoBatch:
        """One of the last few batches, as the model is: a field once written is copied in every step from then on."""
        key = (n, *(id(effect) for effect, _ in active))
        if key not in kept:
            if len(kept) >= KEPT:
                kept.pop(next(iter(kept)))
            kept[key] = MujocoBatch(self.model, n, self.nthread)
        kept[key].restore()
        return kept[key]

    def from_settings(self, settings: Mapping[str, np.ndarray]) -> Active:
        """Parameters that are known of each simulation, by declared name, (n,), as effects with their values."""
        for name in settings:
            if name not in self._settings:
                self._settings[name] = Declared(self.model, name, (-np.inf, np.inf))
        return [(self._settings[name], values[:, None]) for name, values in settings.items()]


Active = Sequence[tuple[Effect, np.ndarray]]


def alike(active: Active, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Of ``n`` simulations the first of each kind by its parameters, (k,), and the kind of each, (n,)."""
    values = np.concatenate([np.empty((n, 0)), *(x for _, x in active)], axis=1)
    begins = np.flatnonzero(np.concatenate([[True], (values[1:] != values[:-1]).any(axis=1)]))
    _, first, kind = np.unique(values[begins], axis=0, return_index=True, return_inverse=True)
    return begins[first], np.repeat(kind.ravel(), np.diff(begins, append=n))


def prepare(batch: SimulationBatch, active: Active) -> None:
    """Write what the effects change of the model: numbers, known or declared, first, additions after.

    What a sensor does last is written first: a servo's gain on the joint's position is then one on what comes before.
    """
    ordered = sorted(active, key=lambda pair: pair[0].rank if isinstance(pair[0], Declared) else math.inf)
    sensing = [pair for pair in ordered if pair[0].senses]
    for effect, x in [*(pair for pair in ordered if not pair[0].senses), *reversed(sensing)]:
        effect.write(batch, x)
    batch.settle()


def pushing(active: Active) -> Active:
    """The effects that act in every substep, in the order in which they do."""
    return sorted((pair for pair in active if pair[0].overrides("act")), key=lambda pair: pair[0].order)


class Push:
    """Collects and applies the forces of one substep after another.

    :param acting: from :func:`pushing`
    """

    def __init__(self, batch: SimulationBatch, acting: Active) -> None:
        self.batch = batch
        self.held = [pair for pair in acting if pair[0].held]
        self.acting = [pair for pair in acting if not pair[0].held]
        self.kept = np.zeros_like(batch.force)

    def __call__(self, begins: bool) -> None:
        """Those of the next substep.

        :param begins: whether a step of the environment begins with it
        """
        if begins and self.held:
            collect(self.batch, self.held)
            self.kept[:] = self.batch.force
        collect(self.batch, self.acting)
        self.batch.force += self.kept
        self.batch.commit()


def collect(batch: SimulationBatch, acting: Active) -> None:
    """Collect the forces of one substep."""
    batch.forget()
    if any(effect.asks_simulator for effect, _ in acting):
        batch.evaluate()
    for effect, x in acting:
        effect.act(batch, x)


def filter_commands(active: Active, commands: np.ndarray, dt: float) -> np.ndarray:
    """Send commands (n, steps, nu) through the effects between controller and actuators, in their order."""
    chain = sorted((pair for pair in active if pair[0].overrides("command")), key=lambda pair: pair[0].order)
    if not chain:
        return commands
    out = commands.copy()
    for effect, x in chain:
        memory: dict[str, Any] = {}
        column = out[:, :, effect.ctrl]
        for k in range(column.shape[1]):
            column[:, k] = effect.command(column[:, k], x, memory, dt)
    return out


class Switch:
    """Turns actuators off where ``enabled`` is 0: no command, no servo, no back-EMF."""

    FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_damping", "actuator_dampingpoly")

    def __init__(self, batch: SimulationBatch, enabled: np.ndarray | None) -> None:
        self.batch, self.enabled = batch, enabled
        if enabled is not None:
            self.on = {name: batch.field(name).copy() for name in self.FIELDS}
            self.last = np.ones_like(enabled[:, 0])

    def __call__(self, k: int) -> None:
        """Set the actuators of step ``k``."""
        if self.enabled is None or np.array_equal(self.enabled[:, k], self.last):
            return
        self.last = self.enabled[:, k]
        for name, on in self.on.items():
            mask = self.last.reshape(*self.last.shape, *[1] * (on.ndim - 2))
            self.batch.field(name)[:] = on * mask
        self.batch.derive()  # the damping of actuators reaches the joints through derived constants


def memory(model: mujoco.MjModel) -> float:
    """Seconds of past commands that the model's own actuators remember, by filters and delays."""
    filters = np.isin(model.actuator_dyntype, FILTERS)
    muscles = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE
    # The times in which a muscle activates and relaxes are up to twice its constants, by how active it is.
    slowest = np.where(muscles, 2 * model.actuator_dynprm[:, :2].max(axis=1), model.actuator_dynprm[:, 0])
    own = CONSTANTS * slowest[filters]
    return max(float(own.max(initial=0.0)), float(model.actuator_delay.max(initial=0.0)))


def settled(model: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
    """The actuators' own states after a command has held for long: filters end at it.

    :param ctrl: (n, nu)
    :return: (n, na)
    """
    act, sent = np.zeros((len(ctrl), model.na)), np.clip(ctrl, *command_limits(model))
    for i in np.flatnonzero(np.isin(model.actuator_dyntype, FILTERS)):
        held = sent[:, model.actuator_ctrladr[i]]
        muscle = model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_MUSCLE
        act[:, model.actuator_actadr[i]] = np.clip(held, 0.0, 1.0) if muscle else held
    return act


def names_of(model: mujoco.MjModel, qpos: Sequence[str]) -> np.ndarray:
    """Addresses in qpos of columns named after joints (``root.2`` for a coordinate of a free joint), (m,)."""
    joints = object_names(model, "joint")
    addresses = []
    for name in qpos:
        # A joint may be called hinge.001 beside another hinge.
        joint, offset = (name, "0") if name in joints else (name[:-2], name[-1])
        addresses.append(int(model.jnt_qposadr[joints.index(joint)]) + int(offset))
    return np.array(addresses, dtype=int)
