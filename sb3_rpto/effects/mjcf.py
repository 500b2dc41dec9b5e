"""MJCF files of models whose numbers were changed after they were compiled."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import mujoco
import numpy as np

from sb3_rpto.effects.model_numbers import numbers, same_layout, set_number

#: Statistics that MuJoCo derives, simulates nothing by, and will not read in an MJCF for ever.
MEANS = ("meaninertia", "meanmass", "meansize")

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
    :raises ValueError: such a file is not the one that MuJoCo reads
    """
    spec = spec.copy()
    means = {name: getattr(spec.stat, name) for name in MEANS}
    compiled = spec.compile()
    _tell_inertia(spec, compiled)
    _tell_derived(spec, compiled)
    try:
        spec.compile()
        spec.copy_back(model)
    except ValueError:
        _copy_some(spec, model)
    for name, value in means.items():
        setattr(spec.stat, name, value)
    assets = _gather(spec, compiled)
    moved = spec.compile()
    for name in ("mesh_vert", "hfield_data", "skin_vert", "tex_data"):
        if not np.array_equal(getattr(moved, name), getattr(compiled, name)):
            raise ValueError(
                f"{name} changes when the model's files are copied, so some are not those that MuJoCo reads; give "
                "different names to the files of models that are attached"
            )
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
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0


def _tell_derived(spec: mujoco.MjSpec, compiled: mujoco.MjModel) -> None:
    """State what MuJoCo derives from masses, lengths and limits as it compiled, so that it stays when these change."""
    for joint in spec.joints:
        if joint.springdamper.any():
            i, dof = joint.id, compiled.jnt_dofadr[joint.id]
            joint.stiffness = [compiled.jnt_stiffness[i], *compiled.jnt_stiffnesspoly[i]]
            joint.damping = [compiled.dof_damping[dof], *compiled.dof_dampingpoly[dof]]
            joint.springdamper = np.zeros(2)
    for tendon in spec.tendons:
        tendon.springlength = compiled.tendon_lengthspring[tendon.id]
    for actuator in spec.actuators:
        i = actuator.id
        actuator.biasprm = compiled.actuator_biasprm[i]  # a dampratio is a positive number here
        actuator.lengthrange = compiled.actuator_lengthrange[i]
        if actuator.inheritrange:
            actuator.ctrlrange, actuator.actrange = compiled.actuator_ctrlrange[i], compiled.actuator_actrange[i]
            actuator.inheritrange = 0.0


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


def _gather(spec: mujoco.MjSpec, compiled: mujoco.MjModel) -> dict[str, bytes]:
    """Point every element that has a file to ``assets/`` and read these files."""
    found: dict[str, bytes] = {}
    known = dict(spec.assets)

    def move(path: str) -> str:
        content = _read(spec.modelfiledir, path, known)
        name = f"{PurePath(path).stem}-{hashlib.sha256(content).hexdigest()[:8]}{PurePath(path).suffix}"
        found[f"assets/{name}"] = content
        return name

    kinds = {"mesh": spec.meshes, "hfield": spec.hfields, "skin": spec.skins, "tex": spec.textures}
    for kind, elements in kinds.items():
        for element in elements:
            if element.file:
                element.file = move(_path(compiled, getattr(compiled, f"{kind}_pathadr")[element.id]))
    for texture in spec.textures:
        texture.cubefiles = [move(_cube_path(spec, texture, file)) if file else "" for file in texture.cubefiles]
    if found:
        spec.meshdir = spec.texturedir = "assets"
        spec.assets = found
    return found


def _path(compiled: mujoco.MjModel, address: int) -> str:
    """Where MuJoCo found a file, by its own rules: no MjSpec tells the folder of a model that is attached."""
    return compiled.paths[address : compiled.paths.index(b"\0", address)].decode()


def _cube_path(spec: mujoco.MjSpec, texture: mujoco.MjsTexture, file: str) -> str:
    """The same of one side of a cube, which a compiled model does not tell."""
    name = PurePath(file).name if spec.strippath else file
    return os.path.join(spec.modelfiledir, texture.compiler.texturedir, name)


def _read(base: str, path: str, known: dict[str, bytes]) -> bytes:
    by_name = {PurePath(key).name: content for key, content in known.items()}
    # As MuJoCo does: of what is in memory, the name alone may do.
    for name, files in ((path, known), (os.path.relpath(path, base or "."), known), (PurePath(path).name, by_name)):
        if name in files:
            return files[name]
    if not Path(path).is_file():
        raise FileNotFoundError(f"the model's asset {PurePath(path).name!r} is not at {path!r}")
    return Path(path).read_bytes()
