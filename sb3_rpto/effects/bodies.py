"""Bodies, and the world around them."""

import mujoco
import numpy as np

from sb3_rpto.effects.effect import Effect, Parameter, register
from sb3_rpto.effects.inertia import from_tensor, rotations, spread, to_tensor
from sb3_rpto.effects.length import link_length, write_length
from sb3_rpto.effects.names import object_names
from sb3_rpto.effects.world import World


@register
class Payload(Effect):
    r"""A point mass at a body: at :math:`p =` ``along`` :math:`\cdot c` from its origin, where c is its centre of mass.

    In the body's frame, with :math:`S(d) = |d|^2 1 - d d^T`: :math:`M' = M + m`, :math:`c' = (M c + m p) / M'`,
    :math:`I' = I + M S(c - c') + m S(p - c')` (Steiner's theorem).
    """

    kind = "payload"
    place = "body"
    parameters = (
        Parameter("mass", "kg", lambda s: 0.03 * s.mass, lower=0.0),
        Parameter("along", "", 0.2, lower=0.0, upper=4.0, null=2.0, shape=True),
    )
    equation = "point mass at along * (body's centre of mass)"
    native = "inertial"
    excite = "accelerations, and poses at which gravity pulls"

    def write(self, world: World, x: np.ndarray) -> None:
        """Change mass, centre and inertia where there is a payload."""
        heavier = x[:, 0] > 0
        if not heavier.any():
            return
        added, along = x[heavier].T
        mass, centre = world.field("body_mass"), world.field("body_ipos")
        inertia, frame = world.field("body_inertia"), world.field("body_iquat")
        m, c = mass[heavier, self.index], centre[heavier, self.index]
        p = along[:, None] * c
        total = m + added
        new = (m[:, None] * c + added[:, None] * p) / total[:, None]
        if not world.model.body_ipos[self.index].any():
            # At the centre of mass a point only weighs; MuJoCo keeps some such bodies in a simplified form.
            mass[heavier, self.index] = total
            return
        tensor = to_tensor(inertia[heavier, self.index], frame[heavier, self.index])
        tensor += spread(m, c - new) + spread(added, p - new)
        mass[heavier, self.index], centre[heavier, self.index] = total, new
        inertia[heavier, self.index], frame[heavier, self.index] = from_tensor(tensor, frame[heavier, self.index])


@register
class Armature(Effect):
    r"""Inertia of a motor's rotor behind its gear, :math:`-a\,\ddot q`: MuJoCo's ``armature``."""

    kind = "armature"
    place = "joint"
    parameters = (Parameter("inertia", "kg·m²", lambda s: 0.05 * s.inertia, lower=0.0),)
    equation = "-inertia qdd"
    native = "armature"
    excite = "large accelerations"
    same = ("armature",)

    def write(self, world: World, x: np.ndarray) -> None:
        """Add to armature."""
        world.field("dof_armature")[:, self.dof] += x[:, 0]


