import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import sb3_rpto  # noqa: F401  (registers the environments)
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.envs import observations as module
from sb3_rpto.envs.observations import States, register_state_map, single_env, state_map

NOT_SHOWN = {"Ant": 2, "HalfCheetah": 1, "Hopper": 1, "Humanoid": 2, "HumanoidStandup": 2, "Swimmer": 2, "Walker2d": 1}
FIXED = ("InvertedDoublePendulum", "InvertedPendulum", "Reacher", "Pusher")
CASES = [
    *[(f"{task}-{v}", {}) for task in (*NOT_SHOWN, *FIXED) for v in ("v4", "v5") if (task, v) != ("Pusher", "v4")],
    *[(f"{task}-v5", {"exclude_current_positions_from_observation": False}) for task in NOT_SHOWN],
    ("Ant-v5", {"include_cfrc_ext_in_observation": False}),
    ("Ant-v4", {"use_contact_forces": True}),
]


def walk(env, steps=150):
    """Observations of random actions with the states behind them, through terminations."""
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    data, rows = env.unwrapped.data, []
    for i in range(steps):
        rows.append((observation.copy(), data.qpos.copy(), data.qvel.copy()))
        if i % 60 == 59:
            observation, _ = env.reset()
        else:
            observation = env.step(env.action_space.sample())[0]
    return [np.array(column) for column in zip(*rows)]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("env_id", "kwargs"), CASES)
def test_known_entries_are_the_simulators_own(env_id, kwargs):
    env = gym.make(env_id, disable_env_checker=True, **kwargs)
    observations, qpos, qvel = walk(env)
    states = state_map(env)(observations)
    error = states.qpos - qpos
    for column in states.wrapped:
        assert (np.abs(states.qpos[:, column]) <= np.pi).all()
        error[:, column] -= 2 * np.pi * np.round(error[:, column] / (2 * np.pi))
    assert np.abs(error[states.known_qpos]).max() < 1e-6
    assert np.abs((states.qvel - qvel)[states.known_qvel]).max() < 1e-6

    task = env_id.split("-")[0]
    hidden = NOT_SHOWN.get(task, 0) if kwargs.get("exclude_current_positions_from_observation", True) else 0
    never = np.flatnonzero(~states.known_qpos.any(0)).tolist()
    assert never == ([7, 8] if task == "Pusher" else list(range(hidden)))
    assert np.isnan(states.qpos[:, :hidden]).all()
    assert np.flatnonzero(~states.known_qvel.any(0)).tolist() == ([7, 8] if task == "Pusher" else [])
    clipped = task in ("Hopper", "Walker2d", "InvertedDoublePendulum")
    unknown = np.abs(qvel) >= 10 if clipped else np.zeros_like(qvel, dtype=bool)
    unknown[:, never if task == "Pusher" else []] = True
    np.testing.assert_array_equal(~states.known_qvel, unknown)


def test_turns_are_lost_and_said_so():
    env = gym.make("Reacher-v5").unwrapped
    env.reset(seed=0)
    env.set_state(np.array([4.0, -2.0, 0.1, 0.1]), np.zeros(4))
    states = state_map(env)(env._get_obs()[None])
    assert states.wrapped == (0, 1)
    np.testing.assert_allclose(states.qpos[0, :2], [4.0 - 2 * np.pi, -2.0])


def test_speeds_at_the_bound_are_not_known():
    env = gym.make("Hopper-v5").unwrapped
    env.reset(seed=0)
    env.set_state(env.init_qpos, np.array([11.0, -12.0, 9.99, 10.0, 0.0, -10.0]))
    states = state_map(env)(env._get_obs()[None])
    np.testing.assert_array_equal(states.known_qvel[0], [False, False, True, False, True, False])
    np.testing.assert_array_equal(np.abs(states.qvel[0, :2]), 10.0)


