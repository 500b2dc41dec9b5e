from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.tracing.planting import KINDS, SYSTEMS, generate
from benchmarks.tracing.planting.plants import (
    CommandDelay,
    CoulombFriction,
    GravityTilt,
    Payload,
    PositionFriction,
    Spring,
)
from benchmarks.tracing.planting.simulation import Simulation
from sb3_rpto.sysid.findings import FindingKind

SHORT = {"episodes": 4, "duration": 0.8}


def measured(planted):
    table = planted.measurements.tables()
    return np.stack([values for name, values in table.items() if name.startswith(("qpos", "qvel", "ctrl"))])


@pytest.fixture(scope="module")
def complete():
    return generate("double_pendulum", None, 0, **SHORT)


#: One kind of five in the quick tests.
every_kind = pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if i % 5 else ()) for i, kind in enumerate(KINDS)]
)


@every_kind
def test_every_effect_changes_what_is_measured(kind, complete):
    small, large = (generate("double_pendulum", [(kind, size)], 0, **SHORT) for size in ("small", "large"))
    shift = [np.sqrt(np.mean((measured(p)[:2] - measured(complete)[:2]) ** 2)) for p in (small, large)]
    assert shift[0] > 2e-3, "less than twice the noise"
    assert shift[1] > shift[0]
    assert small.truth.explainable == KINDS[kind].library
    assert list(small.truth.effects) == list(small.truth.places) == [kind]
    assert small.truth.declared == complete.truth.declared
    assert small.xml == complete.xml


@every_kind
def test_null_effect_leaves_the_data_as_they_are(kind, complete):
    np.testing.assert_array_equal(
        measured(generate("double_pendulum", [(kind, "null")], 0, **SHORT)), measured(complete)
    )


def test_same_seed_same_data():
    effects = [("coulomb_friction", "small"), ("random_walk", "large")]
    first, again = (generate("arm3", effects, 7, jitter=0.2, **SHORT) for _ in range(2))
    np.testing.assert_array_equal(measured(first), measured(again))
    assert first.truth.effects == again.truth.effects
    other = generate("arm3", effects, 8, **SHORT)
    assert other.truth.effects != first.truth.effects
    assert other.truth.declared != first.truth.declared


def test_a_pair_acts_together_in_any_order():
    effects = [("command_delay", "large"), ("coulomb_friction", "large")]
    planted = [generate("cartpole", e, 1, **SHORT) for e in (effects, effects[::-1])]
    np.testing.assert_array_equal(measured(planted[0]), measured(planted[1]))
    assert set(planted[0].truth.effects) == {"command_delay", "coulomb_friction"}
    assert planted[0].truth.places["command_delay"] == "motor"


def test_declared_parameters_are_displaced_by_up_to_15_percent():
    ratios = []
    for seed in range(5):
        planted = generate("arm3", None, seed, episodes=1, duration=0.05)
        nominal = SYSTEMS["arm3"].declared
        assert planted.declared == tuple(nominal)
        assert planted.xml == SYSTEMS["arm3"].xml
        ratios += [planted.truth.declared[name] / nominal[name] for name in nominal]
    assert 0.85 <= min(ratios) < 0.92
    assert 1.08 < max(ratios) <= 1.15


def test_noise_quantum_and_velocity():
    exact = generate("pendulum", None, 0, noise=0.0, **SHORT)
    np.testing.assert_array_equal(np.stack([e.qpos for e in exact.measurements.episodes]), exact.truth.qpos)
    noisy = generate("pendulum", None, 0, noise=2e-3, episodes=10, duration=1.0)
    for name, size in (("qpos", 2e-3), ("qvel", 4e-2)):
        error = np.stack([getattr(e, name) for e in noisy.measurements.episodes]) - getattr(noisy.truth, name)
        assert np.std(error) == pytest.approx(size, rel=0.05)
    coarse = generate("pendulum", None, 0, quantum=0.01, velocity=False, **SHORT)
    steps = np.concatenate([e.qpos for e in coarse.measurements.episodes]) / 0.01
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert coarse.measurements.columns.missing == ("hinge",)


def test_each_episode_has_encoders_with_zeros_of_their_own():
    planted = generate("double_pendulum", None, 0, noise=0.0, zeros=0.05, **SHORT)
    shown = np.stack([e.qpos for e in planted.measurements.episodes]) - planted.truth.qpos
    np.testing.assert_allclose(shown, np.broadcast_to(planted.truth.zeros[:, None], shown.shape), atol=1e-12)
    assert len(np.unique(planted.truth.zeros)) == planted.truth.zeros.size
    with pytest.raises(ValueError, match="zeros is -1"):
        generate("pendulum", None, 0, zeros=-1, **SHORT)


