"""Errors by horizon against motions that are known in closed form."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import RATE, compiled, recorded, torques

from sb3_rpto.effects import Simulation
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.sysid.shooting.prediction_errors import (
    HORIZONS,
    OVERLAP,
    _pool,
    horizon_errors,
    noise_floor,
    predictions,
    whole_runs,
)
from sb3_rpto.sysid.shooting.windows import cut

SIGMA = np.array([1e-3])
#: a wheel without gravity, damping or anything else: q'' = torque / INERTIA
INERTIA = 0.02
ROTOR = f"""<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body><joint name="hinge" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def rotor() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ROTOR)


def test_a_model_predicts_its_own_exact_data_without_error() -> None:
    data = recorded(noise=0.0, exact=True, duration=2.5)
    simulation = Simulation(compiled(), [], 1)
    found = horizon_errors(simulation, simulation.null, data, SIGMA, 0)
    assert [e.horizon for e in found] == [*HORIZONS, "whole run"]
    for e in found:
        assert e.joints == ("hinge",)
        np.testing.assert_allclose([e.rmse, e.mae, e.low, e.high], 0, atol=1e-9)
    assert found[-1].windows == len(data.episodes)
    assert noise_floor(simulation, simulation.null, data, SIGMA, 0) == []


def test_a_model_that_lacks_a_torque_errs_by_the_known_parabola() -> None:
    offset = 0.002
    data = recorded([TorqueOffset("hinge", offset=offset)], rotor(), noise=0.0, exact=True, duration=2.5)
    simulation = Simulation(rotor(), [], 1)
    found = {e.horizon: e for e in horizon_errors(simulation, simulation.null, data, SIGMA, 0)}
    for horizon in HORIZONS:
        k = np.arange(5, round(horizon * 1000) + 1, 5)  # steps of the samples
        error = offset / INERTIA * 1e-6 * k * (k + 1) / 2  # of MuJoCo's semi-implicit Euler
        assert found[horizon].rmse[0] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
        assert found[horizon].mae[0] == pytest.approx(np.mean(error), rel=1e-6)
        # All windows err alike.
        assert found[horizon].low[0] == pytest.approx(found[horizon].high[0], rel=1e-6)
    k = np.arange(5, 2500 - 5, 5)
    whole = offset / INERTIA * 1e-6 * k * (k + 1) / 2
    assert found["whole run"].rmse[0] == pytest.approx(np.sqrt(np.mean(whole**2)), rel=0.01)


def test_predictions_begin_every_fifth_of_a_horizon() -> None:
    """So that where the first of few windows begins does not decide: 21 starts in 2.5 s, of an episode."""
    data = recorded(noise=0.0, exact=True, duration=2.505)
    simulation = Simulation(compiled(), [], 1)
    found = {e.horizon: e.windows for e in horizon_errors(simulation, simulation.null, data, SIGMA, 0)}
    assert found[0.5] == 21 * len(data.episodes)
    assert found[1.0] == 8 * len(data.episodes)


def test_a_constant_offset_of_what_was_measured_is_the_error() -> None:
    data = recorded(noise=0.0, exact=True)
    simulation = Simulation(compiled(), [], 1)
    windows = cut(compiled(), data, SIGMA, 0.5, 100)
    q, difference, usable = predictions(simulation, simulation.null, replace(windows, measured=windows.measured - 0.3))
    assert usable.all()
    np.testing.assert_allclose(difference, 0.3, atol=1e-9)
    np.testing.assert_allclose(q, windows.measured, atol=1e-9)


def test_values_of_the_effects_are_used() -> None:
    effect = CoulombFriction("hinge", level=0.1)
    data = recorded([effect], noise=0.0, exact=True)
    simulation = Simulation(compiled(), [CoulombFriction("hinge")], 1)
    right = horizon_errors(simulation, np.array([0.1]), data, SIGMA, 0)
    wrong = horizon_errors(simulation, np.array([0.0]), data, SIGMA, 0)
    for a, b in zip(right, wrong, strict=True):
        assert a.rmse[0] < 1e-3 * b.rmse[0]


@pytest.mark.slow
def test_the_floor_is_the_error_of_the_true_model_on_noisy_data() -> None:
    simulation = Simulation(compiled(), [], 1)
    found, floor = [], []
    for seed in range(4):
        # Pushes that never carry the pendulum over the top, where an error of the start has no typical size.
        commands = torques(6, 500, seed, size=0.5)
        data = recorded(seed=seed, episodes=6, duration=2.5, noise=2e-3, commands=commands)
        found.append([e.rmse[0] for e in horizon_errors(simulation, simulation.null, data, 2 * SIGMA, seed)][:3])
        floor.append([e.rmse[0] for e in noise_floor(simulation, simulation.null, data, 2 * SIGMA, seed)])
    found, floor = (np.sqrt(np.mean(np.square(x), axis=0)) for x in (found, floor))
    # 4 sets of 12 to 150 windows each; within a window the start's error is one number.
    np.testing.assert_allclose(floor, found, rtol=0.2)
    assert np.all(floor > 2e-3)