def test_a_pushed_object_is_one_simulation_step_old():
    env = gym.make("Pusher-v5").unwrapped
    env.reset(seed=0)
    qvel = env.data.qvel.copy()
    qvel[7:9] = 0.3, -0.2
    env.set_state(env.data.qpos.copy(), qvel)
    observation = env.step(np.zeros(7))[0]
    states = state_map(env)(observation[None])
    assert not states.known_qpos[0, 7:9].any()
    before = env.data.qpos[7:9] - env.model.opt.timestep * env.data.qvel[7:9]
    np.testing.assert_allclose(states.qpos[0, 7:9], before, atol=1e-9)


def test_a_place_in_the_model_counts_for_pusher():
    env = gym.make("Pusher-v5").unwrapped
    env.model.body_pos[env.model.body("object").id] += [0.1, -0.2, 0.0]
    env.reset(seed=1)
    states = state_map(env)(env._get_obs()[None])
    np.testing.assert_allclose(states.qpos[0, 7:], env.data.qpos[7:], atol=1e-9)


class OtherHopper(HopperEnv):
    """Another physics, the same observations."""


class TurnedHopper(HopperEnv):
    def _get_obs(self):
        return super()._get_obs()[::-1]


def test_derived_classes_count_while_they_leave_the_observation():
    observations, qpos, _ = walk(OtherHopper(), steps=3)
    np.testing.assert_allclose(state_map(OtherHopper())(observations).qpos[:, 1:], qpos[:, 1:])
    with pytest.raises(ValueError, match=r"TurnedHopper.*register_state_map\(TurnedHopper, "):
        state_map(TurnedHopper())


def test_wrappers_that_leave_the_observation_do_not_matter():
    env = wrappers.RescaleAction(wrappers.TransformReward(gym.make("Hopper-v5"), lambda r: 2 * r), -0.5, 0.5)
    assert state_map(env).width == 11


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (wrappers.NormalizeObservation, "NormalizeObservation"),
        (lambda env: wrappers.DelayObservation(env, 2), "DelayObservation"),
        (wrappers.TimeAwareObservation, "TimeAwareObservation"),
    ],
)
def test_unknown_wrappers_are_named(wrap, name):
    with pytest.raises(ValueError, match=rf"Hopper-v5.*{name}"):
        state_map(wrap(gym.make("Hopper-v5")))


def test_frames_are_refused():
    with pytest.raises(ValueError, match="must be vectors"):
        state_map(wrappers.FrameStackObservation(gym.make("Hopper-v5"), 2))


def test_a_task_without_a_model_is_named():
    with pytest.raises(ValueError, match=r"rpto/ContinuousCartPole-v0 has no MuJoCo model.*from_tables"):
        state_map(gym.make("rpto/ContinuousCartPole-v0"))


def test_another_chain_than_the_tasks_is_refused():
    env = gym.make("Reacher-v5").unwrapped
    spec = mujoco.MjSpec.from_file(env.fullpath)
    spec.body("target").add_joint(name="target_z", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], range=[0, 1])
    env.model = spec.compile()
    with pytest.raises(ValueError, match=r"Reacher-v5.*this one 5 and 5"):
        state_map(env)


@pytest.mark.parametrize("key", ["TurnedHopper-v7", TurnedHopper])
def test_users_register_their_own(key, monkeypatch):
    monkeypatch.setattr(module, "_registered", {})
    monkeypatch.setitem(gym.registry, "TurnedHopper-v7", gym.envs.registration.EnvSpec("TurnedHopper-v7", TurnedHopper))

    def make(env):
        def recover(obs):
            qpos = np.concatenate([np.full((len(obs), 1), np.nan), obs[:, :5:-1]], axis=1)
            return States(qpos, obs[:, 5::-1], ~np.isnan(qpos), np.abs(obs[:, 5::-1]) < 10)

        return recover

    register_state_map(key, make)
    env = gym.make("TurnedHopper-v7", disable_env_checker=True)
    observations, qpos, qvel = walk(env, steps=5)
    states = state_map(env)(observations)
    np.testing.assert_allclose(states.qpos[:, 1:], qpos[:, 1:])
    np.testing.assert_allclose(states.qvel, qvel)
    with pytest.warns(UserWarning, match="its registered state map is taken to know what the wrapper Normalize"):
        state_map(gym.wrappers.NormalizeObservation(env))


