"""Encoder zeros that differ from run to run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from simulated import PENDULUM, briefly, compiled, recorded

from sb3_rpto.effects.forces import Spring
from sb3_rpto.sysid import Measurements, Report
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.hypotheses.encoder_offsets import offsets_of
from sb3_rpto.sysid.settings import ProblemSettings, Settings

#: of six runs, in rad
ZEROS = np.array([0.03, -0.02, 0.0, -0.04, 0.05, -0.01])
KINDS = ["spring", "sensor_bias"]


def shifted(data: Measurements, offsets: Sequence[float]) -> Measurements:
    """Each run as an encoder with another zero would have shown it."""
    runs = sorted({e.run for e in data.episodes})
    return replace(data, episodes=[replace(e, qpos=e.qpos + offsets[runs.index(e.run)]) for e in data.episodes])


@cache
def runs(stiffness: float = 0.0) -> Measurements:
    return recorded([Spring("hinge", stiffness=stiffness)] if stiffness else [], compiled(), len(ZEROS), 2.5)


@cache
def traced(stiffness: float, scale: float, common: float = 0.0) -> Report:
    return briefly(PENDULUM, shifted(runs(stiffness), scale * ZEROS + common), [], KINDS)


def differences(report: Report, scale: float) -> np.ndarray:
    """Found minus true zeros of the fitted runs, (R,)."""
    assert report.zeros is not None
    assert report.zeros.joints == ("hinge",)
    return report.zeros.offsets[:, 0] - scale * ZEROS[[int(run) for run in report.zeros.runs]]


@pytest.mark.slow
def test_zeros_of_single_runs_are_found_and_taken_off() -> None:
    report = traced(0.0, 1.0)
    assert report.verdict == "explained"
    assert report.effects == []
    np.testing.assert_allclose(differences(report, 1.0), 0.0, atol=1e-3)
    assert not report.adequacy_before.adequate
    assert report.adequacy_after.adequate
    assert set(report.zeros.runs) == {*report.runs["train"], *report.runs["select"]}


@pytest.mark.slow
def test_an_effect_beside_them_is_named() -> None:
    report = traced(0.5, 1.0)
    assert [t.label for t in report.effects] == ["spring(hinge)"]
    assert report.effects[0].effect.values[0] == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(differences(report, 1.0), 0.0, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [0.0, 0.5])
def test_one_zero_in_all_runs_is_none_that_differs(stiffness: float) -> None:
    report = traced(stiffness, 0.0, 0.0 if stiffness else 0.05)
    assert report.zeros is None
    assert [t.label for t in report.effects] == [f"{'spring' if stiffness else 'sensor_bias'}(hinge)"]


@pytest.mark.slow
def test_what_all_runs_have_beyond_chance_is_a_bias_of_the_sensor() -> None:
    report = traced(0.0, 0.3, 0.2)
    (bias,) = report.effects
    assert bias.label == "sensor_bias(hinge)"
    mean = np.mean(0.3 * ZEROS[[int(run) for run in report.zeros.runs]])
    assert bias.effect.values[0] == pytest.approx(0.2 + mean, abs=2e-3)
    np.testing.assert_allclose(differences(report, 0.3), -mean, atol=2e-3)


@pytest.mark.slow
def test_the_report_says_them() -> None:
    report = traced(0.0, 1.0)
    run = report.zeros.runs[0]
    assert f"{run} {report.zeros.offsets[0, 0]:+.3g}" in " ".join(str(report).split())
    assert "differ from run to run" in report.html()
    assert report.to_json()["zeros"]["offsets"]["hinge"][run] == pytest.approx(report.zeros.offsets[0, 0])
    assert FindingKind.RUN_ZEROS in {f.kind for f in report.findings}


@pytest.mark.slow
def test_recordings_lose_the_zeros_of_their_runs_alone() -> None:
    zeros = traced(0.0, 1.0).zeros
    plain = zeros.taken_off(shifted(runs(), ZEROS))
    for before, after in zip(runs().episodes, plain.episodes):
        there = before.run in zeros.runs
        off = ZEROS[int(before.run)] - (zeros.offsets[zeros.runs.index(before.run), 0] if there else 0.0)
        np.testing.assert_allclose(after.qpos - before.qpos, off, atol=1e-12)


@pytest.mark.slow
def test_a_corrected_model_tells_the_zeros_of_other_runs() -> None:
    report = traced(0.0, 1.0)
    new = shifted(recorded([], compiled(), 2, 4.0, seed=9), [0.07, -0.05])
    zeros = report.zeros_of(new)
    assert zeros.joints == ("hinge",)
    assert zeros.runs == ("0", "1")
    np.testing.assert_allclose(zeros.offsets, [[0.07], [-0.05]], atol=2e-3)
    with pytest.raises(ValueError, match="no encoder's zero"):
        traced(0.0, 0.0, 0.05).zeros_of(new)


@pytest.mark.slow
def test_a_joint_that_was_at_rest_says_nothing_of_new_zeros(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("sb3_rpto.sysid.report.report.offsets_of", lambda *args: seen.append(args[2]))
    report = traced(0.0, 1.0)
    replace(report, data=replace(report.data, unobserved=("hinge",))).zeros_of(runs())
    assert seen[0].unobserved == ("hinge",)


@pytest.mark.slow
def test_every_run_is_told_its_zero_and_one_without_a_window_is_named() -> None:
    report, zeros = traced(0.0, 1.0), [0.07, -0.05, 0.02, 0.04]
    new = shifted(recorded([], compiled(), 4, 4.0, seed=9), zeros)
    fitted = (report.simulation, report.values_after, new, report.sigma, report.horizon, report.zeros.joints)
    found = offsets_of(*fitted, Settings(problem=ProblemSettings(train_windows=2, select_windows=1)))
    assert found.runs == ("0", "1", "2", "3")
    np.testing.assert_allclose(found.offsets[:, 0], zeros, atol=5e-3)
    short = new.episodes[-1].part_of(slice(20), after_gap=False)
    with pytest.raises(ValueError, match="runs 3 hold no window of"):
        report.zeros_of(replace(new, episodes=[*new.episodes[:-1], short]))


@pytest.mark.slow
def test_of_a_run_that_is_too_short_for_a_window_no_zero_is_said() -> None:
    data = shifted(runs(), ZEROS)
    short = data.episodes[-1].part_of(slice(40), after_gap=False)
    report = briefly(PENDULUM, replace(data, episodes=[*data.episodes[:-1], short]), [], KINDS)
    assert short.run in {*report.runs["train"], *report.runs["select"]} - {*report.zeros.runs}
    np.testing.assert_allclose(differences(report, 1.0), 0.0, atol=1e-3)


@pytest.mark.slow
def test_without_a_bias_among_the_candidates_none_are_looked_for() -> None:
    report = briefly(PENDULUM, shifted(runs(), ZEROS), [], ["spring"])
    assert report.zeros is None
    assert report.verdict in ("unexplained", "partly explained")
