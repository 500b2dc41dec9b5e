"""The columns of a table of measurements: which are there, what they stand for, in which order they are kept."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sb3_rpto.effects.names import object_names

if TYPE_CHECKING:
    import mujoco

PLAIN = ("episode", "time", "split")
PREFIXES = ("qpos", "qvel", "ctrl", "qfrc", "enabled", "param")


@dataclass(frozen=True)
class Columns:
    """Names, without their prefix, of what a table holds.

    :param qpos: positions, joint by joint in the order of the table; ``root.0`` to ``root.6`` for a free joint
    :param qvel: velocities in the order of the joints; those of a joint without such columns are listed all the same
    :param ctrl: actuators
    :param qfrc: joints whose generalised force was measured
    :param params: settings that differ by run, ``object.parameter``
    :param missing: those of ``qvel`` that have no column and must be estimated
    """

    qpos: tuple[str, ...]
    qvel: tuple[str, ...]
    ctrl: tuple[str, ...]
    qfrc: tuple[str, ...]
    params: tuple[str, ...]
    missing: tuple[str, ...]

    def slides(self, name: str) -> bool:
        """Whether the coordinate is the integral of the velocity of that name: not so for quaternions."""
        joint = joint_of(name)
        return name == joint or (f"{joint}.6" in self.qpos and name[-1] in "012")

    def quaternions(self) -> list[tuple[str, int]]:
        """Ball and free joints, and where their quaternions begin in ``qpos``."""
        found = []
        for joint in dict.fromkeys(map(joint_of, self.qpos)):
            count = sum(joint_of(name) == joint for name in self.qpos)
            if count in (4, 7):
                found.append((joint, self.qpos.index(f"{joint}.{count - 4}")))
        return found


def joint_of(name: str) -> str:
    """Joint of a coordinate: ``root`` for ``root.3``, the name itself for a scalar joint."""
    return re.sub(r"\.\d$", "", name)


def columns_of(model: mujoco.MjModel) -> Columns:
    """Columns of the full state and all commands of a model, in the model's order.

    Joints and actuators without a name are called ``joint0``, ``actuator0`` … by their index.

    :param model: whose names are used; ball and free joints have numbered coordinates, and so do actuators that take
        several commands
    """
    qpos: list[str] = []
    qvel: list[str] = []
    for j, name in enumerate(object_names(model, "joint")):
        size = len(model.joint(j).qpos0)
        for names, count in ((qpos, size), (qvel, {7: 6, 4: 3, 1: 1}[size])):
            names += [name] if count == 1 else [f"{name}.{i}" for i in range(count)]
    ctrl: list[str] = []
    for name, count in zip(object_names(model, "actuator"), model.actuator_ctrlnum, strict=True):
        ctrl += [name] if count == 1 else [f"{name}.{i}" for i in range(count)]
    return Columns(tuple(qpos), tuple(qvel), tuple(ctrl), (), (), ())


def read_columns(names: Iterable[str], file: str) -> Columns:
    """Sort the columns of one table by what they stand for.

    :param names: all column names of the table
    :param file: the table's name, for the messages
    :raises ValueError: unknown, doubled or missing columns
    """
    names = list(names)
    nameless = [name for name in names if not isinstance(name, str)]
    if nameless:
        raise ValueError(f"{file}: column {nameless[0]!r} has no name; give each one, such as 'time' or 'qpos.<joint>'")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ValueError(f"{file}: column {doubled[0]!r} is there twice; rename or remove one")
    found: dict[str, list[str]] = {prefix: [] for prefix in PREFIXES}
    unknown = []
    for name in names:
        prefix, _, rest = name.partition(".")
        if prefix in found and rest:
            found[prefix].append(rest)
        elif name not in PLAIN:
            unknown.append(name)
    if unknown:
        also = f" (unknown, too: {', '.join(map(repr, unknown[1:]))})" if unknown[1:] else ""
        bare = unknown[0].lstrip("#% ")
        if bare != unknown[0] and (bare in PLAIN or bare.partition(".")[0] in PREFIXES):
            raise ValueError(f"{file}: column {unknown[0]!r} begins with a mark of comments; call it {bare!r}")
        raise ValueError(
            f"{file}: unknown column {unknown[0]!r}; {_near(unknown[0])}; rename it, or drop what is not needed{also}"
        )
    if "time" not in names:
        raise ValueError(f"{file}: no column 'time'; add the time of each sample in seconds")
    if not found["qpos"]:
        raise ValueError(f"{file}: no column 'qpos.<joint>'; add the measured position of at least one joint")

    joints = list(dict.fromkeys(joint_of(name) for name in found["qpos"]))
    velocities: list[str] = []
    missing: list[str] = []
    for joint in joints:
        qpos = _coordinates(joint, found["qpos"])
        qvel = _coordinates(joint, found["qvel"])
        sizes = (1, 1) if qpos == [joint] else {4: (4, 3), 7: (7, 6)}.get(len(qpos), (0, 0))
        if not qvel:
            qvel = [joint] if qpos == [joint] else [f"{joint}.{i}" for i in range(sizes[1])]
            missing += qvel
        if (len(qpos), len(qvel)) != sizes or (len(qvel) == 1) != (qvel == [joint]):
            raise ValueError(
                f"{file}: joint {joint!r} has {len(qpos)} qpos and {len(qvel)} qvel columns; "
                f"give 'qpos.{joint}' for a scalar joint, "
                f"4 and 3 numbered ones ('qpos.{joint}.0' …) for a ball joint, 7 and 6 for a free joint, or "
                "leave out all its velocities (a name that ends in a dot and a digit is a coordinate's: rename a "
                "joint that is called so)"
            )
        velocities += qvel
    for prefix, known in (("qvel", velocities), ("qfrc", velocities), ("enabled", found["ctrl"])):
        for name in found[prefix]:
            if name not in known:
                needed = "ctrl" if prefix == "enabled" else "qpos"
                raise ValueError(
                    f"{file}: column '{prefix}.{name}' has no '{needed}.{name}'; add it or correct the name"
                )
    positions = [name for joint in joints for name in _coordinates(joint, found["qpos"])]
    groups = (positions, velocities, found["ctrl"], found["qfrc"], sorted(found["param"]), missing)
    return Columns(*map(tuple, groups))


def _coordinates(joint: str, names: list[str]) -> list[str]:
    return sorted(name for name in names if joint_of(name) == joint)


def _near(name: str) -> str:
    if name == "" or name.startswith("Unnamed"):
        return "an index that was saved with the table? Write it without one (pandas: index=False)"
    if name in PREFIXES:
        return f"write a column of shape (T,) for each object, '{name}.<name>'"
    for prefix in PREFIXES:
        if name.startswith(prefix) and len(name) > len(prefix) + 1 and not name[len(prefix)].isalnum():
            return f"did you mean '{prefix}.{name[len(prefix) + 1 :]}'?"
    prefix, dot, rest = name.partition(".")
    choices = [*PLAIN, *PREFIXES]
    near = difflib.get_close_matches(prefix, choices, n=2, cutoff=0.5)
    if near:
        named = [c + (dot + rest if rest else ".<name>") if c in PREFIXES else c for c in near]
        return "did you mean " + " or ".join(map(repr, named)) + "?"
    return f"columns are {', '.join(PLAIN)} and those that begin with {', '.join(p + '.' for p in PREFIXES)}"
