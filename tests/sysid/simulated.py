"""Recordings of a pendulum by the simulation that the tracer has itself, so that the truth is known exactly."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from conftest import coarsely

from sb3_rpto.effects import Drive, Scales, Simulation
from sb3_rpto.effects.effect import Effect
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import cut

RATE = 200
#: an integrator whose steps may be as long as the samples are apart, and which has its instants where the samples are
PENDULUM = """<mujoco><option timestep="0.005" integrator="RK4"/><worldbody><body name="pole">
<joint name="hinge" axis="0 -1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
#: with a wheel beside it that nothing drives
WITH_WHEEL = PENDULUM.replace(
    "</worldbody>",
    """<body name="wheel" pos="3 0 0"><joint name="axle" axis="0 0 1"/><geom type="cylinder" size=".1 .1" mass="1"/>
</body></worldbody>""",
)


def briefly(model: str, data: Measurements, declared: Sequence[str], candidates: Sequence[str]) -> Report:
    """A trace in windows of 0.35 s: what is tested does not hang on their length, and short ones take less time."""
    with coarsely():
        return trace(model, data, declared, candidates=candidates, horizon=0.35, threads=1)


def compiled(xml: str = PENDULUM) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def torques(episodes: int, samples: int, seed: int, size: float = 1.5, rate: int = RATE) -> np.ndarray:
    """A slow swing with steps in it, (episodes, samples)."""
    rng = np.random.default_rng([seed, 1])
    t, hold = np.arange(samples) / rate, rate // 5
    phase, turns = rng.uniform(0, 2 * np.pi, (2, episodes, 1)), rng.uniform(0.4, 1.0, (episodes, 1))
    steps = np.repeat(rng.uniform(-1, 1, (episodes, samples // hold + 1)), hold, axis=1)[:, :samples]
    return size * (0.5 * np.sin(2 * np.pi * turns * t + phase[0]) + 0.5 * steps)


def table(time: np.ndarray, q: np.ndarray, v: np.ndarray, u: np.ndarray, model: mujoco.MjModel) -> dict:
    """Columns for the arrays (episodes, T, n)."""
    count = len(q)
    found = {"episode": np.repeat(np.arange(count), len(time)).astype(str), "time": np.tile(time, count)}
    for j in range(model.njnt):
        found[f"qpos.{model.joint(j).name}"] = q[..., j].ravel()
        found[f"qvel.{model.joint(j).name}"] = v[..., j].ravel()
    for a in range(model.nu):
        found[f"ctrl.{model.actuator(a).name}"] = u[..., a].ravel()
    return found


def recorded(
    effects: Sequence[Effect] = (),
    model: mujoco.MjModel | None = None,
    episodes: int = 4,
    duration: float = 2.1,
    noise: float = 1e-3,
    seed: int = 0,
    commands: np.ndarray | None = None,
    exact: bool = False,
    start: Sequence[float] | None = None,
    rate: int = RATE,
) -> Measurements:
    """Runs of the model with the effects in it, sampled with white noise on the positions.

    :param commands: (episodes, samples)
    :param start: sizes of the first positions and of the first velocities
    :param rate: of the samples in Hz
    """
    model = model or compiled()
    every, samples = round(1 / rate / model.opt.timestep), round(duration * rate)
    rng = np.random.default_rng([seed, 0])
    u = torques(episodes, samples, seed, rate=rate) if commands is None else commands
    simulation = Simulation(model, [*effects], 1)
    sizes = np.array([0.5, 1.0] if start is None else start)[:, None, None]
    qpos, qvel = sizes * rng.uniform(-1, 1, (2, episodes, model.nq))
    if model.nq > 1:
        qpos[:, 1:], qvel[:, 1:] = 0, 0
    drive = Drive(np.repeat(u, every, axis=1)[:, : (samples - 1) * every, None])
    q, v = simulation.rollout(np.tile(simulation.values(), (episodes, 1)), qpos, qvel, drive)
    q, v = q[:, ::every], v[:, ::every]
    q = q + noise * rng.standard_normal(q.shape)
    data = Measurements.from_tables({"runs": table(np.arange(samples) / rate, q, v, u[..., None], model)})
    return replace(data, exact=exact)


def problem(
    effects: Sequence[Effect],
    data: Measurements,
    model: mujoco.MjModel | None = None,
    noise: float = 1e-3,
    horizon: float = 0.4,
    most: int = 100,
    scales: Scales | None = None,
) -> Problem:
    """Fit these effects to these data."""
    model = model or compiled()
    windows = cut(model, data, np.full(model.nq, noise), horizon, most)
    simulation = Simulation(model, effects, 1)
    usual = Scales(torque=1.5, velocity=5.0, command=1.5, inertia=0.04, span=2.0, mass=0.5)
    return Problem(simulation, windows, [scales or usual] * len(simulation.effects))
