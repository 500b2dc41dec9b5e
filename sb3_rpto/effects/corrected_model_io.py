"""Corrected simulators in a folder: ``model.xml``, which MuJoCo loads, and ``effects.json``, which makes it exact."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects.batch import LiveSimulation
from sb3_rpto.effects.declared import Declared
from sb3_rpto.effects.effect import LIBRARY, Effect, from_json
from sb3_rpto.effects.mjcf import restore, rounded, write_mjcf
from sb3_rpto.effects.model import ModelSource, file_of, load_model
from sb3_rpto.effects.model_numbers import differing, same_layout
from sb3_rpto.effects.names import near
from sb3_rpto.effects.simulation import Simulation, prepare
from sb3_rpto.effects.units import units_at
from sb3_rpto.effects.walker_reset import StandingEnv, nominal_heights
from sb3_rpto.effects.wrapper import CorrectedEnv, active, own
from sb3_rpto.files import write_together

FORMAT = 1
#: What reading a file raises that holds other things than :func:`save_corrected` writes.
_DAMAGED = (KeyError, TypeError, AttributeError, IndexError)
_HOOKS = ("act", "command", "observe", "late")


@dataclass(frozen=True)
class Corrected:
    """A corrected simulator.

    :param model: with the numbers of every effect that ``model.xml`` holds
    :param effects: all effects, as changes of the **nominal** model; those for which :func:`carried_by` says
        ``"mjcf"`` are in ``model`` already
    :param heights: at which the nominal robot stands, see :func:`~sb3_rpto.effects.walker_reset.nominal_heights`
    """

    model: mujoco.MjModel
    effects: list[Effect]
    heights: tuple[float, float] | None = None

    def simulation(self, nthread: int = 0) -> Simulation:
        """Many of it side by side; its effects, and :meth:`Simulation.values`, are those that its model does not hold.

        :param nthread: threads; 0: as many as there are cores
        """
        return Simulation(self.model, [e for e in self.effects if carried_by(e) == "wrapper"], nthread)

    def apply(self, env: gym.Env) -> CorrectedEnv:
        """Put all effects into ``env``, which has the nominal model; one that has :attr:`model` lacks the others alone.

        A walker whose body they change stands on its feet from the next reset on.

        :param env: a gymnasium MuJoCo environment; it is changed. :func:`sb3_rpto.envs.corrected.apply_effects` with
            :attr:`effects` leaves it alone
        :raises TypeError: ``env`` is no environment
        :raises ValueError: it is none of MuJoCo's
        """
        if not isinstance(env, gym.Env):
            raise TypeError(
                f"env must be a gymnasium MuJoCo environment, not {type(env).__name__}; without one, "
                "simulation().rollout(...) simulates the corrected model"
            )
        effects, given = self.effects, getattr(env.unwrapped, "model", None)
        mine = isinstance(given, mujoco.MjModel) and same_layout(given, self.model)
        if mine and not differing(given, self.model, rounded=True):
            return StandingEnv(env, [e for e in effects if carried_by(e) == "wrapper"], self.heights)
        return StandingEnv(env, effects)


def carried_by(effect: Effect) -> Literal["mjcf", "wrapper"]:
    """Where an effect is kept in a saved simulator: in the MJCF's numbers, or in the simulation around it."""
    return "wrapper" if any(map(effect.overrides, _HOOKS)) else "mjcf"


def correct(model: mujoco.MjModel, effects: Sequence[Effect]) -> mujoco.MjModel:
    """A copy of the nominal model with the effects that are numbers of it.

    :raises ValueError: the model lacks an object that an effect sits on
    """
    model = model.__copy__()
    numeric = [effect for effect in own(effects, model) if carried_by(effect) == "mjcf"]
    prepare(LiveSimulation(model, mujoco.MjData(model)), active(numeric))
    return model


def save_corrected(folder: str | os.PathLike[str], source: ModelSource, effects: Sequence[Effect]) -> None:
    """Save the simulator that ``effects`` make of the nominal model.

    MuJoCo writes six digits to an MJCF, so ``effects.json`` holds the exact value of every number that the MJCF
    compiles to something else. Meshes, textures and height fields are copied beside it (``assets/``).

    :param folder: made if missing; what else is in it stays. A crash leaves either state, or a torn one that
        :func:`load_corrected` refuses
    :param source: the nominal model, see :func:`~sb3_rpto.effects.model.load_model`; not an MjModel alone
    :param effects: with their values
    :raises ValueError: nothing tells the MJCF of ``source``, or it has effects that are no numbers of its model, or
        ``folder`` holds a ``model.xml`` that must not be overwritten: the nominal one, or none of this function's
    :raises FileNotFoundError: an asset is missing
    """
    write_files(folder, corrected_files(folder, source, effects))


def write_files(folder: str | os.PathLike[str], contents: Mapping[str, bytes]) -> None:
    """Write files into a folder, all of them or none.

    :param folder: made if missing
    :param contents: by path in it
    """
    found = {Path(folder) / name: content for name, content in contents.items()}
    for path in found:
        path.parent.mkdir(parents=True, exist_ok=True)
    write_together(found)


