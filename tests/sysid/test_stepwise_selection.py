"""Selection: evidence against numbers worked out by hand, and eliminations on small problems."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student
from scipy.stats import ttest_1samp
from simulated import PENDULUM, compiled, problem, recorded

from sb3_rpto.effects import declare
from sb3_rpto.effects.bodies import GravityTilt
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction, PositionFriction, QuadraticDrag, StribeckFriction
from sb3_rpto.fitting.loss import FAR
from sb3_rpto.sysid.selection.model_comparison import Evidence, compare, folds
from sb3_rpto.sysid.selection.screening import screen
from sb3_rpto.sysid.selection.search import SelectorPair, correct_for_discretisation, select_effects
from sb3_rpto.sysid.selection.stepwise_selection import Model, Selection, Selector
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.multiple_shooting import Fit
from sb3_rpto.sysid.shooting.windows import cut

THRESHOLD, GAIN = DEFAULTS.selection.threshold, DEFAULTS.comparison.least_gain
ROUNDS, INSTEAD = DEFAULTS.selection.rounds, DEFAULTS.selection.rounds_instead
COULOMB, OFFSET, DRAG = 0, 1, 2


def selector(planted: list[Effect], effects: list[Effect] | None = None, seed: int = 0) -> Selector:
    effects = effects or [CoulombFriction("hinge"), TorqueOffset("hinge"), QuadraticDrag("hinge")]
    train = problem(effects, recorded(planted, seed=seed))
    select = problem(effects, recorded(planted, seed=seed + 100))
    return Selector(train, select)


def eliminated(s: Selector) -> Selection:
    count = range(len(s.simulation.effects))
    base = s.fit_model((), s.train.score(s.train.null))
    full, _ = s.fit_together(list(count), base.fit, base.fit)
    return s.eliminate(Selection(full), THRESHOLD)


@cache
def with_friction() -> tuple[Selector, Selection]:
    s = selector([CoulombFriction("hinge", level=0.08)])
    return s, eliminated(s)


# --- evidence ---------------------------------------------------------------------------------------------------------


def test_gain_and_t_are_those_of_the_mean_log_ratio_of_blocks() -> None:
    without = np.exp(np.array([0.5, 0.3, 0.2, 0.0, 0.6]))
    evidence = compare(without, np.ones(5), np.array([0, 0, 1, 1, 4]))
    np.testing.assert_allclose(evidence.blocks, [0.4, 0.1, 0.6])
    mean = 1.1 / 3
    error = np.std([0.4, 0.1, 0.6], ddof=1) / np.sqrt(3)
    assert evidence.gain == pytest.approx(1 - np.exp(-mean))
    # Three blocks: what is as unlikely among six.
    assert student.sf(evidence.t, 5) == pytest.approx(student.sf(mean / error, 2))


def test_evidence_changes_its_sign_with_the_models() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(1, 2, (2, 12))
    blocks = np.arange(12) // 3
    assert compare(a, b, blocks).t == pytest.approx(-compare(b, a, blocks).t)
    assert compare(a, a, blocks).gain == 0
    assert compare(a, a, blocks).t == 0


def test_blocks_that_agree_by_chance_have_a_finite_t() -> None:
    evidence = compare(np.full(4, 1.05), np.ones(4), np.arange(4))
    assert student.sf(evidence.t, 5) == pytest.approx(student.sf(np.log(1.05) / (0.01 / 2), 3))


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 10, 20])
def test_few_blocks_pass_by_chance_no_more_often_than_many(count: int) -> None:
    """Without the correction 8 % of two and 4 % of three blocks of pure chance pass a t of 3.5."""
    rng = np.random.default_rng(count)
    drawn = np.exp(rng.normal(0, 0.2, (4_000, count)))  # so wide that the floor of the spread does not matter
    passed = [compare(np.ones(count), 1 / ratio, np.arange(count)).t > THRESHOLD for ratio in drawn]
    assert np.mean(passed) < 0.0087 + 3 * np.sqrt(0.0087 / 4_000)  # of a t with five degrees of freedom


def test_evidence_from_many_blocks_is_the_usual_t() -> None:
    ratio = np.exp(np.random.default_rng(0).normal(0.1, 0.2, 10))
    found = compare(ratio, np.ones(10), np.arange(10)).t
    assert found == pytest.approx(ttest_1samp(np.log(ratio), 0.0).statistic)


def test_one_block_is_no_evidence() -> None:
    evidence = compare(np.full(4, 2.0), np.ones(4), np.zeros(4, dtype=int))
    assert evidence.gain == pytest.approx(0.5)
    assert evidence.t == 0
    assert not evidence.clear(0.1)


def test_clear_takes_more_than_chance_and_more_than_a_trifle() -> None:
    blocks, missed = np.zeros(3), np.full(3, np.nan)
    assert Evidence(GAIN + 0.01, 4.0, blocks, missed).clear(3.5)
    assert not Evidence(GAIN + 0.01, 3.4, blocks, missed).clear(3.5)
    assert not Evidence(GAIN - 0.01, 40.0, blocks, missed).clear(3.5)
    assert not Evidence(-0.5, -9.0, blocks, missed).clear(3.5)


def test_below_the_noise_no_model_is_better() -> None:
    errors, blocks = np.geomspace(0.01, 0.4, 8), np.arange(8)
    assert compare(errors, errors / 100, blocks).gain == 0.0
    assert compare(np.full(8, 1.0), errors, blocks).gain == pytest.approx(0.5)  # down to half of it counts


def few_missed(errors: list[float], of: int = 20) -> np.ndarray:
    """Errors of so many windows, each a block, of which a few are missed and the others met."""
    return np.r_[errors, np.random.default_rng(0).normal(1.0, 0.02, of - len(errors))]


def test_what_acts_in_few_windows_is_clear_by_those() -> None:
    without, blocks = few_missed([25.0, 30.0, 36.0, 28.0]), np.arange(20)
    usual = compare(without, np.ones(20), blocks)
    assert usual.t < np.sqrt(20 * 0.2 / 0.8)  # and no size of theirs would change that
    assert not usual.clear(THRESHOLD)
    rare = compare(without, np.ones(20), blocks, rare=True)
    assert (rare.gain, rare.clear(THRESHOLD)) == (usual.gain, True)
    log = np.log([25.0, 30.0, 36.0, 28.0])  # of four blocks: what is as unlikely among six
    assert student.sf(rare.t, 5) == pytest.approx(student.sf(log.mean() / (log.std(ddof=1) / 2), 3))
    resampled = rare.frequency((THRESHOLD, GAIN), np.random.default_rng(0), resamples=2000)
    draws = np.random.default_rng(1).integers(20, size=(2000, 20)) < 4
    assert resampled == pytest.approx(np.mean(draws.sum(1) >= 3), abs=0.03)  # three are needed, and enough


@pytest.mark.parametrize(
    ("errors", "left"),
    [
        pytest.param([25.0, 30.0], 1.0, id="two of them"),
        pytest.param([25.0, 30.0, 36.0], 20.0, id="little gained"),
        pytest.param([25.0, 25.0, 5.0, 2.5], 4.9, id="not in all"),
        pytest.param([1.9] * 4, 0.9, id="not missed"),
        pytest.param([30.0] * 11, 1.0, id="the typical one is missed, too"),
    ],
)
def test_few_windows_that_do_not_speak_for_it_change_nothing(errors: list[float], left: float) -> None:
    without, blocks = few_missed(errors), np.arange(20)
    with_ = np.where(without > 1.5, left, without)
    assert compare(without, with_, blocks, rare=True).t == compare(without, with_, blocks).t


def test_what_helps_few_windows_and_harms_the_others_is_not_clear() -> None:
    without, blocks = few_missed([25.0, 30.0, 36.0, 28.0]), np.arange(20)
    with_ = np.where(without > 1.5, 1.0, 3 * without)
    assert not compare(without, with_, blocks, rare=True).clear(THRESHOLD)


def test_errors_of_zero_are_compared_without_infinities() -> None:
    evidence = compare(np.zeros(4), np.zeros(4), np.arange(4))
    assert evidence.gain == 0
    assert np.isfinite(compare(np.ones(4), np.zeros(4), np.arange(4)).t)


def test_frequency_is_the_share_of_resamples_that_are_clear() -> None:
    sure, never = np.full(20, 0.5), np.full(20, -0.1)
    assert compare(np.exp(sure), np.ones(20), np.arange(20)).frequency((3.5, GAIN), np.random.default_rng(0)) == 1
    assert compare(np.exp(never), np.ones(20), np.arange(20)).frequency((3.5, GAIN), np.random.default_rng(0)) == 0
    noisy = np.linspace(-0.4, 1.1, 20)
    evidence = compare(np.exp(noisy), np.ones(20), np.arange(20))
    draws = noisy[np.random.default_rng(2).integers(20, size=(20000, 20))]
    t = draws.mean(1) / (draws.std(1, ddof=1) / np.sqrt(20))
    expected = np.mean((t > 3.5) & (1 - np.exp(-draws.mean(1)) > GAIN))
    assert 0.1 < expected < 0.9
    found = evidence.frequency((3.5, GAIN), np.random.default_rng(3), resamples=2000)
    assert found == pytest.approx(expected, abs=0.05)


def test_the_joint_fit_begins_again_from_kinds_that_do_no_better_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """They may be near a lower minimum all the same: beside them an effect that acts in few windows shows."""
    s = selector([CoulombFriction("hinge", level=0.08)])
    windows, base = len(s.train.windows), s.train.score(s.train.null)

    def fitted(first: float, error: float, cost: float) -> Fit:
        values = np.full_like(base.values, first)
        return Fit(values, base.starts, np.full(windows, error), cost)

    few = Model((COULOMB,), fitted(1.0, 1.5, 30.0), np.empty(0))
    ends = {0.0: fitted(0.1, 1.3, 20.0), 1.0: fitted(1.1, 1.0, 10.0)}
    monkeypatch.setattr(s, "_best_few", lambda *a: few)
    monkeypatch.setattr(s.train, "fit", lambda values, *a, **k: ends[values[0]])
    monkeypatch.setattr(s, "fit_model", lambda effects, begin: Model(tuple(effects), begin, begin.errors))
    model, _ = s.fit_together([COULOMB, OFFSET, DRAG], base, fitted(0.0, 2.0, 40.0))
    assert model.fit is ends[1.0]


def test_windows_left_out_do_not_lead_astray_what_hardly_shows() -> None:
    """Gravity that tilts along the axis of a hinge acts to second order: a straight line leads anywhere."""
    s = selector([CoulombFriction("hinge", level=0.08)], [CoulombFriction("hinge"), GravityTilt()], seed=1)
    one = s.fit_model([0], s.train.score(s.train.null))
    beside = one.fit.values + np.array([0.0, 0.002, 0.0])
    two = Model((0, 1), s.train.fit(beside, s.free([0, 1]), one.fit.starts), np.empty(0))
    errors = s._errors(two.fit, two.effects)
    assert abs(compare(errors, one.errors, s.blocks).gain) < 0.003  # 0.048 where moves know no plausible size


# --- fits and elimination ---------------------------------------------------------------------------------------------


def test_elimination_keeps_the_planted_effect_and_drops_the_others() -> None:
    _, selection = with_friction()
    assert selection.model.effects == (COULOMB,)
    assert selection.model.fit.values[0] == pytest.approx(0.08, rel=0.05)
    np.testing.assert_array_equal(selection.model.fit.values[1:], 0)
    assert set(selection.dropped) == {OFFSET, DRAG}
    assert all(step >= 1 for step, _ in selection.dropped.values())


def test_two_planted_effects_are_kept_together() -> None:
    s = selector([TorqueOffset("hinge", offset=0.06), QuadraticDrag("hinge", coefficient=0.01)], seed=3)
    selection = s.judge(eliminated(s))
    assert selection.model.effects == (OFFSET, DRAG)
    assert all(e.clear(THRESHOLD) for e in selection.evidence.values())


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_kept_on_complete_data(seed: int) -> None:
    s = selector([], seed=seed)
    selection = s.judge(eliminated(s))
    assert selection.model.effects == ()
    assert selection.evidence == {}
    np.testing.assert_array_equal(selection.model.fit.values, s.train.null)


def test_judging_drops_what_does_not_help() -> None:
    s, kept = with_friction()
    both = s.fit_model([COULOMB, DRAG], kept.model.fit)
    selection = s.judge(Selection(both))
    assert selection.model.effects == (COULOMB,)
    assert set(selection.evidence) == {COULOMB}
    assert selection.evidence[COULOMB].gain > 0.3
    _, evidence = selection.dropped[DRAG]
    assert not evidence.clear(THRESHOLD)


def test_near_the_noise_evidence_must_be_clearer_far_from_it_the_gain_larger() -> None:
    s, kept = with_friction()
    assert s.limit(kept.model) == (THRESHOLD, GAIN)
    far = s.fit_model((), kept.model.fit)
    assert np.median(far.errors) > FAR
    assert s.limit(far) == (DEFAULTS.selection.threshold_far, DEFAULTS.selection.gain_far)


@pytest.mark.parametrize(
    ("joint_stuck", "few_stuck"), [(False, False), pytest.param(True, False, marks=pytest.mark.slow), (True, True)]
)
def test_a_joint_fit_that_is_no_better_than_none_gives_way_to_the_best_few_kinds_and_these_to_effects_one_by_one(
    joint_stuck: bool, few_stuck: bool
) -> None:
    s = selector([CoulombFriction("hinge", level=0.08)])
    base = s.fit_model((), s.train.score(s.train.null))
    rounds_taken: list[int] = []
    eliminated_from: list[tuple[int, ...]] = []
    look, eliminate, together = s.add_effects, s.eliminate, s.fit_together

    def looking(selection: Selection, candidates: list[int], rounds: int = ROUNDS, alike: Any = None) -> Selection:
        rounds_taken.append(rounds)
        # as if no single effect were clear at first
        return look(selection, candidates, rounds) if len(rounds_taken) > 1 else selection

    def eliminating(selection: Selection, limit: float | None = None) -> Selection:
        eliminated_from.append(selection.model.effects)
        return eliminate(selection, limit)

    def ending_badly(effects: list[int], fit: Fit, begin: Fit) -> tuple[Model, Model]:
        joint, _ = together(effects, fit, begin)
        few = s.fit_model([COULOMB, DRAG], fit)
        stuck = 2 * base.errors
        return replace(joint, errors=stuck) if joint_stuck else joint, replace(few, errors=stuck) if few_stuck else few

    s.add_effects, s.eliminate, s.fit_together = looking, eliminating, ending_badly  # type: ignore[method-assign]
    selection = select_effects(SelectorPair(s, s), base, screen(s.train, base.fit))
    assert selection.model.effects == (COULOMB,)
    assert rounds_taken == [ROUNDS, INSTEAD if joint_stuck and few_stuck else ROUNDS]
    if not few_stuck:
        assert set(eliminated_from[0]) == ({COULOMB, DRAG} if joint_stuck else {COULOMB, OFFSET, DRAG})


def test_where_a_single_effect_leaves_nothing_all_together_are_not_fitted() -> None:
    s = selector([CoulombFriction("hinge", level=0.08)])
    base = s.fit_model((), s.train.score(s.train.null))
    s.fit_together = None  # type: ignore[method-assign, assignment]
    assert s.predicted_gain(base, [COULOMB, OFFSET, DRAG]) > 0.5
    selection = select_effects(SelectorPair(s, s), base, screen(s.train, base.fit))
    assert selection.model.effects == (COULOMB,)
    assert s.predicted_gain(selection.model, [COULOMB, OFFSET, DRAG]) < GAIN


def test_of_effects_that_do_as_well_the_simpler_one_is_added() -> None:
    s = selector([CoulombFriction("hinge", level=0.08)], [StribeckFriction("hinge"), CoulombFriction("hinge")])
    base = s.fit_model((), s.train.score(s.train.null))
    assert s.add_effects(Selection(base), [0, 1]).model.effects == (1,)


def test_one_of_its_class_may_take_the_place_of_what_is_added() -> None:
    s = selector([CoulombFriction("hinge", level=0.08)])
    base = s.fit_model((), s.train.score(s.train.null))
    assert s.add_effects(Selection(base), [DRAG], rounds=1, alike=lambda e: [COULOMB]).model.effects == (COULOMB,)


@pytest.mark.slow
def test_a_shape_that_hides_an_effect_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The declared damping takes the mean friction; the rest is less than nothing where the null phase has it most."""
    there = PositionFriction("hinge", amplitude=0.1, phase=2.9)

    def found() -> Model:
        s = selector([there], [PositionFriction("hinge"), *declare(compiled(), ["hinge.damping"])])
        base = s.fit_model((), s.train.score(s.train.null), iterations=20)
        return s.add_effects(Selection(base), [0]).model

    np.testing.assert_allclose(found().fit.values, [*there.values, 0.05], rtol=0.1)
    phase = replace(PositionFriction.parameters[1], starts=())
    monkeypatch.setattr(PositionFriction, "parameters", (PositionFriction.parameters[0], phase))
    assert found().effects == ()


