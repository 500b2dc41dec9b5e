"""Traces of targets whose truth is known, by the first transitions of an untrained policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import SAC

from benchmarks.closed_loop import study as study
from benchmarks.tracing import targets
from benchmarks.tracing.targets import RUNS, Job, first_transitions, noisy_log, run
from benchmarks.transfer.sources import FOLDER_VARIABLE
from sb3_rpto.sysid.findings import FindingKind


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a source agent that was never trained."""
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    env_id = study.TASKS["double-pendulum"].env_id
    SAC("MlpPolicy", env_id, seed=0, device="cpu", buffer_size=1).save(tmp_path / env_id)
    return tmp_path


def test_the_first_transitions_are_the_targets_and_follow_from_the_seed(folder: Path) -> None:
    first, again, other = (first_transitions(Job("double-pendulum", "declared", 0, s), folder) for s in (0, 0, 1))
    # Of n transitions in e episodes n + e samples are made.
    assert sum(map(len, first.episodes)) <= targets.FIRST + len(first.episodes)
    assert first.exact
    starts = [m.episodes[0].qpos[0].tolist() for m in (first, again, other)]
    assert starts[0] == starts[1] != starts[2]


def test_a_log_holds_noisy_positions_of_the_simulators_steps(folder: Path) -> None:
    exact, noisy = (noisy_log(Job("double-pendulum", "undeclared", 0, noise=noise), folder) for noise in (1e-12, 1e-3))
    assert len(noisy.episodes) == RUNS
    assert np.allclose(np.diff(noisy.episodes[0].time), 0.01)
    assert len(noisy.episodes[0]) % 5 == 0  # samples of a step of the policy, which all have its command
    assert np.all(noisy.episodes[0].ctrl[:5] == noisy.episodes[0].ctrl[0])
    assert {f.kind for f in noisy.findings} == {FindingKind.MISSING_VELOCITY}
    noise = np.concatenate([a.qpos - b.qpos for a, b in zip(noisy.episodes, exact.episodes)])
    assert noise.std() == pytest.approx(1e-3, rel=0.1)


def test_noisy_sensors_show_the_same_transitions_with_noise_that_is_told(folder: Path) -> None:
    job = Job("double-pendulum", "none", 0, sensors=1e-3)
    data = first_transitions(job, folder)
    assert not data.exact
    assert data.noise is not None
    assert data.noise.qpos == pytest.approx(np.full(3, 1e-3), rel=0.05)
    assert data.noise.qvel == pytest.approx(np.full(3, 1e-2), rel=0.05)
    exact = first_transitions(Job("double-pendulum", "none", 0), folder)
    difference = data.episodes[0].qpos[0] - exact.episodes[0].qpos[0]  # the policy sees noise: its actions differ
    assert 0 < np.abs(difference).max() < 5e-3


def test_gusts_push_the_cart_and_nobody_records_them(folder: Path) -> None:
    still, pushed = (first_transitions(Job("double-pendulum", shift, 0), folder) for shift in ("declared", "gusts"))
    a, b = still.episodes[0], pushed.episodes[0]
    np.testing.assert_array_equal(a.qpos[0], b.qpos[0])
    n = min(len(a), len(b))
    assert np.abs(a.qpos[:n, 0] - b.qpos[:n, 0]).max() > 5e-3


def test_gusts_are_in_a_log_as_well(folder: Path) -> None:
    still, pushed = (noisy_log(Job("double-pendulum", shift, 0, noise=1e-3), folder) for shift in ("declared", "gusts"))
    assert any(
        len(a) != len(b) or np.abs(a.qpos - b.qpos).max() > 5e-3 for a, b in zip(still.episodes, pushed.episodes)
    )


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "named"), [("undeclared", "coulomb_friction(slider)"), ("none", "")])
def test_a_trace_is_compared_with_the_truth(
    shift: str, named: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "FIRST", 120)
    job = Job("double-pendulum", shift, 7)
    (row,) = run(job, folder)
    assert row["named_effects"] == named
    assert row["right"] == row["named"] == row["there"] == (1 if named else 0)
    assert row["verdict"] == ("explained" if named else "complete")
    assert row["declared_error_max"] < 1e-4


@pytest.mark.slow
def test_numbers_that_nobody_declared_are_compared_as_effects(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "FIRST", 120)
    (row,) = run(Job("double-pendulum", "declared", 0, declared=False), folder)
    assert row["verdict"] == "explained"
    # Of a cart that slides, a longer one and a heavier one are the same.
    assert row["named_effects"] == "link_length(cart); link_length(pole); link_length(pole2)"
    assert (row["there"], row["right"], row["alike"]) == (3, 2, 1)
    assert [abs(float(off)) < 1e-3 for off in row["true_effects_off"].split("; ")] == [True] * 2
    assert row["declared_worst"] is None
