"""Files that a machine's logger left, as commands take them."""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_rpto.effects import Effect
    from sb3_rpto.effects.model import ModelSource
    from sb3_rpto.sysid import Measurements

#: Readers of recordings by the suffix of their files.
FORMATS = {"csv": "from_csv", "parquet": "from_parquet", "npz": "from_npz"}


def add(parser: argparse.ArgumentParser) -> None:
    """Add what is told of recordings, and of what to look for in them, to a command's parser."""
    parser.add_argument("files", metavar="FILES", nargs="+", help="recordings: .csv, .csv.gz, .parquet or .npz")
    parser.add_argument("--format", choices=sorted(FORMATS), help="of the recordings (default: by their suffix)")
    parser.add_argument(
        "--rename",
        metavar="OLD=NEW,...",
        type=_rename,
        action="append",
        default=[],
        help="columns that the files call otherwise: t=time,q1=qpos.shoulder,cmd1=ctrl.m1; repeatable",
    )
    parser.add_argument(
        "--declare",
        metavar="A,B",
        type=names,
        action="extend",
        default=[],
        help="parameters that may be fitted: hinge.damping, pole.mass, '*.damping', arm.mass=0.2:0.9; repeatable",
    )
    parser.add_argument(
        "--candidates", metavar="K1,K2", type=names, help="kinds of effects to look for (default: all that are offered)"
    )
    parser.add_argument(
        "--known",
        metavar="FILE",
        type=Path,
        help="effects that the machine is known to have: the effects.json of an earlier trace of the same simulator",
    )
    parser.add_argument(
        "--simulated",
        action="store_true",
        help="the recordings are of the simulator itself, in its own steps in time (default: found out; being told "
        "saves a second search)",
    )


def _rename(text: str) -> dict[str, str]:
    from sb3_rpto.sysid.data.text_tables import parse_rename

    try:
        return parse_rename(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def names(text: str) -> list[str]:
    """Names that commas part."""
    return [name.strip() for name in text.split(",") if name.strip()]


def check_candidates(candidates: list[str] | None) -> None:
    """Refuse an empty list.

    :raises ValueError: with the remedy
    """
    if candidates == []:
        raise ValueError("--candidates is empty; name kinds of effects, or leave it out to look for all")


def check_out(out: Path, model: ModelSource) -> None:
    """Require that the simulator of a report can be written, before minutes of work.

    :param out: folder that it goes to
    :param model: the nominal one
    :raises ValueError: nothing tells its MJCF, or it is in ``out`` itself
    """
    from sb3_rpto.effects.corrected_model_io import check_free, save_corrected
    from sb3_rpto.effects.model import file_of

    try:
        check_free(out, file_of(model))
    except ValueError as error:
        raise ValueError(f"--out: {error}") from None
    with tempfile.TemporaryDirectory() as trial:
        save_corrected(trial, model, [])


def known(path: Path | None, model: ModelSource) -> list[Effect]:
    """The effects that a machine is known to have, declared numbers among them.

    :param path: the effects.json of an earlier trace, if any
    :param model: the nominal one
    :raises FileNotFoundError: there is no such file
    :raises ValueError: it holds something else, or an effect that the model cannot have
    """
    from sb3_rpto.commands.options import check_file
    from sb3_rpto.effects.corrected_model_io import read_effects
    from sb3_rpto.effects.model import load_model

    check_file(path, "--known")
    return [] if path is None else read_effects(path, load_model(model)[1])


def read(files: Sequence[str], form: str | None, rename: Sequence[Mapping[str, str]] = ()) -> Measurements:
    """Read files of one format.

    :param files: paths or patterns
    :param form: the format; None: by their suffix
    :param rename: names of columns by those of the files
    :raises ValueError: of several formats, or an unknown one; a name that the files do not have, or that is given twice
    """
    from sb3_rpto.sysid import Measurements

    found = {form} if form else {_format_of(file) for file in files}
    if len(found) > 1:
        raise ValueError(f"FILES are of several formats ({', '.join(sorted(map(str, found)))}); convert them to one")
    pairs = [pair for each in rename for pair in each.items()]
    if len({old for old, _ in pairs}) < len(pairs):
        raise ValueError("--rename names a column twice; name each once")
    return getattr(Measurements, FORMATS[str(found.pop())])(files, rename=dict(pairs) or None)


def digest(data: Measurements) -> str:
    """SHA-256 of what was recorded and whose columns it is, whatever files hold it."""
    found = hashlib.sha256(f"{data.columns}".encode())
    for episode in data.episodes:
        found.update(f"{episode.run} {episode.part} {dict(episode.params)}".encode())
        for values in (episode.time, episode.qpos, episode.qvel, episode.ctrl, episode.qfrc, episode.enabled):
            found.update(values.tobytes())
    return found.hexdigest()


def _format_of(file: str) -> str:
    if Path(file).is_dir():
        raise ValueError(f"{file} is a folder; name its files, such as {Path(file) / '*.csv'}")
    suffix = Path(file.removesuffix(".gz")).suffix.removeprefix(".").lower()
    if suffix not in FORMATS:
        raise ValueError(f"{file}: recordings are .csv, .csv.gz, .parquet or .npz; name another suffix's by --format")
    return suffix
