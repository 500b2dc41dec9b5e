"""What of a model no effect of the library acts on: where a trace leaves something, that may be in one of these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import GAINS, JOINTS, on_voltage
from sb3_rpto.effects.bodies import may_touch
from sb3_rpto.effects.names import SCALAR_JOINTS, object_names
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint, listed
from sb3_rpto.sysid.settings import DEFAULTS

_JOINTS = {int(mujoco.mjtJoint.mjJNT_BALL): "ball joint", int(mujoco.mjtJoint.mjJNT_FREE): "free joint"}
_TIES = {
    int(mujoco.mjtEq.mjEQ_CONNECT): "connect",
    int(mujoco.mjtEq.mjEQ_WELD): "weld",
    int(mujoco.mjtEq.mjEQ_JOINT): "joint equality",
    int(mujoco.mjtEq.mjEQ_TENDON): "tendon equality",
}
_ENDS = {
    int(mujoco.mjtTrn.mjTRN_SITE): "actuator at a site",
    int(mujoco.mjtTrn.mjTRN_SLIDERCRANK): "slider-crank",
    int(mujoco.mjtTrn.mjTRN_BODY): "adhesion",
    int(mujoco.mjtTrn.mjTRN_SO3): "actuator of a ball joint's orientation",
}
_FORCES = {int(mujoco.mjtGain.mjGAIN_MUSCLE): "muscle", int(mujoco.mjtGain.mjGAIN_DCMOTOR): "regulated dcmotor"}
_TENDON, _PID = int(mujoco.mjtTrn.mjTRN_TENDON), int(mujoco.mjtGain.mjGAIN_PID)
_AT_BODIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True)
class Thing:
    """An object of a model on which no effect sits, or effects of its command alone.

    :param kind: what it is, in words
    :param name: of it
    :param bodies: that it moves or ties
    """

    kind: str
    name: str
    bodies: frozenset[int]

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


def unreached(model: mujoco.MjModel) -> list[Thing]:
    """Ball and free joints, mocap bodies, equality constraints, tendons, flexes, and actuators of other forces.

    Listed are those that something moving hangs on. Of actuators it is the force that nothing acts on: delays and the
    like of the command sit on all of them.
    """
    things = [*_joints(model), *_mocaps(model), *_ties(model), *_tendons(model), *_actuators(model), *_soft(model)]
    return [thing for thing in things if any(model.body_treeid[b] >= 0 for b in thing.bodies)]


def weigh_hints(
    model: mujoco.MjModel, hints: Sequence[Finding], ratio: float, small: float = DEFAULTS.adequacy.small
) -> list[Finding]:
    """What may be wrong where nothing explains recordings: what nothing acts on, or what the hints say.

    A hint is withheld where what it concerns hangs together with something that nothing acts on, unless it leaves next
    to nothing: any stand-in lowers the error. Where it does leave nothing, that is what is said.

    :param model: of the machine
    :param hints: those of :class:`Hint` are looked at, others are passed on
    :param ratio: R, of the errors with all that was found
    :param small: below it R is next to nothing
    """
    things = unreached(model)
    trees = {int(model.body_treeid[b]) for thing in things for b in thing.bodies}

    def beside(bodies: Iterable[int] | None) -> bool:
        return bool(things) and (bodies is None or any(int(model.body_treeid[b]) in trees for b in bodies))

    kept, explained = [], False
    for hint in hints:
        if isinstance(hint, Hint) and beside(hint.bodies):
            if not hint.left * ratio < small:
                continue
            explained = True
        kept.append(hint)
    return kept if explained or not things else [*kept, _finding(things)]


def mocap_bodies(model: mujoco.MjModel) -> list[Finding]:
    """Mocap bodies that something moving is tied to, or may touch: where they go is in no column."""
    found = []
    for thing in _mocaps(model):
        message = (
            "its pose is in no column: it is taken to stand still where the model puts it, "
            f"and {_hold(model, thing)}; where it moved, give it joints with columns of its own instead of mocap"
        )
        found.append(Finding(FindingKind.MOCAP_BODY, thing.name, message))
    return found


def moved_by_mocap(model: mujoco.MjModel, tie: int) -> bool:
    """Whether an equality constraint ties something to a mocap body."""
    return bool(
        _tied(model, tie) & {b for i in range(model.nbody) if model.body_mocapid[i] >= 0 for b in _on(model, i)}
    )


def _finding(things: Sequence[Thing]) -> Finding:
    kinds: dict[str, list[str]] = {}
    for thing in things:
        kinds.setdefault(thing.kind, []).append(thing.name)
    said = "; ".join(f"{kind} {listed(names)}" for kind, names in kinds.items())
    message = (
        f"no effect of the library acts on what the model has there ({said}): what is missing may be in it, and what "
        "is named besides may only stand in for it. Compare its numbers in the MJCF with the machine's, or model it "
        "by hinges, slides and motors"
    )
    return Finding(FindingKind.BEYOND_THE_LIBRARY, "the model", message)


def _joints(model: mujoco.MjModel) -> list[Thing]:
    names = object_names(model, "joint")
    others = [j for j in range(model.njnt) if model.jnt_type[j] not in SCALAR_JOINTS]
    return [Thing(_JOINTS[int(model.jnt_type[j])], repr(names[j]), _of_joint(model, j)) for j in others]


def _mocaps(model: mujoco.MjModel) -> list[Thing]:
    """Those that something moving hangs on."""
    names = object_names(model, "body")
    things = [
        Thing("mocap body", repr(names[i]), frozenset(_on(model, i)))
        for i in range(model.nbody)
        if model.body_mocapid[i] >= 0
    ]
    held = []
    for thing in things:
        others: set[int] = set(thing.bodies)
        for tie in _active(model):
            others |= _tied(model, tie) if _tied(model, tie) & thing.bodies else set()
        for t in range(model.ntendon):
            others |= _of_tendon(model, t) if _of_tendon(model, t) & thing.bodies else set()
        for a in range(model.nactuator):
            others |= of_actuator(model, a) if of_actuator(model, a) & thing.bodies else set()
        others |= {other for _, other in _touching(model, thing.bodies)}
        if any(model.body_treeid[b] >= 0 for b in others):
            held.append(Thing(thing.kind, thing.name, frozenset(others)))
    return held


def _hold(model: mujoco.MjModel, thing: Thing) -> str:
    names = object_names(model, "body")
    own = {b for i, name in enumerate(names) if repr(name) == thing.name for b in _on(model, i)}
    ties = [str(_tie(model, tie)) for tie in _active(model) if _tied(model, tie) & own]
    if ties:
        return (
            f"the {listed(ties)} ties the machine to it" if len(ties) == 1 else f"{listed(ties)} tie the machine to it"
        )
    touched = sorted({names[other] for _, other in _touching(model, own)})
    if touched:
        return f"{listed([repr(name) for name in touched])} may touch it"
    return "the machine hangs on it"


def _touching(model: mujoco.MjModel, own: Iterable[int]) -> set[tuple[int, int]]:
    """Pairs of bodies of which one is of these and the other moves, and whose geoms may touch."""
    own = set(own)
    pairs = {
        (int(model.geom_bodyid[g]), int(model.geom_bodyid[h]))
        for g in range(model.ngeom)
        if int(model.geom_bodyid[g]) in own
        for h in range(model.ngeom)
        if may_touch(model, g, h)
    }
    for g, h in zip(model.pair_geom1, model.pair_geom2):
        one, other = int(model.geom_bodyid[g]), int(model.geom_bodyid[h])
        pairs |= {pair for pair in ((one, other), (other, one)) if pair[0] in own}
    return {(one, other) for one, other in pairs if other not in own and model.body_treeid[other] >= 0}


def _active(model: mujoco.MjModel) -> list[int]:
    return [int(tie) for tie in np.flatnonzero(model.eq_active0)]


def _ties(model: mujoco.MjModel) -> list[Thing]:
    return [_tie(model, tie) for tie in _active(model)]


def _tie(model: mujoco.MjModel, tie: int) -> Thing:
    kind, bodies = _TIES.get(int(model.eq_type[tie]), "flex equality"), _tied(model, tie)
    names = object_names(model, "body")
    name = model.equality(tie).name
    return Thing(kind, repr(name) if name else f"of {listed([repr(names[b]) for b in sorted(bodies)])}", bodies)


def _tied(model: mujoco.MjModel, tie: int) -> frozenset[int]:
    """The bodies of an equality constraint, the world left out."""
    kind, ends = int(model.eq_type[tie]), (int(model.eq_obj1id[tie]), int(model.eq_obj2id[tie]))
    at_sites = int(model.eq_objtype[tie]) == int(mujoco.mjtObj.mjOBJ_SITE)
    bodies: set[int] = set()
    for end in (i for i in ends if i >= 0):
        if kind in _AT_BODIES:
            bodies.add(int(model.site_bodyid[end]) if at_sites else end)
        elif kind == int(mujoco.mjtEq.mjEQ_JOINT):
            bodies |= _of_joint(model, end)
        elif kind == int(mujoco.mjtEq.mjEQ_TENDON):
            bodies |= _of_tendon(model, end)
        else:
            bodies |= _of_flex(model, end)
    return frozenset(bodies - {0})


def _tendons(model: mujoco.MjModel) -> list[Thing]:
    names = [model.tendon(t).name or f"tendon{t}" for t in range(model.ntendon)]
    return [Thing("tendon", repr(name), _of_tendon(model, t)) for t, name in enumerate(names)]


def _actuators(model: mujoco.MjModel) -> list[Thing]:
    found = []
    for a, name in enumerate(object_names(model, "actuator")):
        gain, end = int(model.actuator_gaintype[a]), int(model.actuator_trntype[a])
        linear = gain in (*GAINS, _PID) or on_voltage(model, a)
        if not linear:
            kind = _FORCES.get(gain, "actuator of a force of its own")
        elif end in (*JOINTS, _TENDON):  # tendons are named themselves, and so are ball and free joints
            continue
        else:
            kind = _ENDS.get(end, "actuator")
        found.append(Thing(kind, repr(name), of_actuator(model, a)))
    return found


def _soft(model: mujoco.MjModel) -> list[Thing]:
    """Flexes, and bodies that a plugin pushes, as a cable's."""
    names = object_names(model, "body")
    called = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, f) or f"flex{f}" for f in range(model.nflex)]
    flexes = [Thing("flex", repr(name), _of_flex(model, f)) for f, name in enumerate(called)]
    plugged = [b for b in range(model.nbody) if model.body_plugin[b] >= 0]
    return [*flexes, *(Thing("plugin at body", repr(names[b]), frozenset({b})) for b in plugged)]


