"""Tracing as a whole, through the public API."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import coarsely
from gymnasium.envs.mujoco.inverted_double_pendulum_v5 import InvertedDoublePendulumEnv
from simulated import PENDULUM, RATE, WITH_WHEEL, briefly, compiled, problem, recorded, torques
from stable_baselines3.common.buffers import ReplayBuffer

from benchmarks.tracing.planting import Planted, generate
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.effects.commands import ActuatorLag, CommandDelay
from sb3_rpto.effects.corrected_model_io import load_corrected, read_effects
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction, ViscousFriction
from sb3_rpto.effects.library import given
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.problem import Assumptions, IdentificationProblem, Inputs, prepare
from sb3_rpto.sysid.report.diagnostics import at_bounds
from sb3_rpto.sysid.selection.adequacy import Adequacy, judge
from sb3_rpto.sysid.selection.search import SelectorPair

#: the longest steps that the recording and the trace may have
COARSE = PENDULUM.replace('timestep="0.005"', 'timestep="0.01"')
#: without forces in every substep, which take longest
NATIVE = ["coulomb_friction", "spring"]
#: what may change when only the test runs do
TESTED = {"before", "after", "floor", "force_before", "force_after", "learnable"}


@cache
def planted(*effects: tuple[str, str], seed: int = 1) -> Planted:
    return generate("pendulum", list(effects), seed=seed, episodes=6, duration=2.5)


def traced(p: Planted, data: Measurements | None = None, kinds: Sequence[str] = NATIVE, seed: int = 0) -> Report:
    assert 'timestep="0.002"' in p.xml
    xml = p.xml.replace('timestep="0.002"', 'timestep="0.005"')  # as far apart as the samples
    with coarsely():
        return trace(xml, data or p.measurements, p.declared, seed=seed, candidates=kinds, threads=1)


@cache
def complete(seed: int) -> Report:
    return traced(planted(seed=seed))


def few(runs: int, duration: float = 2.1) -> Measurements:
    return recorded([CoulombFriction("hinge", level=0.08)], compiled(COARSE), runs, duration, rate=100)


@cache
def simple() -> Measurements:
    """Runs of the tracer's own simulation with dry friction: quicker to trace than what was planted."""
    return few(5)


def traced_simply(
    data: Measurements | None = None,
    kinds: Sequence[str] = NATIVE,
    declared: Sequence[str] = ("pole.mass",),
    model: Any = COARSE,
    horizon: float | None = 0.4,
    progress: Callable[[float, str], None] | None = None,
) -> Report:
    data = data or simple()
    with coarsely(0.01):
        return trace(model, data, declared, candidates=kinds, horizon=horizon, threads=1, progress=progress)


@cache
def watched() -> tuple[Report, list[float]]:
    """A report, and the shares that were said to be done on the way to it."""
    shares: list[float] = []
    return traced_simply(progress=lambda share, what: shares.append(share)), shares


def simple_report() -> Report:
    return watched()[0]


def parted(data: Measurements, parts: Sequence[str]) -> Measurements:
    return replace(data, episodes=[replace(e, part=p) for e, p in zip(data.episodes, parts, strict=True)])


# --- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_slow_actuator_is_found_with_its_time_constant() -> None:
    data = recorded([ActuatorLag("motor", time_constant=0.2)], compiled(COARSE), 8, 3.0, rate=100)
    report = traced_simply(data, kinds=["actuator_lag", "command_delay"])
    (lag,) = report.effects
    assert report.verdict == "explained"
    assert lag.effect.values == pytest.approx([0.2], rel=0.02)
    assert lag.alike == []


@pytest.mark.slow
def test_a_run_that_stalled_is_named_also_where_others_are_judged_on() -> None:
    data = few(9)
    data = parted(data, ["train"] * 5 + ["select"] * 2 + ["test"] * 2)
    stuck = data.episodes[0]
    still = np.random.default_rng(3).normal(0.9, 1e-3, stuck.qpos.shape)
    data.episodes[0] = replace(stuck, qpos=still, qvel=0 * stuck.qvel)
    report = traced_simply(data, kinds=["coulomb_friction"])
    (stray,) = [f for f in report.findings if f.kind == FindingKind.STRAY_WINDOWS]
    assert (stray.where, stray.runs) == ("0", ("0",))
    assert stray.message.startswith("5 of 5 windows")
    assert report.effects[0].interval[0, 0] < 0.08 < report.effects[0].interval[1, 0]