def corrected_files(folder: str | os.PathLike[str], source: ModelSource, effects: Sequence[Effect]) -> dict[str, bytes]:
    """What :func:`save_corrected` writes, by path in the folder; arguments and errors as there."""
    check_free(folder, file_of(source))
    spec, nominal = load_model(source)
    if spec is None:
        raise ValueError(
            f"nothing tells the MJCF of this {type(source).__name__}; give its file, its MjSpec, or an environment "
            "whose fullpath is the file that it was loaded from"
        )
    model = correct(nominal, effects)
    text, assets = write_mjcf(spec, model)
    plain = mujoco.MjModel.from_xml_string(text, assets)
    lost = differing(plain, model, rounded=True) if same_layout(plain, model) else []
    if lost:
        warnings.warn(
            f"model.xml alone differs from the corrected model in {', '.join(lost)}, which its MJCF cannot say; "
            "load_corrected() tells them from effects.json: do not load the file by itself",
            stacklevel=2,
        )
    stored = {
        "format": FORMAT,
        "mujoco": mujoco.__version__,
        "model": {"file": "model.xml", "sha256": hashlib.sha256(text.encode()).hexdigest()},
        "effects": [_describe(effect, nominal) for effect in own(effects, nominal)],
        "heights": nominal_heights(nominal),
        "exact": rounded(plain, model),
    }
    return {**assets, "model.xml": text.encode(), "effects.json": json.dumps(stored, indent=1).encode()}


def check_free(folder: str | os.PathLike[str], file: Path | None) -> None:
    """Require that a simulator saved to ``folder`` replaces one that was saved there so, and not its nominal model.

    :param file: the nominal model's, from :func:`~sb3_rpto.effects.model.file_of`
    :raises ValueError: it would
    """
    saved = Path(folder) / "model.xml"
    if not saved.is_file():
        return
    # Without effects.json an MjSpec, say, may well be of that file.
    if not saved.with_name("effects.json").is_file() or (file is not None and saved.samefile(file)):
        raise ValueError(
            f"{saved} is the nominal model, or was not saved here by an earlier trace, and would be overwritten; save "
            "elsewhere"
        )


def load_corrected(folder: str | os.PathLike[str]) -> Corrected:
    """Load what :func:`save_corrected` saved: the same simulator bit for bit, given the same version of MuJoCo.

    :raises FileNotFoundError: one of the files is missing
    :raises ValueError: files that do not belong together, another format, or an effect that is not registered
    """
    folder = Path(folder)
    path, xml = folder / "effects.json", folder / "model.xml"
    for file in (path, xml):
        if not file.is_file():
            raise FileNotFoundError(f"{folder} holds no corrected simulator: {file.name} is missing; save it again")
    try:
        stored = json.loads(path.read_bytes())
        version, digest, made_by = stored["format"], stored["model"]["sha256"], stored["mujoco"]
    except (ValueError, *_DAMAGED) as error:
        raise ValueError(f"{path} does not describe a corrected simulator; save it again") from error
    if version != FORMAT:
        raise ValueError(f"{path} has format {version!r}, this version of sb3_rpto reads {FORMAT}; save it again")
    if hashlib.sha256(xml.read_bytes()).hexdigest() != digest:
        raise ValueError(
            f"{xml} is not the file that effects.json was written for; save both again, or load an edited model.xml "
            "by itself"
        )
    if made_by != mujoco.__version__:
        warnings.warn(
            f"{folder} was saved with MuJoCo {made_by}; under {mujoco.__version__} it may differ by rounding",
            stacklevel=2,
        )
    model, heights = mujoco.MjModel.from_xml_path(str(xml)), stored.get("heights")
    try:
        restore(model, stored["exact"])
        effects = [_rebuild(entry, model, entry.get("nominal")) for entry in stored["effects"]]
        return Corrected(model, effects, None if heights is None else (float(heights[0]), float(heights[1])))
    except _DAMAGED as error:
        raise ValueError(f"{path} does not describe a corrected simulator; save it again") from error


def read_effects(path: str | os.PathLike[str], model: mujoco.MjModel) -> list[Effect]:
    """The effects that an ``effects.json`` describes, declared numbers among them, as changes of the nominal model.

    :param path: as :func:`save_corrected` wrote it; or a list of what :meth:`Effect.to_json` gives, in a file
    :param model: the nominal model
    :raises FileNotFoundError: there is no such file
    :raises ValueError: it holds something else, or an effect that is not registered or not of this model
    """
    try:
        stored = json.loads(Path(path).read_bytes())
        entries = stored["effects"] if isinstance(stored, dict) else stored
        return [_rebuild(entry, model) for entry in entries]
    except (json.JSONDecodeError, UnicodeDecodeError, *_DAMAGED) as error:
        raise ValueError(f"{path} does not describe effects; give the effects.json of an earlier trace") from error


def _describe(effect: Effect, model: mujoco.MjModel) -> dict[str, Any]:
    entry = effect.to_json()
    entry["values"] = {name: float(value) for name, value in entry["values"].items()}
    entry["unit"] = {p.name: unit for p, unit in zip(effect.parameters, units_at(effect, model))}
    entry["equation"] = effect.equation
    entry["carried_by"] = carried_by(effect)
    if isinstance(effect, Declared):
        entry["nominal"] = {effect.label: float(effect.nominal)}
    return entry


def _rebuild(entry: Mapping[str, Any], model: mujoco.MjModel, nominal: Mapping[str, float] | None = None) -> Effect:
    """The effect of an entry; ``nominal`` where ``model`` is no longer the one that it changes."""
    kind, values = entry["kind"], entry["values"]
    if kind == Declared.kind:
        ((name, value),) = values.items()
        return Declared(model, name, (-np.inf, np.inf), (nominal or {}).get(name)).with_values(np.array([value]))
    if kind not in LIBRARY:
        raise ValueError(
            f"no effect {kind!r} is registered ({near(kind, LIBRARY)}); import the module with "
            "its class, decorated with @sb3_rpto.effects.register, before loading"
        )
    return from_json(entry)