@register
class LinkLength(Effect):
    r"""A link :math:`(1 + r)` times as long, at its own density; see :mod:`sb3_rpto.effects.length`."""

    kind = "link_length"
    place = "body"
    parameters = (Parameter("change", "", 0.03, lower=-0.5, upper=1.0),)
    equation = "(1 + change) length"
    native = "fromto"
    excite = "accelerations, and poses at which gravity pulls"
    same = ("length",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Moving bodies that have a capsule."""
        names = object_names(model, "body")
        return [name for name in super().places(model) if link_length(model, names.index(name)) > 0]

    def bind(self, model: mujoco.MjModel) -> None:
        """As in :class:`Effect`.

        :raises ValueError: the body has no capsule
        """
        super().bind(model)
        self.nominal = link_length(model, self.index)
        if self.nominal == 0:
            raise ValueError(f"link_length cannot sit on {self.on!r}: the body has no capsule to stretch")

    def write(self, world: World, x: np.ndarray) -> None:
        """Stretch the link."""
        write_length(world, self.index, self.nominal * (1 + x[:, 0]), self.nominal)


@register
class GravityTilt(Effect):
    r"""A base that is not level: gravity becomes :math:`R_x(\alpha)\,R_y(\beta)\,g`."""

    kind = "gravity_tilt"
    place = "world"
    parameters = (
        Parameter("x", "rad", 0.03, lower=-0.5, upper=0.5),
        Parameter("y", "rad", 0.03, lower=-0.5, upper=0.5),
    )
    equation = "g' = Rx(x) Ry(y) g"
    native = "option gravity"
    excite = "poses at which gravity pulls differently"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The world, where there is gravity."""
        off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        return [] if off or not model.opt.gravity.any() else [""]

    def write(self, world: World, x: np.ndarray) -> None:
        """Turn gravity."""
        gravity = world.field("opt.gravity")
        gravity[:] = np.einsum("nij,nj->ni", rotations(x[:, 0], x[:, 1]), gravity)


@register
class Wind(Effect):
    """A steady wind that bodies meet in a fluid: MuJoCo's ``option wind``, where there is density or viscosity."""

    kind = "wind"
    place = "world"
    parameters = tuple(Parameter(axis, "m/s", 0.5) for axis in "xyz")
    equation = "wind' = wind + (x, y, z)"
    native = "option wind"
    excite = "large areas in the wind, and rest"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The world, where there is a fluid."""
        return [""] if model.opt.density > 0 or model.opt.viscosity > 0 else []

    def write(self, world: World, x: np.ndarray) -> None:
        """Add to the wind."""
        world.field("opt.wind")[:] += x


@register
class Fluid(Effect):
    """A medium that drags every body by its size: MuJoCo's ``option density`` and ``viscosity`` (inertia boxes)."""

    kind = "fluid"
    place = "world"
    parameters = (
        Parameter("density", "kg/m³", 10.0, lower=0.0),
        Parameter("viscosity", "Pa·s", 0.1, lower=0.0),
    )
    equation = "drag = density f(v |v|, size) + viscosity f(v, size)"
    native = "option density"
    excite = "fast motion"
    same = ("density", "viscosity")

    def write(self, world: World, x: np.ndarray) -> None:
        """Add to density and viscosity."""
        for column, name in enumerate(("opt.density", "opt.viscosity")):
            world.field(name)[:] += x[:, column].reshape(world.field(name).shape)


@register
class GeomFriction(Effect):
    """Another coefficient of sliding friction of a geom.

    A contact has the larger coefficient of its two geoms: a smaller one shows where the other's is smaller still.
    """

    kind = "geom_friction"
    place = "geom"
    parameters = (Parameter("change", "", 0.1, lower=-1.0, upper=5.0),)
    equation = "friction' = max(friction + change, 0)"
    native = "friction"
    excite = "feet that slip"
    same = ("friction",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Geoms that may touch another with friction."""
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
            return []
        names = object_names(model, "geom")
        return [names[g] for g in range(model.ngeom) if any(_may_touch(model, g, h) for h in range(model.ngeom))]

    def write(self, world: World, x: np.ndarray) -> None:
        """Change the coefficient."""
        friction = world.field("geom_friction")[:, self.index, 0]
        friction[:] = np.maximum(friction + x[:, 0], 0.0)


def _may_touch(model: mujoco.MjModel, g: int, h: int) -> bool:
    """Whether two geoms collide by their bits and their bodies can move against each other, and friction is felt."""
    bits = (model.geom_contype[g] & model.geom_conaffinity[h]) | (model.geom_contype[h] & model.geom_conaffinity[g])
    one, other = (int(model.body_weldid[model.geom_bodyid[i]]) for i in (g, h))
    parent = model.body_weldid[model.body_parentid]
    kin = bool(one and other) and (parent[one] == other or parent[other] == one)
    return bool(bits) and one != other and not kin and max(model.geom_condim[g], model.geom_condim[h]) > 1
