"""Force residuals by inverse dynamics of motions whose missing force is known."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, RATE, WITH_WHEEL, compiled, recorded

from sb3_rpto.effects import Drive, Simulation, declare
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction, QuadraticDrag
from sb3_rpto.effects.sensors import SensorBias, SensorDelay, SensorGain
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual, force_residuals, learnable_share, summary, typical


def smooth(episodes: int = 3, duration: float = 4.0) -> np.ndarray:
    """Commands without steps, which a low pass leaves alone."""
    t = np.arange(round(duration * RATE)) / RATE
    return np.stack([np.sin(2 * np.pi * f * t + f) for f in np.linspace(0.4, 0.8, episodes)])


def swinging(planted: list[Effect], noise: float = 0.0, seed: int = 0) -> Measurements:
    return recorded(planted, episodes=3, duration=4.0, noise=noise, commands=smooth(), seed=seed)


def residuals(data: Measurements, effects: list[Effect] | None = None) -> list[ForceResidual]:
    simulation = Simulation(compiled(), effects or [], 1)
    return force_residuals(simulation, simulation.values(), data)


def inner(r: ForceResidual, values: np.ndarray) -> np.ndarray:
    """Of the hinge, without what little filters and differences still bend."""
    return values[20:-20, 0]


def test_complete_data_leave_nothing() -> None:
    for r in residuals(swinging([])):
        force = inner(r, r.force)
        assert np.sqrt(np.mean(force**2)) < 0.005 * np.sqrt(np.mean(inner(r, r.load) ** 2))


def test_the_ends_do_not_hide_that_nothing_is_left() -> None:
    found = residuals(swinging([]))
    load = np.concatenate([r.load for r in found])
    assert summary(found)[0] < 0.02 * np.sqrt(np.mean(load**2))
    for r in found:
        assert 0 < r.time[0] < 0.2
        assert 3.8 < r.time[-1] < 4.0


def test_noise_on_complete_data_leaves_noise_around_zero() -> None:
    clean, noisy = ([inner(r, r.force) for r in residuals(swinging([], n))] for n in (0.0, 1e-3))
    for quiet, force in zip(clean, noisy):
        # Correlated over about a thirtieth of a second, so that 3.4 s hold some hundred values.
        assert abs(np.mean(force - quiet)) < 4 * np.std(force) / np.sqrt(100)
        assert np.std(force) > 3 * np.std(quiet)
    doubled = [inner(r, r.force) for r in residuals(swinging([], 2e-3))]
    assert np.std(np.concatenate(doubled)) == pytest.approx(2 * np.std(np.concatenate(noisy)), rel=0.15)


@pytest.mark.parametrize("offset", [0.1, -0.25])
def test_a_planted_torque_is_the_residual(offset: float) -> None:
    for r in residuals(swinging([TorqueOffset("hinge", offset=offset)])):
        force = inner(r, r.force)
        np.testing.assert_allclose(np.mean(force), offset, atol=0.004)
        np.testing.assert_allclose(force, offset, atol=0.03)


def test_a_traced_torque_is_no_longer_in_the_residual() -> None:
    effect = TorqueOffset("hinge", offset=0.2)
    for r in residuals(swinging([effect]), [effect]):
        np.testing.assert_allclose(inner(r, r.force), 0, atol=0.03)


@pytest.mark.parametrize(
    "sensor",
    [SensorBias("hinge", offset=0.3), SensorGain("hinge", change=0.15), SensorDelay("hinge", delay=0.03)],
    ids=lambda effect: effect.kind,
)
def test_a_known_fault_of_a_sensor_is_taken_off(sensor: Effect) -> None:
    true = swinging([])
    sensor.bind(compiled())
    episodes = []
    for e in true.episodes:
        x = np.tile(sensor.values, (len(e), 1))
        then = e.time - sensor.late(x)
        shown = sensor.observe(np.interp(then, e.time, e.qpos[:, 0]), np.interp(then, e.time, e.qvel[:, 0]), x)
        qpos = e.qpos.copy()
        qpos[:, 0] = shown[0]
        episodes.append(replace(e, qpos=qpos))
    left = [
        np.std(np.concatenate([inner(r, r.force) for r in residuals(replace(true, episodes=episodes), effects)]))
        for effects in ([], [sensor])
    ]
    assert left[1] < 0.05 * left[0]


def test_dry_friction_shows_as_its_level_against_the_motion() -> None:
    level = 0.15
    found = residuals(swinging([CoulombFriction("hinge", level=level)]))
    force, speed = (np.concatenate([inner(r, getattr(r, n)) for r in found]) for n in ("force", "qvel"))
    fast = np.abs(speed) > 0.4 * np.abs(speed).max()
    assert fast.sum() > 500
    for sign in (-1, 1):
        mine = fast & (np.sign(speed) == sign)
        assert np.mean(force[mine]) == pytest.approx(-sign * level, rel=0.05)
    np.testing.assert_allclose(force[fast], -level * np.sign(speed[fast]), atol=0.2 * level)


@pytest.mark.parametrize("declared", [False, True])
def test_known_dry_friction_is_taken_off(declared: bool) -> None:
    level = 0.15
    effect: Effect = CoulombFriction("hinge", level=level)
    if declared:
        effect = declare(compiled(), ["hinge.frictionloss"])[0].with_values(np.array([level]))
    data = swinging([effect])
    before, after = summary(residuals(data)), summary(residuals(data, [effect]))
    assert before[0] == pytest.approx(level, rel=0.15)
    assert after[0] < 0.3 * before[0]


def test_drag_shows_as_its_law() -> None:
    effect = QuadraticDrag("hinge", coefficient=0.02)
    for r in residuals(swinging([effect])):
        v = inner(r, r.qvel)
        np.testing.assert_allclose(inner(r, r.force), -0.02 * np.abs(v) * v, atol=0.02)


def test_the_actuators_force_is_the_load_and_off_actuators_have_none() -> None:
    data = swinging([])
    found = residuals(data)[0]
    # Held from a sample to the next: on average half a sample late.
    expected = np.interp(found.time - 0.5 / RATE, np.arange(800) / RATE, smooth()[0])
    np.testing.assert_allclose(found.load[:, 0], expected, atol=0.005)
    off = [replace(e, enabled=np.zeros_like(e.enabled)) for e in data.episodes]
    assert not residuals(replace(data, episodes=off))[0].load.any()


@pytest.mark.parametrize(
    "rounded", [lambda t: t.astype(np.float32).astype(float), lambda t: t + 1.7e9], ids=["float32", "since 1970"]
)
def test_commands_are_those_of_their_samples_on_a_rounded_clock(rounded) -> None:
    data = swinging([])
    clocked = replace(data, episodes=[replace(e, time=rounded(e.time)) for e in data.episodes])
    for exact, found in zip(residuals(data), residuals(clocked)):
        n = min(len(exact.command), len(found.command))
        assert n > 500
        np.testing.assert_array_equal(found.command[:n], exact.command[:n])


def test_a_setting_of_a_run_is_in_its_model() -> None:
    heavy = declare(compiled(), ["pole.mass"])[0].with_values(np.array([0.8]))
    data = swinging([heavy])
    known = [replace(e, params={"pole.mass": 0.8}) for e in data.episodes]
    plain, told = summary(residuals(data)), summary(residuals(replace(data, episodes=known)))
    assert told[0] < 0.05 * plain[0]


def test_the_motion_of_a_floating_base_is_in_the_residual_of_its_joints() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
        <freejoint name="root"/><geom type="box" size=".1 .1 .1" mass="1"/><body pos=".1 0 0">
        <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass=".5"/>
        </body></body></worldbody></mujoco>""")
    simulation, spin = Simulation(model, [], 1), np.array([[0, 0, 0, 0, 2.0, 0, 1.0]])
    q, v = simulation.rollout(np.empty((1, 0)), model.qpos0[None], spin, Drive(np.zeros((1, 2000, 0))))
    q, v = q[0, :-1:5], v[0, :-1:5]
    table = {"time": 0.01 * np.arange(len(q)), "qpos.hinge": q[:, 7], "qvel.hinge": v[:, 6]}
    table |= {f"qpos.root.{i}": q[:, i] for i in range(7)} | {f"qvel.root.{i}": v[:, i] for i in range(6)}
    (found,) = force_residuals(simulation, simulation.null, Measurements.from_tables({"run": table}))
    assert np.sqrt(np.mean(found.force[:, 6] ** 2)) < 0.005


