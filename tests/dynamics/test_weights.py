import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions
from sb3_rpto.dynamics.weights import effective_sample_size, normalise, rto_weights


class Shift(Dynamics):
    """s' = s + offset, never terminal."""

    rollout = "branches"

    def __init__(self, offset: float):
        super().__init__(spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(-1, 1, (1,)))
        self.offset = offset

    def step(self, observations, actions, deterministic=False):
        n = len(observations)
        return Prediction(observations + self.offset, th.zeros(n), th.zeros(n, dtype=th.bool))

    def fit(self, data, weights=None, max_steps=None):
        raise NotImplementedError

    def error(self, data):
        raise NotImplementedError


DATA = Transitions(
    observations=th.tensor([[0.0], [1.0], [2.0]]),
    actions=th.tensor([[0.5], [0.0], [-0.5]]),
    rewards=th.tensor([1.0, -1.0, 3.0]),
    next_observations=th.tensor([[1.0], [2.0], [3.0]]),
    terminations=th.tensor([0.0, 0.0, 1.0]),
)


def value(observations):
    return 10.0 * observations[:, 0]


def q(observations, actions):
    return 7.0 * observations[:, 0] + actions[:, 0]


def expected(raw, floor):
    raw = np.square(raw)
    return (raw - raw.min()) / (raw.max() - raw.min()) + floor


@pytest.mark.parametrize(
    ("weighting", "raw"),
    [
        ("paper", [1 + 0.9 * 10, -1 + 0.9 * 20, 3.0]),
        ("centred", [1 + 0.9 * 10 - 0.5, -1 + 0.9 * 20 - 7, 3.0 - (14 - 0.5)]),
        ("value_aware", [10 * 1.5 - 10, 10 * 2.5 - 20, 10 * 3.5 - 0.0]),
    ],
)
def test_each_mode_by_hand(weighting, raw):
    weights = rto_weights(weighting, DATA, Shift(1.5), value, q, gamma=0.9, floor=0.25)
    np.testing.assert_allclose(weights.numpy(), expected(np.array(raw), 0.25), rtol=1e-6)


def test_centred_ignores_a_constant_in_the_reward_and_paper_does_not():
    gamma, c = 0.9, 5.0
    shifted = Transitions(
        DATA.observations, DATA.actions, DATA.rewards + c, DATA.next_observations, th.zeros_like(DATA.terminations)
    )
    still = Transitions(
        DATA.observations, DATA.actions, DATA.rewards, DATA.next_observations, th.zeros_like(DATA.terminations)
    )
    offset = c / (1 - gamma)  # adding c to every reward adds this to every value of an endless task

    def weights(weighting, data, add):
        return rto_weights(weighting, data, Shift(0), lambda s: value(s) + add, lambda s, a: q(s, a) + add, gamma, 0.0)

    th.testing.assert_close(weights("centred", still, 0.0), weights("centred", shifted, offset))
    assert not th.allclose(weights("paper", still, 0.0), weights("paper", shifted, offset))


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=20), st.floats(0, 2))
def test_normalised_weights_lie_between_floor_and_one_more(values, floor):
    weights = normalise(th.tensor(values, dtype=th.float64), floor)
    assert weights.min() >= floor
    assert weights.max() <= 1 + floor + 1e-12
    assert 1 <= effective_sample_size(weights + 1e-9) <= len(values) + 1e-6


def test_equal_weights_where_all_are_the_same():
    assert normalise(th.full((4,), 3.0), 0.5).unique().numel() == 1
    assert effective_sample_size(th.ones(4)) == 4
    assert effective_sample_size(th.tensor([1.0, 0.0, 0.0])) == 1


def test_a_drawn_value_does_not_make_a_perfect_model_look_wrong():
    """V is drawn from one action: the same for s' and for its prediction, or their difference is mostly that draw."""

    def drawn(observations):
        return value(observations) + th.randn(len(observations))

    still = Transitions(
        DATA.observations, DATA.actions, DATA.rewards, DATA.observations, th.zeros_like(DATA.terminations)
    )
    th.manual_seed(3)
    weights = rto_weights("value_aware", still, Shift(0.0), drawn, q, gamma=0.9, floor=0.25)
    th.testing.assert_close(weights, th.full((3,), 1.25))
    after = th.randn(4)
    th.manual_seed(3)
    th.testing.assert_close(after, th.randn(4))  # who draws afterwards draws as ever
