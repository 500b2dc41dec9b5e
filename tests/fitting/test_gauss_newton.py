"""Steps within bounds are the best in the box, and descents along them end in the minimum of a robust cost."""

from dataclasses import dataclass, field
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sb3_rpto.fitting.gauss_newton import (
    Trial,
    add_ridge,
    add_step,
    bounded_least_squares,
    bounded_step,
    minimise,
    quadratic_fall,
)
from sb3_rpto.fitting.loss import Loss


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
        np.testing.assert_array_equal(add_step(begin, step, low, high), bound)
        np.testing.assert_array_equal(add_step(begin, 2 * step, low, high), bound)


def test_a_step_that_ends_before_a_bound_ends_there() -> None:
    step = np.array([0.5, -0.5, 1 - 1e-9])
    found = add_step(np.zeros(3), step, np.array([-np.inf, -1.0, -1.0]), np.array([1.0, np.inf, 1.0]))
    np.testing.assert_array_equal(found, step)


@given(boxes())
def test_a_bounded_step_from_residuals_is_that_from_the_normal_equations(box) -> None:
    a, b, low, high = box
    np.testing.assert_allclose(
        np.clip(bounded_least_squares(a, b, low, high), low, high),
        bounded_step(a.T @ a, -a.T @ b, low, high),
        atol=1e-8,
    )


@given(boxes())
def test_a_quadratic_cost_falls_as_it_says(box) -> None:
    a, b, low, high = box
    step = np.random.default_rng(0).uniform(low, high)
    fall = (b**2).sum() - ((a @ step - b) ** 2).sum()
    assert quadratic_fall(a.T @ a, -a.T @ b, step) == pytest.approx(fall, rel=1e-9, abs=1e-9)


def test_a_ridge_lets_directions_that_are_hardly_told_apart_share_a_move() -> None:
    a = np.array([[1.0, 1.0], [2.0, 2.0]])
    ridged, b = add_ridge(a, np.array([2.0, 4.0]))
    np.testing.assert_allclose(np.linalg.lstsq(ridged, b)[0], [1.0, 1.0], rtol=1e-6)


# --- descents ---------------------------------------------------------------------------------------------------------


@dataclass
class Line:
    """A robust straight line through points, around its coefficients; the trust is a damping."""

    x: np.ndarray
    y: np.ndarray
    low: float
    point: np.ndarray
    tolerance: float = 1e-9
    tried: list[int] = field(default_factory=list)

    def cost(self, point: np.ndarray) -> float:
        return float(Loss(3.0).cost(self.x @ point - self.y).sum())

    def _step(self, damping: float) -> np.ndarray:
        r = self.x @ self.point - self.y
        weights = Loss(3.0).weights(r)[:, None]
        self.normal, self.gradient = self.x.T @ (weights * self.x), self.x.T @ (weights[:, 0] * r)
        damped = self.normal + damping * np.diag(np.diag(self.normal))
        return bounded_step(damped, self.gradient, self.low - self.point, np.full(2, np.inf))

    def expected_fall(self, trust: float) -> float:
        step = self._step(trust)
        return quadratic_fall(self.normal, self.gradient, step)

    def converged(self, fall: float) -> bool:
        return fall < self.tolerance * self.cost(self.point)

    def best_trial(self, trusts: np.ndarray) -> Trial[np.ndarray]:
        self.tried.append(len(trusts))
        points = [self.point + self._step(trust) for trust in trusts]
        falls = [self.cost(self.point) - self.cost(point) for point in points]
        best = int(np.argmax(falls))
        return Trial(points[best], falls[best], float(trusts[best]))

    def is_last(self, trial: Trial[np.ndarray]) -> bool:
        return False


def line(seed: int = 0, low: float = -np.inf) -> Line:
    rng = np.random.default_rng(seed)
    x = np.stack([np.ones(60), np.linspace(-1, 1, 60)], axis=1)
    y = x @ np.array([0.5, -2.0]) + 0.5 * rng.standard_normal(60)
    y[::10] += 30  # outliers
    return Line(x, y, low, np.zeros(2))


@pytest.mark.parametrize("low", [-np.inf, -1.0])
def test_a_descent_ends_in_the_minimum_within_the_bounds(low: float) -> None:
    task = line(low=low)
    descent = minimise(
        lambda point: Line(task.x, task.y, low, point), np.zeros(2), trust=1e-3, ladder=[[0.1], [1, 10]], iterations=100
    )
    found = least_squares(
        lambda p: task.x @ p - task.y, np.zeros(2), bounds=(low, np.inf), loss="soft_l1", f_scale=3.0, xtol=1e-12
    )
    np.testing.assert_allclose(descent.point, found.x, atol=1e-3)
    assert descent.point[1] == (low if np.isfinite(low) else pytest.approx(-2.0, abs=0.3))
    assert descent.around is not None
    assert descent.around.point is descent.point


@pytest.mark.parametrize(("expected", "rungs"), [(0.0, [1]), (np.inf, [1, 3]), (1e9, [1, 3])])
def test_rungs_are_tried_until_the_cost_falls_as_expected(expected, rungs, monkeypatch) -> None:
    task = line()
    monkeypatch.setattr(task, "expected_fall", lambda trust: expected)
    monkeypatch.setattr(task, "converged", lambda fall: False)
    ladder = [[0.1], [1, 10, 100], [1e4]]
    assert minimise(lambda point: task, np.zeros(2), trust=1e-3, ladder=ladder, iterations=1).steps == 1
    assert task.tried == rungs


def test_a_descent_ends_where_no_step_lowers_the_cost(monkeypatch) -> None:
    task = line()
    monkeypatch.setattr(task, "best_trial", lambda trusts: Trial(np.ones(2), 0.0, 1.0))
    descent = minimise(lambda point: task, np.zeros(2), trust=1.0, ladder=[[1.0], [10.0]], iterations=5)
    assert (descent.steps, descent.around) == (0, None)
    assert descent.point.tolist() == [0, 0]


def test_a_descent_takes_a_last_step_and_hands_the_trust_on(monkeypatch) -> None:
    trusts = []

    def linearise(point):
        task = line()
        task.point = point
        monkeypatch.setattr(task, "is_last", lambda trial: len(trusts) == 2)
        monkeypatch.setattr(task, "best_trial", lambda t: trusts.append(t[0]) or Trial(point + 1, 1e9, 3 * t[0]))
        return task

    descent = minimise(linearise, np.zeros(2), trust=1.0, ladder=[[1.0]], iterations=9)
    assert (descent.steps, trusts, descent.point.tolist()) == (2, [1.0, 3.0], [2, 2])