def test_typical_magnitudes_are_those_of_the_motion() -> None:
    model = compiled(WITH_WHEEL)
    data = recorded(model=model, episodes=3, duration=4.0, noise=0.0, commands=smooth())
    simulation = Simulation(model, [], 1)
    found = typical(simulation, force_residuals(simulation, np.empty(0), data))
    speed = np.concatenate([e.qvel[:, 0] for e in data.episodes])
    assert found.velocity[0] == pytest.approx(np.quantile(np.abs(speed), 0.95), rel=0.05)
    assert found.torque[0] == pytest.approx(np.quantile(np.abs(smooth()), 0.95), rel=0.05)
    assert found.command[0] == pytest.approx(np.quantile(np.abs(smooth()), 0.95), rel=0.02)
    assert found.span[0] == pytest.approx(np.ptp(np.concatenate([e.qpos[:, 0] for e in data.episodes])), rel=0.02)
    assert found.inertia[1] == pytest.approx(0.5 * 1.0 * 0.1**2, rel=1e-6)  # of the cylinder about its axis
    np.testing.assert_allclose(found.mass[1:], [0.5, 1.0])
    assert np.all(found.torque > 0)


@pytest.mark.parametrize("floor", [False, True])
def test_a_motor_that_hardly_acts_measures_forces_on_the_ground_alone(floor: bool) -> None:
    ground = '<geom type="plane" size="9 9 1" pos="0 0 -.42"/>' if floor else ""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.001"/><worldbody>{ground}<body>
        <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass=".5"/>
        </body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>""")
    true = model.__copy__()
    true.dof_damping[0], true.geom_contype[:], true.geom_conaffinity[:] = 0.3, 0, 0  # the floor is the model's alone
    simulation, push = Simulation(true, [], 1), 0.002 * np.sin(np.arange(3000) / 90)[None, :, None]
    q, v = simulation.rollout(np.empty((1, 0)), np.array([[2.0]]), np.zeros((1, 1)), Drive(push))
    columns = {"qpos.hinge": q[0, :-1:5, 0], "qvel.hinge": v[0, :-1:5, 0], "ctrl.motor": push[0, ::5, 0]}
    data = Measurements.from_tables({"run": {"time": 0.005 * np.arange(600), **columns}})
    found = typical(Simulation(model, [], 1), force_residuals(Simulation(model, [], 1), np.empty(0), data))
    needed = 0.3 * found.velocity[0]
    assert found.torque[0] == pytest.approx(0.004 if floor else needed, rel=0.1)


# --- what is learnable ------------------------------------------------------------------------------------------------


def made(force, count: int = 3, samples: int = 800, seed: int = 0) -> list[ForceResidual]:
    """Residuals of a smooth motion of two joints, ``force(q, v, rng)`` (T, 2)."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE
    out = []
    for i in range(count):
        w, p = rng.uniform(2, 6, 2), rng.uniform(0, 6, 2)
        q, v = np.sin(w * t[:, None] + p), w * np.cos(w * t[:, None] + p)
        out.append(
            ForceResidual(str(i), t, q, v, rng.standard_normal((samples, 2)), np.zeros((samples, 1)), force(q, v, rng))
        )
    return out


