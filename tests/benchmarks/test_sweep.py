"""Many runs: side by side, resumed after a kill, each with all that made it."""

from __future__ import annotations

import inspect
import json
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from tiny_suite import PLACE, SUITE, returns, run_here, stored

from benchmarks import RESULTS
from benchmarks.__main__ import main
from benchmarks.provenance import constructor_arguments
from benchmarks.runner import read_table
from benchmarks.transfer import sources, sweep, tables
from benchmarks.transfer.plan import Job, Place, Variant, jobs
from benchmarks.transfer.suites import SMOKE, SUITES
from sb3_rpto import RPTO
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.buffers import load_transitions

ROOT = Path(__file__).parents[2]
make_source, make_target = sweep.worlds("ContinuousCartPole", "limb-x2")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite that was run in this process, its source agent and oracle included."""
    return run_here(tmp_path_factory.mktemp("suite"))


@pytest.fixture(autouse=True)
def _sources(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Agent and oracle are found."""
    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(made / "sources"))


@pytest.fixture
def worked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the runs that were made in this process."""
    names: list[str] = []
    original = sweep.transfer_once

    def counted(job: Job, **given: Any) -> dict[str, Any]:
        names.append(job.name)
        return original(job, **given)

    monkeypatch.setattr(sweep, "transfer_once", counted)
    return names


# --- resuming -------------------------------------------------------------------------------------------------------


def test_finished_runs_are_not_repeated_and_torn_failed_or_other_ones_are(tmp_path: Path, worked: list[str]) -> None:
    first = sweep.run(SUITE, tmp_path, workers=1)
    assert sorted(worked) == sorted(job.name for job in jobs(SUITE))
    files = [tmp_path / "runs" / f"{job.name}.json" for job in jobs(SUITE)]
    whole = files[0].read_text()
    files[0].write_text(whole[: len(whole) // 2])
    files[1].write_text(json.dumps({**json.loads(files[1].read_text()), "error": "Traceback\nMemoryError"}))
    worked.clear()
    again = sweep.run(SUITE, tmp_path, workers=1)
    assert worked == [files[0].stem, files[1].stem]
    assert returns(again) == returns(first)

    worked.clear()
    sweep.run(SUITE, tmp_path, workers=1, seeds=1)
    assert worked == []
    assert json.loads((tmp_path / "manifest.json").read_text())["planned"] == len(jobs(SUITE))
    longer = replace(SUITE, places=(replace(PLACE, points=(10, 30), oracle_steps=PLACE.oracle_steps),))
    sweep.run(longer, tmp_path, workers=1, only="sac-warm_1")
    assert worked == ["ContinuousCartPole_limb-x2_sac-warm_1"]
    made_before = {file.stem for file in (tmp_path / "runs").glob("*.json")} - {*worked}
    assert set(tables.load(tmp_path).left_out) == made_before  # the suite had other points then


@pytest.mark.parametrize("suite", ["quick", "ablation", "further"])
def test_the_committed_runs_are_those_that_their_suite_plans(suite: str) -> None:
    found = {result["name"]: result["job"] for result in read_table(RESULTS / f"transfer_{suite}.csv")}
    planned = {job.name: job.to_json() for job in jobs(SUITES[suite])}
    assert found
    assert {name: planned.get(name) for name in found} == found, "they would be made again"


def test_a_run_with_settings_that_sac_writes_into_is_not_repeated(tmp_path: Path, worked: list[str]) -> None:
    """It notes in the policy_kwargs that it is given whether it explores by gSDE."""
    for _ in range(2):  # planned anew, as another process would
        sac = Variant("sac", "sac", settings={"policy_kwargs": {"net_arch": [8]}}, seeds=1)
        sweep.run(replace(SUITE, places=(replace(PLACE, variants=(sac,)),)), tmp_path, workers=1)
        assert len(worked) == 1
        assert json.loads((tmp_path / "runs" / f"{worked[0]}.json").read_text())["error"] is None


def test_a_run_from_another_source_agent_is_made_again(
    made: Path, tmp_path: Path, worked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(made, tmp_path / "suite")
    name = jobs(SUITE)[0].name
    sweep.run(SUITE, tmp_path / "suite", workers=1, only=name)
    assert worked == []
    monkeypatch.setattr(sweep, "digest", lambda path: "another")
    sweep.run(SUITE, tmp_path / "suite", workers=1, only=name)
    assert worked == [name]


@pytest.mark.slow
def test_a_killed_sweep_goes_on_where_it_was(tmp_path: Path, worked: list[str], made: Path) -> None:
    """SIGKILL, when the first run is done and the second is under way."""
    program = f"""
        import os, signal, sys
        sys.path[:0] = [{str(Path(__file__).parent)!r}]
        from benchmarks.transfer import sweep
        from tiny_suite import SUITE
        original, begun = sweep.transfer_once, []
        def dying(job, **given):
            begun.append(job)
            if len(begun) == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(job, **given)
        sweep.transfer_once = dying
        sweep.run(SUITE, {str(tmp_path)!r}, workers=1)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    first = jobs(SUITE)[0].name
    assert [file.name for file in (tmp_path / "runs").iterdir()] == [f"{first}.json"]
    written = (tmp_path / "runs" / f"{first}.json").stat().st_mtime_ns
    results = sweep.run(SUITE, tmp_path, workers=1)
    assert worked == [job.name for job in jobs(SUITE)[1:]]
    assert (tmp_path / "runs" / f"{first}.json").stat().st_mtime_ns == written
    assert returns(results) == stored(made)


