"""One-step errors of simulators are exact, and steps that lower them keep to bounds and trusted sizes."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from shifted import HOPPER, POLE, POLES, SHIFTS, collect, joined, noisy, observed, shifted

from sb3_rpto.dynamics.onestep import BLOWN, FILTERED, MEMORY, OneStepError, as_steps
from sb3_rpto.effects import Simulation, declare
from sb3_rpto.effects.commands import ActuatorLag, CommandDelay
from sb3_rpto.effects.friction import StribeckFriction
from sb3_rpto.effects.sensors import SensorBias, SensorDelay, SensorGain
from sb3_rpto.envs.observations import state_map
from sb3_rpto.fitting.loss import Loss


def steps_of(data, env_id, chosen=None):
    env = gym.make(env_id)
    return as_steps(data, state_map(env), env.unwrapped.model, env.unwrapped.frame_skip, chosen)


def simulation(env_id, names, effects=()):
    model = gym.make(env_id).unwrapped.model
    return Simulation(model, [*declare(model, [*names]), *effects], nthread=1)


def problem(steps, names, env_id, weights=None, bounds=None):
    sim = simulation(env_id, names)
    parameters = [p for e in sim.effects for p in e.parameters]
    lower, upper = (np.array([getattr(p, side) for p in parameters]) for side in ("lower", "upper"))
    lower, upper = (lower, upper) if bounds is None else bounds
    return OneStepError(sim, np.abs(sim.null), lower, upper, steps, weights)


def step(task, values, max_step):
    """One trusted step; None where none lowers the error."""
    moved, taken = task.descend(values, max_step, 1)
    return moved if taken else None


def missed(steps, sim, values):
    return np.abs(steps.reach(sim, np.asarray(values, dtype=float)[None])[0] - steps.reached)[:, steps.compared].max()


# --- transitions as simulator steps -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "scale"), [(POLES, 0.3), (HOPPER, 1.0)])
def test_the_true_numbers_reach_what_the_target_reached(env_id, scale):
    data = collect(shifted(env_id), 80, scale=scale)
    steps, sim = steps_of(data, env_id), simulation(env_id, SHIFTS[env_id])
    assert data.terminations.any()
    assert len(steps) == 80
    assert missed(steps, sim, list(SHIFTS[env_id].values())) < 1e-9
    assert missed(steps, sim, sim.null) > 1e-3


@pytest.mark.parametrize(
    "effects",
    [
        [CommandDelay("slide", delay=0.087)],  # longer than one transition
        [ActuatorLag("slide", time_constant=0.01)],
        [StribeckFriction("slider", extra=0.3, level=0.2, speed=0.4)],
        [SensorBias("hinge", offset=0.05), SensorGain("hinge2", change=0.1)],
        [SensorGain("hinge", change=0.1), SensorBias("hinge", offset=0.05)],
        [SensorBias("hinge", offset=0.05), SensorGain("hinge", change=0.1)],
    ],
    ids=lambda effects: " ".join(effect.kind for effect in effects),
)
def test_true_effects_reach_what_the_target_reached(effects):
    """Through several episodes, so commands from before an episode would show."""
    shift = {"cart.mass": 8.0}
    data = collect(shifted(POLES, shift, effects), 60)
    steps, sim = steps_of(data, POLES), simulation(POLES, shift, effects)
    assert data.terminations.sum() > 3
    truth = np.concatenate([[8.0], *(e.values for e in effects)])
    tolerance = 1e-9 if effects[0].kind != "actuator_lag" else 1e-6  # which remembers all, and the steps 0.2 s
    assert missed(steps, sim, truth) < tolerance
    assert missed(steps, sim, sim.null) > 1e-3


def test_before_an_episode_an_idle_queue_held_zeros():
    late = CommandDelay("slide", delay=0.087)
    late.idle = True
    data = collect(shifted(POLES, {}, [late]), 60)
    env, sim = gym.make(POLES), simulation(POLES, [], [late])
    idle, held = (
        as_steps(data, state_map(env), env.unwrapped.model, env.unwrapped.frame_skip, idle=there)
        for there in (True, False)
    )
    assert data.terminations.sum() > 3
    assert missed(idle, sim, late.values) < 1e-9
    assert missed(held, sim, late.values) > 1e-3


@pytest.mark.parametrize("beside", [[], [SensorGain("hinge2", change=0.1)]], ids=["alone", "after a gain"])
def test_a_late_sensor_is_carried_on_to_the_present(beside):
    """To second order, by the speed it gained: the other joint, which it drives, then moves as it did."""
    late = [*beside, SensorDelay("hinge2", delay=0.01)]
    steps, sim = steps_of(collect(shifted(POLES, {}, late), 60, scale=0.3), POLES), simulation(POLES, [], late)
    known = [0.1] * len(beside)
    reached = steps.reach(sim, np.array([[*known, delay] for delay in (0.0, 0.005, 0.01, 0.015)]))
    errors = np.median(np.abs(reached - steps.reached), axis=1)
    assert errors[:, 1].argmin() == 2
    assert errors[2, 1] < errors[0, 1] / 3
    assert errors[2, 2] < 0.01, "what it shows itself"


def test_several_phis_at_once_are_those_one_by_one():
    steps, sim = steps_of(collect(shifted(POLES), 10), POLES), simulation(POLES, SHIFTS[POLES])
    values = sim.null * np.array([[1.0], [1.2], [0.7]])
    together = steps.reach(sim, values)
    assert together.shape == (3, 10, 6)
    for phi, reached in zip(values, together):
        np.testing.assert_allclose(steps.reach(sim, phi[None])[0], reached, rtol=1e-12, atol=1e-13)


def history(steps, row):
    """The commands of one step, one for each transition, oldest first."""
    return steps.drive.commands[row, :: gym.make(POLE).unwrapped.frame_skip, 0]


def test_commands_from_before_count_and_end_where_a_transition_does_not_follow():
    env = gym.make(POLE)
    one, other = collect(env, 8, seed=0, scale=0.05), collect(env, 6, seed=1, scale=0.05)
    steps = steps_of(joined(one, other), POLE)
    before = steps.drive.before // env.unwrapped.frame_skip
    assert before == FILTERED
    assert steps.drive.before * env.unwrapped.model.opt.timestep >= MEMORY
    assert steps.drive.commands.shape == (14, (before + 1) * env.unwrapped.frame_skip, 1)
    for part, first in ((one, 0), (other, 8)):
        sent = part.actions[:, 0].double().numpy()
        for i in range(len(part)):
            expected = np.r_[np.full(before, sent[0]), sent[: i + 1]][-before - 1 :]
            np.testing.assert_array_equal(history(steps, first + i), expected)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_interleaved_transitions_of_several_environments_keep_their_own_past(count):
    parts = [collect(gym.make(POLE), 8, seed=seed, scale=0.05) for seed in range(count)]
    every = steps_of(joined(*parts), POLE)
    order = np.arange(8 * count).reshape(count, 8).T.reshape(-1)
    mixed = steps_of(joined(*parts).take(th.as_tensor(order)), POLE)
    np.testing.assert_array_equal(mixed.drive.commands, every.drive.commands[order])
    np.testing.assert_array_equal(mixed.qpos, every.qpos[order])


def test_commands_are_cut_as_the_actuators_cut_them():
    data = collect(gym.make(POLE), 4, scale=0.05)
    data.actions[:] = th.tensor([[5.0], [-5.0], [1.0], [3.5]])
    assert history(steps_of(data, POLE), 3)[-4:].tolist() == [3.0, -3.0, 1.0, 3.0]


@pytest.mark.parametrize("chosen", [[11], [7, 8, 9, 10, 11], [2, 10], range(12)])
def test_chosen_transitions_keep_the_commands_from_before_them(chosen):
    data, chosen = collect(gym.make(POLE), 12, scale=0.05), np.array(chosen)
    every, steps = steps_of(data, POLE), steps_of(data, POLE, chosen)
    np.testing.assert_array_equal(steps.rows, chosen)
    np.testing.assert_array_equal(steps.qpos, every.qpos[chosen])
    np.testing.assert_array_equal(steps.reached, every.reached[chosen])
    np.testing.assert_array_equal(steps.drive.commands, every.drive.commands[chosen])


def test_speeds_at_the_bound_are_left_out():
    data = collect(gym.make(HOPPER), 30, scale=1.0)
    data.observations[4, 5] = 10.0
    data.next_observations[9, 10] = -10.0
    steps = steps_of(data, HOPPER)
    np.testing.assert_array_equal(steps.rows, np.setdiff1d(np.arange(30), [4, 9]))
    assert steps.compared.tolist() == [False] + [True] * 11  # the place along the floor is not observed
    data.observations[:, 5] = 10.0
    assert len(steps_of(data, HOPPER)) == 0
    assert len(steps_of(data.take(slice(0, 0)), HOPPER)) == 0


def test_what_does_not_move_is_not_compared():
    steps = steps_of(collect(gym.make("Reacher-v5"), 20), "Reacher-v5")  # its target rests
    assert steps.compared.tolist() == [True, True, False, False] * 2


def test_angles_go_on_over_a_whole_turn():
    env = gym.make("Reacher-v5")
    data = collect(env, 100, scale=1.0)
    angles = state_map(env)(data.observations.numpy()).qpos[:, 0]
    assert np.abs(np.diff(angles)).max() > 6  # the arm turned through the back
    steps = steps_of(data, "Reacher-v5")
    assert np.abs(steps.reached[:, :2] - steps.qpos[:, :2]).max() < np.pi
    assert missed(steps, simulation("Reacher-v5", []), []) < 1e-9


# --- the error and its steps ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def poles():
    return steps_of(collect(shifted(POLES), 40), POLES)


def test_the_cost_is_quadratic_for_small_and_linear_for_large_residuals(poles):
    weights = th.arange(1.0, len(poles) + 1)
    task = problem(poles, SHIFTS[POLES], POLES, weights)
    task.loss = Loss(2.0)
    share = weights.numpy() / weights.numpy().sum()
    residuals = np.zeros((3, len(poles), 6))
    residuals[0, 3] = 1e-4
    residuals[1, 5, 2] = 1e4
    residuals[2, 7, 0], residuals[2, 8, 1] = 2.0, -2.0
    expected = [1e-8 * share[3], 4e4 * share[5] / 6, 8 * (np.sqrt(2) - 1) * (share[7] + share[8]) / 6]
    np.testing.assert_allclose(task.cost(residuals), expected, rtol=1e-3)


def test_the_least_squares_that_stand_for_the_cost_have_its_slope(poles):
    task = problem(poles, SHIFTS[POLES], POLES, th.arange(1.0, len(poles) + 1))
    task.loss = Loss(2.0)
    residuals = np.random.default_rng(0).normal(scale=4.0, size=(len(poles), 6))
    for row, column in ((0, 0), (3, 5), (17, 2)):
        up, down = residuals.copy(), residuals.copy()
        up[row, column] += 1e-5
        down[row, column] -= 1e-5
        slope = np.diff(task.cost(np.stack([down, up])))[0] / 2e-5
        assert 2 * (task.weights(residuals) * residuals)[row, column] / 6 == pytest.approx(slope, rel=1e-4)


def test_slopes_are_the_derivatives_by_the_parameters_in_scales(poles):
    task = problem(poles, SHIFTS[POLES], POLES)
    values = task.simulation.null * 1.05
    residual, slopes = task.differentiate(values, 1e-4)
    assert slopes.shape == (40, 6, 3)
    np.testing.assert_allclose(residual, task.residuals(values[None])[0], rtol=1e-10, atol=1e-11)
    for j in range(3):
        change = 1e-5 * task.scale * (np.arange(3) == j)
        up, down = task.residuals(np.stack([values + change, values - change]))
        np.testing.assert_allclose(slopes[:, :, j], (up - down) / 2e-5, rtol=1e-2, atol=1e-2 * np.abs(slopes).max())


@pytest.mark.parametrize("at", ["lower", "upper"])
def test_differences_stay_inside_the_bounds(poles, at):
    nominal = simulation(POLES, SHIFTS[POLES]).null
    task = problem(poles, SHIFTS[POLES], POLES, bounds=(0.9 * nominal, 1.1 * nominal))
    asked, residuals = [], task.residuals
    task.residuals = lambda values: asked.append(values) or residuals(values)
    slopes = task.differentiate(getattr(task, at), 1e-2)[1]
    assert (asked[0] >= task.lower).all()
    assert (asked[0] <= task.upper).all()
    near = task.differentiate(getattr(task, at) * 0.999 + nominal * 0.001, 1e-4)[1]
    np.testing.assert_allclose(slopes, near, atol=0.05 * np.abs(near).max())


@pytest.mark.parametrize("max_step", [0.3, 0.03, 1e-4])
def test_a_step_lowers_the_cost_within_its_trusted_size(poles, max_step):
    task = problem(poles, SHIFTS[POLES], POLES)
    values = task.simulation.null
    for _ in range(2):
        moved, trusted = step(task, values, max_step), np.maximum(task.scale, np.abs(values))
        assert np.abs((moved - values) / trusted).max() <= max_step * (1 + 1e-9)
        before, after = task.cost(task.residuals(np.stack([values, moved])))
        assert after < before
        values = moved
    if max_step < 0.1:  # far away the step is as long as it may be
        assert np.abs((moved - task.simulation.null) / task.scale).max() == pytest.approx(2 * max_step, rel=max_step)


@pytest.mark.slow
def test_a_number_far_above_its_nominal_value_moves_by_shares_of_what_it_is():
    task = problem(steps_of(collect(shifted(POLES, {"slider.damping": 1.0}), 60), POLES), ["slider.damping"], POLES)
    nominal = float(task.simulation.null[0])
    values = [task.simulation.null]
    while len(values) < 40 and (moved := step(task, values[-1], 0.1)) is not None:
        values.append(moved)
    assert nominal == 0.05
    np.testing.assert_allclose(values[-1], 1.0, rtol=1e-3)
    grown = np.ravel(values[1:21]) / np.ravel(values[:20])
    np.testing.assert_allclose(grown, 1.1, rtol=1e-6)


def test_no_step_leaves_the_bounds(poles):
    lower, upper = np.array([0.59, 0.55, 0.05]), np.array([0.62, 0.65, 0.06])
    task = problem(poles, SHIFTS[POLES], POLES, bounds=(lower, upper))
    values = task.simulation.null
    for _ in range(4):
        moved = step(task, values, 0.1)
        if moved is None:
            break
        assert (moved >= lower).all()
        assert (moved <= upper).all()
        values = moved
    assert values[0] == upper[0]  # the truth lies beyond


def test_no_step_is_taken_from_the_truth(poles):
    task = problem(poles, SHIFTS[POLES], POLES)
    assert step(task, np.array(list(SHIFTS[POLES].values())), 0.1) is None


def test_simulations_that_blow_up_count_as_very_wrong(poles):
    task = problem(poles, ["hinge.damping"], POLES)
    residuals = task.residuals(np.array([[-1e7]]))
    assert np.isfinite(residuals).all()
    assert np.abs(residuals).max() == BLOWN
    assert task.cost(residuals)[0] > task.cost(task.residuals(np.array([[0.05]])))[0]


def test_what_the_data_do_not_show_stays_where_it_is(poles):
    task = problem(poles, ["cpole.friction", "pole.length"], POLES)  # a pole that touches nothing
    nominal = task.simulation.null
    moved = step(task, nominal, 0.1)
    assert task.insensitive.tolist() == [True, False]
    assert moved[0] == nominal[0]
    assert moved[1] != nominal[1]
    covariance = task.covariance(moved)
    assert covariance[0].tolist() == covariance[:, 0].tolist() == [np.inf, 0]
    assert covariance[1, 1] > 0


def test_weights_count_for_the_rows_they_belong_to():
    data = collect(shifted(HOPPER), 24, scale=1.0)
    data.observations[2, 5] = 10.0  # left out, so that steps and weights are counted differently
    data.next_observations[10:14] += 0.5
    weights = th.ones(24)
    weights[10:14] = 0
    good = np.setdiff1d(np.arange(24), [2, 10, 11, 12, 13])
    steps = steps_of(data, HOPPER)
    task = problem(steps, ["leg.length"], HOPPER, weights)
    np.testing.assert_array_equal(task.share[np.isin(steps.rows, good)], 1 / 19)
    assert task.share.sum() == pytest.approx(1)
    assert task.cost(task.residuals(np.array([[0.55]])))[0] > 0  # the damping is wrong
    np.testing.assert_array_equal(task.weights(np.ones((23, 11)))[~np.isin(steps.rows, good)], 0)


def test_the_curvature_is_the_costs_second_derivative():
    task = problem(steps_of(noisy(collect(shifted(POLE, {"pole.mass": 7.0}), 40), 2e-2, 0), POLE), ["pole.mass"], POLE)
    values = np.array([7.0])
    step(task, values, 0.1)  # sets where the loss turns linear
    assert np.mean(np.abs(task.residuals(values[None])) > task.loss.clip) > 0.1  # many are where it is linear

    def slope(by):
        residual, slopes = task.differentiate(values + by * task.scale, 1e-4)
        return float(np.einsum("nc,ncp,nc->", task.weights(residual), slopes, residual))

    hessian, scores = task.curvature(*task.differentiate(values, 1e-3))
    assert hessian[0, 0] == pytest.approx((slope(0.01) - slope(-0.01)) / 0.02, rel=0.05)
    assert scores.sum() == pytest.approx(slope(0.0), rel=0.01)


def test_transitions_that_weigh_nothing_do_not_count_for_the_covariance():
    task = problem(steps_of(collect(shifted(POLES), 12), POLES), ["cart.mass", "pole.mass", "pole2.mass"], POLES)
    scores, every = np.random.default_rng(0).normal(size=(12, 3)), np.ones(3, dtype=bool)
    assert np.isfinite(task.covariance_in_scales(np.eye(3), scores, every)).all()
    task.share = np.where(np.arange(12) < 2, 0.5, 0.0)  # as if there were two
    assert np.isinf(np.diag(task.covariance_in_scales(np.eye(3), scores, every))).all()


def test_transitions_know_which_one_each_follows():
    data = collect(shifted(POLE), 24)
    data.observations[9, 2] = 10.0  # left out
    before = steps_of(data, POLE).before
    assert before[1] == 0
    assert before[9] == -1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torque", "noise"])
def test_the_truth_is_as_often_within_the_deviation_as_it_says(kind):
    """Of repeated data sets, with random torques, or with observations that end one step and begin the next."""
    clean = collect(shifted(POLE, {"pole.mass": 7.0}), 60)
    off = []
    for seed in range(40):
        data = noisy(clean, 2e-3, seed) if kind == "torque" else observed(clean, 1e-3, seed)
        task = problem(steps_of(data, POLE), ["pole.mass"], POLE)
        values = np.array([7.0])
        while (moved := step(task, values, 0.1)) is not None and abs(moved[0] - values[0]) > 1e-4:
            values = moved
        off.append(abs(values[0] - 7.0) / np.sqrt(task.covariance(values)[0, 0]))
    assert np.mean(np.array(off) < 1.96) > 0.85
    assert np.mean(np.array(off) < 0.5) > 0.1  # and not as if it were much less certain


@pytest.mark.slow
def test_the_deviation_is_that_of_repeated_fits():
    """Noise on what is reached: the spread of the fits is what each of them says of itself."""
    clean = collect(shifted(POLE, {"pole.mass": 7.0}), 40)
    found, said = [], []
    for seed in range(16):
        task = problem(steps_of(noisy(clean, 2e-3, seed), POLE), ["pole.mass"], POLE)
        values = np.array([7.0])
        while (moved := step(task, values, 0.1)) is not None and abs(moved[0] - values[0]) > 1e-4:
            values = moved
        found.append(values[0])
        said.append(np.sqrt(task.covariance(values)[0, 0]))
    assert np.mean(found) == pytest.approx(7.0, abs=np.std(found))
    assert np.mean(said) == pytest.approx(np.std(found), rel=0.5)


@pytest.mark.slow
def test_what_is_told_together_errs_together_as_the_covariance_says():
    """A heavier cart and a stronger motor: what repeated fits find scatters along one line."""
    names, truth = ["cart.mass", "slide.gear"], np.array([11.0, 110.0])
    clean, found, said = collect(shifted(POLE, dict(zip(names, truth))), 40), [], []
    for seed in range(24):
        task = problem(steps_of(noisy(clean, 2e-2, seed), POLE), names, POLE)
        values = truth
        while (moved := step(task, values, 0.1)) is not None and np.abs(moved / values - 1).max() > 1e-5:
            values = moved
        covariance = task.covariance(values)
        found.append(values)
        said.append(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    assert abs(np.median(said)) > 0.5
    assert np.median(said) == pytest.approx(np.corrcoef(np.array(found).T)[0, 1], abs=0.2)
