"""Statistics against hand-computed numbers."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_rpto.evaluation import statistics


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    assert statistics.iqm(np.array([100.0, 3.0, 4.0, -50.0, 5.0, 6.0, 2.0, 7.0])) == 4.5
    assert statistics.iqm(np.array([1.0, 2.0, 30.0])) == 11.0  # of three seeds a quarter is less than one
    assert statistics.iqm(np.array([0.0, 1.0, 2.0, 6.0, 99.0])) == 3.0


def test_interval_of_two_seeds_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two runs a resample has the mean 0, 1/2 or 1 with probability 1/4, 1/2, 1/4."""
    assert statistics.iqm_interval(np.array([0.0, 1.0])) == (0.5, 0.0, 1.0)
    monkeypatch.setattr(statistics, "CONFIDENCE", 0.4)
    assert statistics.iqm_interval(np.array([0.0, 1.0])) == (0.5, 0.5, 0.5)


def test_strata_are_resampled_for_themselves() -> None:
    """Runs that agree on each target leave nothing to resample, however far apart the targets are."""
    assert statistics.stratified_interval([np.zeros(4), np.ones(4)]) == (0.5, 0.5, 0.5)
    values = np.array([0.3, 0.1, 0.9, 0.4])
    assert statistics.stratified_interval([values]) == statistics.iqm_interval(values)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ([1, 2, 3], [0, 2, 4], 4.5 / 9),  # 1; 1 and a tie; 2
        ([5, 6], [1, 2, 3], 1.0),
        ([1], [1, 1, 0, 2], 0.5),
        ([0, 3], [1], 0.5),
    ],
)
def test_probability_of_improvement_counts_pairs(x: list[float], y: list[float], expected: float) -> None:
    value, low, high = statistics.improvement([(np.array(x), np.array(y))])
    assert value == pytest.approx(expected)
    assert 0 <= low <= value <= high <= 1
    reverse, *_ = statistics.improvement([(np.array(y), np.array(x))])
    assert reverse == pytest.approx(1 - expected)


def test_probability_of_improvement_is_averaged_over_targets() -> None:
    pairs = [(np.array([1.0]), np.array([0.0])), (np.array([1.0, 2.0, 3.0]), np.array([5.0, 2.5]))]
    value, low, high = statistics.improvement(pairs)
    assert value == pytest.approx((1 + 1 / 6) / 2)
    assert 0.5 <= low <= value <= high <= 1
    assert statistics.improvement([(np.array([0.0, 1.0]), np.array([0.5]))]) == (0.5, 0.0, 1.0)
