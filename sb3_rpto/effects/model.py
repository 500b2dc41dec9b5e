"""MuJoCo models from whatever holds one."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects.wrapper import beyond_model

#: what :func:`load_model` takes
ModelSource: TypeAlias = (
    str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel | gym.Env | tuple[mujoco.MjSpec, mujoco.MjModel]
)

_SHAPES = mujoco.mjtGeom
#: How many of its three sizes a shape has; one that is not here has all.
_SIZES = {
    **{int(_SHAPES.mjGEOM_SPHERE): 1, int(_SHAPES.mjGEOM_CAPSULE): 2, int(_SHAPES.mjGEOM_CYLINDER): 2},
    **{int(_SHAPES.mjGEOM_HFIELD): 0, int(_SHAPES.mjGEOM_MESH): 0},  # those of what they show, which is compared
}


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


def same_layout(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether two models have the same objects by the same names, so that they may differ in numbers alone."""
    if one.names != other.names:
        return False
    ours, theirs = numbers(one), numbers(other)
    return all(ours[name].shape == theirs[name].shape for name in ours)


def numbers(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Every number of a compiled model, live where it is an array: fields, options (``opt.``), statistics (``stat.``).

    More than :data:`mujoco.batch.MODEL_FIELDS`: meshes, height fields and statistics act on the physics too.
    """
    found = {name: value for name, value in _public(model) if isinstance(value, np.ndarray)}
    for part in ("opt", "stat"):
        for name, value in _public(getattr(model, part)):
            if isinstance(value, np.ndarray | float | int):
                found[f"{part}.{name}"] = np.asarray(value)
    # Where the names of asset files stand in a buffer of text.
    return {name: value for name, value in found.items() if not name.endswith("pathadr")}


def differing(one: mujoco.MjModel, other: mujoco.MjModel, rounded: bool = False) -> list[str]:
    """Names of the numbers in which two compiled models differ, those that follow from others left out.

    :param rounded: but for the digits that an MJCF rounds off, the statistics, which are of the model as compiled, and
        sizes that a shape does not have: an MJCF may hold any
    """
    derived = set(mujoco.MjModel._setconst_outputs) - set(mujoco.MjModel._setconst_inputs)
    mine, theirs = numbers(one), numbers(other)
    if rounded:
        for model, held in ((one, mine), (other, theirs)):
            held |= {f"{what}_size": _sizes(model, what) for what in ("geom", "site")}
        named = [n for n in mine if n not in derived and not n.startswith("stat.")]
        return [n for n in named if not np.allclose(mine[n], theirs[n], 1e-4, 1e-9, equal_nan=True)]
    return [n for n in mine if n not in derived and not np.array_equal(mine[n], theirs[n], equal_nan=True)]


def _sizes(model: mujoco.MjModel, what: str) -> np.ndarray:
    """Sizes of the geoms or sites, (n, 3), zero where their shape has none."""
    count = np.array([_SIZES.get(int(shape), 3) for shape in getattr(model, f"{what}_type")], dtype=int)
    return np.where(np.arange(3) < count[:, None], getattr(model, f"{what}_size"), 0.0)


def sites_act(model: mujoco.MjModel) -> bool:
    """Whether the motion depends on where sites are: motors push at them, tendons or constraints hold them."""
    at_sites = (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK)
    tied = (model.eq_objtype == int(mujoco.mjtObj.mjOBJ_SITE)).any()
    return bool(model.ntendon or tied or np.isin(model.actuator_trntype, [int(t) for t in at_sites]).any())


def _public(owner: Any) -> Iterator[tuple[str, Any]]:
    return ((name, getattr(owner, name)) for name in dir(owner) if not name.startswith("_"))


def set_number(model: mujoco.MjModel, name: str, index: list[int], value: list[float]) -> None:
    """Write entries of one of the :func:`numbers`, by flat index.

    :raises ValueError: the model has no such field, or it is smaller
    """
    known = numbers(model)
    if name not in known or max(index) >= known[name].size or len(index) != len(value):
        raise ValueError(f"the model has no entry {max(index)} of {name!r}")
    array = known[name]
    part, dot, rest = name.rpartition(".")
    if array.ndim:
        array.reshape(-1)[index] = value
    else:
        setattr(getattr(model, part) if dot else model, rest, array.dtype.type(value[0]).item())
