"""Intervals from the scatter of blocks, on linear problems whose truth is known."""

import numpy as np
import pytest
from simulated import problem, recorded

from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.fitting.loss import Loss
from sb3_rpto.sysid.selection.confidence_intervals import correlations, fit_with_intervals, half_widths
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.shooting.multiple_shooting import Linear

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
        linear = Linear(x[:, :, None] * x[:, None], gradient, np.arange(size))
        held[k] = np.abs(estimate) < half_widths(linear, block)
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
    linear = Linear(x[:, :, None] * x[:, None], gradient, np.arange(2))
    assert np.isnan(half_widths(linear, np.arange(16))).tolist() == [False, True]
    assert np.isnan(half_widths(linear, np.zeros(16))).all()


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


def test_intervals_are_as_wide_as_the_curvature_of_the_loss_says(monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem([CoulombFriction("hinge")], recorded([CoulombFriction("hinge", level=0.05)]))
    s = Selector(p, p)
    selection, widths = Selection(s.fit_model((0,), p.score(p.null))), []
    for curvature in (1.0, 0.5):
        monkeypatch.setattr(Loss, "curvature", lambda loss, r, by=curvature: by)
        values, intervals, correlation = fit_with_intervals(selection, p)
        assert correlation.tolist() == [[1.0]]
        assert values[0] == pytest.approx(0.05, rel=0.05)
        widths.append(np.diff(intervals[:, 0])[0])
    assert 0 < widths[0] < 0.05
    assert widths[1] == pytest.approx(2 * widths[0])
