r"""The length of a link: its capsules and the offsets of its children.

A link is stretched along the axis :math:`n` of its longest capsule, by the map
:math:`x' = x + (s - 1)(n \cdot x)\,n` of points in the body's frame. The ends of its capsules, the centres of its other
geoms, its sites, its joints' anchors and the points where its children are joined to it move by it; radii, the other
geoms' sizes and the children themselves stay. A body is joined to its parent where it turns, at the anchor of its first
hinge or ball, else at its origin; the stretched body is put where that point stays in its parent. So the distance
between two joints grows by :math:`s`, and a link that slides on rails, such as a walker's torso, stays where it is.
The density stays: the body's mass is spread over its primitive geoms by their volume (meshes count as shown
only), and what the stretched ones gain is added to mass, centre and inertia. That is exact for bodies whose inertia
follows from their geoms at one density, as a recompiled model would have it.
"""

import mujoco
import numpy as np

from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.inertia import from_tensor, matrices, to_tensor

_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_BODY = int(mujoco.mjtObj.mjOBJ_BODY)
_ANCHORED = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
_VOLUMES = {
    _CAPSULE: lambda s: np.pi * s[:, 0] ** 2 * (2 * s[:, 1] + 4 / 3 * s[:, 0]),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda s: 4 / 3 * np.pi * s[:, 0] ** 3,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda s: 2 * np.pi * s[:, 0] ** 2 * s[:, 1],
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda s: 4 / 3 * np.pi * s.prod(axis=1),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda s: 8 * s.prod(axis=1),
}


def link_length(model: mujoco.MjModel, body: int) -> float:
    """Length in m of the longest capsule of a body, between the centres of its caps; 0 without a capsule."""
    return max((2 * float(model.geom_size[g, 1]) for g in _capsules(model, body)), default=0.0)


def held_by_constraint(model: mujoco.MjModel, body: int) -> str:
    """Name of a connect or weld that names the body, whose anchors in it would not be stretched; empty: there is none.

    Those between sites are: sites are stretched with their link.
    """
    for i in range(model.neq):
        named = model.eq_objtype[i] == _BODY and body in (model.eq_obj1id[i], model.eq_obj2id[i])
        if named and model.eq_type[i] in _ANCHORED:
            return model.equality(i).name or f"equality {i}"
    return ""


def write_length(batch: SimulationBatch, body: int, values: np.ndarray, nominal: float) -> None:
    """Stretch a link.

    :param batch: its simulations; only those whose value differs from ``nominal`` are written
    :param body: id of the body
    :param values: the longest capsule's length in each simulation, m, (n,)
    :param nominal: that of the model, see :func:`link_length`
    """
    stretched = np.flatnonzero(values != nominal)
    if len(stretched):
        _Link(batch, body, stretched, values[stretched] / nominal).stretch()


