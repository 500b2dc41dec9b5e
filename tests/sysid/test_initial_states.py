"""Smoothed starts of windows: what is straight, what turns, and the spread that noise leaves."""

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.data.columns import columns_of
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.shooting.initial_states import moved, smoothed_rotation, smoothed_state, start_state, turned
from sb3_rpto.sysid.shooting.windows import names_of

FREE = """
<mujoco><option timestep="0.002" integrator="RK4"/><worldbody>
  <body name="hull" pos="0 0 1"><freejoint name="root"/>
    <inertial pos="0 0 0" mass="2" diaginertia=".02 .03 .04"/>
    <body name="arm"><joint name="swing" axis="0 1 0" damping=".05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4" contype="0" conaffinity="0"/></body></body>
  <body name="weight" pos="1 0 1"><joint name="ball" type="ball" damping=".01"/>
    <geom type="sphere" size=".05" pos="0 0 -.4" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor name="motor" joint="swing"/></actuator></mujoco>
"""


def clock(count: int, rate: float = 100.0, jitter: float = 0.0) -> np.ndarray:
    return (np.arange(count) + jitter * np.random.default_rng(0).uniform(-0.3, 0.3, count)) / rate


def episode(time: np.ndarray, q: np.ndarray) -> Episode:
    empty = np.empty((len(time), 0))
    return Episode("e", "e", time, q, np.zeros_like(q), empty, empty, empty.astype(bool))


@pytest.mark.parametrize("jitter", [0.0, 0.8])
@pytest.mark.parametrize("index", [0, 2, 30, 59])
def test_smoothing_leaves_a_cubic_and_its_derivative_as_they_are(jitter: float, index: int) -> None:
    t = clock(60, 200.0, jitter)
    c = np.array([[0.3, -1.0], [2.0, 0.5], [-40.0, 9.0], [300.0, -70.0]])
    powers = t[:, None] ** np.arange(4)
    q, v, a, _ = smoothed_state(episode(t, powers @ c), index, np.array([1e-3, 1e-3]))
    np.testing.assert_allclose(q, powers[index] @ c, atol=1e-11)
    np.testing.assert_allclose(v, powers[index, :3] @ (c[1:] * np.arange(1, 4)[:, None]), atol=1e-9)
    np.testing.assert_allclose(a, 2 * c[2] + 6 * t[index] * c[3], atol=1e-7)


@pytest.mark.parametrize("index", [0, 20])
def test_spread_of_the_smoothed_state_is_that_of_repeated_noise(index: int) -> None:
    rng, sigma = np.random.default_rng(0), np.array([1e-3, 5e-3])
    t = clock(41, 200.0, 0.5)
    # As many columns as draws: all are smoothed at once.
    draws = rng.standard_normal((len(t), 2, 3000)) * sigma[:, None]
    q, v, _, _ = smoothed_state(episode(t, draws.reshape(len(t), -1)), index, np.ones(6000))
    *_, spread = smoothed_state(episode(t, draws[:, :, 0]), index, sigma)
    np.testing.assert_allclose(spread[0], q.reshape(2, -1).std(1), rtol=0.05)
    np.testing.assert_allclose(spread[1], v.reshape(2, -1).std(1), rtol=0.05)


def tumbling(t: np.ndarray, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of the machine as MuJoCo's finest steps move it."""
    data = mujoco.MjData(model)
    data.qvel[:] = np.random.default_rng(3).uniform(-3, 3, model.nv)
    fine, q, v = model.opt.timestep, [], []
    for now in t:
        while data.time < now - 0.5 * fine:
            mujoco.mj_step(model, data)
        q.append(data.qpos.copy())
        v.append(data.qvel.copy())
    return np.array(q), np.array(v)


def finely() -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(FREE)
    model.opt.timestep = 2e-4
    return model


def test_a_tumbling_body_has_the_simulators_angular_velocity() -> None:
    t, model = clock(60, 200.0), finely()
    q, v = tumbling(t, model)
    for columns, dofs in ((np.arange(3, 7), slice(3, 6)), (np.arange(8, 12), slice(7, 10))):
        quaternion, velocity, _, _ = smoothed_rotation(episode(t, 1.7 * q), 30, columns, np.ones(4))
        np.testing.assert_allclose(quaternion, q[30, columns], atol=1e-5)
        np.testing.assert_allclose(velocity, v[30, dofs], atol=5e-3)


def test_spread_of_a_smoothed_rotation_is_that_of_repeated_noise() -> None:
    t, model, sigma = clock(60, 200.0), finely(), 1e-3
    q, _ = tumbling(t, model)
    rng, columns, found = np.random.default_rng(0), np.arange(3, 7), []
    clean, still, _, _ = smoothed_rotation(episode(t, q), 30, columns, np.ones(4))
    for _ in range(400):
        noisy = q + 0.5 * sigma * rng.standard_normal(q.shape)
        quaternion, velocity, _, spread = smoothed_rotation(episode(t, noisy), 30, columns, np.full(4, 0.5 * sigma))
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, quaternion, clean)
        found.append([turn, velocity - still])
    measured = np.array(found).std(axis=(0, 2))
    # Four components of equal noise: one of them, along the quaternion, is lost when it is made a unit one.
    np.testing.assert_allclose(measured, spread * np.sqrt(3) / 2, rtol=0.06)


