"""The command sb3-rpto: exit codes, messages, and what it writes."""

import csv
import io
import json
import subprocess
import sys
import warnings
from pathlib import Path

import mujoco
import pytest
from conftest import coarsely

from benchmarks.tracing.planting import generate
from sb3_rpto import __version__, cli
from sb3_rpto.commands import recordings
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.report import descriptions


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with robot.xml, runs.csv and wrong ones."""
    folder = tmp_path_factory.mktemp("machine")
    planted = generate("pendulum", [("coulomb_friction", "large")], seed=0, episodes=4, duration=1.5)
    assert 'timestep="0.002"' in planted.xml
    (folder / "robot.xml").write_text(planted.xml.replace('timestep="0.002"', 'timestep="0.005"'))
    table = planted.measurements.tables()
    for name, drop in (("runs.csv", ()), ("unknown.csv", ("qpos.hinge",))):
        columns = {("qpos.elbow" if c in drop else c): v for c, v in table.items()}
        with (folder / name).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(zip(*columns.values()))
    (folder / "broken.xml").write_text("<mujoco><worldbody></mujoco>")
    return folder


def run(files: Path, *options: str, model: str = "robot.xml", data: str = "runs.csv") -> int:
    given = [str(files / model) if model.endswith(".xml") else model, str(files / data)]
    with coarsely():
        return cli.main(["trace", *given, "--out", str(files / "out"), "--candidates", "coulomb_friction", *options])


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr."""
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("sb3-rpto: error: ")
    return lines[0]


