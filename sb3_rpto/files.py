"""Files that are written whole or not at all, and JSON that every reader takes."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # Windows has none
    fcntl = None  # type: ignore[assignment]

#: A temporary file that is older than so many seconds is nobody's any more, where locks do not tell.
LEFT = 3600.0


def write_atomically(path: Any, write: Callable[[Any], None], suffix: str = "zip") -> None:
    """Write through a temporary file beside ``path``: a killed run leaves the old file or the new one, never half.

    :param path: where the file goes; ``suffix`` is added when it has none; file objects are written directly
    :param write: writes to the path that it is given
    :raises ValueError: for a folder
    """
    if not isinstance(path, str | Path):
        write(path)
        return
    path = Path(path)
    _refuse_folder(path, suffix)
    if path.suffix == "":
        path = path.with_name(f"{path.name}.{suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with _temporary(path, suffix) as file:
        write(file)
        _settle(file)
        os.replace(file, path)


def write_bytes(path: Path, content: bytes) -> None:
    """The same of contents that are known."""
    write_together({path: content})


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write several files, all of them or none: each is replaced once all are on the disk.

    :param contents: by path; folders are there
    :raises ValueError: one of the paths is a folder
    """
    with contextlib.ExitStack() as opened:
        made = {path: opened.enter_context(_temporary(path, "part")) for path in contents}
        for path, file in made.items():
            file.write_bytes(contents[path])
            _settle(file)
        for path, file in made.items():
            os.replace(file, path)


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


def _refuse_folder(path: Path, suffix: str) -> None:
    if path.is_dir():
        raise ValueError(
            f"{str(path)!r} is a folder; give the name of a file, such as {str(path / f'model.{suffix}')!r}"
        )


def _settle(file: Path) -> None:
    """Bring the contents to the disk: else the name may outlast a crash of the machine, and they not."""
    with file.open("rb+") as opened:
        os.fsync(opened.fileno())


@contextlib.contextmanager
def _temporary(path: Path, suffix: str) -> Iterator[Path]:
    """An empty file beside ``path`` to write to, gone afterwards; those that killed runs left there go first.

    A lock tells them from those of runs under way: with its process a file's lock goes, too.
    """
    _refuse_folder(path, suffix)
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.{suffix}"):
        with contextlib.suppress(OSError):
            _sweep(left)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{suffix}")
    with _held(temporary):
        yield temporary


@contextlib.contextmanager
def _held(file: Path) -> Iterator[None]:
    """The file, made if it is not there, with a lock on it; gone afterwards, unless it was put elsewhere."""
    if fcntl is None:
        try:
            yield  # an open file could not be replaced there
        finally:
            file.unlink(missing_ok=True)
        return
    while True:
        with file.open("ab") as opened:
            with contextlib.suppress(OSError):  # of a file system without locks
                fcntl.flock(opened, fcntl.LOCK_EX)
            # Another thread may have put it in place meanwhile, or another run have swept it before it was locked.
            if not _is_at(opened.fileno(), file):
                continue
            try:
                yield
            finally:
                if _is_at(opened.fileno(), file):  # once that one is in place, another thread's may be here
                    file.unlink()
            return


def _is_at(opened: int, file: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(opened), file.stat())
    except FileNotFoundError:
        return False


def _sweep(file: Path) -> None:
    """Remove a temporary file that nobody writes to any more."""
    if fcntl is not None:
        with file.open("rb") as opened:
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return
            except OSError:
                pass  # a file system without locks
            else:
                if _is_at(opened.fileno(), file):  # under the lock: whoever waits for it looks again
                    file.unlink()
                return
    if time.time() - file.stat().st_mtime > LEFT:
        file.unlink()


def digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
