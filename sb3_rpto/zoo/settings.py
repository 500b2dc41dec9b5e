"""What the zoo knows of a task by its id, an algorithm's settings, and those of a finished run. Needs no rl_zoo3."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_rpto.algorithms import RPO, RPTO, RTO
from sb3_rpto.algorithms.mbpo import MBPO
from sb3_rpto.algorithms.pdml import PDML
from sb3_rpto.algorithms.ptp import PTP
from sb3_rpto.algorithms.slbo import SLBO
from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.envs import tasks

#: The algorithms that the launcher adds to those of the zoo, by the names of ``--algo``.
ALGORITHMS: dict[str, type[TransferAlgorithm]] = {
    **{"rpo": RPO, "rto": RTO, "rpto": RPTO},
    **{"mbpo": MBPO, "ptp": PTP, "pdml": PDML, "slbo": SLBO},
}
_FOLDER = resources.files("sb3_rpto") / "hyperparams" / "zoo"


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

    :param trained_agent: the zip
    :param name: ``config.yml``, the settings, or ``args.yml``, the command's arguments
    """
    found = sorted(Path(trained_agent).parent.glob(f"*/{name}"))
    return dict(yaml.unsafe_load(found[0].read_text())) if len(found) == 1 else {}  # it holds an OrderedDict's tag


def target_beside(trained_agent: str) -> str | None:
    """In what ``sb3-rpto train`` or ``transfer`` trained a zip; None where it is not in such a run's folder."""
    try:
        return str(json.loads(Path(trained_agent).with_name("config.json").read_text(encoding="utf-8"))["target"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
