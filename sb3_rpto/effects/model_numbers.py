"""The numbers of compiled models: how they are listed, compared and written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

_SHAPES = mujoco.mjtGeom
#: How many of its three sizes a shape has; one that is not here has all.
_SIZES = {
    **{int(_SHAPES.mjGEOM_SPHERE): 1, int(_SHAPES.mjGEOM_CAPSULE): 2, int(_SHAPES.mjGEOM_CYLINDER): 2},
    **{int(_SHAPES.mjGEOM_HFIELD): 0, int(_SHAPES.mjGEOM_MESH): 0},  # those of what they show, which is compared
}


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
