"""DynamicsVecEnv against single episodes and against what SB3's DummyVecEnv promises."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_rpto.dynamics.base import Dynamics, Prediction
from sb3_rpto.dynamics.vec_env import DynamicsVecEnv


class Drift(gym.Env):
    """s' = s + (a, 1); it ends when |s_0| > 1."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = self.np_random.uniform(-1, 1, 2) * (options or {}).get("scale", 1.0)
        return self.s, {"start": float(self.s[0])}

    def step(self, action):
        self.s = self.s + np.array([action[0], 1.0])
        return self.s, float(self.s[0]), bool(abs(self.s[0]) > 1), False, {}

    def get_state(self):
        return {"s": self.s}

    def set_state(self, state):
        self.s = state["s"]


class DriftDynamics(Dynamics):
    rollout = "branches"

    def __init__(self, noise=0.0):
        super().__init__(Drift.observation_space, Drift.action_space)
        self.noise = noise
        self.calls = 0

    def step(self, observations, actions, deterministic=False):
        self.calls += 1
        following = observations + th.stack([actions[:, 0], th.ones(len(actions))], dim=1)
        if self.noise:
            following = following + self.noise * th.randn(following.shape, generator=self.generator)
        return Prediction(following, following[:, 0], following[:, 0].abs() > 1)

    def fit(self, data, weights=None, max_steps=None):
        return {}

    def error(self, data):
        return 0.0


def drift(limit=6):
    return gym.wrappers.TimeLimit(Drift(), limit)


def make(num_envs=16, noise=0.0, seed=0, limit=6, **kwargs):
    env = DynamicsVecEnv(DriftDynamics(noise), DummyVecEnv([lambda: Monitor(drift(limit))]), num_envs, **kwargs)
    env.seed(seed)
    return env


def actions_for(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-0.4, 0.4, size=(steps, env.num_envs, 1)).astype(np.float32)


def test_it_steps_like_a_dummy_vec_env_of_the_real_environment():
    env = make(num_envs=5)
    real = DummyVecEnv([lambda: Monitor(drift())] * 5)
    real.seed(0)
    np.testing.assert_array_equal(env.reset(), real.reset())  # seeds are dealt out alike
    assert env.reset_infos == real.reset_infos
    ended = set()
    alive = np.ones(5, dtype=bool)  # after its first end an episode starts elsewhere than the real one
    for action in actions_for(env, 6):
        observations, rewards, dones, infos = env.step(action)
        real_observations, real_rewards, real_dones, real_infos = real.step(action)
        assert observations.dtype == real_observations.dtype
        assert rewards.dtype == real_rewards.dtype
        np.testing.assert_array_equal(dones[alive], real_dones[alive])
        np.testing.assert_allclose(rewards[alive], real_rewards[alive], rtol=1e-6)
        going = alive & ~dones
        np.testing.assert_allclose(observations[going], real_observations[going], rtol=1e-12)
        for index in np.flatnonzero(alive):
            info, real_info = infos[index], real_infos[index]
            assert info["TimeLimit.truncated"] == real_info["TimeLimit.truncated"]
            assert info.keys() == real_info.keys()
            if dones[index]:
                np.testing.assert_allclose(info["terminal_observation"], real_info["terminal_observation"])
                assert info["episode"]["l"] == real_info["episode"]["l"]
                assert info["episode"]["r"] == pytest.approx(real_info["episode"]["r"], abs=2e-6)
                ended.add(info["TimeLimit.truncated"])
        alive &= ~dones
    assert not alive.any()
    assert ended == {True, False}


def test_mixed_ends_restart_only_what_ended_and_never_call_a_limit_terminal():
    env = make(num_envs=200)
    previous = env.reset()
    lengths = np.zeros(200, dtype=int)
    counts = {"terminated": 0, "truncated": 0, "running": 0}
    for action in actions_for(env, 40):
        observations, rewards, dones, infos = env.step(action)
        lengths += 1
        answer = previous + np.concatenate([action, np.ones((200, 1))], axis=1)
        terminated = np.abs(answer[:, 0]) > 1
        np.testing.assert_array_equal(dones, terminated | (lengths == 6))
        np.testing.assert_allclose(rewards, answer[:, 0], rtol=1e-6)
        for index in range(200):
            if dones[index]:
                np.testing.assert_array_equal(infos[index]["terminal_observation"], answer[index])
                assert infos[index]["TimeLimit.truncated"] == (not terminated[index])
                assert infos[index]["episode"]["l"] == lengths[index]
                assert (np.abs(observations[index]) <= 1).all()  # a start of the source
            else:
                np.testing.assert_array_equal(observations[index], answer[index])
                assert infos[index] == {"TimeLimit.truncated": False}
        counts["terminated"] += terminated.sum()
        counts["truncated"] += (dones & ~terminated).sum()
        counts["running"] += (~dones).sum()
        lengths[dones] = 0
        previous = observations
    assert min(counts.values()) > 100
    assert env.dynamics.calls == 40  # one batched call a step


def test_the_limit_is_the_sources_unless_given():
    assert make(limit=9).max_episode_steps == 9
    assert make(limit=9, max_episode_steps=4).max_episode_steps == 4
    bare = DynamicsVecEnv(DriftDynamics(), DummyVecEnv([Drift]), 3)
    assert bare.max_episode_steps is None
    bare.reset()
    for _ in range(50):
        _, _, dones, _ = bare.step(np.zeros((3, 1), np.float32))
    assert not dones.any()


