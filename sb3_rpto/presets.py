"""Hyperparameter presets: zoo-style YAML that fills in what the user did not pass."""

from __future__ import annotations

import re
from collections.abc import Collection
from importlib import resources
from typing import Any

import yaml

_FOLDER = resources.files("sb3_rpto") / "hyperparams"


def preset_names() -> list[str]:
    """The shipped presets."""
    return sorted(path.name.removesuffix(".yml") for path in _FOLDER.iterdir() if path.name.endswith(".yml"))


def resolve_preset(preset: str, backend: str, env_id: str | None, passed: Collection[str]) -> dict[str, Any]:
    """What a preset sets for an algorithm's constructor.

    A preset file has sections: ``any`` (every environment), a dynamics backend's name, and environment names without
    version, which may hold a section for a backend in their turn. The later of these win; what the user passed wins
    over all. An environment that the file does not name gets the sections ``any`` and the backend's, which is the
    documented default.

    :param preset: name of a shipped preset
    :param backend: the section of the source's kind: "real" (RPO), "ensemble", "physical", "mujoco" or "residual"
    :param env_id: id of the source environment, None when it has none
    :param passed: names of the arguments that the user passed
    :raises ValueError: for a preset that does not exist
    """
    if preset not in preset_names():
        raise ValueError(f"preset={preset!r} does not exist; choose one of {preset_names()}")
    sections = yaml.safe_load((_FOLDER / f"{preset}.yml").read_text(encoding="utf-8"))
    values: dict[str, Any] = {}
    of_task = sections.get(bare_name(env_id), {})
    everywhere = {name: value for name, value in of_task.items() if name not in sections}
    for section in (sections["any"], sections.get(backend, {}), everywhere, of_task.get(backend, {})):
        for name, value in section.items():
            if isinstance(value, dict):
                value = {**values.get(name, {}), **value}
            values[name] = value
    return {name: value for name, value in values.items() if name not in passed}


def bare_name(env_id: str | None) -> str:
    """``"rpto/Ant-v0"`` and ``"module:Ant-v5"`` -> ``"Ant"``."""
    return re.sub(r"-v\d+$", "", re.split(r"[:/]", env_id or "")[-1])