@pytest.mark.slow
def test_a_run_to_select_on_that_never_comes_to_a_limit_does_not_hide_it_from_the_verdict() -> None:
    limited = compiled(COARSE.replace('joint="hinge"/>', 'joint="hinge" forcelimited="true" forcerange="-.5 .5"/>'))
    commands = np.stack([torques(1, 500, seed, size=0.3 if seed == 4 else 1.5, rate=100)[0] for seed in range(6)])
    data = parted(
        recorded(model=limited, episodes=6, duration=5.0, commands=commands, rate=100),
        ["train"] * 4 + ["select"] + ["test"],
    )
    report = traced_simply(data, kinds=["command_saturation"])
    assert report.judged_apart
    assert report.verdict == "explained"
    assert 1 / report.effects[0].effect.values == pytest.approx([0.5], rel=0.05)


@pytest.mark.slow
def test_a_test_run_unlike_all_others_is_told_beside_the_verdict() -> None:
    data = simple()
    runs = simple_report().runs["test"]
    moved = [replace(e, qpos=e.qpos + 0.06) if e.run in runs else e for e in data.episodes]
    report = traced_simply(replace(data, episodes=moved))
    assert report.verdict == simple_report().verdict == "explained"
    (found,) = [f for f in report.findings if f.kind == FindingKind.MISSED]
    assert found.runs == (*runs,)
    assert "times what noise leaves" in found.message
    assert not [f for f in simple_report().findings if f.kind == FindingKind.MISSED]


@pytest.mark.slow
def test_one_test_run_of_several_that_differs_is_named_alone() -> None:
    data = parted(few(9), ["train"] * 3 + ["select"] * 2 + ["test"] * 4)
    data.episodes[-1] = replace(data.episodes[-1], qpos=data.episodes[-1].qpos + 0.03)
    report = traced_simply(data, kinds=["coulomb_friction"])
    assert report.verdict == "explained"
    (found,) = [f for f in report.findings if f.kind == FindingKind.MISSED]
    assert found.where == data.episodes[-1].run


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_complete_model_is_complete_and_nothing_is_named(seed: int) -> None:
    p, report = planted(seed=seed), complete(seed)
    assert report.verdict == "complete"
    assert report.effects == []
    assert {c.status for c in report.candidates} == {"not needed"}
    for t in report.declared:
        truth = p.truth.declared[t.label]
        low, high = t.interval[:, 0]
        assert low <= t.effect.values[0] <= high
        assert t.effect.values[0] == pytest.approx(truth, rel=0.05 if t.label == "pole.mass" else 0.25)
    # A second and whole runs are but a few predictions.
    for before, floor in zip(report.before[:2], report.floor[:2], strict=True):
        assert before.horizon == floor.horizon
        assert 0.5 < before.rmse[0] / floor.rmse[0] < 1.6


@pytest.mark.slow
def test_dry_friction_is_explained_with_its_level() -> None:
    p = planted(("coulomb_friction", "large"), seed=6)
    report = traced(p)
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "coulomb_friction(hinge)"
    assert found.effect.values[0] == pytest.approx(p.truth.effects["coulomb_friction"]["torque"], rel=0.05)
    low, high = found.interval[:, 0]
    assert low < found.effect.values[0] < high
    assert found.t > report.threshold
    assert found.frequency > 0.8
    assert report.horizon == 0.8, "no longer windows are needed"
    assert not report.adequacy_before.adequate
    assert report.adequacy_after.adequate
    assert report.adequacy_after.ratio < 0.5 * report.adequacy_before.ratio
    for before, after in zip(report.before, report.after, strict=True):
        assert after.rmse[0] < before.rmse[0]
    assert report.force_after[0] < report.force_before[0]
    assert {c.label: c.status for c in report.candidates}["coulomb_friction(hinge)"] == "kept"