def test_nothing_is_learnable_in_noise_and_nearly_all_of_a_function_of_the_state() -> None:
    noise = made(lambda q, v, rng: rng.standard_normal(q.shape))
    assert np.all(learnable_share(noise, 0) < 0.03)
    law = made(lambda q, v, rng: 0.3 * v + np.sin(q) - 0.5 * np.tanh(3 * v))
    assert np.all(learnable_share(law, 0) > 0.95)


def test_half_noise_is_half_learnable_joint_by_joint() -> None:
    def mixed(q, v, rng):
        signal = v[:, :1] / v[:, 0].std()
        return np.concatenate([signal + rng.standard_normal(signal.shape), rng.standard_normal(signal.shape)], axis=1)

    share = learnable_share(made(mixed, 6, 2000), 0)
    assert share[0] == pytest.approx(0.5, abs=0.07)
    assert share[1] < 0.03


def test_too_few_samples_to_judge_on_have_no_learnable_share() -> None:
    """A test run of an episode that ended at once leaves a sample or two."""
    assert np.isnan(learnable_share(made(lambda q, v, rng: -v, 1, 2), 0)).all()


def test_a_share_of_short_runs_is_none_and_short_runs_beside_long_ones_change_none() -> None:
    """An eighth of a short run is like the one before it, and so is predicted."""
    law = made(lambda q, v, rng: np.tanh(v), 3, 800)
    assert np.isnan(learnable_share(made(lambda q, v, rng: np.tanh(v), 4, 25), 0)).all()
    np.testing.assert_array_equal(
        learnable_share([*law, *made(lambda q, v, rng: 0 * v, 4, 25)], 0), learnable_share(law, 0)
    )


