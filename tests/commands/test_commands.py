"""The commands train, transfer, plot and enjoy: what they write, how they resume, what they say of wrong input."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_pkl

from sb3_rpto import RPO, RPTO, cli
from sb3_rpto.algorithms.normalisation import statistics_of
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.commands import enjoy, options, video
from sb3_rpto.commands.plot import draw, read_rows
from sb3_rpto.commands.policies import load_policy
from sb3_rpto.commands.runs import RunFolder, SavedCurve
from sb3_rpto.effects.corrected_model_io import load_corrected
from sb3_rpto.evaluation.learning_curve import evaluate
from sb3_rpto.evaluation.statistics import summarise

SOURCE, TARGET = "rpto/ContinuousCartPole-v0", "rpto/ContinuousCartPole-limb-x2-v0"
SMALL_SAC = ["--set", "policy_kwargs={net_arch: [16]}", "--set", "learning_starts=20"]
JUDGED = ["--every", "20", "--episodes", "2", "--quiet"]
FEW = ["--set", "source_steps=2", "--set", "gradient_steps=1"]
PHYSICAL = ["--set", "dynamics=physical", "--set", "declared=[pole_length]"]
STAGES = ["iterations=1", "policy_updates=1", "model_steps=2", "rollout_samples=20", "rollout_length=10"]
SETTINGS = {
    **{"zero-shot": [], "sac": SMALL_SAC, "sac-warm": [], "sac-mixed": [], "trpo-warm": []},
    **{"rpo": FEW, "rto": [*FEW, *PHYSICAL], "rpto": [*FEW, *PHYSICAL]},
    "sysid-retrain": ["--set", "declared=[pole_length]", "--set", "max_steps=2", "--set", "retrain_steps=20"],
    "slbo": [text for stage in [*STAGES, "model_train_freq=20"] for text in ("--set", stage)],
}


def train(out: Path, *options: str) -> int:
    return cli.main(["train", "ContinuousCartPole", "--out", str(out), "--steps", "60", *JUDGED, *SMALL_SAC, *options])


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a source agent, hardly trained."""
    folder = tmp_path_factory.mktemp("agent")
    assert train(folder, "--device", "cpu") == 0
    return folder


def transfer(agent: Path, out: Path, method: str, *options: str, target: str = TARGET) -> int:
    data = ["--source-data", str(agent / "replay_buffer.pkl")]
    given = ["transfer", str(agent / "model.zip"), target, "--method", method, *data, "--out", str(out)]
    return cli.main([*given, "--steps", "60", *JUDGED, *SETTINGS[method], *options])


def rows(out: Path) -> list[dict]:
    """The learning curve, without what differs from run to run."""
    found = json.loads((out / "result.json").read_text())["rows"]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in found]


