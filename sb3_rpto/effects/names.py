"""Names of the objects of a compiled model, also of those that the MJCF leaves nameless."""

import difflib
from collections.abc import Iterable

import mujoco

_KINDS = {
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nactuator"),
}
SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def object_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names by id; a nameless object is called by its kind and id (``joint0``, or ``joint0_`` if another has it).

    :param kind: ``"joint"``, ``"body"``, ``"geom"`` or ``"actuator"``
    """
    objtype, count = _KINDS[kind]
    names = [mujoco.mj_id2name(model, objtype, i) or "" for i in range(getattr(model, count))]
    taken = set(names)
    for i, name in enumerate(names):
        if not name:
            names[i] = f"{kind}{i}"
            while names[i] in taken:
                names[i] += "_"
    return names


def object_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Id of a named object.

    :raises ValueError: there is none; the message says the near names
    """
    names = object_names(model, kind)
    if name not in names:
        raise ValueError(f"the model has no {kind} {name!r}; {near(name, names)}")
    return names.index(name)


def hinges(model: mujoco.MjModel) -> list[str]:
    """Names of the hinges."""
    names = object_names(model, "joint")
    return [names[i] for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE]


def near(name: str, known: Iterable[str]) -> str:
    """What to say after an unknown name: the near ones, or all when there are few."""
    known = list(known)
    parts = [other for other in known if len(name) > 2 and name in other]
    misspelt = difflib.get_close_matches(name, known, n=3, cutoff=0.8)
    close = misspelt or parts[:8] or difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    return f"known: {', '.join(known[:12])}{' …' if len(known) > 12 else ''}" if known else "there are none"
