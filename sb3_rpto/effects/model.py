"""MuJoCo models from whatever holds one."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import mujoco

from sb3_rpto.effects.model_numbers import same_layout
from sb3_rpto.effects.wrapper import beyond_model

#: what :func:`load_model` takes
ModelSource: TypeAlias = (
    str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel | gym.Env | tuple[mujoco.MjSpec, mujoco.MjModel]
)


def load_model(source: ModelSource) -> tuple[mujoco.MjSpec | None, mujoco.MjModel]:
    """The compiled model that ``source`` holds, and the specification that it came from.

    :param source: the path of an MJCF file, MJCF text, an MjSpec, an MjModel, or a gymnasium MuJoCo environment, whose
        model may have been changed since it was loaded. One whose MJCF is in no file tells it by a method ``mjcf()``.
        Or the pair that this returns, as it was then
    :return: a specification (None where nothing tells it: for an MjModel, and for an environment whose file compiles to
        a model of another layout) and a model; copies, the source is left alone
    :raises TypeError: none of these
    :raises FileNotFoundError: there is no such file
    :raises ValueError: the MJCF does not compile; an environment without a MuJoCo model, or with effects in it that are
        no numbers of the model
    """
    if isinstance(source, mujoco.MjModel):
        return None, copy.copy(source)
    if isinstance(source, tuple):
        known, model = source
        return None if known is None else known.copy(), copy.copy(model)
    if isinstance(source, mujoco.MjSpec):
        spec = source.copy()
        return spec, spec.compile()
    if isinstance(source, gym.Env):
        return _from_env(source)
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return _compiled(mujoco.MjSpec.from_string, source, "the MJCF text")
    if isinstance(source, str | os.PathLike):
        path = Path(source).expanduser()
        if not path.is_file():
            raise FileNotFoundError(
                f"there is no MJCF file {str(path)!r}; MJCF text would begin with '<', and of an environment "
                "pass what gymnasium.make returns"
            )
        return _compiled(mujoco.MjSpec.from_file, str(path), str(path))
    raise TypeError(
        f"a model is the path or text of an MJCF file, an MjSpec, an MjModel or a gymnasium MuJoCo environment, "
        f"not {type(source).__name__}"
    )


def file_of(source: ModelSource) -> Path | None:
    """The MJCF file that a model comes from, where it is of one."""
    if isinstance(source, gym.Env):
        source = getattr(source.unwrapped, "fullpath", None) or ""
    if not isinstance(source, str | os.PathLike) or str(source).lstrip().startswith("<"):
        return None
    path = Path(source).expanduser()
    return path if path.is_file() else None


def _compiled(read: Any, source: str, name: str) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    try:
        spec = read(source)
        return spec, spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile {name}: {error}") from error


def _from_env(env: gym.Env) -> tuple[mujoco.MjSpec | None, mujoco.MjModel]:
    base: Any = env.unwrapped
    model = getattr(base, "model", None)
    if not isinstance(model, mujoco.MjModel):
        raise ValueError(f"{type(base).__name__} has no MuJoCo model (env.unwrapped.model); give the MJCF itself")
    beyond = beyond_model(env)
    if beyond:
        raise ValueError(
            f"env has effects already that are no numbers of its model ({', '.join(beyond)}); give the environment as "
            "it was before them, and to trace() these effects as known=[...]"
        )
    if callable(getattr(base, "mjcf", None)):
        spec, compiled = load_model(base.mjcf())
    else:
        path = getattr(base, "fullpath", None)
        if path is None or not Path(path).is_file():
            return None, copy.copy(model)
        spec, compiled = load_model(path)
    return (spec if same_layout(compiled, model) else None), copy.copy(model)
