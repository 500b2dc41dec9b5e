"""Sets simulated by MuJoCo itself, with effects of the package's own classes, at a quarter of the models' timestep.

For what the NumPy machines lack: other effects, and models of gymnasium.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.tracing.planting import SYSTEMS, Link, System
from benchmarks.tracing.planting.excitation import Excitation
from benchmarks.tracing.planting.generate import SPREAD, VELOCITY_NOISE
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.effects.batch import MujocoBatch
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.names import object_names
from sb3_rpto.effects.sensors import ago
from sb3_rpto.effects.simulation import Push, prepare, pushing
from sb3_rpto.sysid import Measurements

STEP = 0.0005
"""Of the integration in s; the tracer's is twice as long."""
GENTLE = 0.05
"""Commands and poses of a gentle set as a share of the usual ones."""


@dataclass(frozen=True)
class Machine:
    """A machine of MuJoCo.

    :param name: one of the planting's machines, or a gymnasium id
    :param system: joints and motors to excite, with peaks in units of the command; nothing else of it is used
    :param declared: names of the declared parameters
    :param rest: pose about which it moves, for each joint of the system, in rad or m
    :param reach: how far it moves, as a share of what the planting's machines do
    """

    name: str
    system: System
    declared: tuple[str, ...]
    rest: tuple[float, ...]
    reach: float = 1.0

    def source(self) -> Any:
        """MJCF text, or a gymnasium environment."""
        return SYSTEMS[self.name].xml if self.name in SYSTEMS else gym.make(self.name)


@dataclass(frozen=True)
class Own:
    """An effect with its values, written down.

    :param machine: name
    :param kind: of the effect
    :param on: where it sits; empty for the world
    :param values: of its parameters, SI
    """

    machine: str
    kind: str
    on: str
    values: dict[str, float]

    def effect(self) -> Effect:
        """The effect itself."""
        return LIBRARY[self.kind](self.on, **self.values)


def _joint(joint: str, torque: float, motor: str | None = None, hinge: bool = True) -> Link:
    return Link(joint, joint, 1.0, float(hinge), 0.0, torque, motor)


_DOUBLE, _REACHER = "InvertedDoublePendulum-v5", "Reacher-v5"
MACHINES = {
    **{name: Machine(name, s, tuple(s.declared), (0.0,) * len(s.links)) for name, s in SYSTEMS.items()},
    # Hanging, as it would fall from where gymnasium begins; at most 50 N, which keep the cart off its stops.
    _DOUBLE: Machine(
        _DOUBLE,
        System(_DOUBLE, (_joint("slider", 0.1, "slide", hinge=False), _joint("hinge", 0), _joint("hinge2", 0)), ()),
        ("slider.damping", "hinge.damping", "hinge2.damping", "cart.mass", "pole.mass", "pole2.mass"),
        (0.0, np.pi, 0.0),
        reach=0.6,
    ),
    # Its armature of 1 kg·m² outweighs its arms by far: masses could not be found.
    _REACHER: Machine(
        _REACHER,
        System(_REACHER, (_joint("joint0", 0.05, "actuator0"), _joint("joint1", 0.03, "actuator1")), ()),
        ("joint0.damping", "joint1.damping", "joint0.armature", "joint1.armature"),
        (0.0, 0.0),
        reach=0.7,
    ),
}
OWN = (
    Own("pendulum", "directional_load_friction", "hinge", {"mu_driving": 0.1, "mu_driven": 0.25}),
    Own("pendulum", "dc_motor", "motor", {"inverse_stall": 0.6, "inverse_speed": 0.12}),
    Own("pendulum", "link_length", "pole", {"change": 0.12}),
    Own("pendulum", "fluid", "", {"density": 20.0}),
    Own("pendulum", "viscous_friction", "hinge", {"coefficient": 0.03}),
    Own("pendulum", "backlash", "motor", {"half_width": 0.15}),
    Own("double_pendulum", "link_length", "lower", {"change": 0.1}),
    Own("double_pendulum", "fluid", "", {"density": 20.0}),
    Own(_DOUBLE, "coulomb_friction", "hinge", {"level": 1.5}),
    Own(_DOUBLE, "viscous_friction", "hinge2", {"coefficient": 0.3}),
    Own(_DOUBLE, "command_delay", "slide", {"delay": 0.015}),
    Own(_DOUBLE, "directional_load_friction", "slider", {"mu_driving": 0.05, "mu_driven": 0.15}),
    Own(_REACHER, "coulomb_friction", "joint0", {"level": 0.5}),
    Own(_REACHER, "viscous_friction", "joint1", {"coefficient": 0.4}),
    Own(_REACHER, "actuator_lag", "actuator0", {"time_constant": 0.03}),
)
"""The group "own classes": no machine has a kind twice."""
UNSEEN = (
    # Near its rest the pendulum is linear: mass and damping take up what these do.
    Own("pendulum", "sensor_gain", "hinge", {"change": 0.05}),
    Own("pendulum", "quadratic_drag", "hinge", {"coefficient": 0.01}),
    Own("double_pendulum", "quadratic_drag", "shoulder", {"coefficient": 0.01}),
    # A twentieth of the peak comes nowhere near a limit.
    Own("pendulum", "dc_motor", "motor", {"inverse_stall": 0.6, "inverse_speed": 0.12}),
    Own("reacher", "dc_motor", "shoulder_motor", {"inverse_stall": 2.0, "inverse_speed": 0.12}),
)
"""The group "not excited" in gentle motion."""