def test_verdicts() -> None:
    fine, poor = Adequacy(1.0, 0.9, 1.05, 0.0, 1.0), Adequacy(9.0, 8.0, 11.0, 0.5, 0.0)
    better, half = Adequacy(2.0, 1.8, 2.2, 0.1, 0.0), Adequacy(5.0, 4.0, 6.0, 0.3, 0.0)
    assert judge(fine, fine, named=False) == "complete"
    assert judge(fine, fine, named=True) == "explained"  # windows of another length had shown that something is missing
    assert judge(poor, fine, named=True) == "explained"
    assert judge(poor, better, named=True) == "partly explained"
    assert judge(poor, half, named=True) == judge(poor, poor, named=False) == "unexplained"
    few, fewer, quarter = (Adequacy(r, 0.95, 1.1, s, 1e-4) for r, s in ((1.05, 0.2), (1.05, 0.11), (1.2, 0.05)))
    assert few.denied_by_strays
    assert judge(few, replace(fewer, strays=0.1), named=True) == "partly explained"  # half as many of them
    assert judge(few, fewer, named=True) == "unexplained"
    assert judge(replace(few, ratio=1.07), quarter, named=True) == "unexplained"  # the typical error is more than noise


@pytest.mark.slow
def test_what_lies_outside_the_library_is_not_explained() -> None:
    report = traced(planted(("wind_gusts", "large")))
    assert report.verdict in ("unexplained", "partly explained")
    assert not report.adequacy_before.adequate


@pytest.mark.slow
def test_of_what_looks_alike_one_is_tried_for_all() -> None:
    p = planted(("wind_gusts", "large"))
    late, slow = trace(p.xml, p.measurements, p.declared, candidates=["command_delay", "actuator_lag"]).candidates
    assert late.status == slow.status == "dropped"
    tried, other = (late, slow) if "unseen windows" in late.reason else (slow, late)
    assert "unseen windows" in tried.reason
    assert other.reason == f"looks like {tried.label}, which was tried"


@pytest.mark.slow
def test_an_effect_that_is_not_among_the_candidates_is_not_explained() -> None:
    report = traced_simply(kinds=["torque_offset"])
    assert report.verdict == "unexplained"
    assert [c.label for c in report.candidates] == ["torque_offset(hinge)"]


@pytest.mark.slow
def test_where_much_is_left_to_explain_longer_windows_are_looked_at() -> None:
    there = [CoulombFriction("hinge", level=0.25), TorqueOffset("hinge", offset=0.1)]
    data, friction = recorded(there, compiled(COARSE), 9, 3.2, rate=50), ["coulomb_friction"]
    for horizon, used in ((None, 1.0), (0.5, 0.5)):
        report = traced_simply(data, friction, horizon=horizon)
        assert [t.label for t in report.effects] == ["coulomb_friction(hinge)"]
        assert report.verdict in ("unexplained", "partly explained")
        assert report.horizon == used, "who gives a length has it"


def test_longer_windows_begin_where_the_others_do() -> None:
    """Laid side by side they are half as many, and what acts little no longer shows in them."""
    data = recorded([], compiled(COARSE), 9, 3.2, rate=50)
    inputs = Inputs(COARSE, data, ["hinge.damping"], candidates=["coulomb_friction"], threads=1)
    made = prepare(inputs, Assumptions(simulated=True))
    assert made.longer == 2 * made.length
    usual, longer = (SelectorPair.on(made, length).fine.train.windows for length in (made.length, made.longer))
    assert {tuple(q) for q in longer.qpos.round(9)} < {tuple(q) for q in usual.qpos.round(9)}
    assert len(longer) > 0.75 * len(usual)  # all but the last of each run


# --- what a report depends on -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report_to_the_last_bit_also_for_a_specification_of_the_model() -> None:
    assert simple_report().effects
    again = traced_simply(model=mujoco.MjSpec.from_string(COARSE))
    assert json.dumps(again.to_json()) == json.dumps(simple_report().to_json())