# --- coarse steps -----------------------------------------------------------------------------------------------------


def test_recordings_less_the_error_of_coarse_steps_are_met_by_them() -> None:
    """Without noise: what is left is the change of that error with the start."""
    effects: list[Effect] = [TorqueOffset("hinge")]
    data = recorded(noise=1e-9, model=compiled(PENDULUM.replace("0.005", "0.001")))

    def rough_or_fine(integrator: str) -> Selector:
        model = compiled(PENDULUM.replace("RK4", integrator))
        return Selector(problem(effects, data, model, noise=1e-4))

    on = SelectorPair(rough_or_fine("RK4"), rough_or_fine("Euler"))
    null = on.fine.train.null
    after = correct_for_discretisation(on, null)
    assert after.fine is on.fine
    errors = [np.median(p.score(null).errors) for p in (on.fine.train, on.rough.train, after.rough.train)]
    assert errors[1] > 3 * errors[0]
    assert errors[2] == pytest.approx(errors[0], rel=0.2)
    alike = SelectorPair(on.fine, on.fine, on.say)
    assert correct_for_discretisation(alike, null) is alike


def test_looking_forward_brings_a_wrongly_dropped_effect_back() -> None:
    s, _ = with_friction()
    nothing = Selection(s.fit_model((), s.train.score(s.train.null)))
    nothing.dropped[COULOMB] = (1, None)
    found = s.add_effects(nothing, [COULOMB, OFFSET, DRAG])
    assert found.model.effects == (COULOMB,)
    assert COULOMB not in found.dropped