def find(table: Sequence[Own], machine: str, kind: str) -> Own:
    """The entry of a machine and a kind."""
    return next(p for p in table if (p.machine, p.kind) == (machine, kind))


def declared_beside(machine: Machine, effects: Sequence[Effect]) -> tuple[str, ...]:
    """What is declared of a machine: not the numbers that the effects change."""
    taken = {f"{effect.on}.{name}" for effect in effects for name in effect.same}
    return tuple(name for name in machine.declared if name not in taken)


def simulate(
    machine: Machine,
    effects: Sequence[Effect],
    seed: int,
    *,
    gentle: bool = False,
    episodes: int = 10,
    duration: float = 4.0,
    rate: float = 250.0,
    noise: float = 1e-3,
    velocity: bool = True,
    step: float = STEP,
) -> Measurements:
    """Recordings of a machine whose declared parameters are off by up to 15 % and that has effects in it.

    As :func:`benchmarks.tracing.planting.generate`: samples are what the sensors show + noise, velocities + 20 noise,
    and the command held until the next sample.

    :param machine: one of :data:`MACHINES`
    :param effects: with their values
    :param seed: of everything
    :param gentle: whether it hardly moves
    :param episodes: how many
    :param duration: of an episode in s
    :param rate: of the samples in Hz; its interval must be a multiple of ``step``
    :param noise: standard deviation of the position noise in rad or m
    :param velocity: whether the velocity is recorded
    :param step: of the integration in s
    """
    substeps, samples = round(1 / rate / step), round(duration * rate)
    if abs(substeps * step * rate - 1) > 1e-9:
        raise ValueError(f"rate is {rate:g} Hz; its interval must be a multiple of {step:g} s")
    _, model = load_model(machine.source())
    model.opt.timestep = step
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    known = declare(model, declared_beside(machine, effects))
    factors = streams[0].uniform(1 - SPREAD, 1 + SPREAD, len(known))
    acting: list[Effect] = [*(d.with_values(d.values * f) for d, f in zip(known, factors)), *effects]
    for effect in acting:
        effect.bind(model)
    times = np.arange(samples) / rate
    excitation = Excitation(machine.system, np.tile(times, (episodes, 1)), streams[1])
    excitation.reference *= machine.reach
    excitation.q *= machine.reach
    if gentle:
        for part in (excitation.reference, excitation.push, excitation.q):
            part *= GENTLE

    joints, motors = object_names(model, "joint"), object_names(model, "actuator")
    moved = [joints.index(link.joint) for link in machine.system.links]
    world = MujocoBatch(model, episodes, 1)
    world.qpos[:] = model.qpos0
    world.qpos[:, moved] = excitation.q + machine.rest
    rows = [(effect, np.tile(effect.values, (episodes, 1))) for effect in acting]
    prepare(world, rows)
    push = Push(world, pushing(rows))
    chain: list[tuple[Effect, np.ndarray, dict[str, Any]]]
    chain = [(e, x, {}) for e, x in sorted(rows, key=lambda row: row[0].order) if e.overrides("command")]
    sensors = [(e, x) for e, x in rows if e.senses]
    errors = noise * streams[2].standard_normal((2, samples, episodes, model.nv))
    errors[1] *= VELOCITY_NOISE
    measured = np.empty((2, episodes, samples, model.nv))
    commands = np.zeros((episodes, samples, model.nu))
    past = [(world.qpos.copy(), world.qvel.copy())]
    for k in range(samples):
        q, v = (a.copy() for a in past[-1])
        for effect, x in sensors:
            steps = effect.late(x) / step
            if steps.any():
                recent = past[-1 - math.ceil(steps.max()) :]
                positions = np.stack([q_then[:, effect.adr] for q_then, _ in recent], axis=1)
                velocities = np.stack([v_then[:, effect.dof] for _, v_then in recent], axis=1)
                q[:, effect.adr], v[:, effect.dof] = ago(steps, positions, velocities)
        for effect, x in sensors:
            q[:, effect.adr], v[:, effect.dof] = effect.observe(q[:, effect.adr], v[:, effect.dof], x)
        measured[:, :, k] = q, v = q + errors[0, k], v + errors[1, k]
        u = excitation.command(k, q[:, moved] - machine.rest, v[:, moved])
        for j, link in enumerate(machine.system.links):
            if link.motor:
                commands[:, k, motors.index(link.motor)] = u[:, j]
        for substep in range(substeps):
            world.ctrl[:] = commands[:, k]
            for effect, x, memory in chain:
                world.ctrl[:, effect.ctrl] = effect.command(world.ctrl[:, effect.ctrl].copy(), x, memory, step)
            push(begins=substep == 0)
            world.engine.step()
            past.append((world.qpos.copy(), world.qvel.copy()))
    if not np.isfinite(measured).all():
        raise ValueError(f"{machine.name} became unstable with {', '.join(map(str, effects))}; plant less")

    table = {"episode": np.repeat(np.arange(episodes), samples).astype(str), "time": np.tile(times, episodes)}
    for name, values in zip(("qpos", "qvel") if velocity else ("qpos",), measured):
        table |= {f"{name}.{joint}": values[..., j].ravel() for j, joint in enumerate(joints)}
    table |= {f"ctrl.{motor}": commands[..., a].ravel() for a, motor in enumerate(motors)}
    return Measurements.from_tables({"simulated": table})
