"""Corrected copies: the source stays as it is, and branches of the copy replay exactly."""

import contextlib
import copy
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from compared import assert_same, fields
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rpto import RPTO
from sb3_rpto.effects import LIBRARY, Declared, Effect, Parameter, declare
from sb3_rpto.effects.friction import CoulombFriction, StribeckFriction
from sb3_rpto.effects.model_numbers import differing
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.corrected import apply_effects, check_carries
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.env_snapshot import restore_state, save_state
from sb3_rpto.envs.shifts import EnvShift

POLE = "InvertedDoublePendulum-v5"


class Lag(Effect):
    kind, place, equation = "test_lag", "actuator", "y' = (u - y)/T"
    parameters = (Parameter("time", "s", 0.1, lower=0.0),)

    def command(self, u, x, memory, dt):
        keep = np.exp(-dt / x[:, 0])
        memory["y"] = memory.get("y", np.zeros_like(u)) * keep + u * (1 - keep)
        return memory["y"]


class Bias(Effect):
    kind, place, equation = "test_bias", "sensor", "q + b"
    parameters = (Parameter("b", "rad", 0.1),)

    def observe(self, q, v, x):
        return q + x[:, 0], v


def effects(model):
    return [
        Declared(model, "hinge.damping").with_values(np.array([0.3])),
        Declared(model, "cart.mass").with_values(np.array([7.0])),
        CoulombFriction("slider", level=0.4),
        StribeckFriction("hinge2", extra=0.2, level=0.05, speed=0.4),
        Lag("slide", time=0.2),
        Bias("hinge2", b=0.02),
    ]


def actions_for(steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, size=(steps, 1)).astype(np.float32)


def run(env, actions, seed=None):
    first = [env.reset(seed=seed)[0]] if seed is not None else []
    return [*first, *(env.step(action) for action in actions)]


def test_the_source_is_not_changed():
    source, reference = gym.make(POLE), gym.make(POLE)
    run(source, actions_for(5), seed=0)
    before, state, names = fields(source), source.unwrapped.state_vector(), set(vars(source.unwrapped))
    corrected = apply_effects(source, effects(source.unwrapped.model))
    run(corrected, actions_for(20), seed=1)
    np.testing.assert_equal(fields(source), before)
    np.testing.assert_array_equal(source.unwrapped.state_vector(), state)
    assert set(vars(source.unwrapped)) == names
    assert fields(corrected)["body_mass"][1] == pytest.approx(7.0)
    assert_same(run(source, actions_for(20), seed=2), run(reference, actions_for(20), seed=2))


def test_it_is_the_wrapped_environment():
    source = gym.make(POLE)
    wrapped = CorrectedEnv(gym.make(POLE), effects(source.unwrapped.model))
    corrected = apply_effects(source, effects(source.unwrapped.model))
    assert_same(run(corrected, actions_for(30), seed=3), run(wrapped, actions_for(30), seed=3))


def test_shifts_of_the_source_are_kept():
    source = gym.make(POLE)
    source.unwrapped.model.dof_damping[0] = 1.25
    assert fields(apply_effects(source, []))["dof_damping"][0] == 1.25


def test_a_corrected_environment_is_corrected_again():
    model = gym.make(POLE).unwrapped.model
    every = effects(model)
    once, twice = (
        apply_effects(gym.make(POLE), every),
        apply_effects(apply_effects(gym.make(POLE), every[2:]), every[:2]),
    )
    assert_same(run(twice, actions_for(30), seed=3), run(once, actions_for(30), seed=3))


def test_copies_branch_exactly_and_alone():
    corrected = apply_effects(gym.make(POLE), effects(gym.make(POLE).unwrapped.model))
    run(corrected, actions_for(7), seed=0)
    twin, third = copy_env(corrected), copy_env(DummyVecEnv([lambda: corrected]))
    assert isinstance(twin, CorrectedEnv)
    ahead = run(twin, actions_for(20, seed=1))
    assert_same(run(third, actions_for(20, seed=1)), ahead)
    assert_same(run(corrected, actions_for(20, seed=1)), ahead)
    assert_same(run(twin, actions_for(20), seed=9), run(corrected, actions_for(20), seed=9))


def build():
    env = make_vec_env(
        lambda: apply_effects(gym.make(POLE, max_episode_steps=15), effects(gym.make(POLE).unwrapped.model)), 2, seed=4
    )
    env.reset()
    return env


def roll(env, actions):
    return [env.step(np.stack([action, -action])) for action in actions]