def interrupt_at(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kill the run at an evaluation."""
    evaluate = SavedCurve.evaluate

    def interrupted(self: SavedCurve, model: SAC, at: int) -> None:
        if at == steps:
            raise KeyboardInterrupt
        evaluate(self, model, at)

    monkeypatch.setattr(SavedCurve, "evaluate", interrupted)


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr."""
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("sb3-rpto: error: ")
    return line


# ---------------------------------------------------------------------- train


def test_train_writes_agent_data_and_result(agent: Path) -> None:
    assert sorted(path.name for path in agent.iterdir()) == [
        *(".lock", "config.json", "model.zip", "replay_buffer.pkl", "result.json")
    ]
    model = SAC.load(agent / "model.zip", device="cpu")
    assert (model.num_timesteps, model.gamma) == (60, 0.98)  # gamma is of hyperparams/zoo/sac.yml
    assert load_from_pkl(agent / "replay_buffer.pkl").size() == 60
    assert [(row["method"], row["steps"]) for row in rows(agent)] == [("sac", n) for n in (0, 20, 40, 60)]
    result = json.loads((agent / "result.json").read_text())
    assert result["config"]["target"] == SOURCE
    assert result["config"]["settings"]["learning_starts"] == 20


def test_a_killed_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(60, patch)
        assert train(tmp_path) == 130
    assert not (tmp_path / "result.json").exists()
    assert train(tmp_path) == 0
    assert [row["steps"] for row in rows(tmp_path)] == [0, 20, 40, 60]
    assert SAC.load(tmp_path / "model.zip", device="cpu").num_timesteps == 60
    assert load_from_pkl(tmp_path / "replay_buffer.pkl").size() == 60
    assert not (tmp_path / "checkpoints").exists()


def test_training_ends_at_a_return_that_suffices(tmp_path: Path) -> None:
    assert train(tmp_path, "--until", "1") == 0
    assert [row["steps"] for row in rows(tmp_path)] == [0, 20]


def test_a_finished_run_is_not_repeated_and_not_overwritten(agent: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (agent / "model.zip").stat().st_mtime_ns
    assert train(agent) == 0
    assert "trained already" in capsys.readouterr().out
    assert train(agent, "--seed", "1") == 2
    assert "holds a run with seed=0, not 1" in error(capsys)
    assert (agent / "model.zip").stat().st_mtime_ns == before


# ---------------------------------------------------------------------- transfer


@pytest.mark.parametrize(
    "method", [pytest.param(m, marks=pytest.mark.slow if m in ("slbo", "trpo-warm") else ()) for m in SETTINGS]
)
def test_every_kind_of_method_leaves_model_and_result(method: str, agent: Path, tmp_path: Path) -> None:
    assert transfer(agent, tmp_path, method) == 0
    steps = [row["steps"] for row in rows(tmp_path)]
    assert steps == ([0] if method == "zero-shot" else [0, 20, 40, 60])
    observation = gym.make(TARGET).reset(seed=0)[0]
    loaded = load_policy(tmp_path / "model.zip", "MODEL").predict(observation, deterministic=True)[0]
    classes = {"rpo": RPO, "rpto": RPTO, "slbo": SLBO}
    if method in classes:
        model = classes[method].load(tmp_path / "model.zip", device="cpu")
        assert model.num_timesteps == sum(model.target_spent.values()) == 60
        np.testing.assert_array_equal(loaded, model.predict(observation, deterministic=True)[0])
    assert loaded.shape == (1,)


@pytest.mark.parametrize(
    "method",
    ["rpo", "rpto", "sac-mixed", *(pytest.param(name, marks=pytest.mark.slow) for name in ("slbo", "trpo-warm"))],
)
def test_a_killed_transfer_goes_on(method: str, agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed, unbroken = tmp_path / "killed", tmp_path / "unbroken"
    with monkeypatch.context() as patch:
        interrupt_at(60, patch)
        assert transfer(agent, killed, method) == 130
    assert list((killed / "checkpoints").iterdir())
    assert transfer(agent, killed, method) == 0
    assert [row["steps"] for row in rows(killed)] == [0, 20, 40, 60]
    if method in ("rpo", "rpto"):  # bit for bit, as our checkpoints are
        assert transfer(agent, unbroken, method) == 0
        assert rows(killed) == rows(unbroken)
        states = [load_policy(out / "model.zip", "MODEL").state_dict() for out in (killed, unbroken)]
        assert all(th.equal(value, states[1][name]) for name, value in states[0].items())


@pytest.mark.parametrize(("told", "lines"), [((), 1), (PHYSICAL, 0), (("--quiet",), 0)])
def test_that_networks_learn_the_source_first_is_said(
    told: Sequence[str], lines: int, agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = "dynamics_kwargs={hidden: [8], n_members: 2, n_elites: 1, max_steps: 5}"
    given = ["transfer", str(agent / "model.zip"), TARGET, "--method", "rpto", "--steps", "20", *FEW, *JUDGED[:-1]]
    networks = [] if told is PHYSICAL else ["--set", "dynamics=ensemble", "--set", network]
    assert cli.main([*given, *networks, *told, "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert ["networks learn" in line for line in said[:2]].count(True) == lines


def test_any_shift_is_a_target(agent: Path, tmp_path: Path) -> None:
    assert transfer(agent, tmp_path, "zero-shot", target="rpto/ContinuousCartPole-limb-x3-v0") == 0
    longer = rows(tmp_path)[0]["return"]
    assert transfer(agent, tmp_path / "other", "zero-shot") == 0
    assert rows(tmp_path / "other")[0]["return"] != longer


def test_the_budget_is_that_of_the_task(agent: Path, tmp_path: Path) -> None:
    given = ["transfer", str(agent / "model.zip"), TARGET, "--method", "zero-shot", "--episodes", "1", "--quiet"]
    assert cli.main([*given, "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "config.json").read_text())["steps"] == 1_000


@pytest.mark.parametrize("method", ["sac-warm", "rpto"])
def test_the_last_return_is_that_of_the_model_that_is_written(method: str, agent: Path, tmp_path: Path) -> None:
    """Updates as large as these change what a policy earns; the last of them come after the last target step."""
    assert transfer(agent, tmp_path, method, "--set", "learning_rate=0.1") == 0
    written = load_policy(tmp_path / "model.zip", "ZIP")
    worlds = make_vec_env(partial(gym.make, TARGET), n_envs=2)
    assert evaluate(written, worlds, 2, seed=0) == rows(tmp_path)[-1]["return"]


@pytest.mark.parametrize("train_freq", ["25", "[1, episode]"])
def test_a_training_of_whole_rollouts_ends_with_the_return_of_its_model(train_freq: str, tmp_path: Path) -> None:
    rollouts = ["--set", f"train_freq={train_freq}", "--set", "gradient_steps=20", "--set", "learning_rate=0.1"]
    assert train(tmp_path, *rollouts) == 0
    written = SAC.load(tmp_path / "model.zip", device="cpu")
    last = rows(tmp_path)[-1]
    assert last["steps"] == written.num_timesteps >= 60
    assert last["updates"] == written._n_updates
    worlds = make_vec_env(partial(gym.make, SOURCE), n_envs=2)
    assert evaluate(written, worlds, 2, seed=0) == last["return"]


@pytest.mark.slow
def test_a_closed_loop_leaves_its_report_and_the_corrected_simulator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = {"net_arch": [16]}
    SAC("MlpPolicy", gym.make("InvertedDoublePendulum-v5"), policy_kwargs=small, seed=0, device="cpu").save(
        tmp_path / "agent.zip"
    )
    closed = [
        "dynamics=physical",
        "close_loop=true",
        "effects=[link_length]",
        "retrain_steps=16",
        "source_steps=1",
        "gradient_steps=1",
    ]
    given = [str(tmp_path / "agent.zip"), "rpto/InvertedDoublePendulum-limb-x2-v0", "--steps", "200", "--every", "100"]
    settings = [text for setting in closed for text in ("--set", setting)]
    out = tmp_path / "run"
    assert cli.main(["transfer", *given, *settings, "--episodes", "2", "--device", "cpu", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"200 steps: explained, link_length(pole2) named; written: {out / 'report.html'}" in said.out
    assert "predicting the test runs" in said.err
    assert "learning in the corrected simulator: 1" in said.err
    (found,) = json.loads((out / "report.json").read_text())["effects"]
    assert found["parameters"]["change"]["value"] == pytest.approx(1.0, abs=1e-3)
    assert [effect.label for effect in load_corrected(out).effects] == ["link_length(pole2)"]


def test_a_checkpoint_is_replaced_as_a_whole(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path, {"command": "train", "a": 1})
    run.save_checkpoint(1, lambda folder: (folder / "model.zip").write_text("first") and None)

    def killed(folder: Path) -> None:
        (folder / "model.zip").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run.save_checkpoint(2, killed)
    assert (run.newest_checkpoint() / "model.zip").read_text() == "first"

    def full(folder: Path) -> None:
        assert not list(folder.parent.glob(".0000000002.*"))  # what was left takes no room
        (folder / "model.zip").write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"checkpoints: the checkpoint of step 3 cannot be written: .*No space left"):
        run.save_checkpoint(3, full)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["0000000001"]
    run.save_checkpoint(3, lambda folder: (folder / "model.zip").write_text("third") and None)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["0000000003"]
    with pytest.raises(ValueError, match="a=1, not 2"):
        RunFolder.open(tmp_path, {"command": "train", "a": 2})


# ---------------------------------------------------------------------- plot


def test_plot_draws_results_of_all_commands(agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="the extra 'experiments' is not installed")
    of_benchmark = {
        "job": {"task": "ContinuousCartPole", "label": "rpto-physical", "seed": 1},
        "target": {"id": SOURCE, "shift": "limb-x2"},
        "rows": [{"steps": n, "return": 10.0 + n} for n in (0, 20)],
    }
    for seed in (1, 2):
        of_benchmark["job"]["seed"] = seed
        (tmp_path / f"{seed}.json").write_text(json.dumps(of_benchmark))
    found = read_rows([agent, tmp_path])
    assert [(row["method"], row["seed"]) for row in found] == [("sac", 0)] * 4 + [
        *(("rpto-physical", 1),) * 2,
        *(("rpto-physical", 2),) * 2,
    ]
    assert {row["target"] for row in found} == {SOURCE, TARGET}  # as "transfer" names it, too
    assert cli.main(["plot", str(agent), str(tmp_path), "--out", str(tmp_path / "figure.png")]) == 0
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "8 evaluations of 2 target(s)" in capsys.readouterr().out


# ---------------------------------------------------------------------- enjoy


def test_enjoy_prints_what_the_policy_earns(agent: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["enjoy", str(agent), "--episodes", "2", "--seed", "5"]) == 0
    printed = capsys.readouterr().out.splitlines()
    model, env = SAC.load(agent / "model.zip", device="cpu"), gym.make(SOURCE)
    for line, seed in zip(printed, (5, None)):
        observation, total, over = env.reset(seed=seed)[0], 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(model.predict(observation, deterministic=True)[0])
            total, over = total + reward, terminated or truncated
        assert line.endswith(f"return {total:.1f}")
    assert printed[2].endswith("2 episodes")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_shows_three_panels(suffix: str, agent: Path, tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2", reason="the extra 'video' is not installed")
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="the extra 'video' is not installed")
    assert transfer(agent, tmp_path / "run", "zero-shot") == 0
    file = tmp_path / f"film{suffix}"
    assert cli.main(["enjoy", str(tmp_path / "run"), "--episodes", "1", "--video", str(file), "--seconds", "0.2"]) == 0
    frames = [frame for frame in imageio.get_reader(file)]  # noqa: C416 (list() asks for the length, which is infinite)
    assert frames[0].shape[:2] == (440, 3 * 604)  # a caption above, a gap beside each
    assert len(frames) > 5
    assert not np.array_equal(frames[0], frames[-1])
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.slow
@pytest.mark.parametrize("named", ["folder", "zip"])
def test_a_film_of_an_agent_that_came_from_none_shows_it_alone(named: str, agent: Path, tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2", reason="the extra 'video' is not installed")
    model = [str(agent)] if named == "folder" else [str(agent / "model.zip"), SOURCE]
    file = tmp_path / "film.gif"
    assert cli.main(["enjoy", *model, "--episodes", "1", "--video", str(file), "--seconds", "0.2"]) == 0
    frames = [frame for frame in imageio.get_reader(file)]  # noqa: C416 (as above)
    assert frames[0].shape[:2] == (440, 604)
    assert len(frames) > 5


def test_what_a_film_shows_is_known_by_the_runs_folder(
    agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[list[str]] = []
    monkeypatch.setattr(video, "film", lambda panels, *_: shown.append([panel.title for panel in panels]))
    monkeypatch.setattr(video, "require", lambda path: None)
    assert transfer(agent, tmp_path / "run", "zero-shot") == 0
    for folder in (agent, tmp_path / "run"):
        assert cli.main(["enjoy", str(folder), "--episodes", "1", "--video", "film.gif"]) == 0
    assert list(map(len, shown)) == [1, 3]
    assert shown[1][-1] == "transferred policy in the target"


@pytest.mark.slow
def test_a_film_of_mujoco_without_a_display(tmp_path: Path) -> None:
    pytest.importorskip("imageio", reason="the extra 'video' is not installed")
    try:  # MuJoCo alone: what fails of ours must not be skipped
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as problem:
        pytest.skip(f"MuJoCo cannot draw here: {problem}")
    env = gym.make("rpto/Hopper-v0")
    SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16]}, device="cpu").save(tmp_path / "hopper.zip")
    env.close()
    agent, file = str(tmp_path / "hopper.zip"), tmp_path / "film.gif"
    options = ["--source-model", agent, "--episodes", "1", "--video", str(file), "--seconds", "0.1"]
    assert cli.main(["enjoy", agent, "rpto/Hopper-limb-x2-v0", *options]) == 0
    assert file.stat().st_size > 1_000


# ---------------------------------------------------------------------- wrong input

BAD = {
    "train Hoper --out O": "did you mean 'Hopper'",
    "train rpto/Hopper-targt0-v0 --out O": "registered for Hopper are target0",
    "train rpto/ContinuousCartPole-push-x2-v0 --out O": "shift='push-x2' does not exist",
    "train no_such_package:X-v0 --out O": "no_such_package cannot be imported",
    "train ContinuousCartPole --out O --set gama=1": "--set gama: there is no such argument; did you mean 'gamma'",
    "train ContinuousCartPole --out O --set gamma": "'gamma' is not NAME=VALUE",
    "train ContinuousCartPole --out O --steps 0": "--steps is 0",
    "train ContinuousCartPole --out O --device gpu": "--device: device='gpu' cannot be used",
    "train ContinuousCartPole --out O --every -1": "--every is -1",
    "train ContinuousCartPole": "--out",
    "train ContinuousCartPole --out O --set seed=3": "--set seed: there is no such argument",
    "train ContinuousCartPole --out O --set batch_size=abc": "batch_size must be a positive integer, got 'abc'",
    "train ContinuousCartPole --out O --set gamma=0.9o": "gamma must lie in [0, 1], got '0.9o'",
    "train ContinuousCartPole --out O --set learning_rate=lin_3e-4": "learning_rate is 'lin_3e-4'; give a number",
    "train ContinuousCartPole --out O --set action_noise=0.1": "--set action_noise: it takes an object of Python",
    "train ContinuousCartPole --out O --steps 100 --set learning_starts=100": "ends before the first update",
    "train Pendulum-v1 --out O --steps 2000": "(learning_starts=10000): nothing would be learned",
    "train ContinuousCartPole --out O --set learning_starts=abc": "learning_starts must be an integer and not",
    "train ContinuousCartPole --out O --set optimize_memory_usage=true": "--set optimize_memory_usage",
    "train CartPole-v1 --out O": "action",
    "train FrozenLake-v1 --out O": "observation",
    "train ContinuousCartPole --out FOREIGN": "holds a model.zip that no run of ours wrote",
    "transfer A/model.zip T --out FOREIGN": "holds a model.zip that no run of ours wrote",
    "transfer A/model.zip T --out O --set n_steps=3": "n_steps",
    "transfer absent.zip T --out O": "ZIP: there is no file 'absent.zip'",
    "transfer A/config.json T --out O": "is no zip of a model",
    "transfer A/model.zip T --out O --source-data x.npz": "--source-data: there is no file 'x.npz'",
    "transfer A/model.zip T --out O --method rtpo": "choose one of zero-shot, rpo",
    "transfer A/model.zip rpto/ContinuousCartPole-v0 --out O": "is the source itself",
    "transfer A/model.zip Pendulum-v1 --out O": "--source ID",
    "transfer A/model.zip rpto/InvertedDoublePendulum-target0-v0 --out O": "name its task's agent",
    "transfer A/model.zip T --out O --set device=cpu": "--set device: there is no such argument",
    "transfer A/model.zip T --out O --set weigting=paper": "did you mean 'weighting'",
    "transfer A/model.zip T --out O --set weighting=papre": "weighting='papre'",
    "transfer A/model.zip T --out O --method sac-warm --set gama=1": "did you mean 'gamma'",
    "transfer A/model.zip T --out O --method sysid-retrain": "--set 'declared=[...]'",
    "transfer A/model.zip T --out O --method sysid-retrain --set declared=[pole_length] --set gama=1": "mean 'gamma'",
    "transfer A/model.zip T --out O --method sysid-retrain --set declared=[pole_length] --set gamma=2": "[0, 1], got 2",
    "transfer A/model.zip T --out O --method sac --set train_freq=4": "is met step by step",
    "transfer A/model.zip T --out O --method sac --steps 90": "ends before the first update (learning_starts=100)",
    "transfer A/model.zip T --out O --method sac-warm --set learning_starts=9": "sac-warm takes no random steps",
    "transfer A/model.zip T --out O --method sac-mixed --set batch_size=0": "batch_size must be a positive integer",
    "transfer A/model.zip T --out O --method sac-mixed --source-data A/model.zip": "model.zip' is no pickle",
    "transfer A/model.zip T --out O --source rpto/InvertedDoublePendulum-v0": "--source Box",
    "plot absent.json --out f.png": "there is nothing at 'absent.json'",
    "plot A/config.json --out f.png": "is no result file",
    "plot A --out f.txt": "a figure is .png",
    "enjoy absent.zip": "MODEL: there is no file 'absent.zip'",
    "enjoy A/config.json T": "is no zip of a model",
    "enjoy A/model.zip": "pass TARGET",
    "enjoy A rpto/InvertedDoublePendulum-v0": "name the same task",
    "enjoy A --episodes 0": "--episodes is 0",
    "enjoy A --seconds 0": "--seconds is 0",
    "enjoy A --seconds inf": "--seconds is inf",
    "enjoy A --seed -1": "--seed is -1",
    "train ContinuousCartPole --out O --set ent_coef=autoo": 'ent_coef must be "auto"',
    "train ContinuousCartPole --out O --device cuda:9": "device='cuda:9' cannot be used",
    "transfer A/model.zip T --out O --set learning_starts=-1": "learning_starts must be an integer and not negative",
    "transfer A/model.zip T --out O --method rpto --set dynamics_kwargs={hidden:[]}": "hidden must be a list of",
    "enjoy BEGUN": "its run is not finished",
    "train ContinuousCartPole --out O --seed -1": "--seed is -1",
    "enjoy A --video f.avi": "a film is .mp4 or .gif",
    "enjoy A --video A/model.zip/f.gif": "nothing can be written into",
    "enjoy A --video f.gif --source Pendulum-v1": "pass its zip by --source-model, too",
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("command", BAD)
def test_wrong_input_is_one_line_before_the_work(
    command: str, agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {
        "O": str(tmp_path / "out"),
        "T": TARGET,
        "FOREIGN": str(tmp_path / "foreign"),
        "BEGUN": str(tmp_path / "begun"),
    }
    for name in ("foreign", "begun"):
        (tmp_path / name).mkdir()
    (tmp_path / "begun" / "config.json").write_text('{"command": "train"}')
    (tmp_path / "foreign" / "model.zip").write_text("somebody's")
    given = [names.get(word, str(agent) + word[1:] if word.split("/")[0] == "A" else word) for word in command.split()]
    assert cli.main(given) == 2
    assert BAD[command] in error(capsys)
    assert not (tmp_path / "out" / "model.zip").exists()
    assert (tmp_path / "foreign" / "model.zip").read_text() == "somebody's"


def test_a_run_of_another_source_agent_is_another_run(
    agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = shutil.copytree(agent, tmp_path / "source")
    assert transfer(source, tmp_path / "out", "rpo") == 0
    SAC("MlpPolicy", gym.make(SOURCE), policy_kwargs={"net_arch": [16]}, device="cpu").save(source / "model.zip")
    capsys.readouterr()
    assert transfer(source, tmp_path / "out", "rpo") == 2
    assert "holds a run with source_model_sha256=" in error(capsys)


def test_a_corrected_command_may_use_the_folder(agent: Path, tmp_path: Path) -> None:
    assert transfer(agent, tmp_path, "rpto", "--set", "weighting=papre") == 2
    assert transfer(agent, tmp_path, "rpto", "--set", "weighting=centred") == 0


def test_what_a_killed_checkpoint_left_is_not_in_the_way(tmp_path: Path) -> None:
    """In a container every command has the same process number."""
    run = RunFolder(tmp_path)
    left = tmp_path / "checkpoints" / f".{20:010d}.{os.getpid()}"
    left.mkdir(parents=True)
    (left / "half").write_text("")
    run.save_checkpoint(20, lambda folder: (folder / "whole").write_text("") and None)
    newest = run.newest_checkpoint()
    assert newest is not None
    assert [path.name for path in newest.iterdir()] == ["whole"]


def test_two_processes_do_not_share_a_folder(tmp_path: Path) -> None:
    config = {"command": "train", "a": 1}
    lock = f"from filelock import FileLock; lock = FileLock({str(tmp_path / '.lock')!r}); lock.acquire(blocking=False)"
    other = [sys.executable, "-c", f"{lock}; print('there'); input()"]  # what opening a folder does, imported quickly
    with subprocess.Popen(other, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        with pytest.raises(ValueError, match="another process runs there; wait until it ends, or give another folder"):
            RunFolder.open(tmp_path, config)
        process.communicate("go\n")
    run = RunFolder.open(tmp_path, config)
    told = subprocess.run(other, input="go\n", capture_output=True, text=True, check=False)
    assert "Timeout" in told.stderr
    del run
    subprocess.run(other, input="go\n", text=True, check=True)


def test_a_run_is_the_same_from_everywhere(agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = shutil.copytree(agent, tmp_path / "source")
    monkeypatch.chdir(tmp_path)
    assert transfer(Path("source"), Path("runs/moved"), "rpto") == 0
    monkeypatch.chdir(tmp_path / "runs")
    assert transfer(Path("../source"), Path("moved"), "rpto") == 0  # transferred already
    config = json.loads(Path("moved/config.json").read_text())
    assert config["source_model"] == str(Path("../../source/model.zip"))
    known = {"source_model": config["source_model"]}
    assert enjoy._agent_of(Path("moved"), known) is not None
    Path("moved/config.json").write_text(json.dumps({**config, "source_model": "source/model.zip"}))  # as it once was
    monkeypatch.chdir(tmp_path)
    assert transfer(Path("source"), Path("runs/moved"), "rpto") == 0
    shutil.rmtree(source)
    with pytest.raises(FileNotFoundError, match=r"the run's source agent .* is not there; pass its zip"):
        enjoy._agent_of(Path("runs/moved"), known)


@pytest.mark.parametrize("kind", ["ppo", "a2c", "recurrent"])
def test_enjoy_runs_policies_of_other_algorithms(kind: str, tmp_path: Path) -> None:
    if kind == "recurrent":
        contrib = pytest.importorskip("sb3_contrib")
        small = {"lstm_hidden_size": 8, "net_arch": [8]}
        model = contrib.RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", policy_kwargs=small, seed=0, device="cpu")
    else:
        made = {"ppo": PPO, "a2c": A2C}[kind]
        model = made("MlpPolicy", "Pendulum-v1", use_sde=True, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    model.save(tmp_path / "model.zip")
    env = gym.make("Pendulum-v1")
    found = enjoy._episode(env, load_policy(tmp_path / "model.zip", "MODEL"), 3, deterministic=True)
    observation, _ = env.reset(seed=3)
    total, over, state = 0.0, False, None
    while not over:
        action, state = model.predict(observation, state, deterministic=True)
        observation, reward, ended, truncated, _ = env.step(action)
        total, over = total + float(reward), ended or truncated
    assert found == pytest.approx(total, rel=1e-5)


#: Of a run of the benchmark that failed.
NOTHING = {"target": {"id": TARGET, "shift": ""}, "rows": []}


def test_plot_tells_source_agents_apart_where_seeds_do_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def finished(name: str, seed: int, agent: str, **more: object) -> Path:
        config = {"method": "rpto", "target": TARGET, "seed": seed, "source_model_sha256": agent * 8, **more}
        (tmp_path / f"{name}.json").write_text(json.dumps({"config": config, "rows": [{"steps": 20, "return": 1.0}]}))
        return tmp_path / f"{name}.json"

    each = [finished("a", 0, "aa"), finished("b", 1, "bb")]  # of each seed an agent of its own
    assert {row["method"] for row in read_rows(each)} == {"rpto"}
    both = [*each, finished("c", 0, "cc")]
    assert {row["method"] for row in read_rows(both)} == {f"rpto agent={name * 4}" for name in ("aa", "bb", "cc")}
    judged = [*each, finished("d", 2, "dd", episodes=3)]
    assert {row["method"] for row in read_rows(judged)} == {"rpto episodes=default", "rpto episodes=3"}
    again = finished("again", 0, "aa")
    assert [row["seed"] for row in read_rows([*each, again])] == [0, 1], "a seed counts once"
    assert f"the same seed of the same method is there: {again}" in capsys.readouterr().err


def test_a_line_is_of_the_same_runs_from_end_to_end() -> None:
    matplotlib = pytest.importorskip("matplotlib.figure", reason="the extra 'experiments' is not installed")
    evaluated = {0: (0, 200, 600), 1: (0, 300, 600, 700)}
    rows = pd.DataFrame([("rpto", seed, seed, s, 1.0 * s + seed) for seed, steps in evaluated.items() for s in steps])
    axes = matplotlib.Figure().subplots()
    draw(axes, rows.set_axis(["method", "run", "seed", "steps", "return"], axis=1), "")
    assert axes.lines[0].get_xdata().tolist() == [0, 200, 300, 600]
    assert axes.lines[0].get_ydata().tolist() == [0.5, 200.5, 300.5, 600.5]


def test_runs_that_share_their_beginning_alone_are_a_line() -> None:
    matplotlib = pytest.importorskip("matplotlib.figure", reason="the extra 'experiments' is not installed")
    rows = pd.DataFrame([("sac", seed, seed, s, 1.0 * s) for seed, s in ((0, 0), (0, 100), (1, 0), (1, 30), (1, 90))])
    axes = matplotlib.Figure().subplots()
    draw(axes, rows.set_axis(["method", "run", "seed", "steps", "return"], axis=1), "")
    assert axes.lines[0].get_xdata().tolist() == [0, 30, 90]


@pytest.mark.parametrize("name", ["config.json", "model.zip", "replay_buffer.pkl", "result.json", "checkpoints"])
def test_nothing_of_others_is_overwritten(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs = tmp_path / name / "best.pt" if name == "checkpoints" else tmp_path / name
    theirs.parent.mkdir(exist_ok=True)
    theirs.write_text('{"model_type": "bert"}')
    assert train(tmp_path) == 2
    assert f"holds a {name} that no run of ours wrote" in error(capsys)
    assert theirs.read_text() == '{"model_type": "bert"}'
    assert len(list(tmp_path.iterdir())) == 1


class Remembers:
    """Acts by how often it was asked in this episode."""

    def predict(self, observation: object, state: object = None, deterministic: bool = False) -> tuple:
        count = int(state or 0) + 1
        return np.array([count / 10], dtype=np.float32), count


def test_a_film_plays_recurrent_policies_with_their_memory() -> None:
    acted = []

    class Watched(gym.Wrapper):
        def step(self, action: np.ndarray) -> tuple:
            acted.append(round(float(action[0]), 1))
            return super().step(action)

    scene = video._Scene(video.Panel("", Remembers(), lambda: Watched(gym.make("Pendulum-v1"))), seed=0)
    scene.advance(3)
    assert acted == [0.1, 0.2, 0.3]


@pytest.mark.parametrize(
    ("model", "statistics"),
    [
        ("rl_model_20_steps.zip", "rl_model_vecnormalize_20_steps.pkl"),
        ("my_sac_20_steps.zip", "my_sac_vecnormalize_20_steps.pkl"),
        ("model.zip", "statistics.pkl"),
    ],
)
def test_statistics_beside_a_zip_are_found_by_its_name(model: str, statistics: str, tmp_path: Path) -> None:
    assert statistics_of(tmp_path / model) is None
    (tmp_path / "my_sac_vecnormalize_10_steps.pkl").touch()
    assert statistics_of(tmp_path / model) is None
    (tmp_path / statistics).touch()
    assert statistics_of(tmp_path / model) == tmp_path / statistics


def test_a_finished_run_without_its_model_says_how_it_comes_back(
    agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(agent, tmp_path / "run")
    (tmp_path / "run" / "model.zip").unlink()
    assert cli.main(["enjoy", str(tmp_path / "run")]) == 2
    assert "its run is finished and model.zip is gone; remove result.json" in error(capsys)


def test_a_terminal_need_not_show_a_folders_name(agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(agent, tmp_path / "源")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert train(tmp_path / "源", "--device", "cpu") == 0  # trained already
    sys.stdout.seek(0)
    assert sys.stdout.read().endswith("?/model.zip\n")


def test_curves_of_a_transfer_and_of_a_benchmark_are_of_one_method(tmp_path: Path) -> None:
    rows = [{"steps": 0, "return": 1.0}]
    settings = {"gradient_steps": 1}
    config = {"method": "rpto", "target": TARGET, "source": SOURCE, "seed": 0, "settings": settings, "episodes": 5}
    config["source_model_sha256"] = "a" * 64
    job = {"task": "ContinuousCartPole", "label": "rpto", "seed": 1, "settings": settings, "episodes": 5}
    benchmark = {"job": job, "source": {"sha256": "a" * 64}, "target": {"shift": "limb-x2"}, "rows": rows}
    (tmp_path / "a.json").write_text(json.dumps({"config": config, "rows": rows}))
    (tmp_path / "b.json").write_text(json.dumps(benchmark))
    assert [(row["method"], row["seed"]) for row in read_rows([tmp_path])] == [("rpto", 0), ("rpto", 1)]


def test_curves_of_a_benchmark_are_told_apart_by_settings_and_agents(tmp_path: Path) -> None:
    def wrote(name: str, settings: dict[str, int], agent: str, seed: int) -> None:
        job = {"task": "Hopper", "label": "rpto", "seed": seed, "settings": settings, "episodes": 5}
        rows = [{"steps": 0, "return": 1.0}]
        content = {"job": job, "source": {"sha256": agent}, "target": {"shift": "limb-x2"}, "rows": rows}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))

    wrote("a", {"gradient_steps": 5}, "a" * 64, 0)
    wrote("b", {"gradient_steps": 20}, "a" * 64, 0)
    wrote("c", {"gradient_steps": 20}, "b" * 64, 0)
    assert {row["method"] for row in read_rows([tmp_path])} == {
        "rpto gradient_steps=5",
        "rpto gradient_steps=20 agent=aaaaaaaa",
        "rpto gradient_steps=20 agent=bbbbbbbb",
    }


def test_drawn_actions_follow_the_seed(agent: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for seed in ("3", "3", "4"):
        assert cli.main(["enjoy", str(agent), "--stochastic", "--episodes", "2", "--seed", seed]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] != said[2]


def test_plot_counts_seeds_and_tells_settings_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def finished(name: str, seed: int, **settings: object) -> Path:
        config = {"method": "rpto", "target": TARGET, "seed": seed, "settings": settings}
        (tmp_path / name).mkdir()
        file = tmp_path / name / "result.json"
        file.write_text(json.dumps({"config": config, "rows": [{"steps": 20, "return": float(seed)}]}))
        return file

    files = [finished("a", 0), finished("b", 1), finished("c", 0, gradient_steps=20)]
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished" / "config.json").write_text("{}")
    (tmp_path / "another.json").write_text(json.dumps({"config": 3, "rows": [], "job": 1, "target": {}}))
    found = read_rows([tmp_path, *files])
    assert sorted((row["method"], row["seed"]) for row in found) == [
        *(("rpto gradient_steps=20", 0), ("rpto gradient_steps=default", 0), ("rpto gradient_steps=default", 1))
    ]
    assert capsys.readouterr().err == f"sb3-rpto: left out, not finished: {tmp_path / 'unfinished'}\n"
    (tmp_path / "adapted").mkdir()
    (tmp_path / "adapted" / "result.json").write_text(json.dumps({"config": {"command": "adapt"}, "rows": []}))
    read_rows([files[0], tmp_path / "adapted"])
    assert "left out, learned from a log, so that there is no curve" in capsys.readouterr().err
    assert [row["method"] for row in read_rows(files[:2])] == ["rpto", "rpto"]
    for steps in (60, 80):  # a buffer as long as the run is the command's own
        config = {"method": "sac", "target": TARGET, "seed": steps, "steps": steps, "settings": {"buffer_size": steps}}
        (tmp_path / f"{steps}.json").write_text(json.dumps({"config": config, "rows": [{"steps": 20, "return": 1.0}]}))
    assert {row["method"] for row in read_rows([tmp_path / "60.json", tmp_path / "80.json"])} == {"sac"}
    capsys.readouterr()
    (tmp_path / "failed.json").write_text(
        json.dumps({"job": {"task": "Hopper", "label": "x", "seed": 0}, "error": "E", **NOTHING})
    )
    read_rows([*files, tmp_path / "failed.json"])
    assert capsys.readouterr().err == f"sb3-rpto: left out, failed: {tmp_path / 'failed.json'}\n"
    twice = pd.DataFrame([*read_rows(files[:2]), *read_rows(files[:1])])
    assert summarise(twice, ["method", "steps"])["seeds"].tolist() == [2]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("1e-3", 0.001), ("1e1", 10), ("1.0", 1.0), ("None", None), ("[1e-3, auto]", [0.001, "auto"])),
        *(("{learning_rate: 1e-3, hidden: [2e2]}", {"learning_rate": 0.001, "hidden": [200]}), ("inf", float("inf"))),
    ],
)
def test_values_of_settings_are_what_python_users_mean(text: str, value: object) -> None:
    assert options.setting(f"name={text}") == ("name", value)
    assert type(options.setting(f"name={text}")[1]) is type(value)
    assert options.setting("train_freq=[1, episode]") == ("train_freq", (1, "episode"))  # YAML has no tuples


def test_an_environment_of_ones_own_is_found_beside_the_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_arm.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('mine/Arm-v7', 'gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv')\n"
    )
    with pytest.raises(ValueError, match=r"did you mean .*\? One of your own is module:mine/Cart-v0"):
        options.world("mine/Cart-v0", "SOURCE")
    with pytest.raises(
        ValueError, match=r"'mine/Arm-v7' is no environment(; did you .*\? O|; o)ne of your own is module:mine/Arm-v7"
    ):
        options.world("mine/Arm-v7", "ENV")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert options.world("my_arm:mine/Arm-v7", "ENV").env_id == "mine/Arm-v7"


def test_source_transitions_are_for_methods_with_a_use_for_them(
    agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert transfer(agent, tmp_path / "warm", "zero-shot") == 0
    assert "--method zero-shot has no use for --source-data" in capsys.readouterr().err
    assert transfer(agent, tmp_path / "rpo", "rpo") == 0
    assert "no use" not in capsys.readouterr().err
    assert rows(tmp_path / "rpo")[0]["source_steps"] == 0


def test_a_traceback_is_there_for_those_who_ask(agent: Path) -> None:
    with pytest.raises(ValueError, match="does not exist"):
        cli.main(["--traceback", "transfer", str(agent / "model.zip"), TARGET, "--method", "rtpo", "--out", "x"])


def test_numbers_in_settings_are_numbers(agent: Path, tmp_path: Path) -> None:
    assert transfer(agent, tmp_path, "sac-warm", "--set", "learning_rate=1e-3") == 0
    assert json.loads((tmp_path / "config.json").read_text())["settings"] == {"learning_rate": 0.001}


def test_without_the_extras_the_remedy_is_named(
    agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    assert cli.main(["enjoy", str(agent), "--video", "film.mp4", "--source-model", str(agent / "model.zip")]) == 2
    assert "pip install -e '.[video]'" in error(capsys)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert cli.main(["plot", str(agent), "--out", str(tmp_path / "figure.png")]) == 2
    assert "pip install -e '.[experiments]'" in error(capsys)
