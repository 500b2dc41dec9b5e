"""The gap as a diagnostic of a run, against closed forms, and the best policy as judged by evaluations."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import SMALL_ENSEMBLE, SMALL_POLICY, pendulum, small
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.callbacks import KeepBest, RelativityGapCallback, newest_episodes

GAMMA = 0.9


class Decay(gym.Env):
    """x' = ratio x from x = 1, reward x + bonus whatever the action: V(x) = x / (1 - gamma ratio) without the bonus.

    Episodes last ``lengths[i]`` steps in turn and end by a time limit, or by a termination.
    """

    observation_space = spaces.Box(-10.0, 10.0, (1,), np.float64)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, ratio=1.0, bonus=0.0, lengths=(10,), terminates=False):
        self.ratio, self.bonus, self.lengths, self.terminates = ratio, bonus, lengths, terminates
        self.episode = -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode += 1
        self.t, self.x = 0, 1.0
        return np.array([self.x]), {}

    def step(self, action):
        reward = self.x + self.bonus
        self.t, self.x = self.t + 1, self.x * self.ratio
        over = self.t == self.lengths[self.episode % len(self.lengths)]
        return np.array([self.x]), reward, over and self.terminates, over and not self.terminates, {}


class Recorded(BaseCallback):
    """What was logged, before SB3 clears it."""

    def __init__(self, n):
        super().__init__()
        self.n, self.logs = n, []

    def _on_step(self):
        if self.n_calls % self.n == 0:
            self.logs.append(dict(self.logger.name_to_value))
        return True


def world(*args, **kwargs):
    return Monitor(Decay(*args, **kwargs))


def gaps(steps, source, target, *, q_value=None, soft_value=None, n_episodes=10, cls=RPO, **kwargs):
    """What the callback logs once, at the last of ``steps`` target steps."""
    model = small(cls, source, target, **{"gamma": GAMMA, "gradient_steps": 0, **kwargs})
    if q_value is not None:
        model.soft_value = lambda observations: soft_value(observations[:, 0])
        model.q_value = lambda observations, actions: q_value(observations[:, 0])
    recorded = Recorded(steps // model.target_env.num_envs)
    callbacks = [RelativityGapCallback(steps, n_episodes), recorded]
    model.learn(steps, callbacks, log_interval=None, source_timesteps=0)
    assert model.num_timesteps == sum(model.target_spent.values()) == steps  # it spent nothing of its own
    return recorded.logs[-1]


def exact(ratio):
    """The closed form of the source's critic."""
    return {name: lambda x: x / (1 - GAMMA * ratio) for name in ("q_value", "soft_value")}


# ------------------------------------------------------------------------------------ gap/dynamics


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:target_env has stepped exactly like env")
def test_equal_worlds_have_no_dynamics_gap():
    log = gaps(50, world(0.8), world(0.8), **exact(0.8))
    assert log["gap/dynamics"] == pytest.approx(0.0, abs=1e-6)
    assert log["gap/dynamics_se"] == pytest.approx(0.0, abs=1e-6)


def test_a_bonus_in_the_target_is_its_discounted_sum():
    log = gaps(50, world(0.8), world(0.8, bonus=0.3), **exact(0.8))
    assert log["gap/dynamics"] == pytest.approx(0.3 * (1 - GAMMA**10) / (1 - GAMMA), rel=1e-6)


@pytest.mark.slow
def test_other_dynamics_give_the_difference_of_the_returns():
    log = gaps(401, world(0.5), world(0.9, lengths=(200,)), **exact(0.5))
    difference = 1 / (1 - GAMMA * 0.9) - 1 / (1 - GAMMA * 0.5)
    assert log["gap/dynamics"] == pytest.approx(difference, rel=1e-5)


def residual_sum(length, value, terminates):
    """Sum of gamma^t (1 + gamma (1 - d) value) of an episode with constant reward 1."""
    following = [value] * (length - 1) + [0.0 if terminates else value]
    return sum(GAMMA**t * (1 + GAMMA * v) for t, v in enumerate(following))


