"""Rules against the real environments: every transition of random and of nearly failing rollouts."""

import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_rpto.envs.task_rules import TaskRules, task_rules

MUJOCO = ["Ant", "HalfCheetah", "Hopper", "InvertedDoublePendulum", "InvertedPendulum", "Pusher", "Reacher", "Swimmer"]
MUJOCO += ["Walker2d", "Humanoid"]
WITH_REWARD = {"InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5"}
WITH_REWARD |= {"Pendulum-v1", "MountainCarContinuous-v0"}
ENDS = {"Ant-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "InvertedPendulum-v5", "Walker2d-v5", "Humanoid-v5"}


def make(name, **kwargs):
    if not name.startswith(("Pendulum", "Mountain")):
        pytest.importorskip("gymnasium.envs.mujoco.hopper_v5", exc_type=ImportError)
    if name.startswith("Ant"):
        kwargs.setdefault("include_cfrc_ext_in_observation", False)
    return gym.make(name, **kwargs)


def rollout(env, steps, seed=0, past_the_end=False):
    """Transitions under actions of varying size: small ones keep a walker near its thresholds for long."""
    rng = np.random.default_rng(seed)
    rows = []
    observation, _ = env.reset(seed=seed)
    scale, bias, ended = 1.0, 0.0, 0
    for _ in range(steps):
        low, high = env.action_space.low, env.action_space.high
        unit = np.clip(bias + scale * rng.uniform(-1, 1, size=low.shape), -1, 1)
        action = (low + (high - low) * (unit + 1) / 2).astype(np.float32)
        next_observation, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, next_observation, float(reward), terminated))
        observation = next_observation
        ended += terminated
        # a few steps beyond the end are transitions too, and lie on both sides of the threshold
        if truncated or (ended > 8 if past_the_end else terminated):
            observation, _ = env.reset()
            scale, bias, ended = rng.choice([0.0, 0.1, 0.5, 1.0]), rng.choice([0.0, 0.3, -0.3]), 0
    return [np.stack(column) for column in zip(*rows)]


def compare(env, rules, steps=1200):
    # Beyond its end the double pendulum spins faster than its observation, clipped at 10 rad/s, tells.
    double = "DoublePendulum" in str(env)
    observations, actions, following, rewards, terminated = rollout(env, steps, past_the_end=not double)
    arguments = [th.as_tensor(part) for part in (observations, actions, following)]
    ended = rules.termination_fn(*arguments)
    assert ended.dtype == th.bool
    assert ended.shape == (steps,)
    np.testing.assert_array_equal(ended.numpy(), terminated)
    if rules.reward_fn is not None:
        predicted = rules.reward_fn(*arguments)
        assert predicted.shape == (steps,)
        np.testing.assert_allclose(predicted.numpy(), rewards, rtol=1e-5, atol=5e-4 if double else 1e-5)
    return terminated


@pytest.mark.parametrize("name", [f"{name}-v5" for name in MUJOCO] + ["Pendulum-v1", "MountainCarContinuous-v0"])
def test_rules_agree_with_the_environment(name):
    env = make(name)
    rules = task_rules(env)
    assert (rules.reward_fn is not None) == (name in WITH_REWARD)
    terminated = compare(env, rules)
    if name in ENDS:
        assert 0 < terminated.sum() < len(terminated)  # both answers were put to the test


def test_the_tip_is_low_exactly_when_the_environment_says_so():
    env = make("InvertedDoublePendulum-v5")
    observations, actions, following, _, terminated = rollout(env, 3000, past_the_end=True)
    arguments = [th.as_tensor(part) for part in (observations, actions, following)]
    np.testing.assert_array_equal(task_rules(env).termination_fn(*arguments).numpy(), terminated)
    assert 300 < terminated.sum() < 2700


def test_mountain_car_goal_is_reached_exactly_when_the_environment_says_so():
    env = make("MountainCarContinuous-v0").unwrapped
    rules = task_rules(env)
    rng = np.random.default_rng(1)
    seen = set()
    for _ in range(2000):
        env.reset(seed=0)
        env.state = np.array([rng.uniform(0.38, 0.46), rng.uniform(-0.01, 0.06)], dtype=np.float32)
        before, action = env.state.copy(), rng.uniform(-1, 1, 1).astype(np.float32)
        following, reward, terminated, _, _ = env.step(action)
        for dtype in (th.float32, th.float64):
            arguments = [th.as_tensor(part)[None].to(dtype) for part in (before, action, following)]
            assert bool(rules.termination_fn(*arguments)) == terminated
            assert float(rules.reward_fn(*arguments)) == pytest.approx(reward, abs=1e-5)
        seen.add(terminated)
    assert seen == {True, False}


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("Hopper-v5", {"healthy_z_range": (1.1, 1.24), "healthy_angle_range": (-0.05, 0.1)}),
        ("Hopper-v5", {"healthy_state_range": (-2.0, 3.0), "exclude_current_positions_from_observation": False}),
        ("Walker2d-v5", {"healthy_z_range": (1.1, 1.3), "exclude_current_positions_from_observation": False}),
        ("Ant-v5", {"healthy_z_range": (0.4, 0.8), "exclude_current_positions_from_observation": False}),
        ("Ant-v5", {"include_cfrc_ext_in_observation": True, "healthy_z_range": (0.5, 0.9)}),
        ("Pendulum-v1", {"g": 3.0}),
        ("InvertedDoublePendulum-v5", {"healthy_reward": 3.0}),
        ("Pusher-v5", {"reward_near_weight": 2.0, "reward_control_weight": 0.3}),
        ("Reacher-v5", {"reward_dist_weight": 2.0}),
    ],
)
def test_thresholds_and_weights_are_those_of_the_instance(name, kwargs):
    env = make(name, **kwargs)
    terminated = compare(env, task_rules(env), steps=600)
    if "z_range" in str(kwargs):
        assert 0 < terminated.sum() < len(terminated)