@pytest.mark.slow
def test_a_larger_model_begins_at_the_smaller_ones_optimum_and_is_never_worse() -> None:
    s = selector([CoulombFriction("hinge", level=0.04), TorqueOffset("hinge", offset=0.02)], seed=5)
    small = s.fit_model((), s.train.score(s.train.null))
    for grown in ([COULOMB], [COULOMB, OFFSET], [COULOMB, OFFSET, DRAG]):
        large = s.fit_model(grown, small.fit)
        assert large.fit.cost <= small.fit.cost * (1 + 1e-9)
        small = large
    # With no iteration to spend on it, it is the smaller one.
    fresh = Selector(s.train, s.select, s.say)
    begin = small.fit
    assert fresh.fit_model([COULOMB, OFFSET, DRAG], begin, iterations=1).fit.cost <= begin.cost * (1 + 1e-9)


def test_effects_that_are_not_in_a_model_are_at_their_null_in_it() -> None:
    s, selection = with_friction()
    full = s.fit_model([COULOMB, OFFSET, DRAG], selection.model.fit)
    less = s.fit_model([OFFSET], full.fit)
    np.testing.assert_array_equal(less.fit.values[[COULOMB, DRAG]], 0)
    assert less.effects == (OFFSET,)


def test_the_planted_effects_removal_costs_most() -> None:
    s, selection = with_friction()
    full = s.fit_model([COULOMB, OFFSET, DRAG], selection.model.fit)
    order, costs = s.removal_costs(full)
    assert order[-1] == COULOMB
    assert order == sorted(costs, key=costs.get)
    assert costs[COULOMB] > 20 * max(costs[OFFSET], costs[DRAG])


