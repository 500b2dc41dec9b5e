"""The runner: each job once, side by side, resumed after a kill, and its tables."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks import runner
from benchmarks.runner import Study, chosen, read_table, rows_of, run_jobs, spread, write_table


@dataclass(frozen=True)
class Square:
    """A job for tests."""

    number: int
    seed: int = 0

    @property
    def name(self) -> str:
        return f"square {self.number}"


MADE: list[int] = []


def squared(job: Square) -> list[dict[str, Any]]:
    MADE.append(job.number)
    if job.number < 0:
        raise ValueError("no | root")
    return [{"square": job.number**2}]


@pytest.fixture(autouse=True)
def _nothing_made() -> None:
    MADE.clear()


def run(folder: Path, *numbers: int, **settings: Any) -> list[dict[str, Any]]:
    return run_jobs(squared, [Square(n, settings.pop("seed", 0)) for n in numbers], folder, 1, **settings)


def test_finished_jobs_are_not_repeated_and_torn_failed_or_other_ones_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = run(tmp_path, 3, -1, 2)
    assert MADE == [3, -1, 2], "in their order, and a failure stops no other"
    assert [result["name"] for result in results] == ["square 3", "square -1", "square 2"]
    assert "ValueError: no | root" in results[1]["error"]
    assert "square -1 failed: ValueError: no | root" in capsys.readouterr().err
    assert sorted(file.name for file in tmp_path.iterdir()) == ["square--1.json", "square-2.json", "square-3.json"]
    MADE.clear()
    torn = tmp_path / "square-2.json"
    torn.write_text(torn.read_text()[:40])
    assert rows_of(run(tmp_path, 3, -1, 2)) == rows_of(results)
    assert MADE == [-1, 2]
    MADE.clear()
    run(tmp_path, 3, seed=1)
    assert MADE == [3], "another job of that name"
    run(tmp_path, 3, seed=1, current=lambda job, result: False)
    run(tmp_path, 3, seed=1, fresh=True)
    assert MADE == [3, 3, 3]


def test_a_result_says_what_made_it(tmp_path: Path) -> None:
    (result,) = run(tmp_path, 2)
    assert result["job"] == {"number": 2, "seed": 0}
    assert result["rows"] == [{"square": 4}]
    assert result["versions"]["torch"]
    assert result["seconds"] >= 0
    assert {"commit", "python", "machine", "error"} <= set(result)


def test_bad_settings_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="workers is 0"):
        run_jobs(squared, [Square(1)], tmp_path, 0)
    with pytest.raises(ValueError, match="backend is 'dask'"):
        run_jobs(squared, [Square(1)], tmp_path, 1, "dask")
    with pytest.raises(ValueError, match="the same name"):
        run(tmp_path, 1, 1)
    for only, words in (("(", "no regular expression"), ("cube", "names look like 'square 1'")):
        with pytest.raises(ValueError, match=words):
            chosen([Square(1)], only)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[ray\]'"):
        run_jobs(squared, [Square(1)], tmp_path, 1, "ray")


def die_at_one(item: int) -> int:
    if item == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return -item


@pytest.mark.slow
def test_a_process_that_the_system_ends_takes_no_other_run_with_it() -> None:
    answers = list(spread(die_at_one, range(5), 2, "joblib", lost=lambda item: 100 + item))
    assert sorted(answers) == [-4, -3, -2, 0, 101]
    with pytest.raises(RuntimeError, match="terminated"):
        list(spread(die_at_one, range(3), 2, "joblib"))


def test_a_run_whose_process_was_ended_is_one_that_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ended(function: Any, items: list[Square], workers: int, backend: str, lost: Any) -> Any:
        return map(lost, items)

    monkeypatch.setattr(runner, "spread", ended)
    (result,) = run(tmp_path, 2)
    assert "ended by the system" in result["error"]
    monkeypatch.undo()
    assert rows_of(run(tmp_path, 2))[0]["square"] == 4, "so it is made again"


#: Variable with the path of the pipe on which long runs say that they have begun.
FIFO = "RPTO_TEST_FIFO"


@pytest.mark.slow
def test_an_interrupted_study_keeps_what_is_finished_and_ends_its_processes(tmp_path: Path) -> None:
    program = f"""
        import sys
        sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(Path(__file__).parents[2])!r}]
        from benchmarks.runner import run_jobs
        from test_runner import Square, slow_after_two
        run_jobs(slow_after_two, [Square(n) for n in range(4)], {str(tmp_path)!r}, 2)
    """
    fifo = tmp_path / "begun"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    environment = {**os.environ, FIFO: str(fifo)}
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)], start_new_session=True, env=environment
    )
    begun = b""
    while len(begun) < 2:  # both workers are at a long run, so the two short ones are finished
        begun += read_in_time(reader)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.wait(timeout=120) != 0
    assert sorted(file.name for file in tmp_path.glob("*.json")) == ["square-0.json", "square-1.json"]
    assert read_in_time(reader) == b"", "its workers live on"
    os.close(reader)


def read_in_time(reader: int) -> bytes:
    """What was written to a pipe; nothing once all of its writers have ended."""
    ready, _, _ = select.select([reader], [], [], 300)
    assert ready, "nothing was written, and the writers live on"
    return os.read(reader, 10)


def slow_after_two(job: Square) -> list[dict[str, Any]]:
    if job.number >= 2:
        with open(os.environ[FIFO], "wb", buffering=0) as begun:
            begun.write(b".")
            signal.pause()
    return squared(job)


ROWS = [
    {"text": "72908e7", "number": 0.1 + 0.2, "whole": 3, "yes": True, "nested": {"a": [1.5, "x"]}, "empty": ""},
    {"text": 'a, "b"', "late": None, "number": float("nan"), "whole": -1},
]


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    write_table(tmp_path / "t.csv", ROWS, digits=None)
    first, second = read_table(tmp_path / "t.csv")
    assert first == {**ROWS[0], "late": None}
    assert {name: value for name, value in second.items() if value is not None} == {"text": 'a, "b"', "whole": -1}
    write_table(tmp_path / "t.csv", ROWS, digits=3)
    assert read_table(tmp_path / "t.csv")[0]["number"] == 0.3


def test_a_study_writes_its_table_with_what_made_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = Study(
        "squares",
        "squares",
        "Squares.",
        jobs=lambda asked: [Square(n) for n in asked.numbers],
        run=lambda job, folder: squared(job),
        summary=lambda rows: f"sum {sum(row['square'] for row in rows)}",
        options=lambda parser: parser.add_argument("--numbers", nargs="+", type=int, default=[1, 2, -3]),
    )
    out = ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "squares"), "--workers", "1"]
    assert study.main(out) == 1
    assert "sum 5\n2 of 3 runs are done" in capsys.readouterr().out
    assert [row["square"] for row in read_table(tmp_path / "squares.csv")] == [1, 4]
    assert json.loads((tmp_path / "squares.json").read_text())["command"].startswith("python -m benchmarks squares")
    assert study.main([*out, "--only", "2"]) == 0
    assert study.main([*out, "--list", "--numbers", "7"]) == 0
    assert capsys.readouterr().out.endswith("square 7\n")