def test_a_registered_map_of_wrong_shape_is_refused(monkeypatch):
    monkeypatch.setattr(module, "_registered", {})
    register_state_map("Hopper-v5", lambda env: lambda obs: States(obs, obs, obs > 0, obs > 0))
    with pytest.raises(ValueError, match="returned arrays of shapes"):
        state_map(gym.make("Hopper-v5"))(np.zeros((2, 11)))


def whole(obs):
    return obs[:, :2], obs[:, 2:], np.ones((len(obs), 2)), np.ones((len(obs), 2))


@pytest.mark.parametrize("as_given", [tuple, lambda arrays: States(*(array.tolist() for array in arrays))])
def test_a_registered_map_may_return_what_reads_as_states(as_given, monkeypatch):
    monkeypatch.setattr(module, "_registered", {})
    register_state_map("InvertedPendulum-v5", lambda env: lambda obs: as_given(whole(obs)))
    states = state_map(gym.make("InvertedPendulum-v5"))(np.arange(8.0).reshape(2, 4))
    np.testing.assert_array_equal(states.qvel, [[2.0, 3.0], [6.0, 7.0]])
    assert states.known_qpos.dtype == states.known_qvel.dtype == bool


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda env: None, "a function of the environment that returns the function of observations"),
        (lambda obs: whole(obs), "a function of the environment that returns the function of observations"),
        (lambda env: lambda obs: None, r"returned NoneType; it must return States"),
        (lambda env: lambda obs: whole(obs)[:2], "returned arrays of shapes"),
    ],
)
def test_a_registered_map_that_is_none_is_told(make, said, monkeypatch):
    monkeypatch.setattr(module, "_registered", {})
    register_state_map("InvertedPendulum-v5", make)
    with pytest.raises(ValueError, match=said):
        state_map(gym.make("InvertedPendulum-v5"))(np.zeros((2, 4)))


def test_observations_of_another_env_are_refused():
    with pytest.raises(ValueError, match=r"Hopper-v5 have shape \(n, 11\)"):
        state_map(gym.make("Hopper-v5"))(np.zeros((2, 17)))


def test_the_first_of_several_environments_is_read():
    venv = DummyVecEnv([lambda: gym.make("Hopper-v5")] * 2)
    assert single_env(VecNormalize(venv)) is venv.envs[0]
    assert single_env(venv.envs[1]) is venv.envs[1]


def test_subprocesses_are_refused():
    class Elsewhere(SubprocVecEnv):
        def __init__(self):
            pass

    with pytest.raises(ValueError, match="give one environment"):
        single_env(Elsewhere())


def test_a_map_that_gives_another_state_than_the_simulations_is_refused_before_anything_is_learned(monkeypatch):
    monkeypatch.setattr(module, "_registered", {})
    env = gym.make("InvertedPendulum-v5")

    def made(sign, first, then):
        def recover(obs):
            qpos, qvel = sign * obs[:, first], obs[:, then]
            return States(qpos, qvel, np.isfinite(qpos), np.isfinite(qvel))

        return lambda env: recover

    begin, end = slice(0, 2), slice(2, 4)
    for sign, first, then in ((1, end, begin), (-1, begin, end), (57.3, begin, end)):
        register_state_map("InvertedPendulum-v5", made(sign, first, then))
        with pytest.raises(ValueError, match=r"InvertedPendulum-v5: qpos\[0\] is .* is read as .*register_state_map"):
            physical_config(env)
    register_state_map("InvertedPendulum-v5", made(1, begin, end))
    physical_config(env)
    noise = np.random.default_rng(0)
    seen = gym.wrappers.TransformObservation(env, lambda o: o + noise.normal(0, 1e-3, 4), env.observation_space)
    with pytest.warns(UserWarning, match="registered state map"):
        physical_config(seen)
