"""The zip of a model: what it says of itself, read without the pickles in it, and entries beside SB3's."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch as th

#: How every zip begins, also one that was cut off.
_BEGIN = b"PK\x03\x04"
#: Of entries of ours: SB3 takes what ends in .pth for parameters of the class that loads it, and refuses others'.
_OWN = ".pt"
#: Attributes that a SAC has and SB3's other algorithms have not.
OF_SAC = frozenset({"target_entropy", "ent_coef", "use_sde_at_warmup"})
#: What a TQC has beside all that SAC has.
TQC = "top_quantiles_to_drop_per_net"


def located(path: Any, argument: str) -> Any:
    """The file that a path means, with the suffix that SB3 adds where there is none without it.

    :param path: of the zip, without its suffix, too; or an open file, which is returned
    :param argument: what to call it
    :raises TypeError: neither a path nor an open file
    :raises FileNotFoundError: there is none
    :raises ValueError: for a folder
    """
    if isinstance(path, io.IOBase):
        return path
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"{argument} must be the path of a zip or an open file, not {type(path).__name__}")
    plain = Path(path)
    for file in (plain, plain.with_name(f"{plain.name}.zip")):
        if file.is_file():
            return file
    if plain.is_dir():
        inside = sorted(file.name for file in plain.glob("*.zip"))
        raise ValueError(
            f"{argument}={str(path)!r} is a folder; pass the zip of a model, such as {inside[0]!r} in it"
            if inside
            else f"{argument}={str(path)!r} is a folder, without the zip of a model; pass the file that save() wrote"
        )
    raise FileNotFoundError(f"{argument}={str(path)!r}: there is no such file; pass the zip that save() wrote")


def look_into(file: Any, argument: str) -> dict[str, Any]:
    """The attributes of a model that its zip holds as JSON; of others, it says the pickle's text, which is not read.

    :param file: as :func:`located` found it
    :param argument: what to call it
    :return: by name
    :raises ValueError: no zip, one that is cut off or damaged, and one of anything but a model of SB3's
    """
    name = f"{argument}={str(file)!r}"
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{name} is damaged at its entry {damaged!r}; copy it anew, or save the model again")
            content = json.loads(archive.read("data")) if "data" in archive.namelist() else None
    except zipfile.BadZipFile as error:
        if _begins_as_zip(file):
            raise ValueError(f"{name} is a zip that was cut off; copy it anew, or save the model again") from error
        raise ValueError(f"{name} is no zip of a model; pass what save() wrote") from error
    except (UnicodeDecodeError, json.JSONDecodeError):
        content = None
    if not isinstance(content, dict) or "policy_class" not in content:
        raise ValueError(f"{name} is no zip of a model of Stable-Baselines3; pass what save() wrote")
    return content


def misfit_of_sac(content: Mapping[str, Any]) -> str:
    """Why a model is no SAC, nor derived from one; empty where it is.

    :param content: of :func:`look_into`
    """
    if "trpo_kwargs" in content:
        return "it is an SLBO's, which acts by TRPO's policy"
    if set(content) >= OF_SAC and TQC not in content:
        return ""
    policy = content["policy_class"]
    module = policy.get("__module__") if isinstance(policy, dict) else policy
    return f"another algorithm saved it, with a policy of {module}"


def append_states(file: Any, states: Mapping[str, Any]) -> None:
    """Add to the zip that SB3 wrote what SB3 shall not read.

    :param file: of the zip, readable
    :param states: of modules and optimizers, by name
    """
    with zipfile.ZipFile(file, mode="a") as archive:
        for name, state in states.items():
            with archive.open(f"{name}{_OWN}", mode="w", force_zip64=True) as entry:
                th.save(state, entry)


def read_states(file: Any, names: Collection[str], device: Any) -> dict[str, Any]:
    """What :func:`append_states` added, as far as it is there.

    :param file: of the zip
    :param names: of modules and optimizers
    :param device: to put it on
    """
    with zipfile.ZipFile(file) as archive:
        there = set(archive.namelist())
        found = {}
        for name in names:
            if f"{name}{_OWN}" in there:
                with archive.open(f"{name}{_OWN}") as entry:
                    found[name] = th.load(entry, map_location=device, weights_only=True)
    return found


def _begins_as_zip(file: Any) -> bool:
    if isinstance(file, Path):
        with file.open("rb") as opened:
            return opened.read(len(_BEGIN)) == _BEGIN
    file.seek(0)
    return bool(file.read(len(_BEGIN)) == _BEGIN)