def _on(model: mujoco.MjModel, body: int) -> set[int]:
    """A body and all that it carries."""
    carried = {body}
    for other in range(body + 1, model.nbody):  # parents come first
        if int(model.body_parentid[other]) in carried:
            carried.add(other)
    return carried


def _of_joint(model: mujoco.MjModel, joint: int) -> frozenset[int]:
    return frozenset({int(model.jnt_bodyid[joint])})


def _of_tendon(model: mujoco.MjModel, tendon: int) -> frozenset[int]:
    wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    owner = {
        int(mujoco.mjtWrap.mjWRAP_JOINT): model.jnt_bodyid,
        int(mujoco.mjtWrap.mjWRAP_SITE): model.site_bodyid,
        int(mujoco.mjtWrap.mjWRAP_SPHERE): model.geom_bodyid,
        int(mujoco.mjtWrap.mjWRAP_CYLINDER): model.geom_bodyid,
    }
    pairs = zip(model.wrap_type[wraps].tolist(), model.wrap_objid[wraps].tolist())
    return frozenset(int(owner[kind][i]) for kind, i in pairs if kind in owner)


def of_actuator(model: mujoco.MjModel, actuator: int) -> frozenset[int]:
    """The bodies that an actuator acts at."""
    kind, (one, other) = int(model.actuator_trntype[actuator]), model.actuator_trnid[actuator].tolist()
    if kind == _TENDON:
        return _of_tendon(model, one)
    if kind == int(mujoco.mjtTrn.mjTRN_BODY):
        return frozenset({one})
    if kind in (int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)):
        return frozenset(int(model.site_bodyid[site]) for site in (one, other) if site >= 0)
    return _of_joint(model, one)


def _of_flex(model: mujoco.MjModel, flex: int) -> frozenset[int]:
    first, last = model.flex_vertadr[flex], model.flex_vertadr[flex] + model.flex_vertnum[flex]
    bodies = {*model.flex_vertbodyid[first:last].tolist()}
    if flex < len(model.flex_nodeadr):  # of one that is interpolated between a few bodies
        first, last = model.flex_nodeadr[flex], model.flex_nodeadr[flex] + model.flex_nodenum[flex]
        bodies |= {*model.flex_nodebodyid[first:last].tolist()}
    return frozenset(b for b in bodies if b > 0)
