"""Files are written whole or not at all."""

from pathlib import Path

import pytest

from sb3_rpto.files import write_atomically, write_text


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
