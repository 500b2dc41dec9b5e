"""DynamicsEnv against the environment that its (exact) model describes."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions
from sb3_rpto.dynamics.env import DynamicsEnv, time_limit


class PendulumDynamics(Dynamics):
    """Pendulum-v1 in torch; ``noise`` blurs the angular velocity, ``low`` (a cosine) is where it ends."""

    rollout = "episodes"

    def __init__(self, noise=0.0, low=-2.0):
        env = gym.make("Pendulum-v1")
        super().__init__(env.observation_space, env.action_space)
        self.noise, self.low = noise, low
        self.fitted = None

    def step(self, observations, actions, deterministic=False):
        angle = th.atan2(observations[:, 1], observations[:, 0]).double()
        speed = observations[:, 2].double()
        torque = actions[:, 0].double().clamp(-2, 2)
        rewards = -(angle**2 + 0.1 * speed**2 + 0.001 * torque**2)
        speed = (speed + (15 * angle.sin() + 3 * torque) * 0.05).clamp(-8, 8)
        if self.noise and not deterministic:
            speed = speed + self.noise * th.randn(len(speed), generator=self.generator)
        angle = angle + 0.05 * speed
        following = th.stack([angle.cos(), angle.sin(), speed], dim=1).to(observations.dtype)
        return Prediction(following, rewards, following[:, 0] < self.low)

    def fit(self, data, weights=None, max_steps=None):
        self.fitted = data, weights, max_steps
        return {"loss": 1.0}

    def error(self, data):
        return 0.0


def make(dynamics=None, **kwargs):
    return DynamicsEnv(gym.make("Pendulum-v1", **kwargs), dynamics=dynamics or PendulumDynamics())


def test_an_exact_model_steps_like_the_environment():
    env, real = make(), gym.make("Pendulum-v1")
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(observation, real.reset(seed=3)[0])
    for index in range(200):
        action = rng.uniform(-2, 2, 1).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        expected = real.step(action)
        np.testing.assert_allclose(observation, expected[0], atol=2e-3)  # float32 observations for a float64 state
        assert observation.dtype == np.float32
        assert reward == pytest.approx(float(expected[1]), abs=2e-2)
        assert (terminated, truncated, info) == (False, index == 199, {})
        assert type(terminated) is bool


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_both_checkers_pass(noise):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(make(PendulumDynamics(noise)))
        sb3_check_env(make(PendulumDynamics(noise)))


def test_a_seed_fixes_the_start_and_the_models_noise():
    env = make(PendulumDynamics(noise=0.3))

    def episode(seed):
        first, _ = env.reset(seed=seed)
        return np.stack([first, *(env.step(np.zeros(1, np.float32))[0] for _ in range(20))])

    once = episode(5)
    np.testing.assert_array_equal(once, episode(5))
    assert not np.array_equal(once, episode(6))
    assert not np.array_equal(once[1:], episode(None)[1:])


def test_a_time_limit_truncates_and_a_model_terminal_terminates():
    env = make(PendulumDynamics(low=0.0), max_episode_steps=7)
    seen = set()
    for seed in range(30):
        env.reset(seed=seed)
        for step in range(1, 8):
            observation, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
            assert terminated == (observation[0] < 0.0)
            assert truncated == (step == 7)
            if terminated or truncated:
                break
        seen.add((terminated, truncated))
    assert (True, False) in seen
    assert (False, True) in seen


def test_the_limit_is_found_in_the_chain_or_the_spec():
    assert time_limit(gym.make("Pendulum-v1")) == 200
    assert time_limit(gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 50)) == 50
    assert time_limit(gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 500)) == 200
    bare = type(gym.make("Pendulum-v1").unwrapped)()
    assert time_limit(bare) is None
    bare.spec = gym.spec("Pendulum-v1")
    assert time_limit(bare) == 200
    bare.spec = None
    env = DynamicsEnv(bare, dynamics=PendulumDynamics())
    env.reset(seed=0)
    assert not any(env.step(np.zeros(1, np.float32))[3] for _ in range(300))


def test_the_wrapped_environment_is_never_stepped():
    env = make()
    env.reset(seed=0)
    state = env.unwrapped.state.copy()
    env.step(np.ones(1, np.float32))
    np.testing.assert_array_equal(env.unwrapped.state, state)


def test_a_prediction_that_is_not_finite_is_refused_and_leaves_the_episode():
    env = make()
    env.reset(seed=0)
    first = env.step(np.zeros(1, np.float32))[0]
    with pytest.raises(ValueError, match=r"action \[nan\].*not finite") as caught:
        env.step(np.array([np.nan], np.float32))
    assert str(first) in str(caught.value)
    after = env.step(np.zeros(1, np.float32))[0]
    np.testing.assert_array_equal(after, env.branch(first[None], np.zeros((1, 1), np.float32))[0][0])


def test_predictions_stay_in_the_observation_space():
    env = make(PendulumDynamics(noise=100.0))
    env.reset(seed=0)
    for _ in range(20):
        assert env.observation_space.contains(env.step(np.zeros(1, np.float32))[0])


def test_branches_are_batched_and_leave_the_episode():
    env = make(PendulumDynamics(low=0.0))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 5000)
    observations = np.stack([np.cos(angle), np.sin(angle), rng.uniform(-8, 8, 5000)], axis=1).astype(np.float32)
    actions = rng.uniform(-2, 2, (5000, 1)).astype(np.float32)
    before = env._observation.copy()
    following, rewards, terminations = env.branch(observations, actions)
    assert following.shape == (5000, 3)
    assert rewards.shape == terminations.shape == (5000,)
    assert terminations.dtype == bool
    np.testing.assert_array_equal(terminations, following[:, 0] < 0)
    assert 0 < terminations.sum() < 5000
    np.testing.assert_array_equal(env._observation, before)
    with pytest.raises(ValueError, match="2 of 5000"):
        env.branch(observations, np.where(np.arange(5000)[:, None] < 2, np.nan, actions))


def test_fit_is_the_models():
    env = make()
    data = Transitions(th.zeros(4, 3), th.zeros(4, 1), th.zeros(4), th.zeros(4, 3), th.zeros(4))
    weights = th.ones(4)
    assert env.fit(data, weights, max_steps=5) == {"loss": 1.0}
    assert env.dynamics.fitted == (data, weights, 5)


def test_misuse_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        make().step(np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="dynamics has observation_space"):
        DynamicsEnv(gym.make("MountainCarContinuous-v0"), dynamics=PendulumDynamics())


def test_there_is_no_picture():
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render_mode is None
    assert env.render() is None
    assert env.metadata["render_modes"] == []


def test_the_spec_makes_it_again_with_the_same_model():
    env = make()
    again = gym.make(env.spec)
    assert again.dynamics is env.dynamics
    assert isinstance(again, DynamicsEnv)


def test_sac_trains_in_three_lines():
    model = SAC("MlpPolicy", make(), learning_starts=20, seed=0)
    model.learn(60)
    assert model.num_timesteps == 60
