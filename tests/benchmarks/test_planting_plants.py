from dataclasses import replace

import numpy as np
import pytest

from benchmarks.tracing.planting import KINDS, SYSTEMS, draw, places
from benchmarks.tracing.planting.outside import BoucWen, Flexible, RandomWalk, Thermal, WindGusts
from benchmarks.tracing.planting.plants import (
    ActuatorLag,
    Backlash,
    CommandDeadband,
    CommandDelay,
    CommandGain,
    CommandSaturation,
    CoulombFriction,
    LoadFriction,
    PositionFriction,
    QuadraticDrag,
    SensorBias,
    SensorDelay,
    SensorGain,
    StribeckFriction,
    TorqueRipple,
)
from benchmarks.tracing.planting.simulation import Simulation, stop

INERTIA = 0.5 * 0.6**2 / 3
ONE = np.ones(1)


def wheel(*plants, q=0.0, qd=0.0, damping=0.0):
    """A horizontal rod: nothing but inertia, and what is planted."""
    system = replace(SYSTEMS["pendulum"].with_declared({"hinge.damping": damping}), vertical=False)
    return Simulation(system, plants, np.full((1, 1), q), np.full((1, 1), qd), np.random.default_rng(0))


def hold(sim, command, start, duration, steps):
    sim.hold(np.full(sim.q.shape, command), np.full(len(sim.q), start), np.full(len(sim.q), duration), steps)


def test_coulomb_friction_decelerates_linearly_and_holds_exactly():
    friction, speed = 0.2, 3.0
    sim = wheel(CoulombFriction(0, friction), qd=speed)
    slowing = friction / INERTIA
    hold(sim, 0.0, 0.0, 0.5, 1000)
    np.testing.assert_allclose(sim.qd, speed - slowing * 0.5, rtol=1e-12)
    np.testing.assert_allclose(sim.q, speed * 0.5 - slowing * 0.125, rtol=1e-12)
    hold(sim, 0.0, 0.5, 1.0, 2000)
    assert sim.qd == 0
    np.testing.assert_allclose(sim.q, speed**2 / (2 * slowing), atol=1e-6)
    stands = sim.q.copy()
    hold(sim, 0.999 * friction, 1.5, 1.0, 2000)
    assert sim.qd == 0
    assert sim.q == stands
    hold(sim, 1.5 * friction, 2.5, 0.1, 200)
    np.testing.assert_allclose(sim.qd, 0.5 * friction / INERTIA * 0.1, rtol=1e-9)


def test_stribeck_friction_breaks_away_above_its_static_torque():
    plant = StribeckFriction(0, coulomb=0.1, static=0.2, speed=0.1)
    sim = wheel(plant)
    hold(sim, 0.199, 0.0, 0.5, 1000)
    assert sim.qd == 0
    sim = wheel(plant, qd=3.0)
    hold(sim, 0.0, 0.0, 0.1, 200)
    np.testing.assert_allclose(sim.qd, 3 - 0.1 / INERTIA * 0.1, rtol=1e-9)


def test_load_friction_turns_with_the_motor():
    sim = wheel(LoadFriction(0, 0.2), qd=3.0)
    hold(sim, 1.0, 0.0, 0.1, 200)
    np.testing.assert_allclose(sim.qd, 3 + 0.8 / INERTIA * 0.1, rtol=1e-9)


def test_position_friction_vanishes_opposite_to_its_phase():
    plant = PositionFriction(0, torque=0.4, phase=0.5)
    q = np.array([0.5, 0.5 + np.pi / 2, 0.5 + np.pi])
    np.testing.assert_allclose(plant.bound(q, q, q), [0.4, 0.2, 0.0], atol=1e-15)


def test_quadratic_drag_slows_as_one_over_time():
    sim = wheel(QuadraticDrag(0, 0.05), qd=4.0)
    hold(sim, 0.0, 0.0, 1.0, 2000)
    np.testing.assert_allclose(sim.qd, 4 / (1 + 4 * 0.05 / INERTIA), rtol=1e-6)


def test_ripple_has_six_periods_a_turn():
    plant, q = TorqueRipple(0, sine=0.3, cosine=0.4), np.linspace(0, 1, 7)
    np.testing.assert_allclose(plant.force(q + np.pi / 3, q), plant.force(q, q), atol=1e-12)
    np.testing.assert_allclose(plant.force(np.zeros(1), q[:1]), 0.4)