def test_a_saved_state_replays_exactly():
    env, other = build(), build()
    roll(env, actions_for(8))
    state = save_state(env)
    assert state is not None
    ahead = roll(env, actions_for(30, seed=2))  # over the ends of episodes
    assert any(dones.any() for _, _, dones, _ in ahead)
    roll(other, actions_for(3, seed=5))
    for twin in (env, other):
        restore_state(twin, state)
        for (obs, rewards, dones, _), (obs_, rewards_, dones_, _) in zip(
            roll(twin, actions_for(30, seed=2)), ahead, strict=True
        ):
            np.testing.assert_array_equal(obs, obs_)
            np.testing.assert_array_equal(rewards, rewards_)
            np.testing.assert_array_equal(dones, dones_)


def test_the_memory_of_commands_is_part_of_the_state():
    env = build()
    state = save_state(env)
    env.envs[0].get_wrapper_attr("_memory")[0]["y"] = np.array([0.7])
    restore_state(env, state)
    assert env.envs[0].get_wrapper_attr("_memory") == [{}]


def test_what_is_no_list_of_effects_is_refused():
    friction = CoulombFriction("slider")
    with pytest.raises(TypeError, match=r"write \[coulomb_friction\(slider\)\]"):
        apply_effects(gym.make(POLE), friction)
    with pytest.raises(TypeError, match=r"hold effects, not str; of a report take report.apply"):
        apply_effects(gym.make(POLE), ["coulomb_friction"])


def test_bad_environments_are_named():
    with pytest.raises(TypeError, match="make_vec_env"):
        apply_effects(make_vec_env(POLE), [])
    with pytest.raises(ValueError, match="no gymnasium MuJoCo environment"):
        apply_effects(gym.make("Pendulum-v1"), [])
    stuck = gym.make(POLE)
    stuck.unwrapped.lock = (n for n in ())  # generators cannot be copied
    with pytest.raises(ValueError, match="cannot be copied"):
        apply_effects(stuck, [])


@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_what_was_written_to_the_model_is_pickled(again) -> None:
    env = gym.make("Hopper-v5")
    env.unwrapped.model.opt.timestep = 0.001
    env.unwrapped.model.body_mass[2] *= 1.5
    thigh = declare(env.unwrapped.model, ["thigh.mass"])[0].with_values(np.array([5.0]))
    one = apply_effects(env, [thigh])
    two = apply_effects(one, [LIBRARY["viscous_friction"]("foot_joint", coefficient=0.3)])
    for made in (one, two, EnvShift("slippery", {"*.friction": 0.5}).apply(env)):
        other = again(made)
        assert differing(made.unwrapped.model, other.unwrapped.model) == []
        assert other.unwrapped.dt == made.unwrapped.dt
        (first, _), (second, _) = made.reset(seed=0), other.reset(seed=0)
        np.testing.assert_array_equal(first, second)
        for _ in range(5):
            np.testing.assert_array_equal(made.step(np.full(3, 0.4))[0], other.step(np.full(3, 0.4))[0])
    other.set_effects([])
    assert other.unwrapped.model.body_mass[2] == env.unwrapped.model.body_mass[2]


class Direct(type(gym.make(POLE).unwrapped)):
    """Steps its physics by itself."""

    def do_simulation(self, ctrl, n_frames):
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, nstep=n_frames)


class Own(type(gym.make(POLE).unwrapped)):
    """Has the method that effects would take the place of."""

    def _step_mujoco_simulation(self, ctrl, n_frames):
        super()._step_mujoco_simulation(ctrl, n_frames)


class Inline(type(gym.make(POLE).unwrapped)):
    """Observes in step() itself."""

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("robot", "kind", "said"),
    [
        (Direct, "command_delay", r"command_delay, for one, .*step the physics by self\.do_simulation"),
        (Direct, "viscous_friction", None),
        (Own, "torque_ripple", "torque_ripple, for one, .*Own has a _step_mujoco_simulation"),
        (Own, "sensor_gain", None),
        (Inline, "sensor_gain", "sensor_gain, for one, .*does not use _get_obs"),
        (Inline, "command_delay", None),
    ],
)
def test_an_environment_is_asked_for_what_effects_need_of_it(robot, kind, said):
    env = robot()
    with pytest.raises(ValueError, match=said) if said else contextlib.nullcontext():
        check_carries(env, ["armature", kind])
    assert not {"do_simulation", "_get_obs"} & vars(env).keys()


def test_what_a_trace_could_not_add_is_refused_before_a_target_step():
    """Else it is learned once the steps are spent and traced."""
    settings = {"dynamics": "physical", "declared": ["pole.length"], "policy_kwargs": {"net_arch": [4]}}
    with pytest.raises(ValueError, match=r"effects='all': .*could not act in it.*or pass effects=\[\.\.\.\] with"):
        RPTO("MlpPolicy", Direct(), target_env=gym.make(POLE), close_loop=True, **settings)
    RPTO("MlpPolicy", Direct(), target_env=gym.make(POLE), close_loop=True, effects=["viscous_friction"], **settings)
