"""Robust Gauss-Newton: least-squares steps within bounds and a trust region, and the descent that takes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.optimize import lsq_linear

#: What misses a bound by less than this share of it, or of the step, does so by rounding.
ROUNDING = 1e-12
#: Share of the expected fall of the cost that is enough to take a step without looking further.
KEPT = 0.5
#: Weight, relative to the data's, of the wish that a step be small.
RIDGE = 1e-4

Point = TypeVar("Point")


class Trial(NamedTuple, Generic[Point]):
    """Where a step leads.

    :param point: estimate after the step
    :param fall: how far the cost falls, by simulations side by side
    :param trust: of the step: a reach of the trust region, or a Levenberg-Marquardt damping
    """

    point: Point
    fall: float
    trust: float


class Linearisation(Protocol[Point]):
    """A robust least-squares problem around a point, as :func:`minimise` asks for it."""

    @property
    def point(self) -> Point:
        """The point, with whatever was computed there."""

    def expected_fall(self, trust: float) -> float:
        """How far the cost would fall by a step of this trust if it were quadratic."""

    def converged(self, fall: float) -> bool:
        """Whether the point is a minimum, where the first step is expected to lower the cost by ``fall``."""

    def best_trial(self, trusts: np.ndarray) -> Trial[Point]:
        """The best of the steps of these trusts, all within the bounds, simulated side by side."""

    def is_last(self, trial: Trial[Point]) -> bool:
        """Whether a step that lowers the cost changes too little for another one."""


class Descent(NamedTuple, Generic[Point]):
    """Where :func:`minimise` ended.

    :param point: estimate
    :param steps: that were taken
    :param around: the linearisation at ``point``, where it converged there; else None
    """

    point: Point
    steps: int
    around: Linearisation[Point] | None


def minimise(
    linearise: Callable[[Point], Linearisation[Point]],
    point: Point,
    *,
    trust: float,
    ladder: Sequence[Sequence[float]],
    iterations: int,
) -> Descent[Point]:
    """Gauss-Newton steps that lower a robust cost, until none does, one is the last, or there were enough.

    The two users of this differ in how a step is kept within a region where the linearisation holds:

    - One-step errors are cheap, and phi is to move no farther than a user trusts. The trust is a reach, the ladder has
      one rung of shares of it, and all are tried at once.
    - Errors of windows are expensive and curved. The trust is a damping, the rungs are factors on it, and further
      rungs are tried where the first does not lower the cost by :data:`KEPT` of what was expected.

    :param linearise: the problem around a point
    :param point: where it begins
    :param trust: of the first step; then that of the step before
    :param ladder: factors on the trust, rung by rung
    :param iterations: most steps
    :return: never of a higher cost than ``point``
    """
    steps = 0
    for _ in range(iterations):
        around = linearise(point)
        point, fall = around.point, around.expected_fall(ladder[0][0] * trust)
        if around.converged(fall):
            return Descent(point, steps, around)
        trial = _climb(around, trust, ladder, fall)
        if not trial.fall > 0:
            break
        last = around.is_last(trial)
        point, trust, steps = trial.point, trial.trust, steps + 1
        if last:
            break
    return Descent(point, steps, None)


def _climb(around: Linearisation[Point], trust: float, ladder: Sequence[Sequence[float]], fall: float) -> Trial[Point]:
    """The best step of the first rung that lowers the cost; of the lowest rung, by a share of what is expected."""
    best = around.best_trial(trust * np.array(ladder[0]))
    if best.fall > KEPT * fall:
        return best
    for factors in ladder[1:]:
        best = max(best, around.best_trial(trust * np.array(factors)), key=lambda trial: trial.fall)
        if best.fall > 0:
            break
    return best


def quadratic_fall(normal: np.ndarray, gradient: np.ndarray, step: np.ndarray) -> float:
    """How far the quadratic cost z' N z + 2 g' z falls by a step z, (f,)."""
    return float(-2 * gradient @ step - step @ normal @ step)


def bounded_step(normal: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimise the quadratic z' N z / 2 + g' z within a box: a Gauss-Newton step from the normal equations.

    :param normal: positive semi-definite, (f, f)
    :param gradient: (f,)
    :param low: (f,), may be -inf
    :param high: (f,)
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale[:, None] / scale
    values, vectors = np.linalg.eigh(scaled)
    # Half of it as a least-squares problem: root' root = N, root' rhs = -g.
    root = np.sqrt(np.maximum(values, 1e-12 * values.max()))[:, None] * vectors.T
    rhs = -(vectors.T @ (gradient / scale)) / np.sqrt(np.maximum(values, 1e-12 * values.max()))
    step = np.linalg.lstsq(root, rhs, rcond=None)[0] / scale
    if np.all((step >= low) & (step <= high)):
        return step
    # The solver wants boxes with an inside.
    least = np.nan_to_num(low, neginf=-1e9)
    top = np.maximum(high, least + 1e-9 * (1 + np.abs(least)))
    return np.clip(_solve_in_box(root, rhs, low * scale, top * scale) / scale, low, high)


def bounded_least_squares(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimise |a z - b|² within a box: the same from the residuals, whose digits the normal equations would halve.

    :param a: (m, f)
    :param b: (m,)
    :param low: not positive, (f,), may be -inf
    :param high: not negative, (f,)
    """
    # The solver wants boxes with an inside.
    return _solve_in_box(a, b, np.minimum(low, -1e-12), np.maximum(high, 1e-12))


def _solve_in_box(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.asarray(lsq_linear(a, b, (low, high), method="bvls").x)


def add_ridge(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least squares ``a z = b`` in which directions that the data hardly tell apart share a move."""
    return np.concatenate([a, np.diag(RIDGE * np.sqrt((a**2).sum(axis=0)))]), np.concatenate([b, np.zeros(a.shape[1])])


def add_step(values: np.ndarray, step: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Parameters after a step within their bounds, (p,); what comes to a bound up to rounding is exactly there.

    Steps are solved for in scaled units, and what ended at a bound is found by comparison with it.

    :param values: before, within the bounds, (p,)
    :param step: (p,)
    :param lower: bounds, (p,), may be -inf
    :param upper: (p,)
    """
    found = np.clip(values + step, lower, upper)
    for bound in (lower, upper):
        found = np.where(np.isclose(found, bound, rtol=ROUNDING, atol=ROUNDING * np.abs(step)), bound, found)
    return np.asarray(found)