def test_the_floor_is_of_the_model_alone_and_the_same_for_a_seed() -> None:
    simulation = Simulation(compiled(), [], 1)
    data = recorded(seed=1)
    again = noise_floor(simulation, simulation.null, data, SIGMA, 3)
    for a, b in zip(noise_floor(simulation, simulation.null, data, SIGMA, 3), again, strict=True):
        assert (a.horizon, a.windows) == (b.horizon, b.windows)
        np.testing.assert_array_equal(a.rmse, b.rmse)


def test_intervals_hold_the_error_and_resample_blocks() -> None:
    data = recorded([CoulombFriction("hinge", level=0.05)], episodes=6)
    simulation = Simulation(compiled(), [], 1)
    for e in horizon_errors(simulation, simulation.null, data, SIGMA, 0):
        assert 0 < e.low[0] <= e.rmse[0] <= e.high[0]
        assert 0 < e.mae[0] <= e.rmse[0]


def test_blocks_are_resampled_and_not_the_windows_within_them() -> None:
    """Of two blocks a quarter of all draws holds one alone, so that the bounds are what each errs by."""
    windows = cut(compiled(), recorded(episodes=2, duration=4.0), SIGMA, 0.1, 200, OVERLAP)
    first = np.arange(len(windows)) < len(windows) // 2
    windows = replace(windows, block=np.where(first, 0, 1))
    difference = np.where(first, 0.1, 0.3)[:, None, None] * np.ones((*windows.usable.shape, 1))
    found = _pool(difference, windows.usable, windows, ("hinge",), 0.1, 0)
    assert found.low[0] == pytest.approx(0.1)
    assert found.high[0] == pytest.approx(0.3)


def test_horizons_that_no_run_is_long_enough_for_are_left_out() -> None:
    data = recorded(duration=0.8, noise=0.0, exact=True)
    simulation = Simulation(compiled(), [], 1)
    found = horizon_errors(simulation, simulation.null, data, SIGMA, 0)
    assert [e.horizon for e in found] == [0.1, 0.5, "whole run"]


def test_a_prediction_that_blows_up_is_far_off_and_finite() -> None:
    data = recorded(noise=0.0, exact=True)
    simulation = Simulation(compiled(), [TorqueOffset("hinge")], 1)
    found = horizon_errors(simulation, np.array([1e12]), data, SIGMA, 0)
    for e in found:
        assert np.isfinite(e.rmse).all()
        assert e.rmse[0] > 5.0


def test_samples_that_do_not_count_do_not_count() -> None:
    data = recorded(noise=0.0, exact=True)
    hit = []
    for e in data.episodes:
        usable, qpos = np.ones(len(e), dtype=bool), e.qpos.copy()
        usable[7::20], qpos[7::20] = False, 1e3
        hit.append(replace(e, usable=usable, placed=usable, qpos=qpos))
    simulation = Simulation(compiled(), [], 1)
    for e in horizon_errors(simulation, simulation.null, replace(data, episodes=hit), SIGMA, 0):
        assert e.rmse[0] < 1e-9


def test_whole_runs_are_predicted_to_their_end() -> None:
    data = recorded([TorqueOffset("hinge", offset=0.05)], noise=0.0, exact=True, duration=3.0)
    simulation = Simulation(compiled(), [TorqueOffset("hinge")], 1)
    found = whole_runs(simulation, np.zeros(1), data, SIGMA)
    assert found is not None
    assert found.windows == len(data.episodes)
    assert found.low[0] <= found.rmse[0] <= found.high[0]
    # The last sample counts but for a thousandth of the run.
    windows = cut(compiled(), data, SIGMA, 2.9, 10)
    _, difference, _ = predictions(simulation, np.zeros(1), windows)
    assert found.rmse[0] == pytest.approx(np.sqrt(np.mean(difference**2)), rel=0.05)
    assert pytest.approx(windows.measured.shape[1]) == RATE * 2.9


def test_a_whole_run_begins_where_its_state_is_known() -> None:
    data = recorded(noise=0.0, exact=True)
    known = [np.arange(len(e)) >= 3 for e in data.episodes]
    late = replace(data, episodes=[replace(e, usable=u, placed=u) for e, u in zip(data.episodes, known)])
    simulation = Simulation(compiled(), [], 1)
    found = whole_runs(simulation, simulation.null, late, SIGMA)
    assert found is not None
    assert found.windows == len(data.episodes)
    assert found.rmse[0] < 1e-9


def test_a_single_block_or_run_gives_no_interval() -> None:
    data = recorded(duration=2.5)
    one = replace(data, episodes=data.episodes[:1])
    simulation = Simulation(compiled(), [], 1)
    found = {e.horizon: e for e in horizon_errors(simulation, simulation.null, one, SIGMA, 0)}
    assert np.isfinite(found[0.5].low).all()  # of several blocks
    assert np.isnan([found["whole run"].low, found["whole run"].high]).all()
    short = horizon_errors(simulation, simulation.null, recorded(duration=0.9, episodes=1), SIGMA, 0)[0]
    assert np.isnan([short.low, short.high]).all()
    assert np.isfinite(short.rmse).all()
