"""MJCF files of models whose numbers were changed after they were compiled."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import mujoco
import numpy as np

from sb3_rpto.effects.model import numbers, same_layout, set_number

Rounded: TypeAlias = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True)
class PlainModel:
    """A compiled model as text and numbers, which another version of MuJoCo reads, too.

    :param text: MJCF
    :param assets: contents of the files that it refers to
    :param exact: see :func:`rounded`
    """

    text: str
    assets: dict[str, bytes]
    exact: Rounded

    @classmethod
    def of(cls, spec: mujoco.MjSpec, model: mujoco.MjModel) -> PlainModel:
        """The text of a model; parameters as those of :func:`write_mjcf`."""
        text, assets = write_mjcf(spec, model)
        return cls(text, assets, rounded(mujoco.MjModel.from_xml_string(text, assets), model))

    def compile(self) -> mujoco.MjModel:
        """The model, to the last bit of its numbers."""
        model = mujoco.MjModel.from_xml_string(self.text, self.assets)
        restore(model, self.exact)
        return model


def write_mjcf(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[str, dict[str, bytes]]:
    """MJCF text that compiles to ``model`` up to the six digits that MuJoCo writes, and the files that it refers to.

    What MJCF cannot say of the model is left as ``spec`` has it.

    :param spec: a specification of the same layout; unchanged
    :param model: with other numbers
    :return: the text and the content of ``assets/<name>``
    :raises FileNotFoundError: a mesh, texture or height field is missing
    """
    spec = spec.copy()
    _tell_inertia(spec, spec.compile())
    try:
        spec.compile()
        spec.copy_back(model)
    except ValueError:
        _copy_some(spec, model)
    assets = _gather(spec)
    spec.compile()
    return spec.to_xml(), assets


def rounded(compiled: mujoco.MjModel, model: mujoco.MjModel) -> Rounded:
    """The numbers of ``model`` that differ in what its MJCF compiles to: flat indices and values by field.

    :raises ValueError: it compiles to other objects
    """
    if not same_layout(compiled, model):
        raise ValueError("the MJCF that MuJoCo writes for this model compiles to another layout; name all its objects")
    theirs, found = numbers(compiled), {}
    for name, ours in numbers(model).items():
        index = np.flatnonzero(ours.reshape(-1) != theirs[name].reshape(-1))
        if len(index):
            found[name] = {"index": index.tolist(), "value": ours.reshape(-1)[index].tolist()}
    return found


def restore(model: mujoco.MjModel, exact: Rounded) -> None:
    """Write what :func:`rounded` found into the compiled model."""
    for name, entry in exact.items():
        set_number(model, name, entry["index"], entry["value"])


def _tell_inertia(spec: mujoco.MjSpec, compiled: mujoco.MjModel) -> None:
    """State the inertia of every body as it compiled, so that one body's can change without the others'."""
    for body in spec.bodies[1:]:
        i = body.id
        body.mass, body.inertia = float(compiled.body_mass[i]), compiled.body_inertia[i]
        body.ipos, body.iquat = compiled.body_ipos[i], compiled.body_iquat[i]
        body.fullinertia = np.full(6, np.nan)
        body.explicitinertial = True
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1


def _copy_some(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Copy field by field what can be copied."""
    nominal = numbers(spec.compile())
    for name, value in numbers(model).items():
        if name.startswith("stat.") or np.array_equal(value, nominal[name]):
            continue
        step = spec.compile()
        target = numbers(step)[name]
        if target.ndim:
            target[...] = value
        else:
            setattr(step.opt, name.removeprefix("opt."), value.item())
        try:
            spec.copy_back(step)
        except ValueError:
            continue  # effects.json holds it


def _gather(spec: mujoco.MjSpec) -> dict[str, bytes]:
    """Point every element that has a file to ``assets/`` and read these files."""
    found: dict[str, bytes] = {}
    known = dict(spec.assets)

    def move(folder: str, file: str) -> str:
        content = _read(spec.modelfiledir, folder, file, known)
        name = f"{PurePath(file).stem}-{hashlib.sha256(content).hexdigest()[:8]}{PurePath(file).suffix}"
        found[f"assets/{name}"] = content
        return name

    folders = [(spec.meshes, spec.meshdir), (spec.hfields, spec.meshdir), (spec.skins, spec.meshdir)]
    for elements, folder in [*folders, (spec.textures, spec.texturedir)]:
        for element in elements:
            if element.file:
                element.file = move(folder, element.file)
    for texture in spec.textures:
        texture.cubefiles = [move(spec.texturedir, file) if file else "" for file in texture.cubefiles]
    if found:
        spec.meshdir = spec.texturedir = "assets"
        spec.assets = found
    return found


def _read(base: str, folder: str, file: str, known: dict[str, bytes]) -> bytes:
    for name in (os.path.join(folder, file), file):
        if name in known:
            return known[name]
    path = Path(base) / folder / file
    if not path.is_file():
        raise FileNotFoundError(f"the model's asset {file!r} is not at {str(path)!r}")
    return path.read_bytes()