def test_the_cost_of_a_removal_is_that_of_the_fit_without_it_where_the_effect_is_small() -> None:
    s = selector([TorqueOffset("hinge", offset=0.001)], [TorqueOffset("hinge")], seed=7)
    full = s.fit_model([0], s.train.score(s.train.null), iterations=20)
    _, costs = s.removal_costs(full)
    less = s.train.fit(s.train.null, np.empty(0, dtype=int), full.fit.starts, iterations=20, tolerance=1e-6)
    assert costs[0] == pytest.approx(less.cost - full.fit.cost, rel=0.15)


def test_evidence_is_judged_on_the_select_windows_alone() -> None:
    s, selection = with_friction()
    base = s.fit_model((), s.train.score(s.train.null))
    other = Selector(s.train, s.select, s.say)
    worse = replace(selection.model, errors=2 * base.errors)
    assert other.evidence(worse, base).gain == pytest.approx(1 - 2)


# --- cross-validation -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("overlap", [0.0, 2 / 3])
def test_folds_are_whole_blocks_and_a_gap_apart_from_what_is_fitted(overlap: float) -> None:
    horizon = 0.4
    data = recorded(episodes=2, duration=6.1)
    w = cut(compiled(), data, np.array([1e-3]), horizon, 100, overlap=overlap)
    parts = folds(w, horizon, 4)
    assert len(parts) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate([judged for _, judged in parts])), np.arange(len(w)))
    for others, judged in parts:
        assert len(others)
        assert set(w.block[judged]) & set(np.delete(w.block, judged)) == set()
        apart = np.abs(w.time[others][:, None] - w.time[judged])
        apart[w.episode[others][:, None] != w.episode[judged]] = np.inf
        # No sample of a judged window, nor one within a window's length of it, is fitted to.
        assert apart.min() >= 2 * horizon - 1e-6