@pytest.mark.slow
def test_nothing_but_the_errors_depends_on_the_numbers_of_the_test_runs() -> None:
    report, data = simple_report(), simple()
    rng = np.random.default_rng(0)
    changed = []
    for e in data.episodes:
        if e.run in report.runs["test"]:
            # Another amplitude, and ten times the noise.
            q = 0.7 * e.qpos + 0.01 * rng.standard_normal(e.qpos.shape)
            e = replace(e, qpos=q, qvel=0.7 * e.qvel, ctrl=1.2 * e.ctrl)
        changed.append(e)
    other = traced_simply(replace(data, episodes=changed)).to_json()
    mine = report.to_json()
    for e in (mine, other):
        # A finding about a test run is one about the data; none may come of the others.
        e["findings"] = [f for f in e["findings"] if not f["where"].startswith(tuple(report.runs["test"]))]
    assert {key for key in mine if json.dumps(mine[key]) != json.dumps(other[key])} <= TESTED
    assert mine["before"] != other["before"]
    assert mine["after"] != other["after"]


@pytest.mark.slow
def test_a_split_column_is_honoured() -> None:
    names = [e.run for e in simple().episodes]
    report = traced_simply(parted(simple(), ["test", "train", "select", "train", "select"]))
    assert report.runs == {"train": [names[1], names[3]], "select": [names[2], names[4]], "test": [names[0]]}
    assert report.verdict == "explained"


def selected_on(report: Report) -> list[str]:
    return [
        f.message
        for f in report.findings
        if f.kind == FindingKind.SPLIT and "windows of the training runs" in f.message
    ]


@pytest.mark.slow
def test_with_fewer_than_three_training_runs_blocks_are_selected_on_and_it_says_so() -> None:
    report = traced_simply(few(3))
    assert report.runs["select"] == []
    assert len(report.runs["train"]) == 2
    assert "block" in selected_on(report)[0]
    assert [t.label for t in report.effects] == ["coulomb_friction(hinge)"]


def test_a_single_block_to_select_on_is_no_evidence_so_that_all_take_turns() -> None:
    report = traced_simply(few(5, 1.0))
    assert len(report.runs["select"]) == 1
    assert selected_on(report)
    (found,) = report.effects
    assert found.label == "coulomb_friction(hinge)"
    assert found.effect.values[0] == pytest.approx(0.08, rel=0.1)


@pytest.mark.slow
def test_a_single_run_is_traced_and_reported_as_not_held_out() -> None:
    report = traced_simply(few(1, 3.6))
    assert report.runs["test"] == []
    assert not [f for f in report.findings if f.kind == FindingKind.MISSED]
    assert any("no test data" in f.message for f in report.findings)
    assert "fitted runs" in str(report)
    assert np.isfinite(report.after[0].rmse).all()
    assert [t.label for t in report.effects] == ["coulomb_friction(hinge)"]


def test_a_run_too_short_to_be_parted_into_blocks_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"too few to select on; record longer, three runs or \d s and more to fit to$"
    ):
        traced_simply(few(1, 2.0), horizon=None)
    with pytest.raises(ValueError, match=r"and more to fit to, or lower horizon$"):
        traced_simply(few(1, 2.3), horizon=1.0)


def test_many_short_windows_of_a_single_second_are_refused_too() -> None:
    with pytest.raises(ValueError, match="in fewer than three blocks of a second"):
        traced_simply(recorded(episodes=1, duration=1.0), horizon=0.02)


def test_progress_goes_forward() -> None:
    _, shares = watched()
    assert len(shares) > 5
    assert shares == sorted(shares)
    assert shares[0] > 0
    assert shares[-1] < 1.0 + 1e-9


@pytest.mark.slow
def test_nothing_declared_and_no_candidates_is_a_check_of_the_model() -> None:
    report = traced_simply(recorded(model=compiled(COARSE), rate=100), [], declared=())
    assert report.verdict == "complete"
    assert traced_simply(few(4), [], declared=()).verdict == "unexplained"


@pytest.mark.slow
def test_a_declared_parameter_that_the_data_cannot_show_stops_nothing() -> None:
    still = np.zeros((5, 210))
    data = recorded([TorqueOffset("hinge", offset=0.2)], compiled(COARSE), 5, commands=still, rate=100)
    report = traced_simply(data, ["torque_offset"], declared=["motor.gear"])
    assert [t.label for t in report.effects] == ["torque_offset(hinge)"]


