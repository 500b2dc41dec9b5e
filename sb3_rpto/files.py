"""Files that are written whole or not at all, and JSON that every reader takes."""

from __future__ import annotations

import contextlib
import glob
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

#: A temporary file that is older than so many seconds is nobody's any more.
LEFT = 3600.0


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


def write_json(path: Path, content: Any) -> None:
    """The same of what :func:`plain` makes of the contents."""
    write_text(path, json_text(content) + "\n")


def json_text(content: Any) -> str:
    """Strict JSON of what :func:`plain` makes of the contents."""
    return json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False)


def plain(value: Any) -> Any:
    """The same in types of strict JSON: no NaN, no infinity; classes and functions by their names."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Path):
        return str(value)
    named = value if hasattr(value, "__qualname__") else type(value)
    return f"{named.__module__}.{named.__qualname__}"


def _replace(path: Path, write: Callable[[Path], Any], suffix: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{suffix}")
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.{suffix}"):  # of killed runs, which may fill the disk
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > LEFT:
                left.unlink()
    try:
        write(temporary)
        with temporary.open("rb+") as file:  # else the name may outlast a crash of the machine, and the contents not
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
