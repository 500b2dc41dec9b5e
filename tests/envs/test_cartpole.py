import copy
import math
import pickle
import warnings
from dataclasses import asdict, fields

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_rpto.envs.cartpole import CartPoleParameters, ContinuousCartPoleEnv, cartpole_step

POSITIVE = [f.name for f in fields(CartPoleParameters) if f.name not in ("cart_friction", "pole_friction")]


def push(value: float) -> np.ndarray:
    return np.array([value], dtype=np.float32)


def test_moves_as_gymnasiums_cartpole():
    ours, theirs = ContinuousCartPoleEnv(), CartPoleEnv()
    rng = np.random.default_rng(0)
    ends = 0
    for seed in range(20):
        mine, yours = ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0]
        np.testing.assert_array_equal(mine, yours)
        terminated = False
        while not terminated:
            action = int(rng.integers(2))
            mine, reward, terminated, truncated, _ = ours.step(push(2 * action - 1))
            yours, expected_reward, expected_end, _, _ = theirs.step(action)
            np.testing.assert_allclose(mine, yours, rtol=0, atol=1e-6)
            assert (terminated, truncated) == (expected_end, False)
            assert reward <= expected_reward
        ends += 1
    assert ends == 20


state_values = st.tuples(*(st.floats(-2, 2) for _ in range(4)))
constants = st.builds(
    CartPoleParameters,
    gravity=st.floats(1, 20),
    cart_mass=st.floats(0.2, 5),
    pole_mass=st.floats(0.05, 5),
    pole_length=st.floats(0.2, 5),
    force_scale=st.floats(1, 20),
    cart_friction=st.floats(0, 5),
    pole_friction=st.floats(0, 0.5),
)


@settings(deadline=None, max_examples=50)
@given(state_values, st.floats(-1, 1), constants)
def test_accelerations_obey_lagranges_equations(state, action, p):
    before = th.tensor([state], dtype=th.float64)
    after = cartpole_step(before, th.tensor([[action]], dtype=th.float64), asdict(p))
    _, x_dot, theta, theta_dot = state
    x_acc, theta_acc = ((after - before)[0, [1, 3]] / p.dt).tolist()
    sin, cos, half = math.sin(theta), math.cos(theta), p.pole_length / 2
    moment = p.pole_mass * half
    cart = (p.cart_mass + p.pole_mass) * x_acc + moment * (theta_acc * cos - theta_dot**2 * sin)
    pole = 4 / 3 * moment * half * theta_acc + moment * x_acc * cos - moment * p.gravity * sin
    assert cart == pytest.approx(p.force_scale * action - p.cart_friction * x_dot, abs=1e-8)
    assert pole == pytest.approx(-p.pole_friction * theta_dot, abs=1e-8)
    np.testing.assert_allclose((after - before)[0, [0, 2]] / p.dt, [x_dot, theta_dot], atol=1e-10)