# --- bad input --------------------------------------------------------------------------------------------------------


def test_an_unknown_declared_name_is_refused_with_the_near_ones() -> None:
    p = planted()
    with pytest.raises(ValueError, match=r"hinge\.dampign.*damping"):
        trace(p.xml, p.measurements, ["hinge.dampign"])
    with pytest.raises(ValueError, match=r"no object 'pol'.*pole"):
        trace(p.xml, p.measurements, ["pol.mass"])
    with pytest.raises(TypeError, match="list of names"):
        trace(p.xml, p.measurements, "hinge.damping")


def test_joints_and_actuators_that_the_model_lacks_are_refused() -> None:
    p = planted()
    with pytest.raises(ValueError, match="hinge"):
        trace(p.xml.replace('name="hinge"', 'name="elbow"'), p.measurements)
    with pytest.raises(ValueError, match="motor"):
        trace(p.xml.replace('name="motor"', 'name="drive"'), p.measurements)


def test_joints_that_the_data_lack_are_refused() -> None:
    with pytest.raises(ValueError, match="axle"):
        trace(compiled(WITH_WHEEL), recorded(), threads=1)


def test_an_unknown_kind_of_candidate_is_refused_with_the_known_ones() -> None:
    p = planted()
    with pytest.raises(ValueError, match=r"coulom_friction.*coulomb_friction"):
        traced(p, kinds=["coulom_friction"])


def test_too_long_a_horizon_is_refused() -> None:
    p = planted()
    with pytest.raises(ValueError, match="lower horizon"):
        trace(p.xml, p.measurements, p.declared, candidates=NATIVE, horizon=30.0, threads=1)


def test_too_few_samples_are_refused_in_words() -> None:
    t = np.arange(6) / 200
    table = {"time": t, "qpos.hinge": np.sin(t), "ctrl.motor": 0 * t}
    data = Measurements.from_tables({"a": table, "b": {**table, "qpos.hinge": np.cos(t)}})
    with pytest.raises(ValueError, match=r"few|short|longer|longest"):
        trace(planted().xml, data, candidates=NATIVE, threads=1)


# --- a gymnasium environment ------------------------------------------------------------------------------------------


def driven(friction: float) -> tuple[gym.Env, Measurements]:
    """Random pushes of the double pendulum, whose cart has dry friction, in a replay buffer, and the nominal env."""
    env, nominal = (gym.make("InvertedDoublePendulum-v5") for _ in range(2))
    env.unwrapped.model.dof_frictionloss[0] = friction
    buffer = ReplayBuffer(2000, env.observation_space, env.action_space, "cpu")
    rng = np.random.default_rng(0)
    obs, _ = env.reset(seed=0)
    action, low, high = np.zeros(1), env.action_space.low, env.action_space.high
    for k in range(700):
        if k % 2 == 0:
            action = rng.uniform(-1, 1, 1)
        after, reward, terminated, truncated, _ = env.step((low + (action + 1) / 2 * (high - low)).astype(np.float32))
        buffer.add(obs, after, action[None], np.array([reward]), np.array([terminated or truncated]), [{}])
        obs = after if not (terminated or truncated) else env.reset()[0]
    return nominal, Measurements.from_replay(buffer, nominal)


@pytest.mark.slow
def test_what_an_environment_changed_of_its_file_is_saved(tmp_path: Path) -> None:
    env, data = driven(0.0)
    env.unwrapped.model.dof_damping[0] = 0.123
    trace(env, data, candidates=[], threads=1).save(tmp_path)
    assert load_corrected(tmp_path).model.dof_damping[0] == 0.123


def test_an_unchanged_environment_is_complete_without_error() -> None:
    env, data = driven(0.0)
    report = trace(env, data, candidates=NATIVE, threads=1)
    assert data.exact
    assert report.verdict == "complete"
    assert all(np.all(e.rmse < 1e-4) for e in report.before)
    assert report.floor == []
    assert np.all(np.isnan(report.learnable))  # of rounding