def test_walkers_that_never_end():
    env = make("Hopper-v5", terminate_when_unhealthy=False)
    assert not compare(env, task_rules(env), steps=300).any()


def test_tip_height_follows_the_link_lengths():
    env = make("InvertedDoublePendulum-v5")
    model = env.unwrapped.model
    model.body_pos[3] = [0.05, 0.0, 0.75]
    model.site_pos[0] = [0.0, 0.0, 0.45]
    default = task_rules(make("InvertedDoublePendulum-v5"))
    shifted = task_rules(env)
    assert shifted.termination_fn.keywords["links"] != default.termination_fn.keywords["links"]
    compare(env, shifted, steps=600)


def test_a_double_pendulum_of_another_build_has_no_rule():
    env = make("InvertedDoublePendulum-v5")
    env.unwrapped.model.body_quat[3] = [np.cos(0.1), 0, np.sin(0.1), 0]
    assert task_rules(env) == TaskRules(None, None)


def test_a_walker_with_a_health_of_its_own_has_no_rule():
    from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

    class Low(HopperEnv):
        @property
        def is_healthy(self):
            return bool(self.data.qpos[1] > 0.4)

    class Same(HopperEnv):
        colour = "red"

    assert task_rules(Low()) == TaskRules(None, None)
    assert task_rules(Same()).termination_fn is not None


