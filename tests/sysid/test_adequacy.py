"""The adequacy ratio on data that are complete, that lack an effect, and that err rarely."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom
from simulated import problem, recorded

from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.sysid.selection.adequacy import Adequacy, adequacy, count_strays_with
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem

#: the value at which dry friction does nothing
NOTHING = np.zeros(1)


@cache
def complete(seed: int, noise: float = 1e-3) -> Problem:
    return problem([CoulombFriction("hinge")], recorded(noise=noise, seed=seed, episodes=6), noise=noise)


@cache
def recordings(seed: int, episodes: int = 10) -> Problem:
    return problem([CoulombFriction("hinge")], recorded(seed=seed, episodes=episodes))


def with_errors(p: Problem, errors: np.ndarray) -> Fit:
    return Fit(NOTHING, np.zeros((len(p.windows), 2)), errors, 0.0)


def of_noise(p: Problem, seed: int) -> np.ndarray:
    """Errors of a true model, drawn apart from those that adequacy draws itself."""
    return p.noise_errors(with_errors(p, np.ones(len(p.windows))), seed + 1000, draws=1)[0]


def test_complete_data_are_adequate_with_a_ratio_of_one_in_its_interval() -> None:
    found = []
    for seed in range(6):
        p = complete(seed)
        found.append(adequacy(p, p.score(NOTHING), seed))
    assert all(a.adequate for a in found)
    assert np.mean([a.ratio for a in found]) == pytest.approx(1.0, abs=0.02)
    # One window of a hundred lies beyond the quantile, and fewer a quarter above it.
    assert np.mean([a.strays for a in found]) < 0.01
    assert all(a.chance > 0.1 for a in found)
    # 95 % intervals: at most one of six may miss.
    assert sum(a.low <= 1.0 <= a.high for a in found) >= 5
    assert all(a.low <= a.ratio <= a.high for a in found)


def test_noise_that_is_larger_than_thought_shows_in_the_ratio() -> None:
    p = complete(0, 1.5e-3)
    low = Problem(p.simulation, replace(p.windows, sigma=np.array([1e-3])), p.scales)
    found = adequacy(low, low.score(NOTHING), 0)
    assert found.ratio == pytest.approx(1.5, rel=0.05)
    assert not found.adequate


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_missing_effect_lifts_the_ratio_above_its_interval(seed: int) -> None:
    p = problem([CoulombFriction("hinge")], recorded([CoulombFriction("hinge", level=0.08)], seed=seed, episodes=6))
    found = adequacy(p, p.score(NOTHING), seed)
    assert found.low > 1.5
    assert not found.adequate
    assert not found.denied_by_strays


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("episodes", "every"), [(10, 4), (10, 7), (20, 10)])
def test_a_misfit_of_a_few_windows_is_seen_by_their_number_alone(episodes: int, every: int, seed: int) -> None:
    p = recordings(seed, episodes)
    assert len(p.windows) == 5 * episodes
    errors = of_noise(p, seed)
    usual = adequacy(p, with_errors(p, errors), seed)
    assert usual.adequate
    assert not usual.denied_by_strays
    errors[::every] *= 6.0
    found = adequacy(p, with_errors(p, errors), seed)
    assert found.low < 1.06
    assert found.strays == pytest.approx(1 / every, abs=0.02)
    assert found.chance < 0.1 * DEFAULTS.adequacy.chance
    assert not found.adequate
    assert found.denied_by_strays


def test_chance_is_the_binomials() -> None:
    p = recordings(0)
    errors = of_noise(p, 0)
    errors[:] = np.minimum(errors, 1.0)
    strays = np.array([0, 11, 22, 33])
    errors[strays] = 9.0
    n = len(errors)
    found = adequacy(p, with_errors(p, errors), 0)
    assert found.strays == pytest.approx(4 / n)
    rare = DEFAULTS.adequacy.stray_share
    fewer = sum(math.comb(n, k) * rare**k * (1 - rare) ** (n - k) for k in range(4))
    assert found.chance == pytest.approx(1 - fewer, rel=1e-9)
    assert len(np.unique(p.windows.block[strays])) == 4


def test_a_window_is_a_stray_a_quarter_beyond_what_one_in_a_hundred_of_noise_reaches() -> None:
    p = recordings(0)
    errors = np.full(len(p.windows), 1.0)
    edge = np.quantile(p.noise_errors(with_errors(p, errors), 0), 0.99)
    for times, strays in ((1.24, 0.0), (1.26, 4 / len(errors))):
        errors[[0, 11, 22, 33]] = times * edge
        assert adequacy(p, with_errors(p, errors), 0).strays == pytest.approx(strays)


def test_a_stalled_window_and_a_stalled_block_are_no_inadequacy() -> None:
    p = recordings(4)
    errors = of_noise(p, 4)
    errors[7] = 500.0
    assert adequacy(p, with_errors(p, errors), 0).adequate
    errors[p.windows.block == p.windows.block[7]] = 500.0
    found = adequacy(p, with_errors(p, errors), 0)
    assert found.chance == 1.0
    assert found.adequate


def test_the_interval_is_that_of_resampled_blocks() -> None:
    p = complete(1)
    levels = np.array([1.0, 1.5, 2.0])
    errors = levels[p.windows.block % 3]  # all windows of a block alike
    one = adequacy(p, with_errors(p, errors), 0)
    assert one.ratio / one.low == pytest.approx(1.5, rel=1e-9)
    assert one.high / one.ratio == pytest.approx(2 / 1.5, rel=1e-9)
    apart = Problem(p.simulation, replace(p.windows, block=np.arange(len(p.windows))), p.scales)
    assert adequacy(apart, with_errors(p, np.full(len(errors), 2.0)), 0).low == pytest.approx(2.0, rel=0.06)


def test_the_interval_is_never_narrower_than_noise_alone_makes_it() -> None:
    p = complete(1)
    found = adequacy(p, with_errors(p, np.full(len(p.windows), 2.0)), 0)
    draws = p.noise_errors(with_errors(p, np.ones(len(p.windows))), 1, draws=400)
    least, most = np.quantile(np.median(draws, axis=1) / np.median(draws), [0.025, 0.975])
    assert found.ratio / found.low == pytest.approx(most, abs=0.01)
    assert found.ratio / found.high == pytest.approx(least, abs=0.01)


@pytest.mark.slow
def test_few_windows_of_noise_are_adequate() -> None:
    """Two blocks, resampled, can only be one, the other, or both."""
    p = complete(3)
    few = Problem(p.simulation, p.windows.take(np.flatnonzero(p.windows.block < 2)), p.scales)
    assert len(few.windows) < 8
    none = with_errors(few, np.ones(len(few.windows)))
    draws = few.noise_errors(none, 1000, draws=200)
    found = [adequacy(few, with_errors(few, errors), 0) for errors in draws]
    assert np.mean([a.adequate for a in found]) >= 0.95
    assert np.mean([a.low <= 1.0 <= a.high for a in found]) >= 0.9


def test_the_ratio_is_the_same_for_a_seed() -> None:
    p = complete(2)
    fit = p.score(NOTHING)
    assert adequacy(p, fit, 7) == adequacy(p, fit, 7)
    assert str(Adequacy(1.234, 1.1, 1.3, 0.0, 1.0)) == "R = 1.23 [1.10, 1.30]"


def test_either_the_ratio_or_the_strays_make_it_inadequate() -> None:
    assert Adequacy(1.2, 1.05, 1.3, 0.0, 1.0).adequate
    assert not Adequacy(1.2, 1.07, 1.3, 0.0, 1.0).adequate
    assert Adequacy(1.0, 0.95, 1.05, 0.05, 0.002).adequate
    assert not Adequacy(1.0, 0.95, 1.05, 0.08, 0.0005).adequate


def test_stray_windows_of_a_fit_are_counted_with_those_of_a_few_others() -> None:
    select, fitted = Adequacy(1.03, 0.9, 1.2, 1 / 3, 0.0057), Adequacy(1.0, 0.9, 1.1, 4 / 16, 1.0)
    assert select.adequate
    both = count_strays_with(select, 6, fitted, 16)
    assert both.strays == 6 / 22
    assert both.chance == pytest.approx(binom.sf(5, 22, 0.02))
    assert not both.adequate
    assert count_strays_with(select, 6, replace(fitted, strays=0.0), 16).chance == 0.0057  # they are no excuse