def test_seeds_reproduce_a_run_with_its_resets():
    def run(seed):
        env = make(num_envs=8, noise=0.05, seed=seed)
        return [env.reset(), *(env.step(action)[0] for action in actions_for(env, 30))]

    np.testing.assert_array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_seeds_and_options_are_used_once():
    env = make(num_envs=4)
    env.set_options({"scale": 0.0})
    np.testing.assert_array_equal(env.reset(), np.zeros((4, 2)))
    assert (env.reset() != 0).all()
    first = env.reset()
    assert not np.array_equal(first, env.reset())


def test_a_saved_state_continues_bit_for_bit():
    env = make(noise=0.05)
    env.reset()
    actions = actions_for(env, 40)
    for action in actions[:13]:
        env.step(action)
    state = pickle.loads(pickle.dumps((env.get_state(), env.dynamics.state_dict())))

    def run(vec_env):
        def clockless(info):
            return {**info, "episode": {**info["episode"], "t": 0}} if "episode" in info else info

        return [(*vec_env.step(action)[:3], list(map(clockless, vec_env.step(action)[3]))) for action in actions[13:]]

    expected = run(env)
    other = make(noise=0.05, seed=9)
    for _ in range(2):
        other.set_state(state[0])  # neither reset nor stepped before
        other.dynamics.load_state_dict(state[1])
        np.testing.assert_equal(run(other), expected)


def test_states_that_do_not_fit():
    env = make()
    env.reset()
    with pytest.raises(ValueError, match="num_envs is 4"):
        make(num_envs=4).set_state(env.get_state())
    unknown = DynamicsVecEnv(DriftDynamics(), DummyVecEnv([lambda: gym.wrappers.TransformReward(drift(), abs)]), 2)
    unknown.reset()
    assert unknown.get_state() is None


def test_a_prediction_that_is_not_finite_is_refused_and_leaves_the_episodes():
    env = make(num_envs=3)
    start = env.reset()
    actions = np.zeros((3, 1), np.float32)
    with pytest.raises(ValueError, match="1 of 3 predictions"):
        env.step(np.array([[0.0], [np.nan], [0.0]], np.float32))
    observations, _, _, _ = env.step(actions)
    np.testing.assert_array_equal(observations, start + np.array([0, 1]))


def test_what_it_returns_is_not_written_to_later():
    env = make(num_envs=4)
    first = env.reset()
    kept = first.copy()
    second, *_ = env.step(np.full((4, 1), 0.1, np.float32))
    second_kept = second.copy()
    env.step(np.full((4, 1), 0.1, np.float32))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(second, second_kept)


def test_observations_are_raw_within_vec_normalize():
    source = VecNormalize(DummyVecEnv([drift]))
    source.reset()
    source.obs_rms.mean[:] = 50.0
    env = DynamicsVecEnv(DriftDynamics(), source, 10)
    assert np.abs(env.reset()).max() <= 1
    assert source.obs_rms.mean[0] == 50.0


def test_the_shortest_of_several_limits_ends_an_episode():
    source = DummyVecEnv([lambda: gym.wrappers.TimeLimit(drift(), 1000)])
    assert DynamicsVecEnv(DriftDynamics(), source, 2).max_episode_steps == 6


def test_a_source_in_another_process():
    source = SubprocVecEnv([drift], start_method="fork")
    try:
        env = DynamicsVecEnv(DriftDynamics(), source, 3)
        assert env.max_episode_steps == 6
        env.seed(0)
        np.testing.assert_array_equal(env.reset(), make(num_envs=3).reset())
        assert env.get_state() is None
    finally:
        source.close()


def test_the_rest_of_the_interface():
    env = make(num_envs=3)
    assert env.get_attr("_max_episode_steps") == [6, 6, 6]
    assert env.get_attr("render_mode", indices=1) == [None]
    assert env.render_mode is None
    assert env.has_attr("np_random")
    assert not env.has_attr("nothing")
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gym.wrappers.TimeLimit, indices=[0]) == [False]
    assert env.env_method("has_wrapper_attr", "np_random", indices=[0, 2]) == [True, True]
    assert env.get_images() == [None] * 3
    for refused in (lambda: env.env_method("step", 0), lambda: env.set_attr("x", 1)):
        with pytest.raises(NotImplementedError):
            refused()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1), np.float32))
    for wrong in ({"num_envs": 0}, {"max_episode_steps": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            make(**wrong)
    with pytest.raises(ValueError, match="dynamics has observation_space"):
        DynamicsVecEnv(DriftDynamics(), make_vec_env("Pendulum-v1"), 2)
    source = env.source
    env.close()
    source.reset()  # still the caller's


def test_sac_trains_and_is_evaluated_in_it():
    env = make(num_envs=4)
    model = SAC("MlpPolicy", env, learning_starts=20, train_freq=4, seed=0)
    model.learn(80)
    assert len(model.ep_info_buffer) > 0
    returns, lengths = evaluate_policy(model, make(num_envs=2), n_eval_episodes=4, return_episode_rewards=True)
    assert len(returns) == 4
    assert max(lengths) <= 6