@pytest.mark.parametrize("terminates", [True, False])
@pytest.mark.parametrize("n_episodes", [1, 3, 100])
def test_the_newest_whole_episodes_count_whichever_environment_they_come_from(terminates, n_episodes):
    lengths = [(3, 9, 4), (7, 2)]
    target = DummyVecEnv([lambda own=own: world(1.0, lengths=own, terminates=terminates) for own in lengths])
    # reward 1 everywhere, but an observation that moves, by which rows out of order would be noticed
    for env in target.envs:
        env.unwrapped.step = counting_step(env.unwrapped)
    log = gaps(
        60,
        world(1.0),
        target,
        n_episodes=n_episodes,
        q_value=th.zeros_like,
        soft_value=lambda x: th.full_like(x, 2.0),
    )
    ends = []  # 29 of the 30 steps of each environment are stored when the callback is called
    for own in lengths:
        step = 0
        for length in own * 30:
            step += length
            if step <= 29:
                ends.append((step, length))
    newest = [length for _, length in sorted(ends, key=lambda item: item[0])][-n_episodes:]
    totals = [residual_sum(length, 2.0, terminates) for length in newest]
    assert log["gap/dynamics"] == pytest.approx(np.mean(totals), rel=1e-6)
    if len(totals) > 1:
        assert log["gap/dynamics_se"] == pytest.approx(np.std(totals, ddof=1) / math.sqrt(len(totals)), rel=1e-5)
    else:
        assert math.isnan(log["gap/dynamics_se"])


def counting_step(env):
    step = type(env).step

    def counting(action):
        _, _, terminated, truncated, info = step(env, action)
        return np.array([env.t / 10]), 1.0, terminated, truncated, info

    return counting


def test_rewards_are_on_the_critics_scale():
    source = VecNormalize(DummyVecEnv([lambda: world(0.8)]), gamma=GAMMA)
    log = gaps(21, source, world(0.7), q_value=th.zeros_like, soft_value=th.zeros_like)
    rewards = source.normalize_reward(0.7 ** np.arange(10))
    assert rewards[0] != pytest.approx(1.0, rel=0.05)
    assert log["gap/dynamics"] == pytest.approx(np.sum(GAMMA ** np.arange(10) * rewards), rel=1e-5)


def test_nothing_is_logged_before_an_episode_is_whole_and_every_frequency_steps_after():
    model = small(RPO, world(0.8), world(0.7), gamma=GAMMA, gradient_steps=0)
    recorded = Recorded(1)
    model.learn(34, [RelativityGapCallback(8), recorded], log_interval=None, source_timesteps=0)
    logged = [log.get("gap/dynamics") for log in recorded.logs]
    assert logged[:15] == [None] * 15  # the first episode is stored from step 11 on; step 8 saw none
    changes = [step + 1 for step in range(1, 34) if logged[step] != logged[step - 1]]
    assert changes == [16, 24, 32]
    assert all("gap/policy" in log for log in recorded.logs[15:])


def test_recorded_target_data_give_no_dynamics_gap():
    data = ReplayBuffer(40, Decay.observation_space, Decay.action_space)
    for t in range(40):
        done = t % 10 == 9
        data.add(*(np.full((1, 1), x) for x in (0.7**t, 0.7 ** (t + 1), 0.0)), np.ones(1), np.array([done]), [{}])
    model = RPTO(
        "MlpPolicy",
        world(0.8),
        target_data=data,
        gradient_steps=0,
        source_steps=8,
        batch_size=32,
        policy_kwargs=SMALL_POLICY,
        dynamics_kwargs=SMALL_ENSEMBLE,
        device="cpu",
    )
    assert newest_episodes(model.replay_buffer.target, 1, 10)
    recorded = Recorded(1)
    model.learn(16, [RelativityGapCallback(8), recorded], source_timesteps=0)
    assert "gap/policy" in recorded.logs[-1]
    assert not any("gap/dynamics" in log for log in recorded.logs)


# --------------------------------------------------------------------------------------- gap/policy


class Linear(BaseCallback):
    """After the policy came from the source: another mean and spread of its actions."""

    def __init__(self, mean, log_std):
        super().__init__()
        self.new = mean, log_std

    def _on_training_start(self):
        set_actor(self.model, *self.new)

    def _on_step(self):
        return True


def set_actor(model, mean, log_std):
    for layer, value in ((model.actor.mu, math.atanh(mean)), (model.actor.log_std, log_std)):
        layer.weight.data.zero_()
        layer.bias.data.fill_(value)


def policy_gap(cls, new, old=(0.1, -15.0), slope=3.0, ent_coef=0.0, **kwargs):
    """gap/policy of two nearly deterministic policies under Q'(s, a) = slope a + 5."""
    model = small(
        cls,
        world(0.8, lengths=(12,)),
        world(0.7),
        gamma=GAMMA,
        gradient_steps=0,
        ent_coef=ent_coef,
        **{"policy_kwargs": {"net_arch": []}, **kwargs},
    )
    set_actor(model, *old)
    for network in model.critic_target.q_networks:
        network[0].weight.data.copy_(th.tensor([[0.0, slope]]))
        network[0].bias.data.fill_(5.0)
    recorded = Recorded(20)
    callbacks = [Linear(*new), RelativityGapCallback(20), recorded]
    model.learn(20, callbacks, log_interval=None, source_timesteps=0)
    return recorded.logs[-1]


EPISODE = (1 - GAMMA**12) / (1 - GAMMA)


