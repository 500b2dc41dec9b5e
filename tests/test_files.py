"""Files are written whole or not at all."""

import json
import os
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

from sb3_rpto.files import write_atomically, write_json, write_text


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


def test_what_killed_writes_left_is_swept_by_a_later_one_and_a_write_under_way_is_not(tmp_path: Path) -> None:
    old, new, other = (tmp_path / f".{name}.{pid}.zip" for name, pid in (("a.zip", 1), ("a.zip", 2), ("b.zip", 1)))
    for left in (old, new, other):
        left.write_text("half")
    for left in (old, other):
        os.utime(left, (0, 0))
    write_atomically(tmp_path / "a", lambda path: path.write_text("whole") and None)
    assert {p.name for p in tmp_path.iterdir()} == {"a.zip", new.name, other.name}


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
