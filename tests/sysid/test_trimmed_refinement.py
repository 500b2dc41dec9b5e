"""Fits that contacts hold in kinks, led on: exact data of a walker, whose truth is known to the last digit."""

from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from simulated import compiled, problem, recorded
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_rpto.effects import LIBRARY, Simulation, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.settings import DEFAULTS, RefinementSettings
from sb3_rpto.sysid.shooting import trimmed_refinement
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.trimmed_refinement import fit_lengthening, fit_trimmed
from sb3_rpto.sysid.shooting.windows import cut, discretised, noise_levels

pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute")

NAMES = ["torso.length", "?thigh.length", "?shin.length", "?foot.length", "torso.mass"]
TRUE = np.random.default_rng(0).uniform(0.8, 1.2, 8)  # shares of the nominal values
HORIZON = 0.15

SETTINGS = DEFAULTS.refinement


@cache
def walk(
    shares: tuple[float, ...] = tuple(TRUE), names: tuple[str, ...] = tuple(NAMES), steps: int = 200, seed: int = 0
) -> Measurements:
    """A HalfCheetah with other numbers that falls over itself at random."""
    source = gym.make("HalfCheetah-v5")
    known = declare(source.unwrapped.model, names)
    env = apply_effects(source, [d.with_values(d.values * s) for d, s in zip(known, shares)])
    buffer = ReplayBuffer(steps, env.observation_space, env.action_space, "cpu")
    rng = np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        after, reward, *_ = env.step(action)
        buffer.add(obs, after, action, np.array([reward]), np.array([False]), [{}])
        obs = after
    return Measurements.from_replay(buffer, gym.make("HalfCheetah-v5"))


@cache
def lengths() -> Problem:
    data = walk()
    model = discretised(gym.make("HalfCheetah-v5").unwrapped.model, data, fine=True)
    simulation = Simulation(model, declare(model, NAMES), 1)
    scales = typical(simulation, force_residuals(simulation, simulation.null, data)).scales(simulation.effects)
    return Problem(simulation, cut(model, data, noise_levels(data), HORIZON, 40), scales)


@pytest.mark.slow
def test_a_walkers_lengths_are_found_where_contacts_hold_a_plain_fit() -> None:
    problem = lengths()
    free = np.arange(len(TRUE))
    true = problem.null * TRUE
    plain = problem.fit(problem.null, free, iterations=100, tolerance=1e-9)
    led = fit_trimmed(problem, plain, free)
    assert problem.score(true).errors.max() < 1e-6  # the truth is there to be found
    assert plain.errors.max() > 10 * SETTINGS.enough  # and a descent does not get there
    assert led.errors.max() < SETTINGS.enough
    np.testing.assert_allclose(led.values, true, rtol=1e-4)


@pytest.mark.slow
def test_the_trace_of_a_walker_without_missing_effect_names_none() -> None:
    report = trace(gym.make("HalfCheetah-v5"), walk(steps=120), NAMES, horizon=HORIZON, threads=1)
    assert report.verdict == "complete"
    assert not report.effects
    found = np.array([traced.effect.values[0] for traced in report.declared])
    np.testing.assert_allclose(found, lengths().null * TRUE, rtol=1e-4)


def test_a_spring_about_a_far_angle_is_reached_by_windows_that_grow() -> None:
    """Over whole windows a pole on a cart hides where its spring rests: plain fits end in a valley."""
    xml = """<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="slide" type="slide"
    axis="1 0 0" damping="1"/><geom size=".05" mass="1" contype="0"/><body name="pole">
    <joint name="hinge" axis="0 1 0" damping="0.01"/><geom type="capsule" fromto="0 0 0 0 0 .6" size=".02" mass="0.3"
    contype="0"/></body></body></worldbody><actuator><motor name="motor" joint="slide" gear="5"/></actuator></mujoco>"""
    model = compiled(xml)
    there = [d.with_values(d.values * 1.1) for d in declare(model, ["slide.damping", "hinge.damping", "pole.mass"])]
    spring = LIBRARY["spring"]("hinge", stiffness=0.3, reference=-2.5)
    data = recorded([*there, spring], model, episodes=6, duration=3.0, noise=0.0, exact=True, rate=50)
    model = discretised(model, data, fine=True)
    names = [d.label for d in there]
    simulation = Simulation(model, [*declare(model, names), LIBRARY["spring"]("hinge")], 1)
    scales = typical(simulation, force_residuals(simulation, simulation.null, data)).scales(simulation.effects)
    on = Problem(simulation, cut(model, data, noise_levels(data), 0.8, 12), scales)
    begin = np.append(simulation.null[:3], [0.05, 1.0])
    free = np.arange(5)
    plain = on.fit(begin, free, iterations=40)
    assert plain.errors.max() > 100 * SETTINGS.enough
    led = fit_lengthening(on, plain, free)
    assert led.errors.max() < SETTINGS.enough
    assert led.values[3:] == pytest.approx([0.3, -2.5], rel=1e-4)
    assert fit_lengthening(on, led, free) is led
    assert fit_lengthening(on, plain, free[:0]) is plain


