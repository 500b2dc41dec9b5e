"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(path: Any, write: Callable[[Any], None], suffix: str = "zip") -> None:
    """Write through a temporary file beside ``path``: a killed run leaves the old file or the new one, never half.

    :param path: where the file goes; ``suffix`` is added when it has none; file objects are written directly
    :param write: writes to the path that it is given
    """
    if not isinstance(path, str | Path):
        write(path)
        return
    path = Path(path)
    if path.suffix == "":
        path = path.with_name(f"{path.name}.{suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, write, suffix)


def write_bytes(path: Path, content: bytes) -> None:
    """The same of contents that are known."""
    _replace(path, lambda file: file.write_bytes(content), "part")


def write_text(path: Path, text: str) -> None:
    """The same of a text, in UTF-8."""
    write_bytes(path, text.encode())


def _replace(path: Path, write: Callable[[Path], Any], suffix: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{suffix}")
    try:
        write(temporary)
        with temporary.open("rb+") as file:  # else the name may outlast a crash of the machine, and the contents not
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
