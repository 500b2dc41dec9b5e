"""Covariances and intervals, on linear problems whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_rpto.fitting.covariance import correlations, half_widths, sandwich_covariance, serial_scatter

EVEN, UNEVEN, RARE = np.ones(16), np.geomspace(0.2, 3, 16), np.r_[np.full(12, 0.02), 1.0, 1.2, 0.9, 1.1]


def covered(design: np.ndarray, draws: int = 2000, windows: int = 3) -> np.ndarray:
    """Share of draws in which the intervals hold each parameter; the windows of a block err alike.

    :param design: (blocks, parameters), how the blocks tell the parameters
    """
    rng = np.random.default_rng(0)
    blocks, size = design.shape
    block = np.repeat(np.arange(blocks), windows)
    x = design[block]
    held = np.empty((draws, size))
    for k in range(draws):
        y = rng.standard_normal(blocks)[block] + 0.3 * rng.standard_normal(len(block))  # zero is the truth
        estimate = np.linalg.lstsq(x, y, rcond=None)[0]
        gradient = x * (x @ estimate - y)[:, None]
        held[k] = np.abs(estimate) < half_widths(x[:, :, None] * x[:, None], gradient, block)
    return held.mean(0)


@pytest.mark.parametrize("tell", [EVEN[:3], EVEN[:5], EVEN, UNEVEN, RARE], ids=["3", "5", "16", "uneven", "4 of 16"])
def test_intervals_hold_what_blocks_tell_however_few_of_them_do(tell: np.ndarray) -> None:
    # The degrees of freedom are an approximation where blocks tell unlike much.
    assert covered(tell[:, None]) == pytest.approx(0.95, abs=0.012 if np.ptp(tell) == 0 else 0.03)


def test_of_several_parameters_each_has_the_blocks_that_tell_it() -> None:
    design = np.stack([UNEVEN, RARE, np.sin(np.arange(16))], axis=1)
    assert covered(design) == pytest.approx(0.95, abs=0.03)


def test_what_a_single_block_tells_has_no_interval() -> None:
    x = np.stack([EVEN, np.eye(16)[3]], axis=1)
    gradient = np.random.default_rng(0).standard_normal((16, 2)) * x
    normal = x[:, :, None] * x[:, None]
    assert np.isnan(half_widths(normal, gradient, np.arange(16))).tolist() == [False, True]
    assert np.isnan(half_widths(normal, gradient, np.zeros(16))).all()


def test_the_sandwich_of_least_squares_is_whites() -> None:
    rng = np.random.default_rng(0)
    x, scale = rng.standard_normal((400, 2)), rng.uniform(0.2, 3, 400)
    r = scale * rng.standard_normal(400)
    scores = x * r[:, None]
    found = sandwich_covariance(x.T @ x, serial_scatter(scores, np.full(400, -1), 4), np.ones(2, dtype=bool), 400.0)
    inverse = np.linalg.inv(x.T @ x)
    np.testing.assert_allclose(found, inverse @ (scores.T @ scores) @ inverse * 400 / 398, rtol=1e-9)


@pytest.mark.parametrize(("count", "factor"), [(4.0, 4.0), (12.0, 12 / 9), (3.0, np.inf), (2.0, np.inf)])
def test_covariances_are_those_of_as_many_observations_less_as_there_are_parameters(count, factor) -> None:
    scatter = serial_scatter(np.random.default_rng(0).normal(size=(20, 3)), np.full(20, -1), 4)
    found = np.diag(sandwich_covariance(np.eye(3), scatter, np.ones(3, dtype=bool), count))
    np.testing.assert_allclose(found, factor * np.diag(scatter))


def test_what_does_not_move_or_has_no_slope_has_no_covariance() -> None:
    hessian, scatter = np.diag([4.0, 0.0, 1.0]), np.eye(3)
    found = sandwich_covariance(hessian, scatter, np.array([True, True, False]), 1e12)
    np.testing.assert_allclose(found, np.diag([1 / 16, np.inf, np.inf]), rtol=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_serial_scatter_is_the_weighted_sum_of_products_and_positive(seed: int, lags: int) -> None:
    rng = np.random.default_rng(seed)
    scores, before = rng.normal(size=(23, 2)), np.arange(-1, 22)
    begins = [0, *sorted(rng.integers(1, 23, 3))]
    before[begins] = -1
    expected = np.zeros((2, 2))
    for i in range(23):
        for j in range(23):
            apart = abs(i - j)
            if apart <= lags and not any(min(i, j) < b <= max(i, j) for b in begins):
                expected += (1 - apart / (lags + 1)) * np.outer(scores[i], scores[j])
    found = serial_scatter(scores, before, lags)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-9


def test_correlations_are_exactly_symmetric_and_one_on_the_diagonal() -> None:
    x = np.random.default_rng(0).standard_normal((30, 6)) * np.geomspace(1e-3, 1e3, 6)
    x = np.column_stack([x, x @ np.arange(6), 7 * x[:, 0]])
    covariance = x.T @ x * (1 + 1e-15 * np.random.default_rng(1).standard_normal((8, 8)))
    found = correlations(covariance)
    np.testing.assert_array_equal(np.diag(found), 1)
    np.testing.assert_array_equal(found, found.T)
    assert np.abs(found).max() == 1
    assert found[0, 7] == pytest.approx(1, rel=1e-14)
    np.testing.assert_allclose(found, x.T @ x / np.outer(*2 * [np.linalg.norm(x, axis=0)]), atol=1e-13)
