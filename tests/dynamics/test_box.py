"""Steps within bounds: the best in the box, and exactly at a bound that they come to."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_rpto.dynamics.box import bounded_step, stepped


@st.composite
def boxes(draw, most: int = 5):
    n = draw(st.integers(1, most))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    a, b = rng.standard_normal((n + 3, n)), rng.standard_normal(n + 3)
    low, high = -rng.uniform(0, 1, n) * (rng.random(n) < 0.8), rng.uniform(0.01, 1, n)
    return a, b, low, high


def best(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimises |a x - b|² in the box: the best of all choices of what is free, at its lower or at its upper bound."""
    n, found, least = a.shape[1], np.zeros(a.shape[1]), np.inf
    for at in product((-1, 0, 1), repeat=n):
        side = np.array(at)
        x, free = np.where(side < 0, low, high), side == 0
        x[free] = np.linalg.lstsq(a[:, free], b - a[:, ~free] @ x[~free])[0]
        cost = np.sum((a @ x - b) ** 2)
        if np.all((x >= low - 1e-12) & (x <= high + 1e-12)) and cost < least:
            found, least = x, cost
    return found


@settings(max_examples=60, deadline=None)
@given(boxes(4), st.floats(1e-6, 1e6))
def test_a_bounded_step_is_the_best_in_the_box(box, unit: float) -> None:
    """Whatever the scales of the parameters: those of one model differ by many orders."""
    a, b, low, high = box
    s = np.where(np.arange(a.shape[1]) % 2, unit, 1.0)
    x = bounded_step((a * s).T @ (a * s), -(a * s).T @ b, low / s, high / s)
    assert np.all((x >= low / s) & (x <= high / s))
    np.testing.assert_allclose(x * s, best(a, b, low, high), atol=1e-8)


@given(boxes())
def test_a_bounded_step_is_newtons_where_the_box_does_not_bind(box) -> None:
    a, b, _, _ = box
    wide = np.full(a.shape[1], 1e9)
    np.testing.assert_allclose(bounded_step(a.T @ a, -a.T @ b, -wide, wide), np.linalg.lstsq(a, b)[0], atol=1e-7)


def test_a_bounded_step_keeps_what_its_box_leaves_no_room_and_goes_far_where_there_is_no_bound() -> None:
    normal = np.array([[2.0, 1.0], [1.0, 2.0]])
    gradient = np.array([-4.0, -4.0])
    held = bounded_step(normal, gradient, np.array([0.25, -np.inf]), np.array([0.25, np.inf]))
    np.testing.assert_allclose(held, [0.25, (4 - 0.25) / 2], rtol=1e-6)
    open_ = bounded_step(normal, gradient, np.array([-np.inf, -np.inf]), np.array([1.0, np.inf]))
    np.testing.assert_allclose(open_, [1.0, 1.5], rtol=1e-6)


def test_a_bounded_step_with_a_singular_matrix_is_finite() -> None:
    normal = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    step = bounded_step(normal, np.array([-1.0, -1.0, 0.0]), np.full(3, -2.0), np.full(3, 2.0))
    assert step[:2].sum() == pytest.approx(1.0)
    assert step[2] == 0


@given(boxes(), st.floats(1e-6, 1e6))
def test_a_step_to_a_bound_ends_exactly_there(box, unit: float) -> None:
    """Solved for in other units it would miss the bound by rounding."""
    _, _, low, high = box
    begin = 0.37 * low + 0.63 * high
    for bound in (low, high):
        step = (bound - begin) / unit * unit
        np.testing.assert_array_equal(stepped(begin, step, low, high), bound)
        np.testing.assert_array_equal(stepped(begin, 2 * step, low, high), bound)


def test_a_step_that_ends_before_a_bound_ends_there() -> None:
    step = np.array([0.5, -0.5, 1 - 1e-9])
    found = stepped(np.zeros(3), step, np.array([-np.inf, -1.0, -1.0]), np.array([1.0, np.inf, 1.0]))
    np.testing.assert_array_equal(found, step)