def test_friction_in_coupled_joints_meets_its_conditions():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(500, 3, 3))
    inverse = half @ half.transpose(0, 2, 1) + 0.3 * np.eye(3)
    v, bound = rng.normal(size=(500, 3)), rng.uniform(0, 1, (500, 3))
    bound[rng.random((500, 3)) < 0.2] = 0.0
    after, p = stop(inverse, v, bound, np.zeros_like(v))
    np.testing.assert_allclose(after, v + np.einsum("eij,ej->ei", inverse, p), atol=1e-9)
    sticks = np.abs(p) < bound
    assert sticks.mean() > 0.1
    assert (after[sticks] == 0).all()
    np.testing.assert_allclose(p[~sticks], (-bound * np.sign(after))[~sticks], atol=1e-9)


@pytest.mark.parametrize("delay", [0.003, 0.005, 0.0123, 0.0301])
def test_delay_shifts_the_command_exactly(delay):
    commands, rng = np.random.default_rng(1).normal(size=40), np.random.default_rng(0)
    plant, h = CommandDelay(0, delay), 0.0005
    plant.reset(np.zeros(1), rng)
    torques = []
    for k, u in enumerate(commands):
        plant.command(np.array([u]), np.array([k * 0.005]))
        steps = (k * 0.005 + i * h for i in range(10))
        torques += [plant.drive(u * ONE, ONE, ONE, np.array([t]), np.array([h]))[0] for t in steps]
    integral = np.concatenate([[0.0], np.cumsum(commands) * 0.005])
    ends = np.arange(1, 401) * h - delay
    expected = np.interp(ends, np.arange(41) * 0.005, integral)
    np.testing.assert_allclose(np.cumsum(torques) * h, expected, atol=1e-12)


def test_lag_follows_its_exponential():
    plant, tau, h = ActuatorLag(0, 0.02), 0.02, 0.001
    plant.reset(np.zeros(1), np.random.default_rng(0))
    mean = np.mean([plant.drive(ONE, ONE, ONE, i * h * ONE, h * ONE)[0] for i in range(50)])
    np.testing.assert_allclose(mean, 1 - tau / 0.05 * (1 - np.exp(-0.05 / tau)), rtol=1e-12)


def test_command_maps():
    u, t = np.array([-2.0, -0.3, 0.0, 0.3, 2.0]), np.zeros(5)
    np.testing.assert_allclose(CommandDeadband(0, 0.5).command(u, t), [-1.5, 0, 0, 0, 1.5])
    np.testing.assert_allclose(CommandSaturation(0, 1.0).command(u, t), [-1, -0.3, 0, 0.3, 1])
    np.testing.assert_allclose(CommandGain(0, 0.5).command(u, t), u / 2)


def test_backlash_is_the_play_operator():
    plant = Backlash(0, gap=0.4)
    plant.reset(np.zeros(1), np.random.default_rng(0))
    out = [plant.command(u * ONE, ONE)[0] for u in (0.1, 1.0, 0.7, 0.5, -1.0, -0.7)]
    np.testing.assert_allclose(out, [0.0, 0.8, 0.8, 0.7, -0.8, -0.8])


def test_sensors():
    sim = wheel(SensorBias(0, 0.1), SensorGain(0, 1.1), q=1.0, qd=2.0)
    q, qd = sim.sense()
    np.testing.assert_allclose([q[0, 0], qd[0, 0]], [1.1 * 1.1, 2.2])


def test_a_late_sensor_shows_the_motion_of_before():
    force, delay = 0.3, 0.0123
    sim = wheel(SensorDelay(0, delay), SensorBias(0, 0.1), q=0.2)
    np.testing.assert_allclose(np.array(sim.sense()).ravel(), [0.3, 0.0])
    hold(sim, force, 0.0, 0.004, 2)
    np.testing.assert_allclose(np.array(sim.sense()).ravel(), [0.3, 0.0], err_msg="at first the first state")
    for k in range(1, 20):
        hold(sim, force, 0.004 * k, 0.004, 2)
    then = 0.08 - delay
    shown = np.array(sim.sense()).ravel()
    np.testing.assert_allclose(shown, [0.3 + force / INERTIA * then**2 / 2, force / INERTIA * then], rtol=1e-9)


