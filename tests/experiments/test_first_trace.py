"""Traces of targets whose truth is known, by the first transitions of an untrained policy."""

from __future__ import annotations

from pathlib import Path

import pytest
from stable_baselines3 import SAC

from sb3_rpto.algorithms.closing import FIRST
from sb3_rpto.experiments import closed_loop as study
from sb3_rpto.experiments.first_trace import Job, first_transitions, run
from sb3_rpto.experiments.sources import FOLDER_VARIABLE


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
    assert sum(map(len, first.episodes)) <= FIRST + len(first.episodes)
    assert first.exact
    starts = [m.episodes[0].qpos[0].tolist() for m in (first, again, other)]
    assert starts[0] == starts[1] != starts[2]


@pytest.mark.parametrize(("shift", "named"), [("undeclared", "coulomb_friction(slider)"), ("none", "")])
def test_a_trace_is_compared_with_the_truth_and_made_once(shift: str, named: str, folder: Path) -> None:
    job = Job("double-pendulum", shift, 7)
    row = run(job, folder)
    assert row["named_effects"] == named
    assert row["right"] == row["named"] == row["there"] == (1 if named else 0)
    assert row["verdict"] == ("explained" if named else "complete")
    assert row["declared_error_max"] < 1e-4
    (folder / "trace_double-pendulum_undeclared_7_0.json").write_text('{"verdict": "kept"}')
    assert run(Job("double-pendulum", "undeclared", 7), folder) == {"verdict": "kept"}