class _Link:
    """One body in the simulations where it is stretched by the factors ``scale``."""

    def __init__(self, batch: SimulationBatch, body: int, rows: np.ndarray, scale: np.ndarray) -> None:
        self.batch, self.body, self.rows = batch, body, rows
        capsules = _capsules(batch.model, body)
        longest = max(capsules, key=lambda g: batch.model.geom_size[g, 1])
        axis = _axes(self.get("geom_quat", longest))
        self.map = np.eye(3) + (scale - 1)[:, None, None] * axis[:, :, None] * axis[:, None, :]

    def get(self, name: str, index: int) -> np.ndarray:
        """A copy of an object's field in the stretched simulations."""
        return self.batch.field(name)[self.rows, index]

    def put(self, name: str, index: int, values: np.ndarray) -> None:
        """Write an object's field in the stretched simulations."""
        self.batch.field(name)[self.rows, index] = values

    def moved(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the body's frame, stretched."""
        return np.einsum("nij,nj->ni", self.map, points)

    def stretch(self) -> None:
        """Write all that changes."""
        model, body = self.batch.model, self.body
        geoms = _geoms(model, body)
        before = {g: self.moments(g) for g in geoms}
        for g in geoms:
            self.stretch_geom(g)
        self.add_mass(before)
        self.keep_joint()
        for name, count, owner in (
            ("jnt_pos", model.njnt, model.jnt_bodyid),
            ("site_pos", model.nsite, model.site_bodyid),
        ):
            for i in range(count):
                if owner[i] == body:
                    self.put(name, i, self.moved(self.get(name, i)))
        for child in range(1, model.nbody):
            if model.body_parentid[child] == body:
                arm = self.arm(child, self.anchor(child))
                self.put("body_pos", child, self.moved(self.get("body_pos", child) + arm) - arm)

    def stretch_geom(self, g: int) -> None:
        """Move a geom, and lengthen and turn a capsule."""
        self.put("geom_pos", g, self.moved(self.get("geom_pos", g)))
        if self.batch.model.geom_type[g] != _CAPSULE:
            return
        quat, size = self.get("geom_quat", g), self.get("geom_size", g)
        half = self.moved(_axes(quat) * size[:, 1:2])
        size[:, 1] = np.linalg.norm(half, axis=1)
        self.put("geom_size", g, size)
        self.put("geom_quat", g, _turned(quat, half / size[:, 1:2]))

    def keep_joint(self) -> None:
        """Move the body so that it is joined to its parent where it was."""
        anchor = self.anchor(self.body)
        self.put(
            "body_pos", self.body, self.get("body_pos", self.body) + self.arm(self.body, anchor - self.moved(anchor))
        )

    def anchor(self, body: int) -> np.ndarray:
        """Where a body turns, in its own frame (n, 3): the anchor of its first hinge or ball, else its origin."""
        model = self.batch.model
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if model.jnt_type[joint] in _TURNING:
                return self.get("jnt_pos", joint)
        return np.zeros((len(self.rows), 3))

    def arm(self, body: int, offset: np.ndarray) -> np.ndarray:
        """A vector of a body's frame in its parent's, (n, 3)."""
        return (matrices(self.get("body_quat", body)) @ offset[:, :, None])[:, :, 0]

    def moments(self, g: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r"""Volume (n,), :math:`\int x\,dV` (n, 3) and :math:`\int x x^T dV` (n, 3, 3) of a geom.

        A geom that only moves keeps its moment about its own centre, which is left out.
        """
        model = self.batch.model
        size, centre = self.get("geom_size", g), self.get("geom_pos", g)
        volume = _VOLUMES.get(int(model.geom_type[g]), lambda s: np.zeros(len(s)))(size)
        second = volume[:, None, None] * centre[:, :, None] * centre[:, None, :]
        if model.geom_type[g] == _CAPSULE:
            axis = _axes(self.get("geom_quat", g))
            along, across = _capsule_second_moments(size[:, 0], size[:, 1])
            line = axis[:, :, None] * axis[:, None, :]
            second += across[:, None, None] * (np.eye(3) - line) + along[:, None, None] * line
        return volume, volume[:, None] * centre, second

    def add_mass(self, before: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
        """Add what the geoms have gained, at the body's density."""
        body = self.body
        mass, centre = self.get("body_mass", body), self.get("body_ipos", body)
        if not mass.all():
            return
        tensor = to_tensor(self.get("body_inertia", body), self.get("body_iquat", body))
        density = mass / sum(volume for volume, _, _ in before.values())
        # Second moments about the body's origin add up, tensors about a moving centre do not.
        first = mass[:, None] * centre
        second = np.trace(tensor, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - tensor
        second += mass[:, None, None] * centre[:, :, None] * centre[:, None, :]
        for g, old in before.items():
            new = self.moments(g)
            mass = mass + density * (new[0] - old[0])
            first += density[:, None] * (new[1] - old[1])
            second += density[:, None, None] * (new[2] - old[2])
        centre = first / mass[:, None]
        second -= mass[:, None, None] * centre[:, :, None] * centre[:, None, :]
        tensor = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        inertia, frame = from_tensor(tensor, near=self.get("body_iquat", body))
        for name, values in (
            ("body_mass", mass),
            ("body_ipos", centre),
            ("body_inertia", inertia),
            ("body_iquat", frame),
        ):
            self.put(name, body, values)


def _capsule_second_moments(radius: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a capsule about its centre, along its axis and across it, m⁵: a cylinder and two half balls."""
    cylinder, ball = 2 * np.pi * radius**2 * half, 4 / 3 * np.pi * radius**3
    # A half ball's centre lies 3/8 of the radius beyond the cylinder's end; about the flat face it has the ball's r²/5.
    along = cylinder * half**2 / 3 + ball * (half**2 + 3 / 4 * half * radius + radius**2 / 5)
    across = cylinder * radius**2 / 4 + ball * radius**2 / 5
    return along, across


def _geoms(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_geomadr[body])
    return list(range(first, first + int(model.body_geomnum[body])))


def _capsules(model: mujoco.MjModel, body: int) -> list[int]:
    return [g for g in _geoms(model, body) if model.geom_type[g] == _CAPSULE]


def _axes(quat: np.ndarray) -> np.ndarray:
    """The z axes (n, 3) of quaternions (n, 4)."""
    return matrices(quat)[:, :, 2]


def _turned(quat: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) turned the shortest way so that their z axes are ``axis`` (n, 3)."""
    old = _axes(quat)
    turn = np.concatenate([1 + np.einsum("ni,ni->n", old, axis)[:, None], np.cross(old, axis)], axis=1)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    out = np.empty_like(quat)
    for i in range(len(quat)):
        mujoco.mju_mulQuat(out[i], turn[i], quat[i])
    return out
