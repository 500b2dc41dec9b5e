"""Runs side by side, by joblib or on Ray, are the runs of one process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tiny_suite import SUITE, returns, run_here, stored

from benchmarks import runner
from benchmarks.transfer import sources, sweep
from benchmarks.transfer.plan import jobs


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run in this process."""
    return run_here(tmp_path_factory.mktemp("suite"))


@pytest.fixture
def expected(made: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, list[float]]:
    """What was found; agent and oracle are taken from there."""
    monkeypatch.setenv(sources.FOLDER_VARIABLE, str(made / "sources"))
    return stored(made)


@pytest.mark.slow
def test_two_processes_find_what_one_finds(tmp_path: Path, expected: dict[str, list[float]]) -> None:
    results = sweep.run(SUITE, tmp_path, workers=2)
    assert returns(results) == expected
    assert [result["name"] for result in results] == [job.name for job in jobs(SUITE)]


@pytest.mark.slow
def test_a_local_ray_with_two_workers_finds_what_one_process_finds(
    tmp_path: Path, expected: dict[str, list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = pytest.importorskip("ray", reason="ray, an extra, is not installed")
    monkeypatch.delenv(runner.RAY_ADDRESS, raising=False)
    seen = {}
    original = runner.spread

    def spying(*args: Any, **kwargs: Any) -> Any:
        seen.update(ray.cluster_resources())
        return original(*args, **kwargs)

    monkeypatch.setattr(runner, "spread", spying)
    assert returns(sweep.run(SUITE, tmp_path, workers=2, backend="ray")) == expected
    assert seen["CPU"] == 2
    assert not ray.is_initialized()  # it was ours