@pytest.mark.slow
def test_of_numbers_that_only_show_together_the_last_stays_what_it_was() -> None:
    """A motor's gear and its gain, one of them beside friction that nobody declared."""
    env, data = driven(1.0)
    alike = ["cart.mass", "slide.gear", "slide.gain"]
    report = trace(env, data, alike, candidates=["coulomb_friction"], threads=1)
    mass, gear, gain = report.declared
    assert (float(gear.effect.values[0]), float(gain.effect.values[0])) == pytest.approx((500.0, 1.0), rel=1e-3)
    assert gain.effect.values[0] == 1.0
    assert np.isnan([gear.interval, gain.interval]).all()
    assert np.isfinite(mass.interval).all()
    said = [f.where for f in report.findings if f.kind == FindingKind.UNDETERMINED]
    assert said == ["declared slide.gear", "declared slide.gain"]


@pytest.mark.slow
def test_dry_friction_that_an_environment_lacks_is_found() -> None:
    env, data = driven(1.0)
    report = trace(env, data, candidates=NATIVE, threads=1)
    assert report.verdict in ("explained", "partly explained")
    without = trace(env, data, candidates=[], threads=1)
    assert without.verdict == "unexplained"
    assert np.all(without.learnable >= 0)
    labels = {t.label: t for t in report.effects}
    assert "coulomb_friction(slider)" in labels
    assert labels["coulomb_friction(slider)"].effect.values[0] == pytest.approx(1.0, rel=0.1)
    corrected = report.apply(env)
    assert corrected.unwrapped.model.dof_frictionloss[0] == pytest.approx(1.0, rel=0.1)
    assert env.unwrapped.model.dof_frictionloss[0] == 0


