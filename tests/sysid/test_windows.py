"""Windows of multiple shooting: noise, smoothed starts, and what is cut where."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import PENDULUM, compiled, recorded

from sb3_rpto.effects import Drive, Simulation
from sb3_rpto.effects.commands import Backlash
from sb3_rpto.effects.names import object_id
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.problem.problem import columns_at_rest
from sb3_rpto.sysid.shooting.multiple_shooting import interpolate
from sb3_rpto.sysid.shooting.windows import ENOUGH_BLOCKS, EXACT, REVERSALS, cut, discretised, noise_levels, reversals

SIGMA = np.array([1e-3])


def clock(samples: int, rate: float = 200.0, jitter: float = 0.0, seed: int = 0) -> np.ndarray:
    return (np.arange(samples) + jitter * np.random.default_rng(seed).uniform(-0.5, 0.5, samples)) / rate


def measured(times: list[np.ndarray], q: list[np.ndarray], **columns) -> Measurements:
    """One table for each episode; ``columns`` are lists of arrays, too."""
    tables = {}
    for i, (t, position) in enumerate(zip(times, q)):
        tables[f"run{i}"] = {"time": t, "qpos.hinge": position, "ctrl.motor": np.zeros(len(t))} | {
            name: np.broadcast_to(values[i], len(t)) for name, values in columns.items()
        }
    return Measurements.from_tables(tables)


def swings(jitter: float = 0.0, noise: float = 0.0, quantum: float = 0.0, seed: int = 0) -> Measurements:
    """Five runs of sums of sinusoids up to 2 Hz."""
    rng = np.random.default_rng(seed)
    times = [clock(500, 200.0, jitter, i) for i in range(5)]
    q = []
    for t in times:
        a, f, p = rng.uniform(0.2, 0.6, 4), rng.uniform(0.2, 2.0, 4), rng.uniform(0, 6, 4)
        path = (a * np.sin(2 * np.pi * f * t[:, None] + p)).sum(1) + noise * rng.standard_normal(len(t))
        q.append(quantum * np.round(path / quantum) if quantum else path)
    return measured(times, q)


def ramps(times: list[np.ndarray], **columns) -> Measurements:
    """Runs whose position and command tell the time: q = t, u = t."""
    q = [t.copy() for t in times]
    return measured(times, q, **({"ctrl.motor": q, "qvel.hinge": [np.ones(1)] * len(q)} | columns))


# --- noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-3, 5e-3])
@pytest.mark.parametrize("jitter", [0.0, 0.6])
@pytest.mark.parametrize("seed", [0, 1])
def test_white_noise_is_found_on_smooth_motion_on_any_clock(noise: float, jitter: float, seed: int) -> None:
    assert noise_levels(swings(jitter, noise, seed=seed)) == pytest.approx([noise], rel=0.1)


def test_quantisation_adds_its_own_variance() -> None:
    expected = np.hypot(1e-3, 1e-3 / np.sqrt(12))
    assert noise_levels(swings(noise=1e-3, quantum=1e-3)) == pytest.approx([expected], rel=0.1)


def test_a_quantised_signal_without_noise_has_at_least_the_noise_of_rounding() -> None:
    (found,) = noise_levels(swings(quantum=4e-3))
    assert 4e-3 / np.sqrt(12) <= found * 1.001
    assert found < 4e-3


def test_runs_in_which_a_joint_rests_do_not_say_how_it_is_rounded() -> None:
    """A stiff joint behind an encoder: at rest in four runs of five, on two levels in the last."""
    q = [np.full(500, 0.01) for _ in range(4)] + [np.where(np.arange(500) // 100 % 2, 0.012, 0.01)]
    assert noise_levels(measured([clock(500, 200.0, 0.0, 0)] * 5, q)) == pytest.approx([2e-3 / np.sqrt(12)])


def test_positions_that_never_change_are_not_compared() -> None:
    moving, still = 0.1 * np.sin(np.arange(100) / 5), np.full(100, 0.3)
    table = {"time": np.arange(100) * 0.01, "qpos.a": moving, "qpos.b": still}
    assert columns_at_rest(Measurements.from_tables({"run": table})) == ["b"]
    assert columns_at_rest(Measurements.from_tables({"run": table, "other": table | {"qpos.b": still + 1e-3}})) == []
    with pytest.raises(ValueError, match=r"no position changes .*\('qpos.a', 'qpos.b'\): a dead sensor"):
        columns_at_rest(Measurements.from_tables({"run": table | {"qpos.a": still}}))
    assert columns_at_rest(replace(Measurements.from_tables({"run": table}), exact=True)) == []


def test_exact_data_have_a_fixed_small_share_of_their_spread_as_noise() -> None:
    data = replace(swings(noise=1e-3), exact=True)
    spread = np.std(np.concatenate([e.qpos[:, 0] for e in data.episodes]))
    assert noise_levels(data) == pytest.approx([EXACT * spread], rel=1e-12)


def test_noise_without_motion_and_motion_without_noise() -> None:
    rng = np.random.default_rng(0)
    still = measured([clock(500)] * 4, [2e-3 * rng.standard_normal(500) for _ in range(4)])
    assert noise_levels(still) == pytest.approx([2e-3], rel=0.1)
    assert noise_levels(swings())[0] < 1e-5


def test_noise_is_that_of_each_column() -> None:
    rng = np.random.default_rng(1)
    t = clock(2000)
    tables = {"run": {"time": t, "qpos.a": np.sin(t) + 1e-3 * rng.standard_normal(2000), "ctrl.u": 0 * t}}
    tables["run"]["qpos.b"] = np.cos(3 * t) + 4e-3 * rng.standard_normal(2000)
    assert noise_levels(Measurements.from_tables(tables)) == pytest.approx([1e-3, 4e-3], rel=0.1)


# --- cutting ----------------------------------------------------------------------------------------------------------


def test_the_world_is_integrated_finely_and_a_simulator_as_it_integrates_itself() -> None:
    model, data = compiled(), swings()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for step, expected in ((0.002, 0.002), (0.003, 0.0015), (0.001, 0.001), (0.0005, 0.0005), (0.01, 0.002)):
        model.opt.timestep = step
        for fine, integrator in (
            (True, mujoco.mjtIntegrator.mjINT_RK4),
            (False, mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
        ):
            found = discretised(model, data, fine)
            assert found.opt.timestep == pytest.approx(expected, rel=1e-12)
            assert found.opt.integrator == integrator
            same = discretised(model, replace(data, exact=True), fine)
            assert (same.opt.timestep, same.opt.integrator) == (step, model.opt.integrator)
    assert model.opt.timestep == 0.01


def predicted(data: Measurements, integrator: str) -> np.ndarray:
    """Positions of all windows at their samples by steps of 2 ms."""
    setting = f'timestep="0.002" integrator="{integrator}"'
    model = compiled(PENDULUM.replace('timestep="0.005" integrator="RK4"', setting))
    w = cut(model, data, SIGMA, 0.4, 100)
    q, v = Simulation(model, [], 1).rollout(np.empty((len(w), 0)), w.qpos, w.qvel, w.drive)
    return interpolate(q, v, w.at, 0.002, np.array([0]), np.array([0]))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_semi_implicit_steps_are_of_second_order_from_where_they_have_their_velocities(
    integrator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = recorded(noise=0.0, duration=3.1)
    exact, found = predicted(data, "RK4"), predicted(data, integrator)
    for module in ("initial_states", "windows"):
        monkeypatch.setattr(f"sb3_rpto.sysid.shooting.{module}.half_step", lambda model: 0.0)
    first_order = np.abs(predicted(data, integrator) - exact)
    np.testing.assert_array_equal(predicted(data, "RK4"), exact)
    assert np.median(first_order) > 1e-3
    assert np.median(np.abs(found - exact)) < 0.15 * np.median(first_order)


def test_windows_lie_side_by_side_in_each_episode() -> None:
    data = ramps([clock(300), 5 + clock(420), 9 + clock(90)])
    windows = cut(compiled(), data, SIGMA, 0.3, 100)
    begin, end = windows.qpos[:, 0], windows.measured[:, -1, 0]
    np.testing.assert_allclose(end - begin, 0.3, atol=1e-9)
    np.testing.assert_allclose(windows.qvel[:, 0], 1.0, atol=1e-8)
    assert set(windows.episode) == {0, 1, 2}
    for number, e in enumerate(data.episodes):
        mine = windows.episode == number
        np.testing.assert_allclose(begin[mine][1:], end[mine][:-1], atol=1e-9)
        assert begin[mine][0] >= e.time[0] - 1e-9
        assert end[mine][-1] <= e.time[-1] + 1e-9
        assert e.time[-1] - end[mine][-1] < 0.3 + 1e-9  # nothing that would hold a window is left


def test_no_window_spans_a_gap() -> None:
    t = clock(400)
    t[170:] += 2.0
    windows = cut(compiled(), ramps([t]), SIGMA, 0.3, 100)
    begin, end = windows.qpos[:, 0], windows.measured[:, -1, 0]
    assert len(windows) >= 3
    assert not np.any((begin < t[169] + 1e-6) & (end > t[170] - 1e-6))
    assert len(np.unique(windows.episode)) == 2


def test_no_window_begins_at_a_sample_whose_state_is_unknown_and_such_samples_do_not_count() -> None:
    data = ramps([clock(400)])
    usable = np.ones(400, dtype=bool)
    usable[[8, 9, 60, 61]] = False
    usable[120:260] = False
    data = replace(data, episodes=[replace(data.episodes[0], usable=usable, placed=usable)])
    windows = cut(compiled(), data, SIGMA, 0.2, 100)
    begin = np.round(windows.qpos[:, 0] * 200).astype(int)
    assert usable[begin].all()
    count = 0
    for b, samples, ok in zip(begin, windows.measured[:, :, 0], windows.usable):
        rows = np.round(samples * 200).astype(int)
        np.testing.assert_array_equal(rows, np.arange(b + 1, b + 1 + len(rows)))
        np.testing.assert_array_equal(ok, usable[rows])
        assert usable[b : rows[-1] + 1].mean() > 0.5
        count += (~ok).sum()
    assert count > 0


def test_where_positions_alone_are_known_they_are_compared_but_no_window_begins() -> None:
    data = ramps([clock(400)])
    usable = np.arange(400) % 3 == 0
    placed = np.arange(400) % 50 != 7
    windows = cut(
        compiled(), replace(data, episodes=[replace(data.episodes[0], usable=usable, placed=placed)]), SIGMA, 0.1, 100
    )
    begin = np.round(windows.qpos[:, 0] * 200).astype(int)
    assert usable[begin].all()
    assert len(windows) == 18  # nearly side by side, though two of three samples are no start
    rows = np.round(windows.measured[:, :, 0] * 200).astype(int)
    np.testing.assert_array_equal(windows.usable, placed[rows])


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("jitter", [0.0, 0.7])
def test_commands_are_the_mean_of_those_held_over_each_step_from_before_the_start(
    jitter: float, integrator: str
) -> None:
    t = clock(500, 200.0, jitter)
    model, data = compiled(PENDULUM.replace("RK4", integrator)), ramps([t])
    windows = cut(model, data, SIGMA, 0.3, 100)
    h = model.opt.timestep
    assert windows.drive.commands.shape[1] - windows.drive.before == round(0.3 / h)
    parts = (np.arange(4000) + 0.5) / 4000
    for w in range(0, len(windows), 3):
        t0 = t[np.argmin(np.abs(t - windows.qpos[w, 0]))]
        begin = t0 + h * np.arange(-windows.drive.before, round(0.3 / h)) - (0.0 if integrator == "RK4" else h / 2)
        within = begin[:, None] + h * parts
        row = np.clip(np.searchsorted(t, within, side="right") - 1, 0, len(t) - 1)
        kept = slice(REVERSALS, None)  # before them come turns of older ones
        np.testing.assert_allclose(windows.drive.commands[w, kept, 0], t[row].mean(1)[kept], atol=2e-6)


def play(commands: np.ndarray, half_width: float) -> float:
    y = float(commands[0])
    for u in commands:
        y = min(max(y, u - half_width), u + half_width)
    return y


@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.floats(0, 3), st.booleans())
def test_the_turns_of_commands_leave_a_play_where_all_of_them_do(
    seed: int, n: int, half_width: float, rounded: bool
) -> None:
    commands = np.random.default_rng(seed).normal(size=n).cumsum()
    commands = np.round(commands) if rounded else commands
    turns = reversals(commands, n + 3)
    assert play(np.append(turns, commands[-1]), half_width) == pytest.approx(play(commands, half_width))
    np.testing.assert_array_equal(reversals(commands, 4), turns[:4])


@pytest.mark.parametrize("exact", [False, True])
def test_windows_after_a_rest_know_where_a_play_was_left(exact: bool) -> None:
    servo = compiled(PENDULUM.replace('<motor name="motor"', '<position kp="20" kv="1" name="motor"'))
    truth = Simulation(servo, [Backlash("motor", half_width=0.05)], 1)
    t = np.arange(1600) / 200
    goals = np.interp(t % 4.0, [0, 0.3, 2.0, 2.3, 4.0], [0, 0.4, 0.4, 0, 0])[None, :, None]  # and rests of 1.7 s
    q, v = truth.rollout(truth.values()[None], np.zeros((1, 1)), np.zeros((1, 1)), Drive(goals))
    table = {"time": t, "qpos.hinge": q[0, :-1, 0], "qvel.hinge": v[0, :-1, 0], "ctrl.motor": goals[0, :, 0]}
    data = replace(Measurements.from_tables({"run": table}), exact=exact, simulated=True)
    windows = cut(servo, data, SIGMA, 0.4, 100)
    assert windows.drive.before == 200
    reached, _ = truth.rollout(np.tile(truth.values(), (len(windows), 1)), windows.qpos, windows.qvel, windows.drive)
    off = [abs(reached[w, 80, 0] - windows.measured[w, 79, 0]) for w in range(len(windows))]
    assert max(off) < 2e-3


def test_commands_of_exact_data_are_those_of_the_samples() -> None:
    data = recorded(noise=0.0, exact=True)
    w = cut(compiled(), data, SIGMA, 0.4, 100)
    e = data.episodes[0]
    np.testing.assert_array_equal(
        w.drive.commands[0, w.drive.before :, 0], e.ctrl[: w.drive.commands.shape[1] - w.drive.before, 0]
    )


@pytest.mark.parametrize("kind", ["simulated", "exact"])
@pytest.mark.parametrize(
    "rounded",
    [lambda t: t.astype(np.float32).astype(float), lambda t: np.round(t, 6), lambda t: t + 1.7e9],
    ids=["float32", "microseconds", "since 1970"],
)
def test_a_rounded_clock_does_not_give_steps_the_commands_of_their_neighbours(rounded, kind: str) -> None:
    t, u = rounded(clock(1500, 240.0)), np.arange(1500.0)
    columns = {"ctrl.motor": [u], "qvel.hinge": [np.zeros(1)]}
    data = replace(measured([t], [np.sin(t - t[0])], **columns), **{kind: True}, idle=True)
    model = compiled(PENDULUM.replace('"0.005"', f'"{1 / 240!r}"'))
    windows = cut(model, data, SIGMA, 0.4, 100)
    begun = np.searchsorted(data.episodes[0].time, windows.time - 1e-9)
    steps = np.arange(-windows.drive.before, windows.drive.commands.shape[1] - windows.drive.before)
    row = (begun[:, None] + steps)[:, REVERSALS:]  # before them come turns of older ones
    expected = np.where(row < 0, 0, np.clip(row, 0, 1499))
    np.testing.assert_array_equal(windows.drive.commands[:, REVERSALS:, 0], expected)


@pytest.mark.parametrize("jitter", [0.0, 0.7])
def test_samples_keep_their_own_times(jitter: float) -> None:
    t = clock(500, 200.0, jitter)
    model = compiled()
    windows = cut(model, ramps([t]), SIGMA, 0.3, 100)
    t0 = t[np.argmin(np.abs(t[None] - windows.qpos[:, :1]), axis=1)]
    at = t0[:, None] + windows.at * model.opt.timestep
    np.testing.assert_allclose(np.where(windows.usable, at - windows.measured[..., 0], 0), 0, atol=1e-6)
    assert windows.usable.sum() > 0.9 * windows.usable.size
    if not jitter:
        assert not np.any(windows.at % 1)


def test_a_window_between_samples_of_a_jittered_clock_stays_within_its_horizon() -> None:
    windows = cut(compiled(), ramps([clock(500, 200.0, 0.7)]), SIGMA, 0.3, 100)
    assert windows.at.max() <= windows.drive.commands.shape[1] - windows.drive.before


def test_blocks_are_at_least_as_long_as_asked_for_and_end_with_the_episode() -> None:
    windows = cut(compiled(), ramps([clock(900), 9 + clock(500)]), SIGMA, 0.3, 100)
    assert windows.block[0] == 0
    assert set(np.diff(windows.block)) <= {0, 1}
    begin = windows.qpos[:, 0]
    first = {b: begin[windows.block == b][0] for b in np.unique(windows.block)}
    for b in first:
        assert len(np.unique(windows.episode[windows.block == b])) == 1
        if b + 1 in first and windows.episode[windows.block == b][0] == windows.episode[windows.block == b + 1][0]:
            assert first[b + 1] - first[b] >= 1.0 - 1e-6
    assert windows.block[-1] + 1 == 4 + 2


def test_a_simulators_short_data_are_parted_into_enough_blocks_and_a_machines_are_not() -> None:
    """200 transitions of 8 ms: two blocks of a second would be no evidence for anything."""
    time = np.arange(201) * 0.008
    short = replace(ramps([time[:195], 9 + time[195:]]), exact=True)
    blocks = [
        len(np.unique(cut(compiled(), data, SIGMA, 0.024, 100).block)) for data in (short, replace(short, exact=False))
    ]
    assert blocks[0] >= ENOUGH_BLOCKS
    assert blocks[1] <= 3


def test_a_simulators_long_data_have_blocks_of_a_second() -> None:
    windows = cut(compiled(), replace(ramps([clock(2_400)]), exact=True), SIGMA, 0.05, 1_000)
    begins = np.array([windows.time[windows.block == b][0] for b in np.unique(windows.block)])
    assert np.diff(begins) == pytest.approx(1.0, abs=0.06)


def test_most_windows_are_spread_over_all_episodes() -> None:
    data = ramps([10 * i + clock(400) for i in range(5)])
    every, few = (cut(compiled(), data, SIGMA, 0.2, most) for most in (1000, 10))
    assert len(every) > 30
    assert len(few) == 10
    assert set(few.episode) == set(range(5))
    assert set(few.qpos[:, 0]) <= set(every.qpos[:, 0])


def test_switched_off_actuators_are_off_step_by_step() -> None:
    t = clock(300)
    on = (t < 0.7) | (t > 1.0)
    data = ramps([t], **{"enabled.motor": [on.astype(float)]})
    model = compiled()
    windows = cut(model, data, SIGMA, 0.3, 100)
    assert windows.drive.enabled is not None
    for w in range(len(windows)):
        grid = windows.qpos[w, 0] + model.opt.timestep * np.arange(windows.drive.enabled.shape[1])
        row = np.floor(grid * 200 + 1e-6).astype(int)
        np.testing.assert_array_equal(windows.drive.enabled[w, :, 0], on[row])
    assert cut(model, ramps([t]), SIGMA, 0.3, 100).drive.enabled is None


def test_settings_of_a_run_are_those_of_its_windows() -> None:
    data = ramps([clock(300), 9 + clock(300)], **{"param.pole.mass": [0.5, 0.7]})
    windows = cut(compiled(), data, SIGMA, 0.3, 100)
    (name,) = windows.drive.settings
    assert name == "pole.mass"
    np.testing.assert_array_equal(windows.drive.settings[name], np.where(windows.episode == 0, 0.5, 0.7))


def test_taken_windows_are_the_same_windows() -> None:
    data = ramps([clock(500), 9 + clock(300)], **{"param.pole.mass": [0.5, 0.7]})
    windows = cut(compiled(), data, SIGMA, 0.3, 100)
    index = np.array([5, 1, 5])
    taken = windows.take(index)
    assert len(taken) == 3
    for name in ("qpos", "qvel", "spread", "at", "measured", "usable", "block", "episode"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(windows, name)[index])
    np.testing.assert_array_equal(taken.drive.commands, windows.drive.commands[index])
    np.testing.assert_array_equal(taken.drive.settings["pole.mass"], windows.drive.settings["pole.mass"][index])


def test_a_horizon_longer_than_every_episode_is_refused_with_the_longest() -> None:
    with pytest.raises(ValueError, match=r"window of 5 s.*longest has 1\.[45].* s.*lower horizon"):
        cut(compiled(), ramps([clock(100), 3 + clock(300)]), SIGMA, 5.0, 10)


def test_what_filters_remember_is_taken_off_the_longest() -> None:
    text = PENDULUM.replace("<motor ", '<general dyntype="filter" dynprm="1" ')
    with pytest.raises(ValueError, match=r"longest has 7\.5 s, 2\.5 s after what .* remember .*; lower horizon"):
        cut(mujoco.MjModel.from_xml_string(text), ramps([clock(1_500)]), SIGMA, 3.0, 10)
    with pytest.raises(ValueError, match=r"longest has \S+ s, 0 s after what .* remember .*; record longer"):
        cut(mujoco.MjModel.from_xml_string(text), ramps([clock(1_000)]), SIGMA, 3.0, 10)


def test_a_horizon_shorter_than_two_steps_is_refused_with_the_step() -> None:
    with pytest.raises(ValueError, match=r"window of 0\.005 s holds fewer than two steps of 0\.005 s; raise horizon"):
        cut(compiled(), ramps([clock(100)]), SIGMA, 0.005, 10)


def test_exact_data_start_at_the_recorded_state_with_no_spread() -> None:
    data = recorded(noise=0.0, exact=True)
    windows = cut(compiled(), data, SIGMA, 0.4, 100)
    assert not windows.spread.any()
    e = data.episodes[0]
    np.testing.assert_array_equal(windows.qpos[0], e.qpos[0])
    np.testing.assert_array_equal(windows.qvel[0], e.qvel[0])


def test_columns_in_another_order_than_the_models_reach_their_places() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
        <body><joint name="a" axis="0 0 1"/><geom size=".1"/><body><joint name="b" axis="0 0 1"/>
        <geom size=".1" pos="1 0 0"/></body></body></worldbody><actuator>
        <motor name="A" joint="a"/><motor name="B" joint="b"/></actuator></mujoco>""")
    t = clock(300)
    columns = {"time": t, "qpos.b": t, "qpos.a": 2 * t, "ctrl.B": 0 * t + 3, "ctrl.A": 0 * t + 4}
    windows = cut(model, Measurements.from_tables({"run": columns}), np.array([1e-3, 2e-3]), 0.3, 100)
    np.testing.assert_allclose(windows.qvel, [[2.0, 1.0]] * len(windows), atol=1e-8)
    np.testing.assert_array_equal(windows.columns, [1, 0])
    np.testing.assert_array_equal(windows.sigma, [1e-3, 2e-3])
    np.testing.assert_allclose(windows.spread[:, 0], 2 * windows.spread[:, 1])
    b = object_id(model, "actuator", "B")
    np.testing.assert_allclose(windows.drive.commands[:, :, b], 3, rtol=1e-12)
    np.testing.assert_allclose(windows.drive.commands[:, :, 1 - b], 4, rtol=1e-12)


def test_positions_that_were_not_measured_are_not_compared() -> None:
    data = replace(recorded(noise=0.0, exact=True), unobserved=("hinge",))
    windows = cut(mujoco.MjModel.from_xml_string(PENDULUM), data, SIGMA, 0.4, 100)
    assert windows.measured.shape[2] == 0
    assert len(windows.sigma) == len(windows.columns) == 0


@pytest.mark.parametrize(("seconds", "waits"), [(4.0, 0.2), (0.6, 0.15)])
def test_after_a_gap_windows_wait_for_commands_that_are_not_known(seconds: float, waits: float) -> None:
    time = clock(int(200 * (2 + seconds)))
    time[400:] += 0.3
    data = ramps([time])
    assert [e.after_gap for e in data.episodes] == [False, True]
    windows = cut(compiled(), data, SIGMA, 0.2, 100)
    first = [windows.time[windows.episode == i].min() - data.episodes[i].time[0] for i in (0, 1)]
    assert first[0] < 0.1  # smoothing alone
    assert first[1] == pytest.approx(waits, abs=0.006)