def test_jittered_clock_is_recorded_truly():
    planted = generate("pendulum", None, 0, noise=0.0, jitter=0.4, **SHORT)
    assert {f.kind for f in planted.measurements.findings} == {FindingKind.JITTER}
    for episode in planted.measurements.episodes:
        step = np.diff(episode.time)
        assert step.min() > 0.6 * 0.005
        assert step.max() < 1.4 * 0.005
        mean = np.diff(episode.qpos[:, 0]) / step
        np.testing.assert_allclose(mean, (episode.qvel[1:, 0] + episode.qvel[:-1, 0]) / 2, atol=5e-3)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "cartpole" else pytest.mark.slow) for name in SYSTEMS]
)
def test_motion_is_sensible_and_commands_span_small_and_large(name):
    planted = generate(name, [("coulomb_friction", "small")], 2)
    assert planted.measurements.findings == []
    reach = np.abs(planted.truth.qpos).max((0, 1))
    assert reach.max() < 2 * np.pi
    assert reach.min() > 0.3
    if name == "cartpole":
        assert reach[0] < 2
    peak = SYSTEMS[name].peak[SYSTEMS[name].driven]
    command = np.abs(np.stack([e.ctrl for e in planted.measurements.episodes])) / peak
    assert command.max() <= 1
    assert (command.max((0, 1)) > 0.9).all()
    loudness = np.sqrt((command**2).mean((1, 2)))
    assert loudness.max() > 1.5 * loudness.min()


@pytest.mark.parametrize("name", SYSTEMS)
def test_mujoco_replays_the_complete_model(name):
    """The recorded commands, held between samples, drive MuJoCo along the same path."""
    planted = generate(name, None, 3, episodes=2, duration=0.5, noise=0.0)
    model = mujoco.MjModel.from_xml_string(SYSTEMS[name].with_declared(planted.truth.declared).xml)
    model.opt.timestep, model.opt.integrator = 0.0005, mujoco.mjtIntegrator.mjINT_RK4
    for episode in planted.measurements.episodes:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = episode.qpos[0], episode.qvel[0]
        for command in episode.ctrl[:-1]:
            data.ctrl[:] = command
            mujoco.mj_step(model, data, 10)
        np.testing.assert_allclose(data.qpos, episode.qpos[-1], atol=2e-5)


@pytest.mark.slow
def test_halving_the_step_changes_little_with_friction_in_every_joint():
    system = SYSTEMS["arm3"]
    ends = []
    for steps in (10, 20, 100):
        plants = [CoulombFriction(0, 0.5), PositionFriction(1, 0.4, 0.0)]
        sim = Simulation(system, plants, np.full((1, 3), 0.5), np.zeros((1, 3)), np.random.default_rng(0))
        for k in range(60):
            sim.hold(
                2 * np.sin(0.1 * k) * np.ones((1, 3)) * [[1, 0.4, 0.05]],
                np.full(1, k * 0.005),
                np.full(1, 0.005),
                steps,
            )
        ends.append(sim.q)
    errors = [np.abs(end - ends[-1]).max() for end in ends[:2]]
    assert errors[0] < 1e-3
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"system": "unicycle"}, "unicycle"),
        ({"effects": [("spring", "small"), ("spring", "large")]}, "once"),
        ({"jitter": 1.0}, "jitter"),
        ({"noise": -1.0}, "noise"),
        ({"duration": 0.01}, "duration"),
        ({"episodes": 0}, "episodes"),
        ({"duration": float("inf")}, "duration is inf"),
        ({"effects": "coulomb_friction"}, "effects hold 'coulomb_friction'; give plants or pairs"),
        ({"effects": ["coulomb_friction"]}, "effects hold 'coulomb_friction'; give plants or pairs"),
        ({"effects": [("coulomb_friction",)]}, "effects hold .*; give plants or pairs"),
        ({"effects": [Spring(5, 0.1)]}, r"spring is at joint 5 of pendulum; it acts at \[0\]"),
        ({"system": "cartpole", "effects": [CommandDelay(1, 0.02)]}, r"command_delay is at joint 1 of cartpole"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        generate(**{"system": "pendulum", "effects": None, "seed": 0} | change)


def test_what_is_planted_is_added_to_what_the_machine_has():
    tilted, loaded = replace(SYSTEMS["pendulum"], tilt=0.2), replace(SYSTEMS["pendulum"], payload=0.3)
    for system, plant in ((tilted, GravityTilt(0, 0.0)), (loaded, Payload(0, 0.0))):
        null, plain = (generate(system, effects, 0, episodes=1, duration=0.5) for effects in ([plant], None))
        np.testing.assert_array_equal(null.truth.qpos, plain.truth.qpos)


def test_numbers_of_numpy_are_written_as_numbers():
    system = SYSTEMS["pendulum"].with_declared({"pole.mass": np.float64(0.5)})
    model = mujoco.MjModel.from_xml_string(replace(system, payload=np.float64(0.1)).xml)
    assert model.body("pole").mass[0] == 0.5
