"""The report: its text, its JSON, and the corrected model that it saves."""

import copy
import errno
import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, briefly, recorded

from sb3_rpto.effects import Drive, Simulation
from sb3_rpto.effects.commands import CommandDelay
from sb3_rpto.effects.corrected_model_io import load_corrected
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.effects.units import units_at
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.results import Traced
from sb3_rpto.sysid.selection.adequacy import Adequacy

SLIDE = """<mujoco><worldbody><body name="cart">
<joint name="rail" type="slide"/><geom size="0.1" mass="1"/>
<body name="pole"><joint name="hinge"/><geom size="0.1" pos="0 0 1"/></body></body></worldbody>
<actuator><motor name="push" joint="rail"/></actuator></mujoco>"""


def strict(text: str) -> dict:
    """JSON without the extensions NaN and Infinity."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


def unwrapped(report: Report) -> str:
    """Its text in one line."""
    return " ".join(str(report).split())


def test_the_planted_friction_is_found_with_its_level(report: Report, planted) -> None:
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "coulomb_friction(hinge)"
    assert found.effect.values[0] == pytest.approx(planted.truth.effects["coulomb_friction"]["torque"], rel=0.05)
    low, high = found.interval[:, 0]
    assert low < found.effect.values[0] < high
    assert found.t > report.threshold
    assert not report.adequacy_before.adequate
    assert report.adequacy_after.adequate
    at = [e.horizon for e in report.before].index(0.5)
    assert report.after[at].rmse[0] < 0.3 * report.before[at].rmse[0]


def test_text_has_the_verdict_the_effect_with_unit_and_the_errors(report: Report) -> None:
    text = str(report)
    assert text.startswith(f"verdict: {report.verdict}\n")
    value = descriptions.number(report.effects[0].effect.values[0])
    assert any(line.split()[:3] == ["coulomb_friction(hinge)", "level", value] for line in text.splitlines())
    assert f"[hinge] -{value} sign(qd)" in text
    assert "N·m" in text
    assert descriptions.number(report.before[0].rmse[0]) in text
    assert "in model.xml" in text
    assert max(map(len, text.splitlines())) <= 100


def test_text_says_where_an_effect_without_a_number_in_mjcf_is_carried(report: Report) -> None:
    delay = Traced(
        CommandDelay("motor", delay=0.02), ("s",), np.array([[0.01], [0.03]]), ["actuator_lag(motor)"], 0.5, 9.0, 1.0
    )
    text = unwrapped(replace(report, effects=[delay], verdict="explained"))
    assert "the environment wrapper" in text
    assert "cannot tell it from actuator_lag(motor)" in text
    assert "it lacks" in text
    assert "; [motor] u(t - 0.02)" in text


def test_effects_are_not_claimed_unless_they_explain_the_data(report: Report) -> None:
    assert "it lacks" not in str(replace(report, verdict="partly explained"))
    assert "do not explain" in str(replace(report, verdict="unexplained"))


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (Adequacy(1.27, 1.2, 1.3, 0.0, 1.0), "by 27 % more than noise alone"),
        (Adequacy(1.01, 0.9, 1.1, 0.15, 1e-6), "what remains is in 15 % of windows"),
        (Adequacy(2.7, 2.2, 3.3, 0.4, 1e-9), None),
        (Adequacy(1.01, 0.9, 1.1, 0.0, 1.0), None),
    ],
)
def test_how_little_remains_is_said(report: Report, after: Adequacy, said: str | None) -> None:
    text = unwrapped(replace(report, adequacy_after=after))
    assert said in text if said else "remains" not in text


def test_json_holds_the_numbers_of_the_report(report: Report) -> None:
    found = strict(json.dumps(report.to_json(), allow_nan=False))
    assert found["verdict"] == report.verdict
    (effect,) = found["effects"]
    level = effect["parameters"]["level"]
    assert level["value"] == report.effects[0].effect.values[0]
    assert [level["low"], level["high"]] == report.effects[0].interval[:, 0].tolist()
    assert level["unit"] == "N·m"
    assert effect["carried_by"] == "mjcf"
    for name in ("before", "after", "floor"):
        for entry, error in zip(found[name], getattr(report, name), strict=True):
            assert entry["horizon"] == error.horizon
            assert entry["joints"]["hinge"]["rmse"] == error.rmse[0]
    assert found["force_before"] == {"hinge": report.force_before[0]}
    assert {c["label"]: c["status"] for c in found["candidates"]} == {c.label: c.status for c in report.candidates}
    assert found["runs"] == report.runs


def test_json_writes_null_for_what_is_not_finite(report: Report) -> None:
    broken = replace(report, learnable=np.array([np.nan]), force_after=np.array([np.inf]), threshold=np.float64("-inf"))
    found = strict(json.dumps(broken.to_json(), allow_nan=False))
    assert found["learnable"] == {"hinge": None}
    assert found["force_after"] == {"hinge": None}
    assert found["threshold"] is None


def test_a_report_that_fails_half_way_leaves_all_files_of_the_earlier_one(
    report: Report, tmp_path, monkeypatch
) -> None:
    report.save(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"model.xml", "effects.json", "report.json", "report.html", "notes.txt"}
    later = replace(report, verdict="unexplained", declared=[])
    synced: list[int] = []

    def full(file: int) -> None:
        synced.append(file)
        if len(synced) == 4:  # the last of the files
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        later.save(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    monkeypatch.undo()
    later.save(tmp_path)
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert [name for name in before if before[name] == after[name]] == ["notes.txt"]


def test_saved_model_simulates_as_the_corrected_one(report: Report, planted, tmp_path: Path) -> None:
    assert report.save(tmp_path / "new" / "folder") == tmp_path / "new" / "folder"
    out = tmp_path / "new" / "folder"
    assert sorted(p.name for p in out.iterdir()) == ["effects.json", "model.xml", "report.html", "report.json"]
    assert strict((out / "report.json").read_text(encoding="utf-8")) == report.to_json()
    ours = Simulation(mujoco.MjModel.from_xml_string(planted.xml), report.correction, 1)
    theirs = load_corrected(out).simulation(1)
    commands = np.sin(np.arange(300) / 20)[None, :, None]
    start = np.array([[0.3]]), np.array([[1.0]])
    expected = ours.rollout(ours.values()[None], *start, Drive(commands))
    found = theirs.rollout(theirs.values()[None], *start, Drive(commands))
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
    nominal = Simulation(ours.model, [], 1).rollout(np.empty((1, 0)), *start, Drive(commands))
    assert np.abs(nominal[0] - expected[0]).max() > 0.1


def test_a_known_effect_that_turned_out_to_do_nothing_is_no_correction(report: Report, tmp_path: Path) -> None:
    nothing = replace(report.declared[0], effect=CoulombFriction("hinge"))
    found = replace(report, declared=[*report.declared, nothing], effects=[])
    assert [e.label for e in found.correction] == [t.label for t in report.declared]
    assert "coulomb_friction(hinge)" in str(found)


def test_a_model_whose_mjcf_is_unknown_is_refused_and_nothing_written(report: Report, tmp_path: Path) -> None:
    compiled = replace(report, source=report.simulation.model)
    with pytest.raises(ValueError, match="give its file"):
        compiled.save(tmp_path / "out")
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.slow
def test_the_model_that_was_traced_is_not_overwritten(report: Report, planted, tmp_path: Path) -> None:
    """Though an earlier trace saved it, and the report holds it as it was."""
    report.save(tmp_path)
    text = (tmp_path / "model.xml").read_text()
    later = trace(tmp_path / "model.xml", planted.measurements, ["pole.mass"], candidates=[])
    with pytest.raises(ValueError, match=r"is the nominal model.*save elsewhere"):
        later.save(tmp_path)
    assert (tmp_path / "model.xml").read_text() == text
    assert later.to_json()["verdict"] in (tmp_path / "report.json").read_text()


@pytest.mark.parametrize(
    ("effect", "unit"),
    [
        (CoulombFriction("hinge", level=1.0), "N·m"),
        (CoulombFriction("rail", level=1.0), "N"),
        (CommandDelay("push", delay=0.1), "s"),
    ],
)
def test_units_are_those_of_the_joint(effect, unit: str) -> None:
    model = mujoco.MjModel.from_xml_string(SLIDE)
    assert units_at(effect, model)[0] == unit


def test_units_of_slides_replace_angles() -> None:
    from sb3_rpto.effects import declare
    from sb3_rpto.effects.forces import DCMotor, Spring

    model = mujoco.MjModel.from_xml_string(SLIDE)
    (damping,) = declare(model, ["rail.damping"])
    assert units_at(damping, model) == ("N·s/m",)
    assert units_at(Spring("rail"), model) == ("N/m", "m")
    rail = Traced(Spring("rail"), units_at(Spring("rail"), model), np.zeros((2, 2)), [], 0.5, 9.0, 1.0)
    assert "N/m," in str(rail)
    assert units_at(DCMotor("push"), model) == ("1/N", "s/m")


def test_joints_that_an_effect_acts_on() -> None:
    from sb3_rpto.effects.bodies import GravityTilt, Payload

    model = mujoco.MjModel.from_xml_string(SLIDE)
    assert descriptions.dofs_of(CoulombFriction("hinge"), model) == [1]
    assert descriptions.dofs_of(CommandDelay("push"), model) == [0]
    assert descriptions.dofs_of(Payload("pole"), model) == [0, 1]
    assert descriptions.dofs_of(Payload("cart"), model) == [0]
    assert descriptions.dofs_of(GravityTilt(), model) == [0, 1]


def test_equations_have_numbers_for_names() -> None:
    from sb3_rpto.effects.bodies import Payload
    from sb3_rpto.effects.forces import TorqueOffset, TorqueRipple

    ripple = TorqueRipple("hinge", cosine=-0.5, sine=0.25, turns=6)
    assert descriptions.with_numbers(ripple) == "-0.5 cos(6 q) + 0.25 sin(6 q)"
    ripple = TorqueRipple("hinge", cosine=0.5, sine=-0.25, turns=6)
    assert descriptions.with_numbers(ripple) == "0.5 cos(6 q) + (-0.25) sin(6 q)"
    assert descriptions.with_numbers(TorqueOffset("hinge", offset=-0.5)) == "-0.5"
    # Its equation is in words, one of which is a parameter's name.
    assert descriptions.with_numbers(Payload("pole", mass=0.1)) == f"{Payload.equation} with mass 0.1 kg, along 2"


@pytest.mark.slow
def test_a_report_pickles(report: Report, tmp_path: Path) -> None:
    for other in (pickle.loads(pickle.dumps(report)), copy.deepcopy(report)):
        assert str(other) == str(report)
        report.save(tmp_path / "one")
        other.save(tmp_path / "other")
        for file in (tmp_path / "one").iterdir():
            assert (tmp_path / "other" / file.name).read_bytes() == file.read_bytes()


@pytest.mark.slow
def test_what_all_runs_have_in_common_is_said_once_in_text_json_and_html(tmp_path) -> None:
    table = {n: column for n, column in recorded(episodes=5).tables().items() if not n.startswith("qvel")}
    found = briefly(PENDULUM, Measurements.from_tables({"log": table}), ["hinge.damping"], candidates=[])
    found.save(tmp_path)
    (stored,) = [f for f in json.loads((tmp_path / "report.json").read_text())["findings"] if "velocity" in f["kind"]]
    assert stored["runs"] == ["0", "1", "2", "3", "4"]
    where = "qvel.hinge of 0, 1, 2, 3 and 4"
    assert stored["where"] == where
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [text.count("missing velocity") for text in (str(found), page)] == [1, 1]
    assert where in unwrapped(found)
    assert where in page
