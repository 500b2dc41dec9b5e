"""The study of the closed loop: its targets, its jobs and what its tables say."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th

from benchmarks.__main__ import main
from benchmarks.closed_loop import study as study
from benchmarks.runner import read_table, run_jobs
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.effects import Declared


@pytest.mark.parametrize("task", study.TASKS)
def test_targets_are_fixed_within_20_percent_and_differ(task: str) -> None:
    first, again, other = (study.shifted(task, "declared", i) for i in (0, 0, 1))
    factors = np.array([e.values[0] / e.parameters[0].null for e in first])
    assert np.all((factors >= 0.8) & (factors <= 1.2))
    assert len(set(factors.round(9))) == len(factors)
    np.testing.assert_array_equal([e.values for e in first], [e.values for e in again])
    assert not np.allclose([e.values for e in first], [e.values for e in other])


@pytest.mark.parametrize("task", study.TASKS)
def test_the_undeclared_effect_comes_on_top_of_the_same_declared_shift(task: str) -> None:
    declared, both = study.shifted(task, "declared", 0), study.shifted(task, "undeclared", 0)
    np.testing.assert_array_equal([e.values for e in declared], [e.values for e in both if isinstance(e, Declared)])
    more = [e for e in both if not isinstance(e, Declared)]
    assert [e.kind for e in more] == [study.TASKS[task].lacks[0]] * len(study.TASKS[task].lacks[2])
    assert all(e.values[0] > 0 for e in more)


@pytest.mark.parametrize(("shift", "same"), [("none", True), ("declared", False), ("undeclared", False)])
def test_a_target_differs_from_its_source_where_it_should(shift: str, same: bool) -> None:
    envs = study.make_source("double-pendulum"), study.make_target("double-pendulum", shift, 0)
    steps = [(env.reset(seed=0), env.step(np.array([0.5])))[1][0] for env in envs]
    assert np.array_equal(*steps) == same


def test_an_undeclared_friction_is_its_share_of_the_motors_peak() -> None:
    effects = {e.label: e for e in study.shifted("cheetah", "undeclared", 0)}
    model = gym.make("HalfCheetah-v5").unwrapped.model  # type: ignore[attr-defined]
    assert effects["coulomb_friction(bthigh)"].values[0] == pytest.approx(0.12 * model.actuator_gear[0, 0])


def test_the_truth_of_an_unchanged_target_is_what_the_source_has() -> None:
    same, other = study.true_numbers("hopper", "none", 0), study.true_numbers("hopper", "declared", 0)
    assert set(same) == set(other)
    assert same["leg.length"] == pytest.approx(0.5)
    assert all(0 < abs(other[name] / value - 1) <= 0.2 for name, value in same.items())


def test_an_unfinished_study_is_a_fair_sample() -> None:
    listed = study.jobs(["hopper"], study.SHIFTS, study.TARGETS, range(2))
    assert len(listed) == len({job.name for job in listed}) == 3 * 2 * 2 * len(study.METHODS)
    assert [job.seed for job in listed] == sorted(job.seed for job in listed)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ValueError, match=r"tasks.*ant"):
        study.jobs(["ant"], ["none"], [0], [0])


def test_the_uncorrected_simulator_errs_on_shifted_targets_alone() -> None:
    errors = {}
    for shift in study.SHIFTS:
        env = study.make_target("double-pendulum", shift, 0)
        env.action_space.seed(0)
        seen, steps = env.reset(seed=0)[0], []
        for _ in range(5):
            action = env.action_space.sample()
            after, reward, *_ = env.step(action)
            steps.append((seen, action, reward, after, 0.0))
            seen = after
        data = Transitions(*(th.as_tensor(np.array(column), dtype=th.float64) for column in zip(*steps)))
        errors[shift] = study.uncorrected("double-pendulum").error(data)
    assert errors["none"] < 1e-4 < 0.01 < min(errors["declared"], errors["undeclared"])


def rows() -> pd.DataFrame:
    lines = []
    for seed in range(3):
        for steps, value in ((0, 100.0), (250, 500.0 + 100 * seed), (500, 950.0)):
            line = {"task": "hopper", "shift": "none", "target": 0, "method": "SAC-warm", "seed": seed, "steps": steps}
            lines.append({**line, "return": value, "updates": 2 * steps, "source_steps": 0, "seconds": 1.0})
    return pd.DataFrame(lines)


def test_summary_says_what_was_spent_for_what() -> None:
    table = study.summary(rows(), {("hopper", "none", 0): 1000.0}).set_index("steps")
    assert table.loc[250, "iqm"] == pytest.approx(600)
    assert table.loc[500, "share"] == pytest.approx(0.95)
    assert table.loc[500, "updates_per_step"] == pytest.approx(2)
    assert table.loc[0, "runs"] == 3


def test_how_targets_differ_is_not_how_runs_do() -> None:
    better = rows().assign(target=1, **{"return": lambda table: table["return"] + 10_000})
    line = study.summary(pd.concat([rows(), better]), {}).set_index("steps").loc[0]
    assert line["low"] == line["iqm"] == line["high"]  # all runs of a target begin alike


def test_an_oracle_is_the_best_of_its_evaluations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(study, "source_agent", lambda *_: ("agent.zip", None))
    monkeypatch.setattr(
        study,
        "transfer",
        lambda *args, **kwargs: (
            asked.append((args[0], args[4], kwargs["every"]))
            or [{"steps": 100_000, "return": value} for value in (1.0, 9.0, 7.0)]
        ),
    )
    job = study.Job("hopper", "none", 0, study.ORACLE, 0, budget=500)
    run_jobs(partial(study.run, folder=tmp_path), [job], tmp_path / "runs", 1)
    assert asked == [("sac-warm", 100_000, tuple(range(10_000, 100_001, 10_000)))]
    assert study.oracles(study.collected(tmp_path / "runs")) == {("hopper", "none", 0): 9.0}


def test_a_folder_has_runs_of_one_source_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = tmp_path / "sources"
    sources.mkdir()
    agent = sources / "Hopper-v5.zip"
    agent.write_text("an agent")
    monkeypatch.setenv(study.sources.FOLDER_VARIABLE, str(sources))
    found = study.source_agent.__wrapped__
    assert found("hopper", tmp_path / "runs") == found("hopper", tmp_path / "runs") == (str(agent), None)
    agent.write_text("another")
    with pytest.raises(ValueError, match="another source agent"):
        found("hopper", tmp_path / "runs")
    assert found("hopper", tmp_path / "others")[0] == str(agent)


def test_steps_to_a_share_of_the_oracle() -> None:
    line = study.steps_to_oracle(rows(), {("hopper", "none", 0): 760.0}).iloc[0]
    # 684 is reached at once by the third seed alone.
    assert (line["median"], line["reached"]) == (500, 3)
    assert study.steps_to_oracle(rows(), {("hopper", "none", 0): 2000.0}).iloc[0]["reached"] == 0
    nothing = study.steps_to_oracle(rows(), {("hopper", "none", 1): 1.0})
    assert nothing.empty, "of an unknown oracle nothing is said"
    assert list(nothing.columns) == list(line.index)


@pytest.mark.parametrize("runs", [2, 4, 6, 8])
def test_where_half_of_the_runs_are_there_the_median_is_not(runs: int) -> None:
    half = pd.concat(
        [rows().query("seed == 0").assign(seed=i, **{"return": 800.0 if i % 2 else 0.0}) for i in range(runs)]
    )
    line = study.steps_to_oracle(half, {("hopper", "none", 0): 760.0}).iloc[0]
    assert line["reached"] == runs // 2
    assert line["median"] == np.inf


def test_noisy_sensors_are_those_of_the_target_and_the_loop_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    monkeypatch.setattr(study, "source_agent", lambda *_: ("agent", None))
    monkeypatch.setattr(study, "transfer", lambda *args, **kwargs: told.append((args[3], kwargs)) or [])
    for method in ("SAC-warm", "RPTO-physical, open loop", "RPTO-physical, closed loop"):
        job = study.Job("double-pendulum", "none", 0, method, 0, sensors=1e-3)
        assert job.name.endswith("_0_sensors-0.001")
        study.run(job, tmp_path)
    noise = np.array([1e-3] * 5 + [1e-2] * 3 + [0.0])
    for target, _ in told:
        shown, exact = (env.reset(seed=0)[0] for env in (target(), study.make_target("double-pendulum", "none", 0)))
        assert (np.abs(shown - exact)[:8] > 0).all()
        assert (np.abs(shown - exact) < 5 * noise + 1e-12).all()
    passed = [kwargs.get("dynamics_kwargs") for _, kwargs in told]
    assert passed[:2] == [None, None]
    np.testing.assert_allclose(passed[2]["observation_noise"], noise)


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The points of the runs that were made."""
    made: list[tuple[int, ...]] = []
    monkeypatch.setattr(study, "source_agent", lambda *_: ("agent", None))

    def transfer(*_: object, every: tuple[int, ...], **__: object) -> list[dict[str, float]]:
        made.append(every)
        spent = {"updates": 0, "source_steps": 0, "seconds": 0.0}
        return [{"steps": steps, "return": 1.0, **spent} for steps in (0, *every)]

    monkeypatch.setattr(study, "transfer", transfer)
    return made


