"""The threshold that complete sets ask for."""

from pathlib import Path

import pytest

from benchmarks.tracing import threshold
from benchmarks.tracing.threshold import Job, jobs, summary


@pytest.mark.slow
def test_a_complete_set_needs_a_threshold(tmp_path: Path) -> None:
    (row,) = threshold.needed(Job("pendulum", 1e-3, 1), tmp_path, episodes=6, duration=2.0)
    assert row["candidates"] > 5
    assert 0 <= row["t"] < 10


def test_machines_and_noises_take_turns() -> None:
    sets = jobs(11)
    assert [job.seed for job in sets] == list(range(threshold.FIRST, threshold.FIRST + 11))
    assert {job.noise for job in sets} == set(threshold.NOISES)
    assert len({job.system for job in sets}) == 5
    assert jobs(3) == sets[:3]
    with pytest.raises(ValueError, match="sets"):
        jobs(0)


def test_what_is_needed_is_said() -> None:
    words = summary([{"t": float(i)} for i in range(1, 12)])
    assert words == "95% of 11 complete sets need less than 10.50; 8 need more than 3.5"