def test_environment_and_torch_share_the_physics():
    env = ContinuousCartPoleEnv(pole_length=1.7, cart_friction=0.3, pole_friction=0.02, dt=0.01)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(30):
        state, action = env.get_state()["physics"], push(rng.uniform(-1.5, 1.5))
        observation = env.step(action)[0]
        expected = cartpole_step(th.tensor([state], dtype=th.float64), th.tensor(action)[None], asdict(env.parameters))
        # Sines of the standard library and of torch may differ in their last digit.
        np.testing.assert_allclose(env.get_state()["physics"], expected[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_array_max_ulp(observation, expected[0].numpy().astype(np.float32))


def test_actions_are_clipped():
    results = []
    for value in (1.0, 7.0):
        env = ContinuousCartPoleEnv()
        env.reset(seed=0)
        results.append(env.step(push(value))[0])
    np.testing.assert_array_equal(*results)


def test_passes_both_checkers():
    env = TimeLimit(ContinuousCartPoleEnv(render_mode="rgb_array"), 500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium's hint that unbounded observations are unusual
        check_env(env, skip_render_check=True)
        sb3_check_env(env)


def test_batched_functions_agree_with_the_environment():
    env = ContinuousCartPoleEnv(theta_threshold=0.1, x_threshold=0.1)
    rows = []
    for seed in range(30):
        observation, terminated = env.reset(seed=seed)[0], False
        while not terminated:
            action = push(1.0 if seed % 2 else -1.0)
            reached, reward, terminated, _, _ = env.step(action)
            rows.append((observation, action, reached, reward, terminated))
            observation = reached
    obs, act, reached, rewards, ends = (th.as_tensor(np.array(column)) for column in zip(*rows))
    assert 0 < ends.sum() < len(ends)
    terminations = env.termination_fn(obs, act, reached)
    assert terminations.dtype == th.bool
    assert terminations.equal(ends)
    np.testing.assert_allclose(env.reward_fn(obs, act, reached), rewards, atol=1e-6)


@pytest.mark.parametrize(
    ("state", "ends"),
    [
        ((2.41, 0, 0, 0), True),
        ((-2.41, 0, 0, 0), True),
        ((0, 9, 0.22, 9), True),
        ((0, 0, -0.22, 0), True),
        ((2.39, 9, 0.2, 9), False),
        ((-2.39, 9, -0.2, 9), False),
    ],
)
def test_thresholds(state, ends):
    reached = th.tensor([state], dtype=th.float32)
    assert ContinuousCartPoleEnv().termination_fn(reached, th.zeros(1, 1), reached).tolist() == [ends]


def test_a_restored_state_continues_as_if_never_stopped():
    def play(env: gym.Env, steps: int) -> list[np.ndarray]:
        seen = []
        for k in range(steps):
            observation, _, terminated, _, _ = env.step(push(math.cos(k)))
            seen.append(env.reset()[0] if terminated else observation)  # reset draws from np_random
        return seen

    env = ContinuousCartPoleEnv(theta_threshold=0.06)
    env.reset(seed=3)
    play(env, 25)
    state = pickle.loads(pickle.dumps(env.get_state()))
    expected = play(env, 60)
    other = ContinuousCartPoleEnv(theta_threshold=0.06)
    other.reset(seed=99)
    other.set_state(state)
    np.testing.assert_array_equal(play(other, 60), expected)
    other.set_state(state)  # is not changed by playing on
    np.testing.assert_array_equal(play(other, 60), expected)


def test_reset_options_and_seed():
    env = ContinuousCartPoleEnv()
    first = env.reset(seed=5)[0]
    np.testing.assert_array_equal(env.reset(seed=5)[0], first)
    assert not np.array_equal(env.reset()[0], first)
    wide = env.reset(seed=5, options={"low": 0.5, "high": 0.6})[0]
    assert ((wide >= 0.5) & (wide <= 0.6)).all()
    with pytest.raises(ValueError):
        env.reset(options={"low": 1.0, "high": 0.0})


@pytest.mark.parametrize("name", POSITIVE)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_constants_must_be_positive(name, value):
    with pytest.raises(ValueError, match=name):
        ContinuousCartPoleEnv(**{name: value})


@pytest.mark.parametrize("name", ["cart_friction", "pole_friction"])
def test_friction_may_be_zero_but_not_negative(name):
    assert asdict(ContinuousCartPoleEnv(**{name: 0.0}).parameters)[name] == 0
    with pytest.raises(ValueError, match=name):
        ContinuousCartPoleEnv(**{name: -0.1})


def test_other_errors_name_the_cause():
    with pytest.raises(TypeError, match="pole_lenght"):
        ContinuousCartPoleEnv(pole_lenght=2.0)
    with pytest.raises(ValueError, match="human"):
        ContinuousCartPoleEnv(render_mode="human")
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        ContinuousCartPoleEnv().step(push(0))


def test_copies_are_independent():
    env = ContinuousCartPoleEnv()
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(env.step(push(1))[0], twin.step(push(1))[0])
    env.step(push(1))
    assert env.get_state()["physics"] != twin.get_state()["physics"]


def test_render_shows_where_the_pole_is():
    def pole(length: float, theta: float) -> np.ndarray:
        env = ContinuousCartPoleEnv(render_mode="rgb_array", pole_length=length)
        assert env.render() is None
        env.reset(seed=0)
        env.set_state({**env.get_state(), "physics": (0.0, 0.0, theta, 0.0)})
        frame = env.render()
        assert frame.shape == (400, 600, 3)
        assert frame.dtype == np.uint8
        return np.argwhere((frame == (202, 152, 101)).all(axis=2))

    upright, right, long = pole(1.0, 0.0), pole(1.0, 0.2), pole(2.0, 0.0)
    assert upright[:, 1].mean() == pytest.approx(299.5)
    assert right[:, 1].mean() > 305
    assert len(long) > 1.8 * len(upright)
    assert ContinuousCartPoleEnv().render() is None


def test_the_reward_is_one_at_the_centre_and_falls_to_zero_at_both_thresholds():
    env = ContinuousCartPoleEnv(x_threshold=2.0, theta_threshold=0.5)
    states = th.tensor([[0.0, 3.0, 0.0, 1.0], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, -0.5, 0.0], [-2.0, 0.0, 0.5, 0.0]])
    th.testing.assert_close(env.reward_fn(states, states, states), th.tensor([1.0, 0.5, 0.5, 0.0]))
