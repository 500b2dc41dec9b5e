"""Soft-L1: where it bends, and how it bounds the influence of outliers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_rpto.fitting.loss import FAR, Loss

CLIPS = st.floats(1e-3, 1e3)
RESIDUALS = st.floats(-1e3, 1e3)


def test_the_loss_turns_linear_at_three_typical_residuals() -> None:
    r = np.random.default_rng(0).standard_normal((50, 200))
    assert Loss.of(r).clip == pytest.approx(3.0, rel=0.03)
    assert Loss.of(0.1 * r).clip == 3.0, "units of noise"
    assert Loss.of(0.1 * r, least=1e-6).clip == pytest.approx(0.3, rel=0.03)
    assert Loss.of(0 * r, least=1e-6).clip == pytest.approx(3e-6)
    large = Loss.of(10 * r)
    assert large.clip == pytest.approx(30.0, rel=0.03)
    assert large.model_error_dominates
    assert not Loss.of(FAR / 2 * r).model_error_dominates


@given(CLIPS, RESIDUALS)
def test_the_loss_is_soft_l1(clip: float, r: float) -> None:
    cost = float(Loss(clip).cost(np.array(r)))
    assert cost <= min(r**2, 2 * clip * abs(r)) * (1 + 1e-9) + 1e-9 * clip**2
    assert cost >= 2 * clip * abs(r) - 2 * clip**2 - 1e-9 * clip**2


@given(CLIPS, RESIDUALS)
def test_weights_and_second_derivative_are_those_of_the_loss(clip: float, r: float) -> None:
    loss, by = Loss(clip), 1e-3 * clip
    below, here, above = loss.cost(np.array([r - by, r, r + by]))
    slope, bend = (above - below) / (2 * by), (above - 2 * here + below) / by**2
    assert 2 * float(loss.weights(np.array(r))) * r == pytest.approx(slope, rel=1e-4, abs=1e-4 * clip)
    assert 2 * float(loss.second_derivative(np.array(r))) == pytest.approx(
        bend, rel=1e-2, abs=1e-2 + 1e-9 * abs(r / clip)
    )


def test_weights_count_observations_by_their_share() -> None:
    r, share = np.array([[0.5, -4.0], [1.0, 9.0]]), np.array([[0.25], [0.75]])
    np.testing.assert_allclose(Loss(3.0).weights(r, share), share * Loss(3.0).weights(r), rtol=1e-15)


@pytest.mark.parametrize("tails", [np.inf, 3.0])
def test_an_estimate_scatters_as_the_curvature_of_the_loss_says(tails: float) -> None:
    rng, loss = np.random.default_rng(0), Loss(3.0)
    draws = rng.standard_normal((4_000, 100)) if np.isinf(tails) else rng.standard_t(tails, (4_000, 100))
    centre = np.zeros((len(draws), 1))
    for _ in range(40):  # of each row by the loss
        weight = loss.weights(draws - centre)
        centre += (weight * (draws - centre)).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    r = draws - centre
    seems = np.sqrt(((weight * r) ** 2).sum(axis=1)) / weight.sum(axis=1)
    scatter = seems / loss.curvature(r)
    assert np.sqrt(np.mean(scatter**2)) == pytest.approx(centre.std(), rel=0.03)
    assert np.sqrt(np.mean(seems**2)) < 0.95 * centre.std()