def test_positions_move_as_mujoco_moves_them() -> None:
    model, rng = mujoco.MjModel.from_xml_string(FREE), np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (5, 1))
    by = rng.uniform(-1, 1, (5, model.nv))
    by[0] = 0
    expected = qpos.copy()
    for row, step in zip(expected, by):
        mujoco.mj_integratePos(model, row, step, 1.0)
    np.testing.assert_allclose(moved(model, qpos, by), expected, atol=1e-12)
    np.testing.assert_array_equal(turned(qpos[:1, 3:7], by[:1, 3:6]), qpos[:1, 3:7])


def recorded(
    xml: str, episodes: int, seconds: float = 1.5, noise: float = 1e-3, velocities: bool = True
) -> Measurements:
    """The machine as it is, measured with noise."""
    model, rng, tables = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0), {}
    model.opt.timestep = 2e-4
    columns = columns_of(model)
    for number in range(episodes):
        data, rows = mujoco.MjData(model), []
        data.qvel[:] = rng.uniform(-2, 2, model.nv)
        frequency, phase = rng.uniform(0.5, 2), rng.uniform(0, 6)
        for k in range(round(seconds * 250)):
            data.ctrl[:] = np.sin(2 * np.pi * frequency * k / 250 + phase)
            rows.append(np.concatenate([data.qpos, data.qvel, data.ctrl]))
            mujoco.mj_step(model, data, 20)
        table = np.array(rows)
        table[:, : model.nq] += noise * rng.standard_normal((len(rows), model.nq))
        parts = (("qpos", columns.qpos), ("qvel", columns.qvel), ("ctrl", columns.ctrl))
        names = [f"{prefix}.{name}" for prefix, part in parts for name in part]
        kept = {name: column for name, column in zip(names, table.T) if velocities or not name.startswith("qvel")}
        tables[f"run{number}"] = {"time": np.arange(len(rows)) / 250, **kept}
    return Measurements.from_tables(tables)


def test_starts_of_all_joints_have_a_spread() -> None:
    model, data = mujoco.MjModel.from_xml_string(FREE), recorded(FREE, 3)
    sigma = np.full(len(data.columns.qpos), 1e-3)
    addresses = names_of(model, data.columns.qpos)
    *_, spread = start_state(model, data, data.episodes[0], 100, sigma, addresses)
    assert (spread > 0).all()


BALL = """
<mujoco><option timestep="0.002" integrator="RK4"/><worldbody>
  <body name="weight"><joint name="ball" type="ball" damping=".05"/>
    <geom type="sphere" size=".05" pos="0 0 -.4" mass="1"/></body>
</worldbody><actuator><motor name="motor" joint="ball" gear="1 0.5 0 0 0 0"/></actuator></mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("velocities", [True, False])
def test_a_complete_machine_with_a_ball_joint_is_complete(velocities: bool) -> None:
    data = recorded(BALL, 4, velocities=velocities)
    report = trace(BALL, data, ["weight.mass"], candidates=["payload"], horizon=0.4, threads=1)
    assert report.verdict == "complete"
    assert report.adequacy_before.ratio == pytest.approx(1.0, abs=0.06)


SERVO = """
<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body>
  <joint name="elbow" axis="0 1 0" damping=".2" armature=".02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass=".8" contype="0" conaffinity="0"/>
  <body name="hand" pos="0 0 -.3"><geom size=".04" mass=".6" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><position name="servo" joint="elbow" kp="50" kv="3" forcerange="-20 20"/></actuator></mujoco>
"""


@pytest.mark.slow
def test_a_stiff_servo_that_steps_is_complete_from_slow_positions() -> None:
    model, resolution = mujoco.MjModel.from_xml_string(SERVO.replace('mass=".6"', 'mass=".75"')), 2 * np.pi / 4096
    rng, tables = np.random.default_rng(0), {}
    for run in range(8):
        data, rows = mujoco.MjData(model), []
        commands = np.repeat(rng.uniform(-1, 1, 20), rng.integers(15, 40))[:400]
        for k, command in enumerate(commands):
            data.ctrl[0] = command
            rows.append((0.02 * k, np.round(data.qpos[0] / resolution) * resolution, command))
            mujoco.mj_step(model, data, 10)
        tables[f"run{run}"] = dict(zip(("time", "qpos.elbow", "ctrl.servo"), np.array(rows).T))
    report = trace(SERVO, Measurements.from_tables(tables), declared=["hand.mass"], threads=1)
    assert report.verdict == "complete", str(report)
    assert report.declared[0].effect.values[0] == pytest.approx(0.75, rel=0.01)
