"""Multiple shooting: interpolation, derivatives and fits against brute force and SciPy."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from simulated import RATE, compiled, problem, recorded, table

from sb3_rpto.effects import Drive, Simulation, declare
from sb3_rpto.effects.commands import CommandDelay
from sb3_rpto.effects.effect import Effect, Parameter
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.effects.sensors import SensorBias, SensorDelay, SensorGain
from sb3_rpto.fitting.loss import FAR, Loss
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.shooting.initial_states import TRUST
from sb3_rpto.sysid.shooting.multiple_shooting import (
    CRUDE,
    RIDGE,
    UNSTABLE,
    Fit,
    Problem,
    interpolate,
    start_weight,
    window_costs,
)

DECLARED = ["hinge.damping", "pole.mass"]
TRUE = np.array([0.08, 0.62])


def true_effects(values=TRUE, names=DECLARED) -> list[Effect]:
    return [d.with_values(np.array([v])) for d, v in zip(declare(compiled(), names), values)]


@cache
def declared_problem(noise: float = 1e-3, sigma: float | None = None, seed: int = 0, **kwargs) -> Problem:
    data = recorded(true_effects(), noise=noise, seed=seed, **kwargs)
    return problem(declare(compiled(), DECLARED), data, noise=sigma or noise)


# --- interpolation ----------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-5, 5), min_size=4, max_size=4), st.lists(st.floats(0, 6), min_size=1, max_size=9))
def test_interpolation_reproduces_cubics(c: list[float], at: list[float]) -> None:
    dt = 0.01
    p, t = np.polynomial.Polynomial(c), dt * np.arange(7)
    q, v = p(t)[None, :, None], p.deriv()(t)[None, :, None]
    found = interpolate(q, v, np.array([at]), dt, np.array([0]), np.array([0]))
    np.testing.assert_allclose(found[0, :, 0], p(dt * np.array(at)), atol=1e-12)


def test_interpolation_gives_whole_steps_bit_for_bit_and_is_linear_without_a_velocity() -> None:
    rng = np.random.default_rng(0)
    q, v = rng.standard_normal((2, 3, 6, 2))
    at = np.array([[0, 2, 5], [1, 5, 5], [4, 3, 0]])
    expected = np.stack([q[i, a] for i, a in enumerate(at)])
    columns, dofs = np.array([0, 1]), np.array([0, 1])
    np.testing.assert_array_equal(interpolate(q, v, at.astype(float), 0.1, columns, dofs), expected)
    mixed = interpolate(q, v, at + np.array([0.25, 0, 0])[None] * (at < 5), 0.1, columns, np.array([-1, 1]))
    np.testing.assert_allclose(mixed[:, 1:], expected[:, 1:], atol=1e-13)
    np.testing.assert_allclose(mixed[0, 0, 0], 0.75 * q[0, 0, 0] + 0.25 * q[0, 1, 0])


# --- prediction and derivatives ---------------------------------------------------------------------------------------


def test_residuals_are_those_of_a_rollout_of_each_window_by_itself() -> None:
    p = declared_problem()
    w = p.windows
    count = len(w)
    found = p.residuals(np.tile(TRUE, (count, 1)), np.zeros((count, 2)), np.arange(count))
    for i in (0, 5, count - 1):
        drive = w.drive.take(np.array([i]))
        alone = Simulation(compiled(), true_effects(), 1)
        q, _ = alone.rollout(TRUE[None], w.qpos[[i]], w.qvel[[i]], Drive(drive.commands, drive.before))
        expected = (q[0, w.at[i].astype(int), 0] - w.measured[i, :, 0]) / w.sigma[0]
        np.testing.assert_allclose(found[i], expected * w.usable[i], atol=1e-9)
    np.testing.assert_allclose(p.errors(found)[3], np.sqrt(np.mean(found[3] ** 2)))


def test_a_sensors_bias_shifts_the_start_and_what_is_shown_alike() -> None:
    data = recorded([*true_effects(), SensorBias("hinge")], noise=0.0)
    shifted = replace(data, episodes=[replace(e, qpos=e.qpos + 0.1) for e in data.episodes])
    p = problem([*true_effects(), SensorBias("hinge")], shifted)
    count = len(p.windows)
    values = np.tile([*TRUE, 0.1], (count, 1))
    right = p.errors(p.residuals(values, np.zeros((count, 2)), np.arange(count)))
    values[:, 2] = 0
    wrong = p.errors(p.residuals(values, np.zeros((count, 2)), np.arange(count)))
    assert np.median(right) < 0.1 * np.median(wrong)


def test_a_sensor_of_ones_own_is_given_the_velocity() -> None:
    class Filtered(Effect):
        """An encoder behind a quick filter, to first order."""

        kind, place, equation = "filtered", "sensor", "q - T qd"
        parameters = (Parameter("T", "s", 0.005, lower=0.0),)

        def observe(self, q, v, x):
            return q - x[..., 0] * v, v

        def unobserve(self, q, v, x):
            return q + x[..., 0] * v, v

    data = recorded(noise=0.0)
    shown = [replace(e, qpos=e.qpos - 0.02 * e.qvel) for e in data.episodes]
    p = problem([Filtered("hinge")], replace(data, episodes=shown))
    errors = [np.median(p.score(np.array([lag]), iterations=3).errors) for lag in (0.0, 0.02)]
    assert errors[1] < 0.1 < 1 < errors[0]


@pytest.mark.parametrize("bias_first", [True, False])
def test_bias_and_gain_of_one_sensor_are_undone_in_the_opposite_order(bias_first: bool) -> None:
    pair = [SensorBias("hinge", offset=0.3), SensorGain("hinge", change=0.2)][:: 1 if bias_first else -1]
    data, (b, g) = recorded(true_effects(), noise=0.0), (0.3, 0.2)
    rows = [(1 + g) * (e.qpos + b) if bias_first else (1 + g) * e.qpos + b for e in data.episodes]
    data = replace(data, episodes=[replace(e, qpos=q, qvel=(1 + g) * e.qvel) for e, q in zip(data.episodes, rows)])
    p = problem([*true_effects(), *pair], data)
    count = len(p.windows)
    values = np.tile([*TRUE, *(effect.values[0] for effect in pair)], (count, 1))
    np.testing.assert_array_less(p.errors(p.residuals(values, np.zeros((count, 2)), np.arange(count))), 0.5)


def test_derivatives_are_differences_of_residuals() -> None:
    p = declared_problem()
    count = len(p.windows)
    rng = np.random.default_rng(0)
    values, starts = np.array([0.06, 0.55]), 0.1 * rng.standard_normal((count, 2))
    r, jt, jx = p.linearise(values, starts, np.array([1, 0]))

    def at(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
        return p.residuals(np.tile(values, (count, 1)), starts, np.arange(count))

    np.testing.assert_allclose(r, at(values, starts), atol=1e-9)
    scale = np.linalg.norm(jt, axis=1).mean()
    for column, k in enumerate((1, 0)):
        e = 1e-3 * p.size[k] * np.eye(2)[k]
        central = (at(values + e, starts) - at(values - e, starts)) / 2e-3
        assert np.linalg.norm(jt[:, :, column] - central) < 0.03 * np.linalg.norm(central)
    for k in range(2):
        e = 1e-2 * np.eye(2)[k]
        central = (at(values, starts + e) - at(values, starts - e)) / 2e-2
        assert np.linalg.norm(jx[:, :, k] - central) < 0.03 * np.linalg.norm(central)
    assert scale > 1


@pytest.mark.parametrize("free", [[], [1, 0]])
def test_residuals_that_are_known_are_not_simulated_again(free, monkeypatch) -> None:
    p = declared_problem()
    count = len(p.windows)
    values, starts = np.array([0.06, 0.55]), 0.1 * np.random.default_rng(0).standard_normal((count, 2))
    base = p.residuals(np.tile(values, (count, 1)), starts, np.arange(count))
    expected = p.linearise(values, starts, np.array(free, dtype=int))
    simulated = []
    predict = p.predict
    monkeypatch.setattr(p, "predict", lambda *a: (simulated.append(len(a[2])), predict(*a))[1])
    for one, other in zip(p.linearise(values, starts, np.array(free, dtype=int), base), expected):
        np.testing.assert_array_equal(one, other)
    assert simulated == [count * (len(free) + 2)]


def test_the_derivative_at_a_bound_points_inside() -> None:
    p = problem(declare(compiled(), ["pole.mass=0.2:0.5"]), recorded(true_effects()))
    assert p.steps(np.array([0.5]))[0] < 0
    assert p.steps(np.array([0.2]))[0] > 0
    _, jt, _ = p.linearise(np.array([0.5]), np.zeros((len(p.windows), 2)), np.array([0]))
    _, inside, _ = p.linearise(np.array([0.49]), np.zeros((len(p.windows), 2)), np.array([0]))
    assert np.linalg.norm(jt - inside) < 0.2 * np.linalg.norm(inside)


def test_starts_are_eliminated_as_in_the_full_normal_equations() -> None:
    p = declared_problem()
    count, loss = len(p.windows), Loss(3.0)
    starts = 0.2 * np.random.default_rng(1).standard_normal((count, 2))
    r, jt, jx = p.linearise(np.array([0.06, 0.55]), starts, np.array([0, 1]))
    reduced = p.reduce(r, jt, jx, starts, loss)
    for w in (0, count - 1):
        weight = 1 / np.sqrt(1 + (r[w] / loss.clip) ** 2)
        j = np.concatenate([jt[w], jx[w]], axis=1)
        full = (j * weight[:, None]).T @ j + np.diag([0, 0, start_weight(loss), start_weight(loss)])
        gradient = (j * weight[:, None]).T @ r[w] + np.concatenate([[0, 0], start_weight(loss) * starts[w]])
        inner = np.linalg.inv(full[2:, 2:])
        np.testing.assert_allclose(reduced.normal[w], full[:2, :2] - full[:2, 2:] @ inner @ full[2:, :2], rtol=1e-7)
        np.testing.assert_allclose(
            reduced.gradient[w], gradient[:2] - full[:2, 2:] @ inner @ gradient[2:], rtol=1e-6, atol=1e-6
        )


# --- fits -------------------------------------------------------------------------------------------------------------


def test_declared_parameters_are_recovered_from_exact_data() -> None:
    data = recorded(true_effects(), noise=0.0, exact=True)
    p = problem(declare(compiled(), DECLARED), data, noise=1e-4)
    fit = p.fit(p.null, np.arange(2), iterations=20, tolerance=1e-8)
    np.testing.assert_allclose(fit.values, TRUE, rtol=1e-3)
    assert fit.errors.max() < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_a_fit_of_noisy_data_is_scipys_on_the_same_cost(seed: int) -> None:
    p = declared_problem(seed=seed)
    p = p.on(np.arange(0, len(p.windows), 4))
    count = len(p.windows)
    fit = p.fit(p.null, np.arange(2), iterations=30, tolerance=1e-7)
    np.testing.assert_allclose(fit.values, TRUE, rtol=0.1)
    loss = Loss.of(p.residuals(np.tile(fit.values, (count, 1)), fit.starts, np.arange(count)))

    def parts(x: np.ndarray) -> np.ndarray:
        values, starts = x[:2] * p.size, x[2:].reshape(count, 2)
        r = p.residuals(np.tile(values, (count, 1)), starts, np.arange(count))
        soft = np.sign(r) * loss.clip * np.sqrt(2 * (np.sqrt(1 + (r / loss.clip) ** 2) - 1))
        return np.concatenate([soft.ravel(), np.sqrt(start_weight(loss)) * starts.ravel()])

    begin = np.concatenate([fit.values / p.size, fit.starts.ravel()])
    found = least_squares(parts, begin, diff_step=1e-4, max_nfev=8)
    assert fit.cost <= 2 * found.cost * 1.002
    spread = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))[:2] * p.size
    assert np.all(np.abs(fit.values - found.x[:2] * p.size) < 0.3 * spread)


def test_noisy_declared_parameters_are_within_their_own_spread() -> None:
    z = []
    for seed in range(3):
        p = declared_problem(seed=seed)
        fit = p.fit(p.null, np.arange(2), iterations=20, tolerance=1e-5)
        normal = p.linear(fit, np.arange(2)).normal.sum(0)
        z.append((fit.values - TRUE) / (p.size * np.sqrt(np.diag(np.linalg.inv(normal)))))
    assert np.sqrt(np.mean(np.square(z))) < 2.0
    assert np.abs(z).max() < 4.5


@settings(max_examples=8, deadline=None)
@given(st.floats(0.001, 0.5), st.floats(0.1, 2.0), st.integers(0, 3))
def test_a_fit_is_never_worse_than_where_it_began(damping: float, mass: float, seed: int) -> None:
    p = declared_problem()
    count = len(p.windows)
    values, starts = np.array([damping, mass]), np.random.default_rng(seed).standard_normal((count, 2))
    r = p.residuals(np.tile(values, (count, 1)), starts, np.arange(count))
    began = float(p.cost(r, starts, values, Loss.of(r)))
    fit = p.fit(values, np.arange(2), starts, iterations=2)
    assert fit.cost <= began * (1 + 1e-9)
    assert np.all((fit.values >= p.lower) & (fit.values <= p.upper))


def test_a_fit_that_came_to_rest_knows_the_cost_around_it() -> None:
    task, free = declared_problem(), np.arange(2)
    fit = task.fit(task.simulation.null, free, tolerance=1e-6)
    assert fit.linear is not None
    assert task.linear(fit, free) is fit.linear
    again = task.linear(replace(fit, linear=None), free)
    np.testing.assert_array_equal(fit.linear.normal, again.normal)
    np.testing.assert_array_equal(fit.linear.gradient, again.gradient)
    np.testing.assert_array_equal(task.linear(fit, free[1:]).free, [1])


def test_a_small_step_lowers_the_cost_as_expected() -> None:
    task, free = declared_problem(), np.arange(2)
    fit = task.fit(task.simulation.null, free)
    around = task.around(fit.values * [1.02, 0.998], fit.starts, None, free)
    trial = around.best_trial(np.array([1e-4]))
    assert trial.fall > 0.01 * around.cost
    assert trial.fall == pytest.approx(around.expected_fall(1e-4), rel=0.2)


def test_what_is_not_free_stays() -> None:
    p = declared_problem()
    begin = np.array([0.06, 0.4])
    fit = p.fit(begin, np.array([1]), iterations=4)
    assert fit.values[0] == 0.06
    assert fit.values[1] != 0.4
    scored = p.score(begin)
    np.testing.assert_array_equal(scored.values, begin)


def test_a_score_may_have_parameters_of_its_own_in_each_window() -> None:
    p = declared_problem(sigma=5e-2)  # so small residuals that the loss is the same for any of them
    rows = TRUE * np.where(np.arange(len(p.windows)) % 2, 1.0, 1.1)[:, None]
    mixed, even, odd = p.score(rows), p.score(1.1 * TRUE), p.score(TRUE)
    np.testing.assert_allclose(mixed.errors[::2], even.errors[::2], rtol=1e-9)
    np.testing.assert_allclose(mixed.errors[1::2], odd.errors[1::2], rtol=1e-9)
    assert not np.allclose(even.errors, odd.errors, rtol=0.1)


def test_a_score_may_begin_at_starts_that_are_known() -> None:
    task = declared_problem()
    fit = task.fit(task.simulation.null, np.arange(2), tolerance=1e-9)
    np.testing.assert_allclose(task.score(fit.values, fit.starts, iterations=1).errors, fit.errors, rtol=1e-3)
    np.testing.assert_array_equal(task.score(fit.values, fit.starts, iterations=0).starts, fit.starts)


def test_a_simulation_without_parameters_is_fitted_in_its_starts() -> None:
    model = compiled()
    model.dof_damping[0] = TRUE[0]
    p = problem([], recorded(model=model), model)
    _, jt, jx = p.linearise(np.empty(0), np.zeros((len(p.windows), 2)), np.empty(0, dtype=int))
    assert jt.shape[2] == 0
    assert jx.any()
    fit = p.fit(np.empty(0), np.empty(0, dtype=int))
    assert fit.values.shape == (0,)
    assert np.median(fit.errors) == pytest.approx(1.0, abs=0.05)


def test_starts_are_held_less_firmly_where_the_model_errs_by_more_than_noise() -> None:
    r = np.random.default_rng(0).standard_normal((50, 200))
    assert start_weight(Loss.of(0.1 * r)) == 1.0
    # Where the model errs by ten units of noise, so may the starts, at the price of one.
    assert start_weight(Loss.of(10 * r)) == pytest.approx(100.0, rel=0.06)
    starts = np.array([[1.0, 2.0]])
    assert window_costs(Loss(3.0), np.array([[0.01]]), starts)[0] == pytest.approx(5.0 + 1e-4, rel=1e-4)
    assert window_costs(Loss(6.0), np.array([[3e4]]), 0 * starts)[0] == pytest.approx(2 * 6.0 * 3e4, rel=1e-3)


def counted(p: Problem, monkeypatch: pytest.MonkeyPatch, crude: float) -> tuple[Fit, int]:
    """A fit of all parameters with this share far from the noise, and how many derivatives it took."""
    calls, once = [], p.linearise
    with monkeypatch.context() as patch:
        patch.setattr(p, "linearise", lambda *a: calls.append(1) or once(*a))
        return p.fit(p.null, np.arange(2), iterations=20, tolerance=1e-6, crude=crude), len(calls)


@pytest.mark.slow
def test_fits_far_from_the_noise_end_sooner_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    near = declared_problem()
    (soon, calls), (late, others) = (counted(near, monkeypatch, crude) for crude in (CRUDE, 0.0))
    assert calls == others
    np.testing.assert_array_equal(soon.values, late.values)
    data = recorded([*true_effects(), CoulombFriction("hinge", level=0.3)])
    far = problem(declare(compiled(), DECLARED), data, noise=1e-3)
    (soon, calls), (late, others) = (counted(far, monkeypatch, crude) for crude in (CRUDE, 0.0))
    assert np.median(late.errors) > FAR
    assert calls < others
    assert late.cost <= soon.cost < 1.05 * late.cost
    exact = replace(far.windows, exact=True)
    _, calls = counted(Problem(far.simulation, exact, far.scales), monkeypatch, CRUDE)
    assert calls == others


def test_starts_are_recovered() -> None:
    p = problem(true_effects(), recorded(true_effects(), noise=0.0), noise=1e-3)
    w, rng = p.windows, np.random.default_rng(0)
    off = rng.standard_normal(w.spread.shape)
    shift = off * w.spread
    moved = Problem(p.simulation, replace(w, qpos=w.qpos + shift[:, :1], qvel=w.qvel + shift[:, 1:]), p.scales)
    # In units of the trusted spread: what was put on is taken off, but for the pull on the starts.
    put = (p.score(TRUE, iterations=4).starts - moved.score(TRUE, iterations=4).starts) * TRUST
    np.testing.assert_allclose(put, off, rtol=0.05, atol=0.02)


def test_one_stalled_window_does_not_move_the_fit() -> None:
    p = declared_problem()
    w = p.windows
    moving = int(np.argmax(np.ptp(w.measured[:, :, 0], axis=1)))
    measured = w.measured.copy()
    measured[moving] = measured[moving, 0]
    stalled = Problem(p.simulation, replace(w, measured=measured), p.scales)
    clean = p.fit(p.null, np.arange(2), iterations=20, tolerance=1e-5)
    fit = stalled.fit(p.null, np.arange(2), iterations=20, tolerance=1e-5)
    np.testing.assert_allclose(fit.values, clean.values, rtol=0.04)
    assert fit.errors[moving] > 10 * np.median(fit.errors)
    assert np.median(fit.errors) < 1.2 * np.median(clean.errors)


def test_a_window_whose_simulation_blows_up_does_not_poison_the_others() -> None:
    p = declared_problem()
    qvel = p.windows.qvel.copy()
    qvel[3] = 1e8
    broken = Problem(p.simulation, replace(p.windows, qvel=qvel), p.scales)
    fit = broken.fit(p.null, np.arange(2), iterations=20, tolerance=1e-5)
    clean = p.fit(p.null, np.arange(2), iterations=20, tolerance=1e-5)
    assert np.all(np.isfinite(fit.values))
    assert np.isfinite(fit.cost)
    assert fit.errors[3] > 0.5 * UNSTABLE
    others = np.arange(len(p.windows)) != 3
    np.testing.assert_allclose(fit.values, clean.values, rtol=0.04)
    np.testing.assert_allclose(fit.errors[others], clean.errors[others], rtol=0.2)


class Explosion(Effect):
    """Harmless below two, infinite above: what a trial step may run into."""

    kind = "explosion"
    place = "joint"
    parameters = (Parameter("strength", "N·m", 1.0, lower=0.0, upper=100.0),)
    equation = "boom"

    def act(self, world, x) -> None:
        world.force[:, self.dof] += np.where(x[:, 0] > 0.4, 1e12, 0.05 * x[:, 0])


def test_differences_across_an_explosion_count_as_nothing() -> None:
    data = recorded(true_effects())
    p = problem([*declare(compiled(), DECLARED), Explosion("hinge")], data)
    r, jt, jx = p.linearise(p.null, np.zeros((len(p.windows), 2)), np.arange(3))
    assert np.isfinite(r).all()
    assert np.isfinite(jt).all()
    assert np.isfinite(jx).all()
    assert not jt[:, 10:, 2].any()
    fit = p.fit(p.null, np.arange(3), iterations=20, tolerance=1e-5)
    np.testing.assert_allclose(fit.values[:2], TRUE, rtol=0.1)
    assert fit.values[2] < 0.4


def test_a_planted_effect_is_fitted_beside_the_declared_parameters() -> None:
    truth = [*true_effects(), CoulombFriction("hinge", level=0.06), TorqueOffset("hinge", offset=-0.05)]
    effects = [*declare(compiled(), DECLARED), CoulombFriction("hinge"), TorqueOffset("hinge")]
    p = problem(effects, recorded(truth, episodes=6))
    fit = p.fit(p.null, np.arange(4), iterations=20, tolerance=1e-5)
    np.testing.assert_allclose(fit.values[1:], [0.62, 0.06, -0.05], rtol=0.1)
    assert np.median(fit.errors) == pytest.approx(1.0, abs=0.1)


def test_the_pull_towards_the_null_is_on_effects_alone() -> None:
    p = problem([*declare(compiled(), DECLARED), TorqueOffset("hinge")], recorded())
    count = len(p.windows)
    r, starts = np.zeros((count, 5)), np.zeros((count, 2))
    away = p.null + np.array([3, -2, 0]) * p.size
    assert p.cost(r, starts, away, Loss(3.0)) == 0
    away[2] = 2 * p.size[2]
    assert p.cost(r, starts, away, Loss(3.0)) == pytest.approx((2 / RIDGE) ** 2)


# --- noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-3, 5e-3])
def test_errors_of_noise_alone_are_those_of_the_true_model_on_simulated_noise(noise: float) -> None:
    found, expected = [], []
    for seed in range(5):
        p = problem(true_effects(), recorded(true_effects(), noise=noise, seed=seed), noise=noise)
        fit = p.score(TRUE)
        found.append(fit.errors)
        expected.append(p.noise_errors(fit, seed))
    found, expected = np.concatenate(found), np.concatenate(expected, axis=1)
    assert expected.shape[0] == 8
    # About 100 windows with 80 samples each: the median is known to a percent or two.
    assert np.median(found) == pytest.approx(np.median(expected), rel=0.03)
    assert np.quantile(found, 0.9) == pytest.approx(np.quantile(expected, 0.9), rel=0.05)
    # The starts take a little of the noise.
    assert 0.95 < np.median(expected) < 1.0


def test_errors_of_noise_alone_do_not_depend_on_what_was_measured() -> None:
    p = declared_problem()
    fit = p.score(TRUE)
    other = Problem(p.simulation, replace(p.windows, measured=p.windows.measured + 3.0), p.scales)
    np.testing.assert_allclose(p.noise_errors(fit, 5), other.noise_errors(fit, 5), rtol=1e-9)


def test_samples_that_do_not_count_count_nowhere() -> None:
    p = declared_problem()
    usable, measured = p.windows.usable.copy(), p.windows.measured.copy()
    usable[:, ::3] = False
    measured[:, ::3] = 1e3
    masked = Problem(p.simulation, replace(p.windows, usable=usable, measured=measured), p.scales)
    fit = masked.fit(p.null, np.arange(2), iterations=12)
    np.testing.assert_allclose(fit.values, TRUE, rtol=0.1)
    assert np.median(fit.errors) == pytest.approx(1.0, abs=0.1)
    assert np.median(masked.noise_errors(fit, 0)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("effect", [CommandDelay("motor"), SensorDelay("hinge")], ids=lambda effect: effect.kind)
def test_sensors_that_are_all_late_look_like_commands_that_are_late(effect: Effect) -> None:
    """What they show at t is the motion at t - d, to which the commands of t - d belong."""
    data, late = recorded(), 2
    rows = [(e.qpos[:-late], e.qvel[:-late], e.ctrl[late:]) for e in data.episodes]
    q, v, u = (np.stack(parts) for parts in zip(*rows))
    time = data.episodes[0].time[late:]
    shown = Measurements.from_tables({"runs": table(time, q, v, u, compiled())})
    task = problem([effect], shown)
    fit = task.fit(task.null, np.arange(1))
    assert fit.values[0] == pytest.approx(late / RATE, rel=0.02)
    assert np.median(fit.errors) < 1.1
    assert np.median(task.score(task.null).errors) > 2


def test_interpolation_goes_back_in_a_straight_line() -> None:
    q, v = np.array([[[1.0], [2.0], [2.5]]]), np.array([[[3.0], [4.0], [5.0]]])
    found = interpolate(q, v, np.array([[-2.0, -0.5, 0.0, 1.0]]), 0.1, np.array([0]), np.array([0]))
    np.testing.assert_allclose(found[0, :, 0], [1 - 0.6, 1 - 0.15, 1.0, 2.0])