@pytest.mark.parametrize(("cls", "horizon"), [(RPO, EPISODE), (RPTO, 1 / (1 - GAMMA))])
def test_the_policy_gap_is_the_old_critics_advantage(cls, horizon):
    log = policy_gap(cls, (0.4, -15.0))
    assert log["gap/policy"] == pytest.approx(3.0 * 0.3 * horizon, rel=1e-4)
    assert log["gap/policy_se"] == pytest.approx(0.0, abs=1e-4)


def test_the_policy_gap_credits_entropy_at_the_old_temperature():
    log = policy_gap(RPO, (0.1, -6.0), old=(0.1, -7.0), slope=0.0, ent_coef=0.5)
    assert log["gap/policy"] == pytest.approx(0.5 * 1.0 * EPISODE, rel=1e-2)


@pytest.mark.parametrize("cls", [RPO, RPTO])
def test_an_unchanged_policy_has_no_policy_gap(cls):
    log = policy_gap(cls, (0.1, -1.0), old=(0.1, -1.0), ent_coef=0.5)
    assert log["gap/policy"] == log["gap/policy_se"] == 0.0


@pytest.mark.parametrize("cls", [RPO, RPTO])
def test_an_unchanged_policy_that_explores_by_states_has_no_policy_gap(cls):
    model = small(cls, world(0.8), world(0.7), use_sde=True, gradient_steps=0)
    model.learn(60, log_interval=None, source_timesteps=0)
    callback = RelativityGapCallback()
    callback.init_callback(model)
    held = model.actor.action_dist.exploration_mat
    gap = callback.policy_gap()
    assert gap is not None
    assert gap.mean == gap.standard_error == 0.0
    assert model.actor.action_dist.exploration_mat is held


def test_state_dependent_exploration():
    model = small(RPO, world(0.8), world(0.7), use_sde=True)
    recorded = Recorded(20)
    model.learn(20, [RelativityGapCallback(20), recorded], log_interval=None, source_timesteps=0)
    assert all(math.isfinite(recorded.logs[-1][f"gap/{name}"]) for name in ("dynamics", "policy"))


# --------------------------------------------------------------------------------------- the run


@pytest.mark.parametrize("cls", [RPO, RPTO])
def test_the_run_is_the_same_with_and_without_the_callback(cls):
    finals = []
    for callback in (None, RelativityGapCallback(10)):
        model = small(cls, world(0.8), world(0.7), learning_starts=0)
        model.learn(45, callback, source_timesteps=0)
        finals.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    assert th.equal(*finals)


@pytest.mark.parametrize("name", ["frequency", "n_episodes"])
def test_numbers_below_one_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        RelativityGapCallback(**{name: 0})


def test_endless_sums_are_refused_before_the_first_target_step():
    model = small(RPO, world(0.8), world(0.7), gamma=1.0)
    with pytest.raises(ValueError, match="needs gamma below 1"):
        model.learn(10, RelativityGapCallback(5), source_timesteps=0)
    assert model.target_spent == {}


@pytest.mark.parametrize("callback", [RelativityGapCallback, KeepBest])
def test_other_algorithms_are_refused(callback):
    with pytest.raises(TypeError, match="needs RPO, RTO or RPTO, got SAC"):
        SAC("MlpPolicy", world(0.8), device="cpu").learn(1, callback())