@pytest.mark.parametrize("name", ["Hopper-v5", "HalfCheetah-v5", "InvertedDoublePendulum-v5", "Pendulum-v1"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_next_observation_that_is_not_finite_is_terminal(name, value):
    env = make(name)
    observation, _ = env.reset(seed=0)
    following = th.as_tensor(np.stack([observation, observation]))
    following[1, -1] = value
    actions = th.zeros(2, *env.action_space.shape)
    assert task_rules(env).termination_fn(following[:1].expand(2, -1), actions, following).tolist() == [False, True]


@pytest.mark.parametrize("name", ["Hopper-v5", "InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Pendulum-v1"])
def test_rules_pickle_and_keep_the_dtype(name):
    env = make(name)
    rules = pickle.loads(pickle.dumps(task_rules(env)))
    assert len(pickle.dumps(rules)) < 2000  # plain numbers, no environment
    observations, actions, following, _, terminated = rollout(env, 50)
    for dtype in (th.float32, th.float64):
        arguments = [th.as_tensor(part).to(dtype) for part in (observations, actions, following)]
        assert rules.termination_fn(*arguments).tolist() == terminated.tolist()
        if rules.reward_fn is not None:
            assert rules.reward_fn(*arguments).dtype == dtype


class OwnRules(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, limit=1.0):
        self.limit = limit

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}

    def reward_fn(self, observations, actions, next_observations):
        return next_observations[:, 0] - self.limit

    def termination_fn(self, observations, actions, next_observations):
        return next_observations[:, 0] > self.limit


class Bare(gym.Wrapper):
    pass


class Doubled(gym.RewardWrapper):
    def reward(self, reward):
        return 2 * reward


class Half(gym.ObservationWrapper):
    def observation(self, observation):
        return observation / 2


def answers(rules):
    following = th.tensor([[1.5, 0.0], [2.5, 0.0], [0.0, np.nan]])
    arguments = (following, th.zeros(3, 1), following)
    return [None if rule is None else rule(*arguments).tolist() for rule in rules]


def test_the_environments_own_rules_come_first_through_wrappers_and_vec_envs():
    expected = [[-0.5, 0.5, -2.0], [False, True, True]]  # a value that is not finite is terminal here too
    env = Monitor(gym.wrappers.TimeLimit(Bare(OwnRules(limit=2.0)), 10))
    assert answers(task_rules(env)) == expected
    assert answers(task_rules(VecNormalize(DummyVecEnv([lambda: env])))) == expected


def test_wrappers_that_change_data_take_the_rules_with_them():
    assert answers(task_rules(Doubled(OwnRules(2.0)))) == [None, [False, True, True]]
    assert task_rules(Half(OwnRules())) == TaskRules(None, None)
    pendulum = gym.make("Pendulum-v1")
    assert task_rules(Bare(pendulum)) == TaskRules(None, None)  # who knows what it does
    assert task_rules(gym.wrappers.NormalizeObservation(pendulum)) == TaskRules(None, None)
    rescaled = task_rules(gym.wrappers.RescaleAction(pendulum, np.float32(-1), np.float32(1)))
    assert rescaled.reward_fn is None
    assert rescaled.termination_fn is not None
    assert task_rules(VecFrameStack(make_vec_env("Pendulum-v1"), 2)) == TaskRules(None, None)


class Bonus(gym.Wrapper):
    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, reward + 10, *rest


def test_a_wrapper_that_steps_in_its_own_way_takes_the_environments_own_rules():
    assert task_rules(Bonus(OwnRules())) == TaskRules(None, None)
    assert task_rules(gym.wrappers.NormalizeReward(OwnRules())) == TaskRules(None, None)
    gym.register("BonusElsewhere-v0", entry_point=f"{__name__}:OwnRules", max_episode_steps=5)
    remote = SubprocVecEnv([lambda: Bonus(gym.make("BonusElsewhere-v0"))], start_method="fork")
    try:
        assert task_rules(remote) == TaskRules(None, None)
    finally:
        remote.close()


def test_rules_of_a_wrapper_hold_for_what_is_outside_of_it():
    class Ruled(Bonus):
        def reward_fn(self, observations, actions, next_observations):
            return next_observations[:, 0] + 10

    rules = task_rules(gym.wrappers.TimeLimit(Ruled(OwnRules(2.0)), 10))
    assert answers(rules)[0] == [11.5, 12.5, 10.0]
    assert rules.termination_fn is None  # that of the environment is not Ruled's


class Paid(PendulumEnv):
    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward + 100, *rest


class Renamed(PendulumEnv):
    def render(self):
        return None


def test_somebodys_own_class_is_no_known_task_by_its_name():
    for name, own, known in (("Pendulum-v7", Paid, False), ("Other-v7", Renamed, True), ("Hopper-v7", NoRules, False)):
        gym.register(name, entry_point=own, max_episode_steps=5)
        try:
            assert (task_rules(gym.make(name)).termination_fn is not None) == known
            remote = SubprocVecEnv([partial(gym.make, name)], start_method="fork")
            assert task_rules(remote).termination_fn is None
            remote.close()
        finally:
            del gym.registry[name]


class NoRules(OwnRules):
    reward_fn = termination_fn = None
    _exclude_current_positions_from_observation, _terminate_when_unhealthy = True, False


def test_a_function_of_that_name_that_is_no_rule_is_told_and_left():
    class Other(OwnRules):
        def reward_fn(self, state, action):
            return 0.0

        def termination_fn(self, observations, actions, following):
            return False

    with pytest.warns(UserWarning, match="not taken for the task's rule") as told:
        assert task_rules(Other()) == TaskRules(None, None)
    assert ["by bool" in str(w.message) for w in told] == [True, False]
    assert "TypeError" in str(told[1].message)


def test_an_unknown_environment_has_no_rules():
    assert task_rules(gym.make("CartPole-v1")) == TaskRules(None, None)
    gym.register("elsewhere/Hopper-v0", entry_point=Half, kwargs={"env": OwnRules()})
    assert task_rules(gym.make("elsewhere/Hopper-v0", disable_env_checker=True)) == TaskRules(None, None)


@pytest.mark.slow
def test_an_environment_in_another_process():
    pytest.importorskip("gymnasium.envs.mujoco.hopper_v5", exc_type=ImportError)
    kwargs = {"healthy_z_range": (1.1, 1.3)}
    remote = make_vec_env("Hopper-v5", n_envs=1, vec_env_cls=SubprocVecEnv, env_kwargs=kwargs)
    try:
        rules = task_rules(remote)
        assert rules.termination_fn.keywords == task_rules(gym.make("Hopper-v5", **kwargs)).termination_fn.keywords
        assert rules.reward_fn is None
        assert remote.reset().shape == (1, 11)  # the process is still there
    finally:
        remote.close()


def test_the_own_rules_of_an_environment_in_another_process():
    gym.register("OwnRulesElsewhere-v0", entry_point=f"{__name__}:OwnRules", max_episode_steps=5)
    remote = SubprocVecEnv([lambda: gym.make("OwnRulesElsewhere-v0", limit=2.0)], start_method="fork")
    try:
        assert answers(task_rules(remote)) == [[-0.5, 0.5, -2.0], [False, True, True]]
    finally:
        remote.close()