def test_trace_prints_the_report_and_writes_the_folder(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(files, "--declare", "pole.mass", "--declare", "hinge.damping", "--seed", "1") == 0
    captured = capsys.readouterr()
    found = json.loads((files / "out" / "report.json").read_text(encoding="utf-8"))
    assert captured.out.startswith(f"verdict: {found['verdict']}\n")
    assert "report.html" in captured.out.splitlines()[-1]
    assert "fitting the declared parameters" in captured.err
    assert [d["label"] for d in found["declared"]] == ["pole.mass", "hinge.damping"]
    assert {c["label"] for c in found["candidates"]} == {"coulomb_friction(hinge)"}
    assert found["seed"] == 1
    assert (files / "out" / "model.xml").is_file()


@pytest.mark.slow
def test_effects_are_known_from_a_file(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = files / "known.json"
    known.write_text(json.dumps([CoulombFriction("hinge", level=0.05).to_json()]))
    assert run(files, "--known", str(known), "--declare", "pole.mass,hinge.damping", "--quiet") == 0
    assert capsys.readouterr().out == "complete\n"
    known.write_text("verdict: complete")
    assert run(files, "--known", str(known)) == 2
    assert "does not describe effects; give the effects.json of an earlier trace" in error(capsys)
    assert run(files, "--known", str(files / "none.json")) == 2
    assert "--known: there is no file" in error(capsys)


def test_options_reach_the_trace(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, object] = {}

    def stop(model: object, data: object, declared: object, **kwargs: object) -> None:
        asked.update(kwargs)
        raise ValueError("enough")

    monkeypatch.setattr("sb3_rpto.sysid.trace", stop)
    options = ["--calibrate", "7", "--horizon", "0.2", "--threads", "1", "--seed", "4", "--quiet"]
    assert run(files, *options) == 2
    expected = {"calibrate": 7, "horizon": 0.2, "threads": 1, "seed": 4, "candidates": ["coulomb_friction"]}
    assert {name: asked[name] for name in expected} == expected


def test_columns_that_files_call_otherwise_are_renamed(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    header, rows = (files / "runs.csv").read_text().split("\n", 1)
    (files / "own.csv").write_text(f"# {header.replace('time', 't').replace('qpos.hinge', 'q1')}\n{rows}")
    read: list[Measurements] = []
    monkeypatch.setattr("sb3_rpto.sysid.trace", lambda model, data, *_, **__: read.append(data) or sys.exit(7))
    with pytest.raises(SystemExit):
        run(files, "--rename", "t=time", "--rename", "q1=qpos.hinge", data="own.csv")
    assert recordings.digest(read[0]) == recordings.digest(Measurements.from_csv(files / "runs.csv"))
    capsys.readouterr()
    for given, said in (
        ("t=time", "unknown column 'q1'"),
        ("t=time,q2=qpos.hinge", "rename: there is no column 'q2'; did you mean 'q1'"),
        ("t=tme", "argument --rename: 't=tme' is not OLD=NEW"),
    ):
        assert run(files, "--rename", given, data="own.csv") == 2
        assert said in error(capsys)


def test_a_file_is_no_folder_to_write_to(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "report").write_text("mine")
    assert run(files, "--out", str(files / "report")) == 2
    assert "is a file; give a folder" in error(capsys)


def test_bad_input_leaves_no_folder(files: Path, tmp_path: Path) -> None:
    rows = (files / "runs.csv").read_text().splitlines()
    (tmp_path / "short.csv").write_text("\n".join(rows[:20]) + "\n")
    arguments = ["trace", str(files / "robot.xml"), str(tmp_path / "short.csv"), "--quiet", "--out"]
    assert cli.main([*arguments, str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    (tmp_path / "mine").mkdir()
    assert cli.main([*arguments, str(tmp_path / "mine")]) == 2
    assert (tmp_path / "mine").exists()


@pytest.mark.slow
def test_quiet_prints_the_verdict_alone(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(files, "--quiet", "--format", "csv", "--horizon", "0.15") == 0
    captured = capsys.readouterr()
    assert captured.out.strip() in descriptions.VERDICTS
    assert captured.err == ""


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"data": "absent.csv"}, "no file matches"),
        ({"data": "runs.mat"}, "--format"),
        ({"data": ""}, "is a folder; name its files, such as"),
        ({"data": "unknown.csv"}, "has no 'qpos.hinge'"),
        ({"model": "absent.xml"}, "there is no MJCF file"),
        ({"model": "broken.xml"}, "broken.xml"),
        ({"model": "Nothing-v7"}, "neither a file nor a gymnasium environment"),
        ({"model": "mine/Crane-v0"}, "module:name/Task-v0"),
        ({"model": "no_such_package:Nothing-v7"}, "neither a file nor a gymnasium environment"),
        ({"model": "CartPole-v1"}, "no MuJoCo model"),
        ({"options": ["--declare", "hinge.dampng"]}, "damping"),
        ({"options": ["--candidates", "coulomb"]}, "coulomb_friction"),
        ({"options": ["--candidates", ""]}, "--candidates is empty"),
        ({"options": ["--horizon", "-1"]}, "--horizon"),
        ({"options": ["--calibrate", "-1"]}, "--calibrate"),
        ({"options": ["--threads", "-1"]}, "--threads must be a number of threads from 1"),
        ({"options": ["--threads", "1000000"]}, "or 0 for one for each core, got 1000000"),
        ({"options": ["--seed", "-1"]}, "--seed is -1"),
        ({"options": ["--seed", "one"]}, "sb3-rpto trace --help"),
    ],
)
def test_bad_input_is_one_line_that_names_the_remedy(
    files: Path, given: dict, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(files, *given.pop("options", ()), "--quiet", **given) == 2
    assert message in error(capsys)


def test_modules_of_ones_own_environments_are_found_where_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_arm.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('own/Arm-v0', 'gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    assert cli._model("own_arm:own/Arm-v0").spec.id == "own/Arm-v0"


def test_a_gymnasium_id_names_a_model() -> None:
    env = cli._model("InvertedPendulum-v5")
    assert isinstance(env.unwrapped.model, mujoco.MjModel)
    assert cli._model("sb3_rpto:InvertedPendulum-v5").spec.id == "InvertedPendulum-v5"
    heavier = cli._model("rpto/Hopper-gravity-x3-v0")  # registered nowhere
    assert heavier.unwrapped.model.opt.gravity[2] == 3 * cli._model("Hopper").unwrapped.model.opt.gravity[2]


def test_files_of_several_formats_are_refused(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["trace", str(files / "robot.xml"), "a.csv", "b.npz", "--out", str(files / "out")]
    assert cli.main(arguments) == 2
    assert "csv, npz" in error(capsys)


def test_an_output_that_cannot_be_a_folder_fails_before_the_work(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(files, "--out", str(files / "runs.csv")) == 2
    assert "runs.csv" in error(capsys)


def test_the_nominal_model_is_not_overwritten(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (files / "robot.xml").read_text()
    (tmp_path / "model.xml").write_text(text)
    assert cli.main(["trace", str(tmp_path / "model.xml"), str(files / "runs.csv"), "--out", str(tmp_path)]) == 2
    assert "--out" in (said := error(capsys))
    assert "save elsewhere" in said
    assert (tmp_path / "model.xml").read_text() == text


@pytest.fixture(scope="module")
def found(files: Path) -> Report:
    """What a trace finds."""
    data = Measurements.from_csv(str(files / "runs.csv"))
    return trace(str(files / "robot.xml"), data, candidates=["coulomb_friction"], threads=1)


def refuse(*_: object) -> None:
    raise FileNotFoundError("tip.obj is gone")


def test_a_model_that_cannot_be_saved_fails_before_the_work(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_rpto.effects.corrected_model_io.write_mjcf", refuse)
    monkeypatch.setattr("sb3_rpto.sysid.trace", lambda *_, **__: pytest.fail("it was started"))
    assert run(files) == 2
    assert "tip.obj is gone" in error(capsys)


@pytest.mark.slow
def test_the_report_is_written_where_the_model_cannot_be(
    files: Path, found: Report, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_rpto.sysid.trace", lambda *_, **__: found)
    monkeypatch.setattr("sb3_rpto.sysid.report.report.save_corrected", refuse)
    assert run(files, "--out", str(tmp_path / "new")) == 2
    captured = capsys.readouterr()
    assert captured.out.startswith("verdict: ")
    assert captured.err.endswith("sb3-rpto: error: tip.obj is gone\n")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["report.html", "report.json"]


@pytest.mark.slow
def test_what_a_terminal_cannot_show_keeps_nothing_from_being_written(
    files: Path, found: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_rpto.sysid.trace", lambda *_, **__: found)
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stdout)
    assert run(files, "--out", str(tmp_path / "plain")) == 0
    assert b"N?m" in stdout.buffer.getvalue()
    monkeypatch.setattr(cli, "say", refuse)
    assert run(files, "--out", str(tmp_path / "closed")) == 2
    for name in ("plain", "closed"):
        assert {"report.json", "model.xml"} <= {path.name for path in (tmp_path / name).iterdir()}


def test_without_matplotlib_nothing_is_started(
    files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run(files) == 2
    assert "pip install -e '.[tracing]'" in error(capsys)


def test_interrupt_gives_130(files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recordings, "read", interrupted)
    assert run(files) == 130
    assert capsys.readouterr().err == "sb3-rpto: interrupted\n"


def test_no_command_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "--help" in error(capsys)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([], "move a source agent to a target"),
        (["train"], "sb3-rpto train Hopper --out"),
        (["transfer"], "sb3-rpto transfer runs/"),
        (["plot"], "sb3-rpto plot runs/"),
        (["enjoy"], "--video hopper.mp4"),
        (["trace"], "example:"),
    ],
)
def test_help_exits_with_0(command: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main([*command, "--help"])
    assert words in capsys.readouterr().out


def test_as_a_process(files: Path) -> None:
    arguments = ["trace", str(files / "absent.xml"), str(files / "runs.csv"), "--out", str(files / "out")]
    done = subprocess.run([sys.executable, "-m", "sb3_rpto.cli", *arguments], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("sb3-rpto: error: there is no MJCF file")
    assert "Traceback" not in done.stderr


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"sb3-rpto {__version__}\n"


def test_warnings_are_told_without_a_line_of_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = warnings.formatwarning

    def said(_: object) -> int:
        print(warnings.formatwarning("raise --steps", UserWarning, "somewhere.py", 7), end="")
        return 0

    monkeypatch.setattr(cli.plot, "run", said)
    assert cli.main(["plot", "results", "--out", "figure.png"]) == 0
    assert capsys.readouterr().out == "sb3-rpto: warning: raise --steps\n"
    assert warnings.formatwarning is shown