class Steps(InvertedDoublePendulumEnv):
    """One whose step does more than simulate."""

    gain, push = 2.0, 0.0

    def step(self, action):
        self.data.qfrc_applied[0] = self.push
        return super().step(self.gain * action)


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "push", "said"), [(2.0, 0.0, "gives the commands"), (1.0, 3.0, "moves otherwise")])
def test_an_environment_that_does_more_than_its_model_is_told(gain: float, push: float, said: str) -> None:
    _, data = driven(0.0)
    env = Steps()
    env.gain, env.push = gain, push
    report = trace(env, data, candidates=[], threads=1)
    (found,) = [f for f in report.findings if f.kind == FindingKind.OWN_STEP]
    assert said in found.message
    assert not [
        f for f in trace(driven(0.0)[0], data, candidates=[], threads=1).findings if f.kind == FindingKind.OWN_STEP
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("threshold", "verdict"), [(5.0, "explained"), (1e9, "unexplained")])
def test_a_calibrated_threshold_is_the_one_that_selects(
    threshold: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def calibrate_threshold(selector: Any, base: Any, chosen: list[int], sets: int, seed: int) -> float:
        asked.append((len(selector.train.simulation.effects), chosen, sets, seed))
        return threshold

    monkeypatch.setattr("sb3_rpto.sysid.selection.search.calibrate_threshold", calibrate_threshold)
    data = recorded([CoulombFriction("hinge", level=0.08)], model=compiled(COARSE), rate=100)
    settings: dict[str, Any] = {"candidates": ["coulomb_friction"], "horizon": 0.35, "threads": 1}
    with coarsely(0.01):
        report = trace(COARSE, data, ["hinge.damping"], calibrate=20, seed=3, **settings)
    assert asked == [(2, [1], 20, 3)]
    assert report.verdict == verdict
    if verdict == "explained":  # else a t of 2 is enough: far from the noise other limits hold
        assert report.threshold == threshold


@pytest.mark.parametrize("name", ["seed", "calibrate", "threads"])
@pytest.mark.parametrize("wrong", [1.5, True, -1])
def test_what_is_no_whole_number_is_refused(name: str, wrong: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*, got"):
        trace(COARSE, simple(), **{name: wrong})


@pytest.mark.slow
def test_how_test_runs_were_sampled_changes_nothing_of_the_fit() -> None:
    made = planted(("coulomb_friction", "large"))

    def fitted_with(speed: float) -> IdentificationProblem:
        # Most of the samples are the test runs'.
        episodes = [
            replace(e, part="test", time=e.time / speed) if i < 4 else replace(e, part="train")
            for i, e in enumerate(made.measurements.episodes)
        ]
        data = replace(made.measurements, episodes=episodes)
        return prepare(Inputs(made.xml, data, made.declared, candidates=NATIVE, threads=1))

    ours, theirs = fitted_with(1.0), fitted_with(20.0)
    for name in ("fine", "rough"):
        assert getattr(ours, name).model.opt.timestep == getattr(theirs, name).model.opt.timestep
    np.testing.assert_array_equal(ours.sigma, theirs.sigma)
    assert (ours.length, ours.longer, ours.scales) == (theirs.length, theirs.longer, theirs.scales)


@pytest.mark.slow
def test_declared_numbers_of_which_the_data_tell_nothing_are_named() -> None:
    rng, n = np.random.default_rng(0), 400
    still = {f"r{i}": {"time": np.arange(n) / RATE, "qpos.hinge": 1e-4 * rng.standard_normal(n)} for i in range(3)}
    data = Measurements.from_tables({name: {**t, "ctrl.motor": np.zeros(n)} for name, t in still.items()})
    report = briefly(PENDULUM, data, ["hinge.damping", "pole.mass"], candidates=[])
    assert [f.where for f in report.findings if f.kind == FindingKind.UNDETERMINED] == [
        "declared hinge.damping",
        "declared pole.mass",
    ]
    moved = briefly(PENDULUM, recorded(), ["hinge.damping", "pole.mass"], candidates=[])
    assert FindingKind.UNDETERMINED not in {f.kind for f in moved.findings}


@pytest.mark.slow
def test_a_declared_number_that_ends_at_its_bound_is_named() -> None:
    light = COARSE.replace('mass="0.5"', 'mass="0.3"')  # where the machine has 0.5
    data = recorded(model=compiled(COARSE), rate=100)
    narrow, wide = (traced_simply(data, [], [f"pole.mass=0.2:{most}"], light) for most in (0.4, 1.0))
    (finding,) = [f for f in narrow.findings if f.kind == FindingKind.AT_ITS_BOUND]
    assert (finding.where, finding.message[:4]) == ("declared pole.mass", "0.4 ")
    assert "pole.mass=low:high" in finding.message
    assert FindingKind.AT_ITS_BOUND not in {f.kind for f in wide.findings}


def test_an_effect_that_ends_at_its_bound_is_named() -> None:
    late = problem([CommandDelay("motor")], recorded(rate=100), compiled(COARSE))
    (finding,) = at_bounds(late, late.upper, [0])
    assert (finding.where, finding.message[:4]) == ("command_delay(motor), delay", "0.2 ")
    assert at_bounds(late, late.upper, []) == []  # it is not kept


def test_data_that_were_not_read_are_refused_at_once() -> None:
    with pytest.raises(TypeError, match="data must be Measurements, not str"):
        trace(PENDULUM, "runs/*.csv")  # type: ignore[arg-type]


# --- effects that are known beforehand --------------------------------------------------------------------------------


@cache
def late(level: float = 0.0) -> Measurements:
    """Commands act 20 ms late, and there is dry friction of a level."""
    effects = [CommandDelay("motor", delay=0.02), CoulombFriction("hinge", level=level)]
    return recorded(effects, compiled(COARSE), 5, 2.1, rate=100)


def with_known(data: Measurements, *known: Effect, declared: Sequence[str] = ("pole.mass",)) -> Report:
    with coarsely(0.01):
        return trace(COARSE, data, declared, known=known, candidates=NATIVE, horizon=0.4, threads=1)


@pytest.mark.slow
def test_a_known_effect_is_fitted_and_what_else_is_missing_is_named(tmp_path: Path) -> None:
    report = with_known(late(0.08), CommandDelay("motor", delay=0.03))
    assert report.verdict == "explained"
    assert [t.label for t in report.effects] == ["coulomb_friction(hinge)"]
    assert report.effects[0].effect.values[0] == pytest.approx(0.08, rel=0.03)
    assert [t.label for t in report.declared] == ["pole.mass", "command_delay(motor)"]
    assert report.declared[1].effect.values[0] == pytest.approx(0.02, abs=1e-3)
    assert "command_delay(motor)" not in {c.label for c in report.candidates}
    assert "known effects, fitted" in str(report)
    report.save(tmp_path)
    for again in (load_corrected(tmp_path).effects, read_effects(tmp_path / "effects.json", compiled(COARSE))):
        assert [e.label for e in again] == ["pole.mass", "command_delay(motor)", "coulomb_friction(hinge)"]


@pytest.mark.slow
def test_with_all_effects_known_a_model_is_complete() -> None:
    report = with_known(late(0.08), CommandDelay("motor", delay=0.02), CoulombFriction("hinge", level=0.05))
    assert report.verdict == "complete"
    assert report.declared[2].effect.values[0] == pytest.approx(0.08, rel=0.03)


@pytest.mark.slow
def test_a_known_effect_that_is_not_there_ends_at_its_null() -> None:
    report = with_known(few(5), CommandDelay("motor", delay=0.03), CoulombFriction("hinge", level=0.05))
    assert report.verdict == "complete"
    assert report.declared[1].effect.values[0] == pytest.approx(0.0, abs=5e-4)


@pytest.mark.slow
def test_a_correction_is_gone_on_from() -> None:
    first = with_known(late(), CommandDelay("motor", delay=0.03))
    then = with_known(late(0.08), *first.correction, declared=())
    assert [t.label for t in then.declared] == [t.label for t in first.declared]
    assert [t.label for t in then.effects] == ["coulomb_friction(hinge)"]


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (CommandDelay("motor", delay=0.02), r"must be a list of effects; write \[command_delay\(motor\)\]"),
        (["command_delay"], "known must hold effects such as"),
        ([CommandDelay("moter", delay=0.02)], r"no registered effect is 'command_delay\(moter\)'.*mean.*\(motor\)"),
        ([ViscousFriction("hinge", coefficient=0.1)], "is a number that is declared, too"),
        ([CommandDelay("motor")], "does nothing"),
        ([CommandDelay("motor", delay=0.02), CommandDelay("motor", delay=0.03)], "is there twice"),
    ],
)
def test_known_effects_that_cannot_be_are_refused_before_the_work(known: Any, said: str) -> None:
    with pytest.raises((TypeError, ValueError), match=said):
        trace(COARSE, simple(), ["hinge.damping"], known=known)


