"""Files are written whole or not at all."""

import errno
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

from sb3_rpto.files import write_atomically, write_json, write_text, write_together


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "\ud800")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_a_writer_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    def fails(path: Path) -> None:
        path.write_text("half")
        raise KeyboardInterrupt

    write_atomically(tmp_path / "model", lambda path: path.write_text("old") and None)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "model", fails)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("model.zip", "old")]


def test_what_killed_writes_left_goes_with_the_next_write_and_a_write_under_way_does_not(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    writer = """
import sys, time
from pathlib import Path
from sb3_rpto.files import write_atomically

def write(file):
    file.write_text("half")
    print("begun", flush=True)
    sys.stdin.read()
    file.write_text("whole")

write_atomically(Path(sys.argv[1]), write)
"""

    def begin() -> subprocess.Popen[str]:
        run = subprocess.Popen(
            [sys.executable, "-c", writer, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert run.stdout is not None
        assert run.stdout.readline() == "begun\n"
        return run

    killed, under_way = begin(), begin()
    (tmp_path / ".b.zip.1.zip").write_text("of another file")
    killed.kill()
    killed.communicate()
    assert len(list(tmp_path.glob(".a.zip.*"))) == 2
    write_atomically(path, lambda file: file.write_text("mine") and None)
    assert {p.name for p in tmp_path.iterdir()} == {"a.zip", f".a.zip.{under_way.pid}.zip", ".b.zip.1.zip"}
    assert path.read_text() == "mine"
    under_way.communicate("")
    assert (under_way.returncode, path.read_text()) == (0, "whole")
    assert {p.name for p in tmp_path.iterdir()} == {"a.zip", ".b.zip.1.zip"}


def test_threads_that_write_the_same_file_do_not_disturb_each_other(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda i: write_text(path, str(i) * 1000), range(10), timeout=60))
    assert path.read_text() in {str(i) * 1000 for i in range(10)}
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_files_that_are_written_together_are_all_new_or_all_old(tmp_path: Path, monkeypatch) -> None:
    paths = [tmp_path / name for name in ("model.xml", "report.json")]
    write_together(dict.fromkeys(paths, b"old"))
    monkeypatch.setattr(os, "fsync", lambda file: full_disk() if len(list(tmp_path.glob(".*"))) == 2 else None)
    with pytest.raises(OSError, match="No space left"):
        write_together(dict.fromkeys(paths, b"new"))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(paths, b"old")
    monkeypatch.undo()
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="is a folder; give the name of a file"):
        write_together({paths[0]: b"new", tmp_path / "folder": b"new"})
    assert paths[0].read_bytes() == b"old"
    write_together(dict.fromkeys(paths, b"new"))
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == dict.fromkeys(paths, b"new")


def full_disk() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("name", ["runs", "runs.zip"])
def test_a_folder_is_no_place_for_a_file(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=r"runs.* is a folder; give the name of a file, such as .*model\.zip"):
        write_atomically(tmp_path / name, lambda path: path.write_text("x") and None)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_json_is_strict_whatever_a_result_holds(tmp_path: Path) -> None:
    class Colour(Enum):
        RED = "red"

    given = {
        "a": np.float32(0.5),
        1: (np.nan, float("inf")),
        "f": len,
        "class": Path,
        "path": Path("a/b"),
        "array": np.array([[1.0, np.inf]]),
        "enum": Colour.RED,
        "none": None,
    }
    write_json(tmp_path / "result.json", given)

    def never(constant: str) -> None:
        pytest.fail(f"{constant} is not JSON")

    assert json.loads((tmp_path / "result.json").read_text(), parse_constant=never) == {
        "a": 0.5,
        "1": [None, None],
        "f": "builtins.len",
        "class": f"{Path.__module__}.Path",
        "path": "a/b",
        "array": [[1.0, None]],
        "enum": "red",
        "none": None,
    }
