"""What made a result: versions, commit, machine, and every argument of the model."""

from __future__ import annotations

import importlib.metadata
import inspect
import os
import platform
import subprocess
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch as th

from sb3_rpto.files import plain

PACKAGES = ("sb3-rpto", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "mujoco", "numpy", "scipy")
#: What a constructor takes that says nothing of the method, and attributes that are not called as the argument is.
_NOT_SETTINGS = frozenset({"self", "env", "target_env", "target_data", "_init_setup_model"})
_ATTRIBUTES = {"policy": "policy_class", "dynamics": "dynamics_backend"}


def versions() -> dict[str, str | None]:
    """Of the packages that results depend on; None: it is not there."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


@cache
def commit() -> str | None:
    """The commit of the package's checkout, marked where it was changed; None outside of one.

    An installed package that lies in somebody's checkout, as a virtual environment does, is no part of it.
    It is looked up once in a process, whose code stays what it was when the checkout moves on: ask early.
    """
    tracked = ["git", "ls-files", "--error-unmatch", Path(__file__).name]
    describe = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        for command in (tracked, describe):
            done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip() or None


def machine() -> dict[str, str]:
    """Python, system and cores."""
    system = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return {"python": platform.python_version(), "machine": system}


def constructor_arguments(model: Any) -> dict[str, Any]:
    """The values that an SB3 model has for the arguments of its own and its parents' constructors, as JSON takes them.

    :param model: an algorithm; SB3's common base classes do not count
    """
    values: dict[str, Any] = {}
    for cls in takewhile(lambda c: not c.__module__.startswith("stable_baselines3.common"), type(model).__mro__):
        for parameter in inspect.signature(cls.__init__).parameters.values():  # type: ignore[misc]
            name, kind = parameter.name, parameter.kind
            if name in _NOT_SETTINGS or kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                continue
            attributes = (_ATTRIBUTES.get(name, name), name, f"_{name}")
            found = [getattr(model, attribute) for attribute in attributes if hasattr(model, attribute)]
            if found:
                values.setdefault(name, str(found[0]) if isinstance(found[0], th.device) else plain(found[0]))
    return values