def test_a_failed_run_is_kept_said_and_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = replace(PLACE, variants=(*PLACE.variants, Variant("broken", "slbo", {"iterations": 0}, seeds=1)))
    monkeypatch.setitem(SUITES, "smoke", replace(SUITE, places=(broken,)))
    assert main(["transfer", "--suite", "smoke", "--runs", str(tmp_path), "--workers", "1"]) == 1
    said = capsys.readouterr()
    assert "4 of 5 runs are done" in said.out
    assert "_broken_0 failed: ValueError: iterations must be a positive integer" in said.err
    assert "4 of 5 runs are done" in (tmp_path / "table.md").read_text()
    result = json.loads((tmp_path / "runs" / "ContinuousCartPole_limb-x2_broken_0.json").read_text())
    assert "Traceback" in result["error"]
    assert result["rows"] == []


def test_agents_and_oracles_are_said_before_the_first_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep.run(SUITE, tmp_path, workers=1, only="zero-shot_0")
    assert capsys.readouterr().err.splitlines()[:4] == [
        "[0/1] source agents: found, or trained now and kept",
        "[1/1] source agent of ContinuousCartPole is there",
        "[0/1] oracles: found, or trained now and kept",
        "[1/1] oracle of ContinuousCartPole_limb-x2 is there",
    ]


# --- what a result holds --------------------------------------------------------------------------------------------


def test_a_result_says_all_that_made_it(made: Path) -> None:
    file = made / "runs" / "ContinuousCartPole_limb-x2_sac-warm_1.json"
    result = json.loads(file.read_text(), parse_constant=pytest.fail)
    arguments = set(inspect.signature(SAC.__init__).parameters) - {"self", "env", "_init_setup_model"}
    assert set(result["arguments"]) == arguments
    assert result["algorithm"] == "SAC"
    assert (result["arguments"]["seed"], result["arguments"]["learning_starts"]) == (1, 0)
    assert result["arguments"]["policy_kwargs"]["net_arch"] == [16]
    assert result["job"] == next(job for job in jobs(SUITE) if job.name == file.stem).to_json()
    assert result["target"]["factors"] == {"pole_length": 2.0}
    assert result["source"]["sha256"] == sources.digest(made / "sources" / f"{PLACE.agent}.zip")
    assert result["versions"]["torch"]
    assert {"commit", "python", "machine"} <= set(result)
    assert result["seconds"] >= result["rows"][-1]["seconds"] > 0
    assert [row["steps"] for row in result["rows"]] == [0, 20, 40]


def test_no_file_names_a_place_on_this_machine(made: Path) -> None:
    for file in (*made.glob("*.json"), *made.glob("runs/*.json"), *made.glob("sources/*.json")):
        for path in (made, Path.home(), ROOT):
            assert str(path) not in file.read_text()


def test_the_manifest_is_what_a_report_needs(made: Path) -> None:
    manifest = json.loads((made / "manifest.json").read_text())
    assert (manifest["suite"], manifest["planned"], manifest["labels"]) == ("tiny", 4, ["zero-shot", "sac-warm"])
    reference = manifest["references"]["ContinuousCartPole_limb-x2"]
    assert reference["oracle"] >= reference["zero_shot"]
    assert reference["steps"] == PLACE.oracle_steps
    assert main(["transfer", "report", str(made)]) == 0


def test_all_arguments_of_an_algorithm_are_read_off_it() -> None:
    env = partial(gym.make, "Pendulum-v1")
    model = RPTO("MlpPolicy", env(), target_env=gym.make("Pendulum-v1", g=12.0), gradient_steps=3, seed=4)
    found = constructor_arguments(model)
    arguments = set(inspect.signature(RPTO.__init__).parameters) - {"self", "env", "target_env", "target_data"}
    assert set(found) == arguments - {"_init_setup_model"}
    assert (found["dynamics"], found["gradient_steps"], found["seed"]) == ("ensemble", 3, 4)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert {"iterations", "trpo_kwargs", "gamma"} <= set(constructor_arguments(SLBO("MlpPolicy", env())))


