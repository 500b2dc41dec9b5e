"""The examples that are short enough to run."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from conftest import coarsely
from stable_baselines3 import SAC

from sb3_rpto.algorithms.closed_loop import controller
from sb3_rpto.effects.corrected_model_io import load_corrected
from sb3_rpto.sysid import Measurements

EXAMPLES = Path(__file__).parents[1] / "examples"
STARTS = {"quickstart_pendulum", "close_the_loop", "robot_log_to_policy", "trace_robot", "transfer_double_pendulum"}
SMALL = ["--episodes", "6", "--duration", "2.5"]


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def trace_robot(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return load("trace_robot", monkeypatch)


def run(module: ModuleType, monkeypatch: pytest.MonkeyPatch, out: Path, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["trace_robot.py", "--out", str(out), *SMALL, *arguments])
    module.main()


@pytest.mark.slow
def test_trace_robot_names_what_is_in_the_robot(trace_robot, monkeypatch, tmp_path, capsys):
    label, effect, _ = trace_robot.robot(seed=0)[3].open()
    assert label == "actuator_lag(motor)"
    look = trace_robot.Envelope.open
    opened_after = []

    def watched(envelope):
        opened_after.append(sorted(p.name for p in tmp_path.iterdir()))
        return look(envelope)

    monkeypatch.setattr(trace_robot.Envelope, "open", watched)
    run(trace_robot, monkeypatch, tmp_path, "--candidates", "actuator_lag,torque_offset")
    assert opened_after == [["effects.json", "log", "model.xml", "report.html", "report.json"]]
    found = json.loads((tmp_path / "report.json").read_text())
    assert [e["label"] for e in found["effects"]] == [label]
    assert found["effects"][0]["parameters"]["time_constant"]["value"] == pytest.approx(effect.values[0], rel=0.25)
    assert [e.label for e in load_corrected(tmp_path).effects if e.kind != "declared"] == [label]
    out = capsys.readouterr().out
    assert out.index("verdict:") < out.index("the envelope says: actuator_lag(motor)") < out.index("named itself")
    assert "MISSED" not in out


def test_trace_robot_writes_logs_that_tell_no_more_than_a_robots_would(trace_robot, tmp_path):
    data, xml, declared, _ = trace_robot.robot(seed=3, episodes=2, duration=0.5)
    trace_robot.write_log(data, tmp_path)
    files = sorted(tmp_path.iterdir())
    assert [f.name for f in files] == ["run00.csv", "run01.csv"]
    assert {f.read_text().splitlines()[0] for f in files} == {"time,qpos.hinge,qvel.hinge,ctrl.motor"}
    read = Measurements.from_csv(tmp_path / "*.csv")
    np.testing.assert_allclose(read.episodes[1].qpos, data.episodes[1].qpos, atol=1e-6)
    assert trace_robot.robot(seed=4, episodes=2, duration=0.5)[1:3] == (xml, declared)


@pytest.mark.slow
def test_trace_robot_draws_by_seed(trace_robot):
    def inside(seed: int, library: bool) -> tuple[str, bool]:
        label, effect, _ = trace_robot.robot(seed, 1, 0.1, library)[3].open()
        return label, effect is not None

    robots = [inside(seed, True) for seed in range(40)]
    assert robots == [inside(seed, True) for seed in range(40)]
    assert len(set(robots)) > 12
    assert all(known for _, known in robots)
    assert not any(inside(seed, False)[1] for seed in range(5))


@pytest.mark.slow
def test_robot_log_to_policy_goes_from_a_log_to_a_policy(monkeypatch, tmp_path, capsys):
    example = load("robot_log_to_policy", monkeypatch)
    monkeypatch.setattr(sys, "argv", ["robot_log_to_policy.py", "--quick", "--out", str(tmp_path)])
    with coarsely(few_windows=12):
        example.main()
    header = "time,qpos.slider,qpos.hinge,qpos.hinge2,qvel.slider,qvel.hinge,qvel.hinge2,ctrl.slide"
    assert {file.read_text().splitlines()[0] for file in (tmp_path / "log").iterdir()} == {header}
    assert len(list((tmp_path / "log").iterdir())) == 8
    length, secret = example.Robot(0)._inside
    found = {e.label: e.values for e in load_corrected(tmp_path).effects}
    assert found["pole.length"] == pytest.approx(length.values, rel=0.03)
    assert found[secret.label] == pytest.approx(secret.values, rel=0.25)
    assert SAC.load(tmp_path / "sac.zip", device="cpu").observation_space.shape == (9,)
    out = capsys.readouterr().out
    assert out.index("verdict:") < out.index("policy of the corrected simulator") < out.index("in the robot:")


def test_robot_log_to_policy_draws_by_seed(monkeypatch):
    robot = load("robot_log_to_policy", monkeypatch).Robot
    drawn = [robot(seed).truth() for seed in range(12)]
    assert drawn == [robot(seed).truth() for seed in range(12)]
    assert len(set(drawn)) == 12
    assert len({robot(seed)._inside[1].label for seed in range(12)}) == 3


@pytest.mark.slow
def test_close_the_loop_names_what_is_in_the_target(monkeypatch, tmp_path, capsys):
    transfer = load("transfer_double_pendulum", monkeypatch)
    example = load("close_the_loop", monkeypatch)
    small = {"policy_kwargs": {"net_arch": [16]}, "batch_size": 16, "buffer_size": 1_000, "learning_starts": 300}
    agent = SAC("MlpPolicy", transfer.source(), seed=0, device="cpu", **small).learn(300)
    agent.save(tmp_path / "source_0.zip")
    agent.save_replay_buffer(tmp_path / "source_0_data.pkl")
    trace = controller.trace
    monkeypatch.setattr(controller, "trace", lambda *a, **k: trace(*a, **{**k, "candidates": ["coulomb_friction"]}))
    few = ["--steps", "202", "--retrain-steps", "25"]
    monkeypatch.setattr(sys, "argv", ["close_the_loop.py", *few, "--out", str(tmp_path)])
    example.main()
    true = {effect.label: effect.values for effect in example.unknown(0)}
    found = {effect.label: effect.values for effect in load_corrected(tmp_path).effects}
    assert set(found) == set(true)
    assert all(found[label] == pytest.approx(true[label], rel=0.01) for label in true)
    out = capsys.readouterr().out
    assert out.index("verdict:") < out.index("what the simulator did not know") < out.index("return, zero-shot")
    assert "not there" not in out
    curves = pd.read_csv(tmp_path / "closed_loop_0_0.csv")
    last = curves.groupby("method").last()
    assert last.steps.to_dict() == {"RPTO, loop closed": 202, "RPTO, loop open": 202, "SAC, fine-tuned": 202}
    assert last["return"].notna().all()
    before, after = last.source_error, last.model_error
    assert after["RPTO, loop closed"] < 1e-3 < 0.01 < after["RPTO, loop open"] < before["RPTO, loop open"]
    assert (tmp_path / "closed_loop.png").exists()


def test_examples_are_those_that_a_user_would_start_from():
    assert {path.stem for path in EXAMPLES.iterdir() if path.suffix} == STARTS


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_examples_say_how_they_are_run(name):
    assert f"python examples/{name}" in (EXAMPLES / name).read_text()
