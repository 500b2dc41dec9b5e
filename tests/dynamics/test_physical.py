"""Simulators as trainable dynamics: what is fitted is what the target has, and step() is the environment's own."""

import copy
import importlib.util
import io
import pickle
import warnings
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from gymnasium import spaces, wrappers
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from shifted import HOPPER, POLE, POLES, SHIFTS, collect, joined, noisy, observed, shifted
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPTO
from sb3_rpto.algorithms.target_checks import doubt
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.env import DynamicsEnv
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.simulator import check_memoryless, physical_config
from sb3_rpto.effects import LIBRARY, Declared
from sb3_rpto.effects.commands import CommandDelay, CommandGain
from sb3_rpto.effects.friction import StribeckFriction
from sb3_rpto.effects.sensors import SensorBias
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.observations import States, register_state_map, state_map


def dynamics(env_id, declared=None, **kwargs):
    env = gym.make(env_id)
    declared = tuple(SHIFTS[env_id]) if declared is None else declared
    return PhysicalDynamics(
        env.observation_space, env.action_space, **physical_config(env), declared=declared, threads=1, **kwargs
    )


@pytest.fixture(scope="module")
def poles():
    return collect(shifted(POLES), 100)


@pytest.fixture(scope="module")
def pole():
    return collect(shifted(POLE), 60)


# --- what it is told of the environment -------------------------------------------------------------------------------


def test_a_source_with_forces_of_its_own_is_refused():
    corrected = apply_effects(gym.make(POLE), [CommandDelay("slide", delay=0.05)])
    with pytest.raises(ValueError, match=r"command_delay\(slide\).*which phi would lack"):
        physical_config(corrected)


def test_the_walker_that_answers_stands_on_its_own_legs():
    model = dynamics(HOPPER, ("leg.length",))
    model.attach(gym.make(HOPPER))
    base = model._twin.unwrapped
    height, healthy = base.init_qpos[1], base._healthy_z_range[0]
    model._twin.set_effects([e.with_values(1.2 * e.values) for e in model.effects()])
    assert base.init_qpos[1] == pytest.approx(height + 0.2 * 0.5, abs=1e-6)
    assert base._healthy_z_range[0] > healthy


def test_the_config_is_plain_data_of_its_own():
    env = gym.make(HOPPER)
    config = physical_config(VecNormalize(DummyVecEnv([lambda: env])))
    env.unwrapped.model.body_mass[1] = 99.0
    again = pickle.loads(pickle.dumps(config))
    assert again["frame_skip"] == 4
    assert again["mj_model"].compile().body_mass[1] == gym.make(HOPPER).unwrapped.model.body_mass[1]
    assert again["recover"](np.zeros((2, 11))).qpos.shape == (2, 6)