def test_a_limits_own_force_is_not_missing() -> None:
    model = compiled(PENDULUM.replace('axis="0 -1 0"', 'axis="0 -1 0" range="-20 20" limited="true"'))
    data = recorded([], model, episodes=2, duration=3.0, noise=0.0, start=[0.1, 0.1])
    assert any(np.abs(e.qpos).max() > np.deg2rad(20) for e in data.episodes)
    simulation = Simulation(model, [], 1)
    found = force_residuals(simulation, simulation.values(), data)
    pushed = np.concatenate([r.force[r.stopped[:, 0], 0] for r in found if r.stopped is not None])
    load = np.concatenate([r.load for r in found])
    assert np.abs(pushed).max() > 0.5 * np.abs(load).max()
    assert summary(found)[0] < 0.05 * np.sqrt(np.mean(load**2))


def test_learnable_share_of_nothing_is_zero_and_the_same_for_a_seed() -> None:
    np.testing.assert_array_equal(learnable_share(made(lambda q, v, rng: 0 * q), 0), 0)
    law = made(lambda q, v, rng: v**2)
    np.testing.assert_array_equal(learnable_share(law, 3), learnable_share(law, 3))


def test_the_summary_leaves_rest_out() -> None:
    rest = ForceResidual("a", *[np.zeros((10, 1))] * 5, np.full((10, 1), 100.0))
    moving = ForceResidual("b", *[np.ones((40, 1))] * 5, np.full((40, 1), -2.0))
    assert summary([rest, moving]) == pytest.approx([2.0])


def test_the_summary_of_a_joint_that_is_always_at_its_limit_is_not_known() -> None:
    stopped = ForceResidual("a", *[np.ones((40, 1))] * 6, False, np.ones((40, 1), bool))
    assert np.isnan(summary([stopped])).all()


def test_a_run_shorter_than_the_filter_is_taken() -> None:
    limited = compiled(PENDULUM.replace('name="hinge"', 'name="hinge" limited="true" range="-170 170"'))
    data = recorded(model=limited, episodes=2)
    long, short = data.episodes
    names = ("time", "qpos", "qvel", "ctrl", "enabled", "usable", "placed")
    brief = replace(short, **{name: getattr(short, name)[:8] for name in names if getattr(short, name) is not None})
    data = replace(data, episodes=[long, brief])
    simulation = Simulation(limited, [], 1)
    for found in force_residuals(simulation, simulation.values(), data):
        assert found.stopped is not None
        assert found.stopped.shape == found.qvel.shape