def make(folder: Path, *jobs: study.Job) -> None:
    run_jobs(partial(study.run, folder=folder), jobs, folder / "runs", 1, current=study.long_enough)


def test_exact_and_noisy_runs_of_one_folder_are_kept_apart(tmp_path: Path, ran: list[tuple[int, ...]]) -> None:
    make(tmp_path, *(study.Job("double-pendulum", "none", 1, "zero-shot", 0, sensors) for sensors in (0.0, 0.001)))
    for sensors in (0.0, 0.001):
        assert study.collected(tmp_path / "runs", sensors)["sensors"].tolist() == [sensors]


def test_a_run_of_a_smaller_budget_is_not_taken_for_a_longer_one(tmp_path: Path, ran: list[tuple[int, ...]]) -> None:
    for budget in (250, 500, 250, None):
        make(tmp_path, study.Job("double-pendulum", "none", 0, "RPTO-ensemble", 0, budget=budget))
    assert ran == [(250,), (250, 500), study.SHORT]
    assert study.collected(tmp_path / "runs")["steps"].tolist() == [0, *study.SHORT]


def test_the_command_writes_the_table_of_all_runs(
    tmp_path: Path, ran: list[tuple[int, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--runs", str(tmp_path), "--workers", "1", "--tasks", "hopper", "--shifts", "none", "--targets", "0"]
    some = [*arguments, "--methods", "SAC-warm", "zero-shot", "--seeds", "2"]
    assert main(["closed_loop", *some]) == 0
    assert len(ran) == 5, "four runs and an oracle"
    assert main(["closed_loop", *arguments, "--seeds", "0"]) == 0
    rows = read_table(tmp_path / "table.csv")
    assert {row["method"] for row in rows} == {"SAC-warm", "zero-shot", "oracle"}
    assert json.loads((tmp_path / "table.json").read_text())["targets"] == study.fingerprint()
    capsys.readouterr()
    assert main(["closed_loop", "report", str(tmp_path / "table.csv")]) == 0
    assert "SAC-warm" in capsys.readouterr().out
    assert (tmp_path / "table.png").exists()
