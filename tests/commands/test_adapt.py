"""The command adapt: from a log to a report, a corrected simulator and a policy; how it resumes, what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPTO, cli
from sb3_rpto.algorithms.closed_loop import controller
from sb3_rpto.algorithms.normalisation import read_statistics
from sb3_rpto.commands import enjoy
from sb3_rpto.commands.progress import Progress
from sb3_rpto.commands.recordings import digest
from sb3_rpto.effects import LIBRARY
from sb3_rpto.effects.corrected_model_io import load_corrected
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements

ENV = "InvertedPendulum-v5"
FEW = ["--steps", "320", "--set", "source_steps=4", "--set", "gradient_steps=2", "--device", "cpu", "--quiet"]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An agent that knows nothing, and the log of a machine whose hinge is pulled to one side."""
    folder = tmp_path_factory.mktemp("given")
    SAC("MlpPolicy", gym.make(ENV), policy_kwargs={"net_arch": [16]}, seed=0, device="cpu").save(folder / "agent.zip")
    machine = gym.make(ENV, frame_skip=1)
    machine.unwrapped.model.opt.timestep = 0.005  # a log is finer than the commands, as that of a robot
    robot = apply_effects(machine, [LIBRARY["torque_offset"]("hinge", offset=0.5)])
    rng, rows = np.random.default_rng(0), []
    for attempt in range(8):
        robot.reset(seed=attempt)
        state = robot.unwrapped.data
        commands = rng.uniform(-1, 1, (160 // 8, 1)).repeat(8, axis=0)
        for step, command in enumerate(commands):
            shown = state.qpos + 1e-4 * rng.standard_normal(2)
            rows.append([attempt, step * 0.005, *shown, *command])
            robot.step(command)
    columns = ["episode", "time", "qpos.slider", "qpos.hinge", "ctrl.slide"]
    pd.DataFrame(rows, columns=columns).to_csv(folder / "log.csv", index=False)
    return folder


def adapt(given: Path, out: Path, *options: str, agent: str = "agent.zip", env: str = ENV, log: str = "log.csv") -> int:
    found = ["--candidates", "torque_offset", *FEW, *options]
    return cli.main(["adapt", str(given / agent), env, str(given / log), "--out", str(out), *found])


@pytest.mark.slow
def test_a_log_becomes_a_report_a_simulator_and_a_policy(given: Path, tmp_path: Path, capsys) -> None:
    assert adapt(given, tmp_path) == 0
    said = capsys.readouterr().out
    assert said.startswith("explained\n")
    assert said.endswith(f"in the corrected simulator; written: {tmp_path / 'model.zip'}\n")
    names = {
        ".lock",
        "config.json",
        "effects.json",
        "model.xml",
        "model.zip",
        "report.html",
        "report.json",
        "result.json",
    }
    assert {path.name for path in tmp_path.iterdir()} == names
    (pull,) = load_corrected(tmp_path).effects
    assert pull.label == "torque_offset(hinge)"
    assert pull.values == pytest.approx([0.5], rel=0.02)
    rows = json.loads((tmp_path / "result.json").read_text())["rows"]
    assert [row["steps"] for row in rows] == [48, 80, 128, 160, 208, 240, 288, 320]  # at the ends of rounds of 16
    assert all(row["simulated_return"] > 0 for row in rows)  # judged from the first round on
    assert RPTO.load(tmp_path / "model.zip", device="cpu").num_timesteps == 320

    assert adapt(given, tmp_path) == 0
    assert capsys.readouterr().out == f"adapted already: {tmp_path / 'model.zip'}\n"
    assert adapt(given, tmp_path, "--seed", "1") == 2
    assert "holds a run with seed=0" in capsys.readouterr().err
    log = given / "log.csv"
    kept = log.read_text()
    log.write_text(kept.replace("0.005,", "0.006,", 1))
    assert adapt(given, tmp_path) == 2
    assert "holds a run with recordings_sha256=" in capsys.readouterr().err
    log.write_text(kept)


def test_exchanged_headers_are_another_log(given: Path, tmp_path: Path) -> None:
    text = (given / "log.csv").read_text()
    mended = text.replace("qpos.slider", "kept").replace("qpos.hinge", "qpos.slider").replace("kept", "qpos.hinge")
    (tmp_path / "log.csv").write_text(mended)
    logs = [Measurements.from_csv([str(folder / "log.csv")]) for folder in (given, tmp_path, given)]
    first, other, again = map(digest, logs)
    assert first == again != other


@pytest.mark.parametrize("total", [300, 320, 5000])
def test_a_run_ends_with_one_row_and_no_checkpoint_of_its_end(total: int, tmp_path: Path) -> None:
    seen: list[int] = []

    class Folder:
        def save_checkpoint(self, steps: int, write: object) -> None:
            seen.append(steps)

    shown = Progress(Folder(), total, [], quiet=True)  # type: ignore[arg-type]
    shown.model = SimpleNamespace(n_updates=0, loop=SimpleNamespace(simulator_validated=False))  # type: ignore[assignment]
    for steps in range(160, total + 160, 160):
        shown.num_timesteps = min(steps, total)
        shown._on_step()
    shown._on_training_end()
    rows = [row["steps"] for row in shown.rows]
    assert rows == [*seen, total]
    assert len({*rows}) == len(rows)


def test_what_was_traced_is_in_a_checkpoint_at_once(tmp_path: Path) -> None:
    seen: list[int] = []
    folder = SimpleNamespace(save_checkpoint=lambda steps, write: seen.append(steps))
    shown = Progress(folder, 5000, [], quiet=True)  # type: ignore[arg-type]
    for shown.n_calls, shown.num_timesteps in ((1, 10), (2, 20)):
        shown._on_step()
    assert (seen, shown.rows) == ([10], [])


def test_its_folder_is_enjoyed_in_the_corrected_simulator(given: Path, tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(given / "agent.zip", run / "model.zip")
    (run / "config.json").write_text(json.dumps({"command": "adapt", "env": ENV, "source_model": "../agent.zip"}))
    pull = LIBRARY["torque_offset"]("hinge", offset=5.0)
    (run / "effects.json").write_text(json.dumps([pull.to_json()]))
    assert cli.main(["enjoy", str(run), "--episodes", "1", "--seed", "3"]) == 0
    corrected = capsys.readouterr().out.splitlines()[0]
    policy, env = SAC.load(given / "agent.zip"), apply_effects(gym.make(ENV), [pull])
    assert corrected == f"episode 1: return {enjoy._episode(env, policy, 3, deterministic=True):.1f}"
    assert cli.main(["enjoy", str(run), ENV, "--episodes", "1", "--seed", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[0] != corrected


@pytest.mark.slow
def test_a_simulated_log_is_traced_as_one_where_that_is_said(given: Path, tmp_path: Path, monkeypatch) -> None:
    found = []
    monkeypatch.setattr(controller, "trace", lambda env, data, *args, **kwargs: found.append(data) or 1 / 0)
    for options in ([], ["--simulated"]):
        with pytest.raises(ZeroDivisionError):
            adapt(given, tmp_path, *options)
    assert [data.simulated for data in found] == [False, True]
    assert json.loads((tmp_path / "config.json").read_text())["simulated"] is True


@pytest.mark.slow
def test_what_is_known_is_fitted_and_not_found_again(given: Path, tmp_path: Path) -> None:
    mass = {"kind": "declared", "on": "", "values": {"pole.mass": 5.5}}
    known = [mass, LIBRARY["torque_offset"]("hinge", offset=0.3).to_json()]
    (tmp_path / "known.json").write_text(json.dumps(known))
    assert adapt(given, tmp_path / "out", "--known", str(tmp_path / "known.json"), "--declare", "pole.mass=4:6") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["verdict"], report["effects"]) == ("complete", [])
    fitted = {entry["label"]: entry["parameters"] for entry in report["declared"]}
    assert fitted["torque_offset(hinge)"]["offset"]["value"] == pytest.approx(0.5, rel=0.02)
    assert fitted.keys() == {"pole.mass", "torque_offset(hinge)"}
    loop = RPTO.load(tmp_path / "out" / "model.zip", device="cpu").loop
    assert loop.declared == ("pole.mass", "pole.mass=4:6")  # the bounds are those that the user gave


@pytest.mark.slow
@pytest.mark.parametrize("rows", [0, 3])
def test_a_killed_run_goes_on_as_if_it_had_not_been(given: Path, tmp_path: Path, monkeypatch, rows: int) -> None:
    assert adapt(given, tmp_path / "whole") == 0
    add, traces = Progress._add_row, []

    def interrupted(self: Progress) -> None:
        if len(self.rows) == rows:
            raise KeyboardInterrupt
        add(self)

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "_add_row", interrupted)
        assert adapt(given, tmp_path / "killed") == 130
    assert (tmp_path / "killed" / "report.html").exists()
    monkeypatch.setattr(controller, "trace", lambda *args, **kwargs: traces.append(1) or 1 / 0)
    assert adapt(given, tmp_path / "killed") == 0
    assert not traces
    one, other = (RPTO.load(tmp_path / name / "model.zip", device="cpu").policy for name in ("whole", "killed"))
    assert all(th.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    seen = [json.loads((tmp_path / name / "result.json").read_text())["rows"] for name in ("whole", "killed")]
    whole, killed = ([{**row, "seconds": 0} for row in rows] for rows in seen)
    assert whole == killed


@pytest.mark.parametrize(
    ("passed", "options", "said"),
    [
        ({"agent": "absent.zip"}, [], "ZIP: there is no file"),
        ({"env": "InvertedPendulum-v55"}, [], "did you mean 'InvertedPendulum-v5'"),
        ({"log": "absent.csv"}, [], "no file matches"),
        ({}, ["--candidates", ""], "--candidates is empty"),
        ({}, ["--candidates", "torque_ofset"], "did you mean 'torque_offset'"),
        ({}, ["--declare", "hinge.dampng"], "declared: 'hinge.dampng'"),
        ({}, ["--set", "target_env=x"], "--set target_env: there is no such argument"),
        ({}, ["--steps", "0"], "--steps is 0"),
        ({}, ["--known", "absent.json"], "--known: there is no file"),
    ],
)
def test_bad_input_is_told_before_the_trace(given: Path, tmp_path: Path, capsys, passed, options, said) -> None:
    assert adapt(given, tmp_path / "out", *options, **passed) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_simulator_that_could_not_be_written_is_told_before_the_trace(given: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "model.xml").write_text("<mujoco/>")
    assert adapt(given, tmp_path) == 2
    assert "error: --out: " in (said := capsys.readouterr().err)
    assert "would be overwritten; save elsewhere" in said
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]


@pytest.mark.slow
def test_an_agent_that_saw_normalised_observations_is_adapted_by_its_statistics(given: Path, tmp_path: Path, capsys):
    agent, env = tmp_path / "agent", VecNormalize(DummyVecEnv([lambda: gym.make(ENV)]))
    agent.mkdir()
    env.obs_rms.mean[:], env.obs_rms.var[:], env.obs_rms.count = 0.5, 0.04, 1e6
    SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu").learn(20).save(agent / "agent.zip")
    env.save(str(agent / "vecnormalize.pkl"))
    shutil.copy(given / "log.csv", agent / "log.csv")
    out = tmp_path / "out"
    assert adapt(agent, out) == 0
    assert f"ZIP sees observations normalised by {agent / 'vecnormalize.pkl'}" in capsys.readouterr().err
    statistics = read_statistics(out / "vecnormalize.pkl")
    np.testing.assert_allclose(statistics.obs_rms.mean, 0.5, atol=0.01)
    assert 1e6 < statistics.obs_rms.count < 1.1e6
    assert cli.main(["enjoy", str(out), "--episodes", "1"]) == 0
    assert "MODEL sees observations normalised by" in capsys.readouterr().err