# --- source agents and oracles --------------------------------------------------------------------------------------


def test_agents_are_trained_once_with_their_transitions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(tmp_path / "none"))
    small = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 30}
    agent, data = sources.source_agent("a", make_source, 60, tmp_path / "here", **small)
    assert data is not None
    assert len(load_transitions(data)["rewards"]) == 60
    assert SAC.load(agent).policy_kwargs["net_arch"] == [16]
    assert sorted(file.name for file in (tmp_path / "here").iterdir()) == ["a.zip", "a_transitions.npz"]

    monkeypatch.setattr(sources, "_train", lambda *_: pytest.fail("it is there"))
    assert sources.source_agent("a", make_source, 60, tmp_path / "here") == (agent, data)
    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(tmp_path / "here"))
    assert sources.source_agent("a", make_source, 60, tmp_path / "elsewhere") == (agent, data)
    Path(data).unlink()
    assert sources.source_agent("a", make_source, 60, tmp_path / "here") == (agent, None)


def test_the_best_policy_of_a_training_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations that say 1, 3, 2: what is kept is the policy of the second."""
    kept: list[np.ndarray] = []
    said = iter([1.0, 3.0, 2.0])

    def judge(model: SAC, *_: Any, **__: Any) -> tuple[list[float], list[int]]:
        kept.append(next(model.policy.parameters()).detach().numpy().copy())
        return [next(said)], [1]

    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(tmp_path / "none"))
    monkeypatch.setattr(sources, "CHECKS", 3)
    monkeypatch.setattr("stable_baselines3.common.callbacks.evaluate_policy", judge)
    agent, _ = sources.source_agent("a", make_source, 60, tmp_path, learning_starts=5)
    found = next(SAC.load(agent).policy.parameters()).detach().numpy()
    np.testing.assert_array_equal(found, kept[1])
    assert not np.array_equal(kept[1], kept[2])


def test_an_oracle_is_the_best_of_a_long_run_and_is_kept(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, int]] = []

    def transfer(method: str, agent: str, *args: Any, **_: Any) -> list[dict[str, float]]:
        calls.append((method, args[-1]))
        return [{"return": value} for value in (3.0, 9.0, 7.0)]

    monkeypatch.setattr(sources, "transfer", transfer)
    agent = str(made / "sources" / f"{PLACE.agent}.zip")
    measure: Callable[[int], sources.Reference]
    measure = partial(lambda steps: sources.reference("x", agent, make_source, make_target, steps, tmp_path))
    first = measure(500)
    assert (first["zero_shot"], first["oracle"], first["steps"]) == (3.0, 9.0, 500)
    assert measure(500) == first
    assert calls == [("oracle", 500)]
    assert measure(700)["steps"] == 700  # another budget is another oracle
    assert len(calls) == 2
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "x_oracle.json").write_text(json.dumps({**first, "agent": "another"}))
    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(tmp_path / "given"))
    assert measure(700)["steps"] == 700
    assert len(calls) == 2, "one that is given and does not fit hides none that is kept"


# --- the command ----------------------------------------------------------------------------------------------------


def test_list_prints_runs_and_costs_and_starts_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["--suite", "quick", "--only", "InvertedDouble.*rpto", "--seeds", "2", "--workers", "2", "--list"]
    assert main(["transfer", *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 * 3 + 1
    assert "min on 2 cores" in lines[-1]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_holds_one_suite(made: Path) -> None:
    with pytest.raises(ValueError, match="holds the suite 'tiny'"):
        sweep.run(SMOKE, made, workers=1)


@pytest.mark.parametrize(("argument", "value"), [("workers", 0), ("backend", "dask"), ("only", "absent")])
def test_bad_arguments_are_refused(argument: str, value: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{argument} is|matches"):
        sweep.run(SUITE, tmp_path, **{argument: value})


def test_a_place_has_agents_for_its_task_alone(made: Path, tmp_path: Path) -> None:
    """``--only`` trains no agent and no oracle that its runs do not need."""
    other = Place("InvertedDoublePendulum", ("friction-x20",), PLACE.variants, (20,), "absent", source_steps=10**9)
    both = replace(SUITE, places=(PLACE, other))
    assert len(sweep.run(both, tmp_path, workers=1, only="CartPole.*zero-shot_0")) == 1