def test_elastic_transmission_keeps_momentum_and_has_its_resonance():
    rotor, stiffness = 0.02, 30.0
    plant = Flexible(0, rotor, stiffness, 0.0)
    sim = wheel(plant, qd=1.0)
    period = 2 * np.pi / np.sqrt(stiffness * (1 / rotor + 1 / INERTIA))
    hold(sim, 0.0, 0.0, period / 2, 1000)
    center = INERTIA / (INERTIA + rotor)
    np.testing.assert_allclose(sim.qd, center - (1 - center), rtol=1e-4)
    np.testing.assert_allclose(INERTIA * sim.qd[0] + rotor * plant._rate, INERTIA, rtol=1e-9)


def test_other_effects_outside_the_library():
    thermal = Thermal(0, drop=0.3, duration=4.0)
    np.testing.assert_allclose(thermal.drive(ONE, ONE, ONE, 2 * ONE, ONE), 0.85)
    wind = WindGusts(0, 1.0, 0.5)
    wind.reset(np.zeros(2), np.random.default_rng(0))
    at = [wind.disturb(ONE, ONE, np.full(2, t), np.zeros(2)) for t in (0.3, 2.3)]
    np.testing.assert_allclose(at[0], at[1])
    assert at[0][0] != at[0][1]
    bouc_wen = BoucWen(0, torque=2.0, travel=0.1)
    bouc_wen.reset(np.zeros(1), np.random.default_rng(0))
    for _ in range(2000):
        force = bouc_wen.disturb(ONE, ONE, ONE, 0.001 * ONE)
    np.testing.assert_allclose(force, -2.0, rtol=1e-6)
    walk = RandomWalk(0, rate=0.5)
    walk.reset(np.zeros(4000), np.random.default_rng(0))
    for _ in range(100):
        force = walk.disturb(np.zeros(4000), np.zeros(4000), np.zeros(4000), np.full(4000, 0.02))
    np.testing.assert_allclose(np.std(force), 0.5 * np.sqrt(2), rtol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_null_size_does_nothing(kind):
    system = SYSTEMS["arm3"]
    q = np.full((2, 3), 0.4)
    command = np.random.default_rng(0).normal(size=(10, 2, 3)) * system.peak / 3
    ends = []
    for plants in ([], [draw(system, kind, "null", 0)]):
        sim = Simulation(system, plants, q, np.zeros_like(q), np.random.default_rng(0))
        for k, u in enumerate(command):
            sim.hold(u, np.full(2, k * 0.01), np.full(2, 0.01), 20)
        ends.append(np.array(sim.sense()))
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize("kind", KINDS)
def test_large_is_two_and_a_half_times_small(kind):
    null, small, large = (draw("double_pendulum", kind, size, 3) for size in ("null", "small", "large"))
    assert small.joint == large.joint
    if kind in ("flexible", "thermal"):
        assert small.parameters != large.parameters
        return
    first = next(iter(small.parameters))
    start = {"command_saturation": SYSTEMS["double_pendulum"].links[small.joint].torque}.get(
        kind, null.parameters[first]
    )
    ratio = (large.parameters[first] - start) / (small.parameters[first] - start)
    assert ratio == pytest.approx(2.5, rel=0.25 if kind == "command_saturation" else 1e-9)


def test_places():
    assert places(SYSTEMS["cartpole"], "torque_ripple") == []
    assert places(SYSTEMS["cartpole"], "sensor_bias") == [1]
    assert places(SYSTEMS["reacher"], "sensor_bias") == [1]
    assert places(SYSTEMS["pendulum"], "command_gain") == []
    assert places(SYSTEMS["pendulum"], "sensor_delay") == []
    assert places(SYSTEMS["cartpole"], "sensor_delay") == [0, 1]
    with pytest.raises(ValueError, match="choose another effect"):
        draw("pendulum", "command_gain", "small", 0)
    with pytest.raises(ValueError, match="medium"):
        draw("pendulum", "spring", "medium", 0)
    with pytest.raises(ValueError, match="use one of"):
        places(SYSTEMS["pendulum"], "magic")