def test_few_blocks_are_as_many_folds_and_never_without_something_to_fit() -> None:
    data = recorded(episodes=1, duration=2.6)
    w = cut(compiled(), data, np.array([1e-3]), 0.4, 100)
    count = len(np.unique(w.block))
    parts = folds(w, 0.4)
    assert len(parts) == count < 6
    assert all(len(others) and len(judged) for others, judged in parts)
    assert all(set(others) & set(judged) == set() for others, judged in parts)


def test_a_fold_is_judged_as_by_a_fit_to_the_others() -> None:
    """One Gauss-Newton step from the fit to all windows is nearly that fit."""
    effects: list[Effect] = [CoulombFriction("hinge"), TorqueOffset("hinge")]
    p = problem(effects, recorded([CoulombFriction("hinge", level=0.05)], episodes=3, noise=2e-3), noise=2e-3)
    s = Selector(p, horizon=0.4)
    full = s.fit_model((0, 1), p.score(p.null), 20)
    assert len(s.folds) == 6
    expected, inside = [], []
    for others, judged in s.folds:
        refitted = p.on(others).fit(full.fit.values, np.arange(2), iterations=4, tolerance=1e-4)
        expected.append(p.on(judged).score(refitted.values).errors)
        inside.append(p.on(judged).score(full.fit.values).errors)
    order = np.concatenate([judged for _, judged in s.folds])
    assert len(full.errors) == len(order)
    # What the windows themselves would have pulled the parameters to is left out, as a refit leaves it out.
    step, refit = full.errors - np.concatenate(inside), np.concatenate(expected) - np.concatenate(inside)
    assert np.corrcoef(step, refit)[0, 1] > 0.95
    assert np.linalg.norm(step - refit) < 0.3 * np.linalg.norm(refit)
    assert refit.mean() > 0
    assert s.evidence(full, s.fit_model((1,), full.fit)).clear(THRESHOLD)
    assert not s.evidence(full, s.fit_model((0,), full.fit)).clear(THRESHOLD)


def test_noisy_data_are_not_exact() -> None:
    assert not with_friction()[0].train.exact
