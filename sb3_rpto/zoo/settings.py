"""What the zoo knows of a task by its id, an algorithm's settings, and those of a finished run. Needs no rl_zoo3."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_rpto.algorithms import RPO, RPTO, RTO
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.pdml import PDML
from sb3_rpto.baselines.ptp import PTP
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.envs import tasks

#: The algorithms that the launcher adds to those of the zoo, by the names of ``--algo``.
ALGORITHMS: dict[str, type[TransferAlgorithm]] = {
    **{"rpo": RPO, "rto": RTO, "rpto": RPTO},
    **{"mbpo": MBPO, "ptp": PTP, "pdml": PDML, "slbo": SLBO},
}
#: How YAML tags what is an object of Python's.
_PYTHON = "tag:yaml.org,2002:python/"
_FOLDER = resources.files("sb3_rpto") / "hyperparams" / "zoo"


class _Object:
    """Stands for an object of Python's: making it would run whatever the file says."""


class _PlainLoader(yaml.SafeLoader):
    """Reads what the zoo writes, plain data in an OrderedDict, and makes no other object."""


def _ordered(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> dict[Any, Any]:
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


_PlainLoader.add_constructor(f"{_PYTHON}object/apply:collections.OrderedDict", _ordered)
_PlainLoader.add_constructor(f"{_PYTHON}tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True)))
_PlainLoader.add_multi_constructor(_PYTHON, lambda loader, suffix, node: _Object())


def _holds_object(value: Any) -> bool:
    if isinstance(value, dict):
        return any(map(_holds_object, (*value, *value.values())))
    return any(map(_holds_object, value)) if isinstance(value, list | tuple) else isinstance(value, _Object)


def source_of(target_id: str) -> str | None:
    """The source of one of our targets; a source is its own, an environment of somebody else has none.

    :param target_id: gymnasium id
    """
    spec = gym.registry.get(target_id)
    if spec is None or not str(spec.entry_point).startswith(f"{tasks.__name__}:"):
        return None
    return tasks.env_id(spec.kwargs["task"])


def shipped_file(algo: str) -> Path | None:
    """The YAML file of an algorithm's settings, None where we ship none."""
    path = Path(str(_FOLDER / f"{algo}.yml"))
    return path if path.is_file() else None


def section(env_id: str) -> str:
    """The key of the algorithms' files that holds for an environment."""
    return source_of(env_id) or env_id


def shipped_settings(algo: str, env_id: str) -> dict[str, Any]:
    """The shipped settings of an algorithm in an environment, ``n_timesteps`` and ``policy`` among them.

    :param algo: name of a shipped file
    :param env_id: id of a source or a target; the section ``default`` holds for those that the file does not name
    :raises ValueError: for an algorithm without a file
    """
    path = shipped_file(algo)
    if path is None:
        raise ValueError(f"there are no settings for {algo!r}; there are some for {', '.join(shipped_algorithms())}")
    sections = yaml.safe_load(path.read_text(encoding="utf-8"))
    return dict(sections.get(section(env_id), sections["default"]))


def shipped_algorithms() -> list[str]:
    """Names of the algorithms that we ship settings for."""
    return sorted(path.name.removesuffix(".yml") for path in _FOLDER.iterdir() if path.name.endswith(".yml"))


def settings_beside(trained_agent: str, name: str) -> dict[str, Any]:
    """What the zoo saved of the run of a zip; nothing where it is not in such a run's folder.

    Objects of Python's, which the file could have run anything by, are left out.

    :param trained_agent: the zip
    :param name: ``config.yml``, the settings, or ``args.yml``, the command's arguments
    :raises ValueError: the file is none of the zoo's
    """
    found = sorted(Path(trained_agent).parent.glob(f"*/{name}"))
    if len(found) != 1:
        return {}
    try:
        settings = yaml.load(found[0].read_text(encoding="utf-8"), Loader=_PlainLoader)
    except yaml.YAMLError as error:
        raise ValueError(f"{found[0]} is no YAML of the zoo's ({error}); mend it, or take the zip elsewhere") from error
    if not isinstance(settings, dict):
        raise ValueError(f"{found[0]} holds no settings by name; mend it, or take the zip elsewhere")
    return {key: value for key, value in settings.items() if not _holds_object(value)}


def target_beside(trained_agent: str) -> str | None:
    """In what ``sb3-rpto train`` or ``transfer`` trained a zip; None where it is not in such a run's folder."""
    try:
        return str(json.loads(Path(trained_agent).with_name("config.json").read_text(encoding="utf-8"))["target"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