def test_a_fit_near_the_noise_stays() -> None:
    problem = lengths()
    fit = problem.score(problem.null * TRUE)
    assert fit_trimmed(problem, fit, np.arange(len(TRUE))) is fit


def test_a_fit_without_free_parameters_stays() -> None:
    problem = lengths()
    fit = problem.score(problem.null)
    assert fit_trimmed(problem, fit, np.empty(0, dtype=int)) is fit


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_never_ends_higher_than_it_began(seed: int) -> None:
    problem = lengths()
    few = problem.on(np.arange(seed, len(problem.windows), 5))
    begin = few.score(problem.null * np.random.default_rng(seed).uniform(0.8, 1.2, len(TRUE)))
    assert fit_trimmed(few, begin, np.arange(4)).cost <= begin.cost


def test_a_parameter_that_shows_nowhere_goes_back_to_where_it_may_show() -> None:
    """Feet of friction 0.4 hide a floor's below that: a fit that came there would stay for ever."""
    true, names = np.array([1.5, 1.1]), ("floor.friction", "torso.mass")
    data = walk(tuple(true), names)
    model = discretised(gym.make("HalfCheetah-v5").unwrapped.model, data, fine=True)
    simulation = Simulation(model, declare(model, names), 1)
    scales = typical(simulation, force_residuals(simulation, simulation.null, data)).scales(simulation.effects)
    problem = Problem(simulation, cut(model, data, noise_levels(data), HORIZON, 40), scales)
    hidden = problem.null * [0.5, 1.0]
    assert problem.fit(hidden, np.arange(2)).values[0] == hidden[0]
    led = fit_trimmed(problem, problem.score(hidden), np.arange(2))
    np.testing.assert_allclose(led.values, problem.null * true, rtol=1e-4)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Costs of the fits that would be trimmed; none is."""
    costs: list[float] = []

    def seen(problem: Problem, fit: Fit, free: np.ndarray, settings: RefinementSettings) -> Fit:
        costs.append(fit.cost)
        return fit

    monkeypatch.setattr(trimmed_refinement, "fit_trimmed", seen)
    return costs


@pytest.mark.slow
def test_exact_data_that_still_err_are_fitted_anew_beside_the_best_until_that_does_not_pay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    costs = counted(monkeypatch)
    never = replace(SETTINGS, enough=0.0)
    problem = lengths().on(np.arange(0, 40, 4))
    free = np.arange(len(TRUE))
    led = trimmed_refinement.refine(problem, problem.fit(problem.null, free, iterations=20), free, never)
    best = np.minimum.accumulate(costs)
    paid = np.array(costs[1:]) < SETTINGS.worth * best[:-1]
    assert led.cost == min(costs)
    assert not paid[-SETTINGS.hops :].any()
    assert all(paid[k : k + SETTINGS.hops].any() for k in range(len(paid) - SETTINGS.hops))
    assert (
        trimmed_refinement.refine(problem, problem.fit(problem.null, free, iterations=20), free, never).cost == led.cost
    )


def test_noisy_data_are_not_fitted_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    costs = counted(monkeypatch)
    noisy = problem(declare(compiled(), ["pole.mass"]), recorded([], noise=1e-3), noise=1e-3)
    far = noisy.score(2 * noisy.null)
    assert far.errors.max() > SETTINGS.enough
    assert trimmed_refinement.refine(noisy, far, np.arange(1)) is far
    assert len(costs) == 1