# ---------------------------------------------------------------------------------- newest_episodes


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.lists(st.integers(1, 6), min_size=1, max_size=5), min_size=1, max_size=3),
    n_steps=st.integers(1, 40),
    capacity=st.integers(4, 60),
    n_episodes=st.integers(1, 8),
)
def test_newest_episodes_finds_all_that_are_whole(lengths, n_steps, capacity, n_episodes):
    n_envs = len(lengths)
    space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    dual = DualReplayBuffer(capacity, space, Decay.action_space, device="cpu", target_size=capacity)
    # each observation is unique: (environment and episode, time)
    clock = [(0, 0)] * n_envs
    episodes = []
    for step in range(n_steps):
        rows = []
        for env, (episode, t) in enumerate(clock):
            done = t + 1 == lengths[env][episode % len(lengths[env])]
            rows.append(((env * 1000 + episode, t), (env * 1000 + episode, t + 1), done))
            clock[env] = (episode + 1, 0) if done else (episode, t + 1)
            if done:
                episodes.append((env, step - t, step, env * 1000 + episode))
        obs, next_obs, dones = (np.array(column, dtype=float) for column in zip(*rows))
        dual.append("target", obs, next_obs, np.zeros((n_envs, 1)), np.zeros(n_envs), dones)
    full = n_steps * n_envs >= capacity
    oldest = -(-max(n_steps * n_envs - capacity, 0) // n_envs)  # first step with a row of every environment
    if full:
        oldest += 1  # whether the oldest row begins an episode cannot be known
    expected = [name for env, start, _, name in episodes if start >= oldest]
    found = newest_episodes(dual.target, n_envs, n_episodes)
    observations = [dual.target.observations[rows, 0] for rows in found]
    assert [int(episode[0, 0]) for episode in observations] == expected[-n_episodes:]
    for episode in observations:
        assert np.array_equal(episode[:, 1], np.arange(len(episode)))
        assert len(set(episode[:, 0])) == 1


def test_an_episode_that_a_new_learn_cut_off_is_left_out():
    model = small(RPO, world(0.8), world(0.7, lengths=(5,)), gradient_steps=0)
    model.learn(7, source_timesteps=0)
    model.learn(13, source_timesteps=0)
    found = newest_episodes(model.replay_buffer.target, 1, 10)
    # 5 of the first learn(); its last 2 and the 5 after them are no episode; the next 5; 3 are under way
    assert [(rows[0], rows[-1]) for rows in found] == [(0, 4), (12, 16)]


# ----------------------------------------------------------------------------------------- KeepBest


class Scripted(EvalCallback):
    """An evaluation whose results are given."""

    def __init__(self, results, **kwargs):
        super().__init__(pendulum(12.0), eval_freq=20, n_eval_episodes=1, verbose=0, **kwargs)
        self.results, self.policies = iter(results), []

    def _on_step(self):
        if self.n_calls % self.eval_freq:
            return True
        self.policies.append({name: value.clone() for name, value in self.model.policy.state_dict().items()})
        result = next(self.results)
        if result > self.best_mean_reward:
            self.best_mean_reward = result
            return self.callback_on_new_best.on_step()
        return True


def same_policy(a, b):
    return all(th.equal(a[name], b[name]) for name in a)


def short_pendulum():
    return gym.make("Pendulum-v1", g=12.0, max_episode_steps=5)


def test_evaluations_decide_which_policy_is_kept():
    model = small(RPO, target=short_pendulum())
    scripted = Scripted([-1e6, -9e5, -2e6, -1e6], callback_on_new_best=KeepBest())
    model.learn(80, scripted, source_timesteps=0)
    # every training return is far above these: had they counted, no evaluation would have been kept
    assert model.snapshots.best_mean_reward == -9e5
    assert same_policy(model.snapshots["best"]["policy"], scripted.policies[1])
    model.rollback("best")
    assert same_policy(model.policy.state_dict(), scripted.policies[1])


def test_a_real_evaluation_callback_keeps_its_best():
    model = small(RPO)
    evaluation = EvalCallback(
        DummyVecEnv([short_pendulum]), callback_on_new_best=KeepBest(), eval_freq=10, n_eval_episodes=1, warn=False
    )
    model.learn(30, evaluation, source_timesteps=0)
    assert model.snapshots.best_mean_reward == evaluation.best_mean_reward > -np.inf
    assert "best" in model.snapshots


def test_training_returns_decide_without_the_callback():
    model = small(RPO, target=short_pendulum())
    model.learn(60, source_timesteps=0)
    assert model.snapshots.best_by == "training"
    assert model.snapshots.best_mean_reward > -1e5


@pytest.mark.slow
def test_training_and_evaluation_are_never_compared(tmp_path):
    model = small(RPO, target=short_pendulum())
    model.learn(40, source_timesteps=0)
    model.learn(20, Scripted([-1e6], callback_on_new_best=KeepBest()), source_timesteps=0)
    assert (model.snapshots.best_by, model.snapshots.best_mean_reward) == ("evaluation", -1e6)
    # a resumed run goes on with the score of its evaluations
    model.save(tmp_path / "model.zip")
    loaded = RPO.load(tmp_path / "model.zip", env=pendulum(), target_env=short_pendulum(), device="cpu")
    loaded.learn(20, Scripted([-2e6], callback_on_new_best=KeepBest()), source_timesteps=0)
    assert loaded.snapshots.best_mean_reward == -1e6
    # without an evaluation the training returns decide again, on their own scale
    loaded.learn(40, source_timesteps=0)
    assert loaded.snapshots.best_by == "training"
    assert loaded.snapshots.best_mean_reward > -1e5


def test_keep_best_belongs_into_an_evaluation():
    with pytest.raises(ValueError, match="callback_on_new_best"):
        small(RPO).learn(5, KeepBest(), source_timesteps=0)


@pytest.mark.slow
def test_keep_best_may_be_one_of_several_in_an_evaluation():
    both = CallbackList([KeepBest(), StopTrainingOnRewardThreshold(0.0)])
    model = small(RPO).learn(30, EvalCallback(pendulum(12.0), both, eval_freq=10, verbose=0), source_timesteps=0)
    assert model.snapshots.best_by == "evaluation"
    assert model.snapshots.best_mean_reward > -1e5