@pytest.mark.slow
def test_the_shape_of_a_known_effect_does_not_bend_to_what_is_missing() -> None:
    stribeck = LIBRARY["stribeck_friction"]
    true = stribeck("hinge", level=0.05, extra=0.1, speed=0.4)
    data = recorded([true, LIBRARY["spring"]("hinge", stiffness=0.3)], compiled(COARSE), 5, 2.1, rate=100)
    report = with_known(data, stribeck("hinge", level=0.06, extra=0.08, speed=0.4))
    assert report.verdict == "explained"
    assert [t.label for t in report.effects] == ["spring(hinge)"]
    known = report.declared[1]
    np.testing.assert_allclose(known.effect.values, true.values, rtol=0.1)
    shape = [p.shape for p in true.parameters]
    assert known.effect.values[shape] == [0.4]
    assert np.isnan(known.interval[:, shape]).all()


@pytest.mark.slow
def test_what_the_data_do_not_show_stays_as_it_is_given_and_is_named() -> None:
    saturation = LIBRARY["command_saturation"]("motor", inverse_limit=0.3)  # far above all commands
    report = with_known(simple(), saturation)
    assert report.declared[1].effect.values[0] == 0.3
    assert np.isnan(report.declared[1].interval).all()
    assert "known command_saturation(motor), inverse_limit" in {f.where for f in report.findings}


def test_bounds_that_are_declared_win_over_those_of_what_is_known() -> None:
    model = compiled(COARSE)
    (mass,) = given(model, ["pole.mass=0.3:0.9"], declare(model, ["pole.mass"]))
    assert (mass.parameters[0].lower, mass.parameters[0].upper) == (0.3, 0.9)