class OneForAll(gym.ActionWrapper):
    """The same command for every motor."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def action(self, action):
        return np.repeat(action, 3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), "Pendulum-v1 has no MuJoCo model"),
        (lambda: OneForAll(gym.make(HOPPER)), r"Hopper-v5: actions have shape \(1,\), the model 3 actuators"),
        (lambda: wrappers.RescaleAction(gym.make(HOPPER), np.float32(-0.5), np.float32(0.5)), "RescaleAction changes"),
        (lambda: wrappers.TransformObservation(gym.make(HOPPER), lambda o: o, None), "TransformObservation"),
    ],
)
def test_environments_that_it_cannot_have_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        physical_config(make())


def test_clipped_actions_are_commands():
    assert physical_config(wrappers.ClipAction(gym.make(HOPPER)))["frame_skip"] == 4


@pytest.mark.parametrize("name", ["max_step", "max_steps", "randomise"])
@pytest.mark.parametrize("value", [-1, float("nan"), float("inf"), "a"])
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .*, got"):
        dynamics(POLE, **{name: value})


def test_unknown_names_raise_with_the_near_ones():
    with pytest.raises(ValueError, match=r"no object 'thihg'; did you mean 'thigh'"):
        dynamics(HOPPER, ["thihg.length"])
    with pytest.raises(ValueError, match=r"has no 'lenght'; did you mean 'length'"):
        dynamics(HOPPER, ["thigh.lenght"])
    with pytest.raises(ValueError, match="no effect 'command_dely' is registered; did you mean 'command_delay'"):
        dynamics(POLE, effects=[{"kind": "command_dely", "on": "slide", "values": {}}])
    with pytest.raises(ValueError, match="no actuator 'slid'"):
        dynamics(POLE, effects=[{"kind": "command_delay", "on": "slid", "values": {}}])


def test_actions_of_another_size_are_refused():
    env = gym.make(POLE)
    with pytest.raises(ValueError, match=r"shape \(2,\), the model 1 actuators"):
        PhysicalDynamics(env.observation_space, spaces.Box(-1, 1, (2,)), **physical_config(env))


# --- the fit ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "scale"), [(POLES, 0.3), pytest.param(HOPPER, 1.0, marks=pytest.mark.slow)])
def test_a_fit_finds_what_was_shifted(env_id, scale):
    data = collect(shifted(env_id), 100, scale=scale)
    model = dynamics(env_id)
    before = model.error(data)
    log = model.fit(data, max_steps=30)
    for name, value in SHIFTS[env_id].items():
        assert model.describe()[name] == pytest.approx(value, rel=0.01)
    assert log["left_out"] == 0
    assert log["steps"] <= 30
    assert model.error(data) < 1e-4 * before


def test_the_source_moves_towards_the_target_step_by_step(poles):
    model = dynamics(POLES, max_step=0.05)
    nominal, errors = model.values, [model.error(poles)]
    for _ in range(3):
        before = model.values
        assert model.fit(poles, max_steps=1)["steps"] == 1
        assert np.abs((model.values - before) / nominal).max() <= 0.05 * (1 + 1e-9)
        errors.append(model.error(poles))
    assert errors == sorted(errors, reverse=True)
    assert model.fit(poles, max_steps=0)["steps"] == 0


def test_bounds_hold(poles):
    model = dynamics(POLES, ["pole.length=0.55:0.65", "pole2.length", "hinge.damping"])
    for _ in range(4):
        model.fit(poles, max_steps=1)
        assert 0.55 <= model.values[0] <= 0.65
    assert model.values[0] == 0.65  # the truth lies beyond


def test_transitions_of_no_weight_do_not_count(pole):
    bad = copy.deepcopy(pole.take(slice(20, 35)))
    bad.next_observations[:, 2:] += 5.0
    mixed = joined(pole.take(slice(0, 20)), bad, pole.take(slice(35, None)))
    weights = th.ones(60)
    weights[20:35] = 0
    right, wrong = dynamics(POLE, ["pole.mass"]), dynamics(POLE, ["pole.mass"])
    right.fit(mixed, weights, max_steps=30)
    wrong.fit(mixed, max_steps=30)
    assert abs(wrong.values[0] - right.values[0]) > 1e-3
    without = dynamics(POLE, ["pole.mass"])
    without.fit(joined(pole.take(slice(0, 20)), pole.take(slice(35, None))), max_steps=30)
    np.testing.assert_array_equal(right.values, without.values)
    np.testing.assert_array_equal(right.deviation, without.deviation)


def test_equal_weights_are_none(pole):
    one, other = dynamics(POLE), dynamics(POLE)
    one.fit(pole, th.full((60,), 0.5), max_steps=2)
    other.fit(pole, max_steps=2)
    np.testing.assert_allclose(one.values, other.values, rtol=1e-9)


def test_bad_weights_are_refused(pole):
    for weights, message in (
        (th.ones(59), r"shape \(60,\).*not \(59,\)"),
        (-th.ones(60), "not negative"),
        (th.full((60,), th.nan), "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            dynamics(POLE).fit(pole, weights)


@pytest.mark.parametrize("case", ["empty", "one", "same", "no weight", "nothing declared"])
def test_data_that_say_nothing_change_nothing(pole, case):
    data = {"empty": pole.take(slice(0, 0)), "one": pole.take(slice(0, 1)), "same": pole.take(th.zeros(9).long())}
    model = dynamics(POLE, [] if case == "nothing declared" else None)
    before = model.values
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = model.fit(data.get(case, pole), th.zeros(60) if case == "no weight" else None)
    assert log == {"steps": 0.0, "unobserved": 0.0, "left_out": 0.0}
    np.testing.assert_array_equal(model.values, before)
    np.testing.assert_array_equal(model.deviation, 0)


def test_speeds_at_the_bound_are_left_out_and_counted():
    data = collect(shifted(HOPPER, {"leg.length": 0.55}), 60, scale=1.0)
    wrong = copy.deepcopy(data)
    wrong.observations[[5, 9], 5], wrong.next_observations[[20, 21], 8] = 10.0, -10.0
    wrong.next_observations[5, :5] += 1.0
    model = dynamics(HOPPER, ["leg.length"])
    assert model.fit(wrong, max_steps=8)["left_out"] == 4
    assert model.values[0] == pytest.approx(0.55, rel=1e-3)
    wrong.observations[:, 5:] = 10.0
    assert model.fit(wrong) == {"steps": 0.0, "unobserved": 1.0, "left_out": 60.0}
    assert np.isnan(model.error(wrong))


def test_the_newest_transitions_are_fitted():
    old = collect(gym.make(POLE), PhysicalDynamics.fits_newest, seed=3, scale=0.05)
    delayed = collect(
        shifted(POLE, {}, [CommandDelay("slide", delay=0.07)]), PhysicalDynamics.fits_newest, seed=4, scale=0.1
    )
    model = dynamics(POLE, [], effects=[CommandDelay("slide", delay=0.068).to_json()])
    assert model.fit(joined(old, delayed), max_steps=4)["left_out"] == 0
    assert model.values[0] == pytest.approx(0.07, abs=1e-6)


@pytest.mark.parametrize(("bounds", "ends_at"), [("", 40.0), ("=0.5:10", 10.0)])
def test_a_number_that_is_far_off_is_on_its_way_and_not_unseen(bounds, ends_at):
    data = collect(shifted(POLE, {"slider.damping": 40.0}), 100)
    model = dynamics(POLE, ["slider.damping" + bounds])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that the data do not show it, say
        for _ in range(6):
            model.fit(data)
    assert model.values == pytest.approx([ends_at], rel=1e-6)


def test_a_number_that_is_roughly_told_to_be_far_off_is_fitted():
    """To a tenth of itself, which is three times what it was."""
    data = noisy(collect(shifted(POLES, {"slider.damping": 1.5}), 100, scale=0.3), 3e-3)
    model = dynamics(POLES, ["slider.damping", "hinge.damping", "cart.mass"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(8):
            model.fit(data)
    nominal = np.array([0.05, gym.make(POLES).unwrapped.model.body("cart").mass[0]])
    off = (model.values - [1.5, *nominal]) / model.deviation
    assert np.abs(off).max() < 3
    assert 0.05 < model.deviation[0] < 0.5


def test_what_the_data_do_not_show_is_named_once_and_stays(pole):
    model = dynamics(POLE, ["pole.mass", "cart.friction"])
    nominal = model.values
    with pytest.warns(UserWarning, match=r"do not show cart\.friction: left at") as caught:
        model.fit(pole, max_steps=20)
    assert caught[0].filename == __file__
    assert model.values[1] == nominal[1]
    assert model.deviation[1] == np.inf
    assert 0 < model.deviation[0] < np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.fit(pole)


@pytest.mark.parametrize("level", [0, 1e-3])
def test_what_the_data_do_not_tell_apart_is_named_once_and_one_of_it_stays(level):
    data = noisy(collect(shifted(POLE, {"slide.gear": 130.0, "pole.mass": 7.0}), 100), level)
    model = dynamics(POLE, ["slide.gear", "pole.mass=4:9", "slide.gain"])
    said = r"do not tell slide\.gear, slide\.gain apart: slide\.gain left at"
    with pytest.warns(UserWarning, match=said) as caught:
        model.fit(data, max_steps=20)
    assert caught[0].filename == __file__
    np.testing.assert_allclose(model.values, [130.0, 7.0, 1.0], rtol=0.01)
    assert model.values[2] == 1.0
    np.testing.assert_array_equal(model.deviation[[0, 2]], np.inf)
    assert model.deviation[1] < 0.1
    model.randomise = 2.0
    drawn = [e.values[0] for e in model.effects(np.random.default_rng(0))]
    assert [drawn[0], drawn[2]] == [model.values[0], model.values[2]]
    before = model.values
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.fit(data)
    assert model.values[2] == 1.0
    np.testing.assert_allclose(model.values, before, rtol=1e-3)


def test_all_that_a_direction_has_in_common_is_named_and_one_of_it_stays():
    names = ["cart.mass", "pole.mass", "slide.gear", "slider.damping", "hinge.damping"]  # twice all is the same motion
    data = collect(shifted(POLE, {"slide.gear": 130.0}), 100)
    model = dynamics(POLE, names)
    with pytest.warns(UserWarning, match=rf"tell {', '.join(names)} apart: hinge.damping left"):
        model.fit(data, max_steps=20)
    assert model.error(data) < 1e-6
    assert model.describe()["slide.gear"] == pytest.approx(130.0, rel=1e-3)


def test_numbers_that_are_hard_to_tell_apart_are_all_fitted():
    names = ["*.mass", "slide.gear"]
    data = collect(shifted(POLES, {"slide.gear": 600.0}), 100)
    model = dynamics(POLES, names)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.fit(data, max_steps=40)
    assert model.describe()["slide.gear"] == pytest.approx(600.0, rel=0.01)
    assert np.isfinite(model.deviation).all()


def test_the_deviation_shrinks_with_the_data():
    clean = collect(shifted(POLE), 240)
    said = []
    for n in (60, 240):
        model = dynamics(POLE)
        model.fit(noisy(clean.take(slice(0, n)), 1e-3), max_steps=20)
        said.append(model.deviation)
        truth = np.array(list(SHIFTS[POLE].values()))
        np.testing.assert_array_less(np.abs(model.values - truth), 5 * model.deviation)
    assert (said[1] > 0).all()
    ratio = said[0] / said[1]  # 2 for independent transitions that tell the same
    assert ((ratio > 1.3) & (ratio < 4)).all()
    assert model.describe() == {
        **dict(zip(SHIFTS[POLE], model.values)),
        **{f"{name}_se": d for name, d in zip(SHIFTS[POLE], model.deviation)},
    }


@pytest.mark.slow
def test_what_is_too_faint_to_tell_is_named_and_stays_where_it_was():
    data = noisy(collect(shifted(HOPPER), 60), 0.1)
    model = dynamics(HOPPER, ["*.mass", "*.armature"])
    before = model.values.copy()
    with pytest.warns(UserWarning, match="do not show .*rootx.armature, rootz.armature.*: left at what it was"):
        model.fit(data, max_steps=3)
    left = np.isinf(model.deviation)
    assert 0 < left.sum() < len(left)
    np.testing.assert_array_equal(model.values[left], before[left])
    assert (model.values[~left] != before[~left]).all()
    assert (model.deviation[~left] < model.scale[~left]).all()


def test_a_fit_that_makes_the_simulator_unstable_is_refused(monkeypatch):
    data = collect(shifted(POLE), 60)
    model = dynamics(POLE)
    before = model.describe()
    monkeypatch.setattr(model, "runs_on", lambda _: model.values[0] == before["pole.mass"])
    with pytest.warns(UserWarning, match="becomes unstable: refused, the last one is kept; give bounds"):
        assert model.fit(data)["steps"] == 0
    assert model.describe() == before


@pytest.mark.parametrize("stiffness", [1e9, 1e14])
def test_a_simulator_that_blows_up_does_not_run_on(stiffness):
    data = collect(gym.make(POLE), 30)
    model = dynamics(POLE)
    assert model.runs_on(data)
    model.adopt([LIBRARY["spring"]("hinge", stiffness=stiffness)])
    assert not model.runs_on(data)


PENDULUM = """
<mujoco><option timestep="0.01"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.1"/>
<geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" gear="2"/></actuator></mujoco>
"""


@pytest.mark.parametrize(("env_id", "count"), [("Pusher-v5", 4), ("Reacher-v5", 0)])
def test_what_no_observation_tells_is_counted(env_id, count):
    model = dynamics(env_id, ["*.damping"])
    assert model.fit(collect(gym.make(env_id), 20), max_steps=1)["unobserved"] == count


@pytest.mark.parametrize("form", ["text", "file", "spec"])
def test_an_mjcf_alone_is_fitted_to_its_states(form, tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    model = {"text": PENDULUM, "file": path, "spec": mujoco.MjSpec.from_string(PENDULUM)}[form]
    env = mujoco.MjModel.from_xml_string(PENDULUM.replace('damping="0.1"', 'damping="0.15"'))
    state, rng, rows = mujoco.MjData(env), np.random.default_rng(0), []
    for _ in range(50):
        before, state.ctrl[0] = np.concatenate([state.qpos, state.qvel]), rng.uniform(-1, 1)
        command = state.ctrl.copy()
        mujoco.mj_step(env, state, 2)
        rows.append((before, command, 0.0, np.concatenate([state.qpos, state.qvel]), 0.0))
    data = Transitions(*(th.as_tensor(np.array(column)) for column in zip(*rows)))
    states, commands = spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1, 1, (1,))
    fitted = PhysicalDynamics(states, commands, mj_model=model, frame_skip=2, declared=["hinge.damping"])
    fitted.fit(data)
    assert fitted.describe()["hinge.damping"] == pytest.approx(0.15, rel=1e-6)
    with pytest.raises(ValueError, match=r"shape \(3,\), and states are recovered from 2 numbers; give recover="):
        PhysicalDynamics(spaces.Box(-1, 1, (3,)), commands, mj_model=model)


# --- effects in phi ---------------------------------------------------------------------------------------------------


def test_a_traced_delay_is_taken_in_and_fitted():
    data = collect(shifted(POLES, {"pole.length": 0.7}, [CommandDelay("slide", delay=0.02)]), 80)
    model = dynamics(POLES, ["pole.length"])
    model.fit(data, max_steps=5)
    without = model.error(data)
    model.adopt([CommandDelay("slide", delay=0.013)])
    assert model.names == ["pole.length", "command_delay(slide).delay"]
    model.fit(data, max_steps=20)
    np.testing.assert_allclose(model.values, [0.7, 0.02], rtol=0.01)
    assert model.error(data) < 1e-2 * without


def test_a_biased_sensor_is_fitted():
    bias = SensorBias("hinge", offset=0.05)
    data = collect(shifted(POLE, {"pole.mass": 7.0}, [bias]), 60)
    model = dynamics(POLE, ["pole.mass"])
    model.adopt([SensorBias("hinge", offset=0.01)])
    model.fit(data, max_steps=80)
    np.testing.assert_allclose(model.values, [7.0, 0.05], rtol=0.01)


def test_a_trial_run_begins_at_the_true_state_not_at_what_a_biased_sensor_shows(monkeypatch):
    data = collect(shifted(POLE, {}, [SensorBias("hinge", offset=0.05)]), 20)
    model = dynamics(POLE, ["pole.mass"])
    model.adopt([SensorBias("hinge", offset=0.05)])
    begun, rollout = [], model.simulation.rollout
    monkeypatch.setattr(model.simulation, "rollout", lambda *a: begun.append(a[1].copy()) or rollout(*a))
    actions = data.actions.numpy()
    assert model.runs(data.observations.numpy()[[3, 7]], np.stack([actions[3:8], actions[7:12]]))
    shown = data.observations[[3, 7], 1].numpy()  # the hinge's angle
    np.testing.assert_allclose(begun[0][:, 1], shown - 0.05, atol=1e-6)


def test_adopt_keeps_the_values_of_what_it_is_not_told():
    model = dynamics(POLE)
    found = CommandDelay("slide", delay=0.03)
    mass = model.effects()[0].with_values(np.array([6.0]))
    model.adopt([found, mass])
    assert model.describe()["pole.mass"] == 6.0
    assert model.describe()["hinge.damping"] == 1.0
    assert model.describe()["command_delay(slide).delay"] == 0.03
    model.adopt([StribeckFriction("hinge", extra=0.2, level=0.1, speed=0.5), CommandDelay("slide", delay=0.01)])
    np.testing.assert_array_equal(model.values, [6.0, 1.0, 0.01, 0.2, 0.1, 0.5])
    assert [e.label for e in model.effects()] == [
        *("pole.mass", "hinge.damping", "command_delay(slide)", "stribeck_friction(hinge)")
    ]
    np.testing.assert_array_equal(model.deviation, np.zeros(6))


def test_adopt_takes_a_covariance_and_keeps_that_of_what_it_is_not_told(pole):
    model = dynamics(POLE)
    model.fit(noisy(pole, 1e-3), max_steps=3)
    found = CommandDelay("slide", delay=0.03)
    mass, damping = model.effects()
    before, known = model.effects(), model.covariance.copy()
    assert known[0, 1] == pytest.approx(known[1, 0])
    assert known[0, 1] != 0
    model.adopt([found, damping], np.array([[4e-6, 1e-6], [1e-6, 9e-6]]))
    np.testing.assert_array_equal(model.covariance, [[known[0, 0], 0, 0], [0, 9e-6, 1e-6], [0, 1e-6, 4e-6]])
    model.adopt([mass])
    np.testing.assert_array_equal(model.deviation, [0, 3e-3, 2e-3])
    model.replace(before, known)
    assert model.names == list(SHIFTS[POLE])
    np.testing.assert_array_equal(model.covariance, known)


def test_what_was_added_and_the_state_rebuild_the_model(pole):
    model = dynamics(POLE)
    model.adopt([CommandGain("slide", change=0.1), model.effects()[0].with_values(np.array([6.0]))])
    model.fit(pole, max_steps=2)
    file = io.BytesIO()
    th.save(model.state_dict(), file)
    file.seek(0)
    again = dynamics(POLE, effects=pickle.loads(pickle.dumps(model.added())))
    again.load_state_dict(th.load(file, weights_only=False))
    assert again.describe() == model.describe()
    for each in (model, again):
        each.fit(pole, max_steps=2)
    assert again.describe() == model.describe()  # and learns on alike


def test_effects_are_phi_or_drawn_around_it(pole):
    model = dynamics(POLE, ["pole.mass=4.5:7.5", "hinge.damping"], randomise=2.0)
    rng = np.random.default_rng(0)
    assert [e.values[0] for e in model.effects(rng)] == model.values.tolist()  # before a fit nothing is uncertain
    model.fit(noisy(pole, 0.02), max_steps=20)
    drawn = np.array([[e.values[0] for e in model.effects(rng)] for _ in range(400)])
    assert (drawn >= [4.5, 0]).all()
    assert (drawn[:, 0] <= 7.5).all()
    spread = 2 * model.deviation[1]
    assert drawn[:, 1].std() == pytest.approx(spread, rel=0.2)
    assert drawn[:, 1].mean() == pytest.approx(model.values[1], abs=spread / 4)
    assert [e.values[0] for e in model.effects()] == model.values.tolist()
    assert all(isinstance(e, Declared) for e in model.effects(rng))
    model.randomise = 0.0
    assert [e.values[0] for e in model.effects(rng)] == model.values.tolist()


def test_what_is_told_together_is_drawn_together():
    model = dynamics(POLE, ["pole.mass=0.01:100", "cart.mass=0.01:100", "hinge.damping"], randomise=2.0)
    covariance = np.array([[0.04, -0.019, 0], [-0.019, 0.01, 0], [0, 0, np.inf]])
    model.adopt(model.effects(), covariance)
    rng = np.random.default_rng(0)
    drawn = np.array([[e.values[0] for e in model.effects(rng)] for _ in range(2000)])
    np.testing.assert_allclose(np.cov(drawn[:, :2].T), 4 * covariance[:2, :2], rtol=0.1)
    np.testing.assert_array_equal(drawn[:, 2], model.values[2])  # nothing tells how far it may be off
    assert [e.values[0] for e in model.effects()] == model.values.tolist()


# --- prediction -------------------------------------------------------------------------------------------------------


def test_the_error_is_in_standard_one_step_changes(poles):
    model = dynamics(POLES)
    steps = model._steps(poles)
    off = (steps.reach(model.simulation, model.values[None])[0] - steps.reached) / steps.scale
    assert model.error(poles) == pytest.approx(np.sqrt((off**2).mean()))
    model.adopt([e.with_values(np.array([v])) for e, v in zip(model.effects(), SHIFTS[POLES].values())])
    assert model.error(poles) < 1e-9


def test_it_is_tried_all_along_the_transitions_and_for_twenty_steps(poles, monkeypatch):
    model, tried = dynamics(POLES), []
    monkeypatch.setattr(model, "runs", lambda observations, actions: (tried.append((observations, actions)), True)[1])
    assert model.runs_on(poles)
    ((observations, actions),) = tried
    assert actions.shape == (16, 20, 1)
    rows = [np.flatnonzero((poles.observations.numpy() == row).all(axis=1))[0] for row in observations]
    assert (rows[0], rows[-1]) == (0, len(poles) - 21)
    assert np.ptp(np.diff(rows)) <= 1
    for row, given in zip(rows, actions):
        np.testing.assert_array_equal(given, poles.actions.numpy()[row : row + 20])


def test_a_number_that_was_at_its_bound_has_not_moved_there():
    model = dynamics(POLE, ["slider.frictionloss", "pole.mass=4.5:7.5"])
    assert model.values[0] == model.simulation.lower[0] == 0.0
    assert model.declared_at_bounds() == []
    (loss, mass) = model.effects()
    model.adopt([loss, mass.with_values(np.array([7.5]))])
    assert model.declared_at_bounds() == ["pole.mass = 7.5"]


def test_steps_need_the_environment():
    with pytest.raises(RuntimeError, match="attach"):
        dynamics(POLE).step(th.zeros(1, 4), th.zeros(1, 1))


def test_an_environment_of_the_model_steps_as_the_corrected_one_and_needs_no_more():
    source, model = gym.make(POLES), dynamics(POLES)
    model.adopt([e.with_values(np.array([v])) for e, v in zip(model.effects(), SHIFTS[POLES].values())])
    env, corrected = DynamicsEnv(source, model), apply_effects(source, model.effects())
    seen, expected = env.reset(seed=3)[0], corrected.reset(seed=3)[0]
    for _ in range(5):
        np.testing.assert_allclose(seen, expected, atol=1e-9)
        seen, expected = env.step(np.array([0.5]))[0], corrected.step(np.array([0.5]))[0]


@pytest.mark.parametrize(
    ("late", "refused"), [(CommandDelay("slide", delay=0.04), True), (CommandGain("slide", change=-0.2), False)]
)
def test_an_environment_of_the_model_does_not_lose_what_acts_late(late, refused):
    model = dynamics(POLE)
    model.adopt([late])
    with pytest.raises(ValueError, match=r"command_delay\(slide\).*apply_effects") if refused else nullcontext():
        DynamicsEnv(gym.make(POLE), model)


def test_an_environment_that_cannot_be_copied_is_refused():
    env = gym.make(POLE)
    env.unwrapped.lock = (n for n in ())
    with pytest.raises(ValueError, match="cannot be copied"):
        dynamics(POLE).attach(env)


@pytest.mark.parametrize(("env_id", "sensor"), [(POLES, "hinge"), (HOPPER, "thigh_joint")])
def test_a_step_is_the_corrected_environments_own(env_id, sensor):
    source = gym.make(env_id)
    model = dynamics(env_id)
    model.attach(source)
    model.step(th.zeros(1, source.observation_space.shape[0]), th.zeros(1, source.action_space.shape[0]))
    model.adopt([e.with_values(np.array([v])) for e, v in zip(model.effects(), SHIFTS[env_id].values())])
    model.adopt([StribeckFriction(sensor, extra=0.3, level=0.2, speed=0.4), SensorBias(sensor, offset=0.02)])
    data = collect(apply_effects(source, model.effects()), 40, scale=1.0)
    assert data.terminations.any()
    said = model.step(data.observations, data.actions)
    np.testing.assert_allclose(said.next_observations, data.next_observations, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(said.rewards, data.rewards, rtol=1e-5)
    np.testing.assert_array_equal(said.terminations, data.terminations.bool())
    assert said.next_observations.dtype == data.observations.dtype
    np.testing.assert_array_equal(model.step(data.observations, data.actions).rewards, said.rewards)


def test_a_reward_by_how_far_a_body_came_is_that_of_an_episode_under_way(tmp_path):
    """Ant's is; Euler's method leaves bodies where they were before its last step."""
    assets = Path(importlib.util.find_spec("gymnasium.envs.mujoco").submodule_search_locations[0]) / "assets"
    (tmp_path / "ant.xml").write_text((assets / "ant.xml").read_text().replace("RK4", "Euler"))
    kwargs = {"xml_file": str(tmp_path / "ant.xml"), "frame_skip": 2, "include_cfrc_ext_in_observation": False}
    env = gym.make("Ant-v5", **kwargs)
    spaces_of = env.observation_space, env.action_space
    model = PhysicalDynamics(*spaces_of, **physical_config(env), declared=["torso.mass"], threads=1)
    model.attach(env)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for step in range(8):
        action = env.action_space.sample()
        before = th.as_tensor(observation)[None]
        observation, reward, *_ = env.step(action)
        if step:  # at a reset they are where they are
            said = model.step(before, th.as_tensor(action)[None])
            assert float(said.rewards[0]) == pytest.approx(reward, abs=1e-6)


class Reaching(InvertedPendulumEnv):
    """Each episode has a goal of its own for the cart, which is no part of the model."""

    goal, shown = 0.0, True

    def __init__(self, shown=True):
        super().__init__()
        self.shown = shown
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4 + shown,), np.float64)

    def reset_model(self):
        self.goal = float(self.np_random.uniform(-0.5, 0.5))
        return super().reset_model()

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel, [self.goal] * self.shown])

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, -abs(observation[0] - self.goal), *rest


@pytest.mark.parametrize(("shown", "named"), [(True, r"observation\[4\]"), (False, "the reward")])
def test_a_goal_that_each_reset_draws_is_refused_where_single_steps_would_lack_it(shown, named):
    def recover(obs):
        known = np.ones((len(obs), 2), dtype=bool)
        return States(obs[:, :2], obs[:, 2:4], known, known)

    register_state_map(Reaching, lambda env: recover)
    worlds = {"env": Reaching(shown), "target_env": Reaching(shown)}
    settings = {"declared": ["pole.mass"], "policy_kwargs": {"net_arch": [8]}, "source_steps": 4, "device": "cpu"}
    with pytest.raises(ValueError, match=f"after a step {named} depends on more than the state"):
        RPTO("MlpPolicy", **worlds, dynamics="residual", **settings).learn(4, source_timesteps=0)
    with pytest.raises(ValueError, match=f"after a step {named} depends on more than the state"):
        RPTO("MlpPolicy", **worlds, dynamics="physical", weighting="value_aware", **settings).learn(4)
    RPTO("MlpPolicy", **worlds, dynamics="physical", **settings).learn(4, source_timesteps=0)


class Remembering(InvertedPendulumEnv):
    """Told of a change of its action, or of the time, or showing it."""

    what, before = "", 0.0

    def __init__(self, what):
        super().__init__()
        self.what = what
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4 + (what == "clock"),), np.float64)

    def reset_model(self):
        self.before = 0.0
        return super().reset_model()

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel, [self.data.time] * (self.what == "clock")])

    def step(self, action):
        observation, reward, *rest = super().step(action)
        change, self.before = float(action[0]) - self.before, float(action[0])
        told = {"rate": 0.1 * change**2, "time": (observation[0] - np.sin(9 * self.data.time)) ** 2}
        return observation, reward - told.get(self.what, observation[0] ** 2), *rest


@pytest.mark.parametrize(
    ("what", "named"), [("rate", "the reward"), ("time", "the reward"), ("clock", r"observation\[4\]"), ("none", None)]
)
def test_actions_before_and_the_time_are_more_than_the_state(what, named):
    def recover(obs):
        known = np.ones((len(obs), 2), dtype=bool)
        return States(obs[:, :2], obs[:, 2:4], known, known)

    register_state_map(Remembering, lambda env: recover)
    env = Remembering(what)
    if named is None:
        check_memoryless(env, state_map(env))
    else:
        with pytest.raises(ValueError, match=f"after a step {named} depends on more .*an action before, the time"):
            check_memoryless(env, state_map(env))


@pytest.mark.parametrize("noise", [0.0005, 0.005, 0.05])
def test_observations_that_are_noisier_than_resets_are_no_goal(noise):
    class Noisy(HopperEnv):
        """Behind sensors with white noise; a reset spreads positions and velocities by 0.005."""

        def _get_obs(self):
            return super()._get_obs() + self.np_random.normal(0, noise, 11)

    plain = state_map(gym.make(HOPPER))
    register_state_map(Noisy, lambda env: plain)
    physical_config(Noisy())
    check_memoryless(Noisy(), plain)


def test_a_map_in_another_order_is_refused_however_noisy():
    class Shaken(HopperEnv):
        def _get_obs(self):
            return super()._get_obs() + self.np_random.normal(0, 0.01, 11)

    plain = state_map(gym.make(HOPPER))
    register_state_map(Shaken, lambda env: lambda obs: plain(obs[:, [0, 1, 3, 2, 4, 5, 6, 7, 9, 8, 10]]))
    with pytest.raises(ValueError, match="where the observation is read as"):
        physical_config(Shaken())


@pytest.mark.parametrize(
    ("change", "noisy_sensors"),
    [
        (lambda data: observed(data, 5e-3, 0), True),
        (lambda data: noisy(data, 2e-2), False),
        (lambda data: data, False),  # the pole has twice the mass, which no damping tells
    ],
)
def test_observations_that_err_are_told_from_what_a_simulator_lacks(change, noisy_sensors):
    data = change(collect(shifted(POLE, {"pole.mass": 10.0}), 200, scale=1.0))
    model = dynamics(POLE, ["hinge.damping"])
    model.fit(data)
    assert model.error(data) > 0.05
    assert (0.4 < model.undone(data) < 0.7) if noisy_sensors else (model.undone(data) < 0.25)
    said = pytest.warns(UserWarning, match="undoes a part of the one before it") if noisy_sensors else nullcontext()
    with warnings.catch_warnings(), said:
        warnings.simplefilter("default" if noisy_sensors else "error")
        doubt(model, min(model.error(data), 0.4), data)
    assert model.undone(data.take(slice(60))) == 0


def test_inertia_that_is_not_declared_is_no_noise_under_alternating_commands():
    target = gym.make("HalfCheetah-v5")
    target.unwrapped.model.dof_armature[3:] *= 2
    data = collect(target, 250, scale=1.0)
    model = dynamics("HalfCheetah-v5", [])
    assert model.error(data) > 0.2
    assert model.undone(data) < 0.25


def test_an_effect_is_there_once_and_described():
    drag = LIBRARY["quadratic_drag"]("slider", coefficient=8.0)
    with pytest.raises(ValueError, match=r"effects: 'quadratic_drag\(slider\)' is there twice, and would act twice"):
        dynamics(POLE, [], effects=[drag.to_json(), {**drag.to_json(), "values": {"coefficient": 1.0}}])
    with pytest.raises(TypeError, match=r"is no description of an effect; pass what its to_json\(\) returns"):
        dynamics(POLE, [], effects=[drag])


def test_a_speed_at_its_observations_bound_is_not_known():
    model = dynamics(HOPPER)
    observations = np.zeros((3, 11))
    observations[1, 5], observations[2, 8] = 10.0, -10.0
    assert model.knows(observations).tolist() == [True, False, False]


class Tracking(InvertedPendulumEnv):
    """Its observations are told by a map of its own."""


@pytest.mark.parametrize(
    ("scales", "shift", "noise", "refused"),
    [
        ((1, 1), 0.0, 0.0, False),
        ((1, 1), 0.0, 0.01, False),
        ((1.2, 1), 0.0, 0.0, True),
        ((1, 0.8), 0.0, 0.0, True),
        ((1, 1.4), 0.0, 0.001, True),
        ((1, 1), 0.005, 0.0, True),
    ],
)
def test_a_map_of_another_scale_or_zero_is_refused_and_one_of_noise_is_not(scales, shift, noise, refused):
    rng = np.random.default_rng(0)

    def recover(obs):
        known = np.ones((len(obs), 2), dtype=bool)
        qpos = scales[0] * obs[:, :2] + [0.0, shift] + noise * rng.standard_normal((len(obs), 2))
        return States(qpos, scales[1] * obs[:, 2:4], known, known)

    register_state_map(Tracking, lambda env: recover)
    if refused:
        with pytest.raises(ValueError, match=r"where the observation is read as .*; correct the map"):
            physical_config(Tracking())
    else:
        physical_config(Tracking())


def test_steps_do_not_touch_the_environment_they_were_given():
    env = gym.make(POLE)
    env.reset(seed=0)
    model = dynamics(POLE)
    before = env.unwrapped.state_vector(), env.unwrapped.model.body_mass.copy()
    model.attach(DummyVecEnv([lambda: env]))
    model.adopt([model.effects()[0].with_values(np.array([6.0]))])
    model.step(th.zeros(2, 4), th.ones(2, 1))
    np.testing.assert_array_equal(env.unwrapped.state_vector(), before[0])
    np.testing.assert_array_equal(env.unwrapped.model.body_mass, before[1])


def test_a_wrapper_that_changes_observations_is_named_where_a_registered_map_gives_other_states() -> None:
    class Mine(type(gym.make("InvertedPendulum-v5").unwrapped)):  # type: ignore[misc]
        """With the observations of its parent, told by a map of its own."""

    def make(env):
        return lambda obs: States(obs[:, :2], obs[:, 2:], np.ones((len(obs), 2), bool), np.ones((len(obs), 2), bool))

    register_state_map(Mine, make)
    plain = Mine()
    physical_config(plain)
    with (
        pytest.warns(UserWarning, match="TransformObservation"),
        pytest.raises(ValueError, match="wrapper TransformObs"),
    ):
        physical_config(wrappers.TransformObservation(plain, lambda obs: 2 * obs, plain.observation_space))
