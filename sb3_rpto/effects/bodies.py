"""Bodies, and the world around them."""

import mujoco
import numpy as np

from sb3_rpto.effects.batch import SimulationBatch, add
from sb3_rpto.effects.effect import Effect, Parameter, register
from sb3_rpto.effects.inertia import from_tensor, rotations, spread, to_tensor
from sb3_rpto.effects.length import held_by_constraint, link_length, write_length
from sb3_rpto.effects.names import object_names


@register
class MassScale(Effect):
    r"""A body of another density: MuJoCo's ``body_mass`` and ``body_inertia`` are :math:`1 + c` times as much."""

    kind = "mass_scale"
    place = "body"
    parameters = (Parameter("change", "", 0.03, lower=-0.9, upper=9.0),)
    equation = "(1 + change) mass and inertia"
    native = "inertial"
    excite = "accelerations, and poses at which gravity pulls"
    same = ("mass",)
    offered = False

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the body's mass and inertia."""
        batch.field("body_mass")[:, self.index] *= 1 + x[:, 0]
        batch.field("body_inertia")[:, self.index] *= 1 + x


@register
class InertiaScale(Effect):
    r"""A body whose inertia is :math:`1 + c` times as much at the same mass: MuJoCo's ``body_inertia`` alone.

    So it is where masses were changed and inertias were not, as scripts that write ``body_mass`` alone do.
    """

    kind = "inertia_scale"
    place = "body"
    parameters = (Parameter("change", "", 0.1, lower=-0.95, upper=29.0),)
    equation = "(1 + change) inertia, the mass as it is"
    native = "inertial"
    excite = "angular accelerations"
    same = ("inertia",)
    offered = False

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the body's inertia."""
        batch.field("body_inertia")[:, self.index] *= 1 + x


@register
class Payload(Effect):
    r"""A point mass at a body: at :math:`p =` ``along`` :math:`\cdot c` from its origin, where c is its centre of mass.

    In the body's frame, with :math:`S(d) = |d|^2 1 - d d^T`: :math:`M' = M + m`, :math:`c' = (M c + m p) / M'`,
    :math:`I' = I + M S(c - c') + m S(p - c')` (the parallel-axis theorem, Craig 2005): MuJoCo's ``inertial``.
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

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Change mass, centre and inertia where there is a payload."""
        heavier = x[:, 0] > 0
        if not heavier.any():
            return
        added, along = x[heavier].T
        mass, centre = batch.field("body_mass"), batch.field("body_ipos")
        inertia, frame = batch.field("body_inertia"), batch.field("body_iquat")
        m, c = mass[heavier, self.index], centre[heavier, self.index]
        p = along[:, None] * c
        total = m + added
        new = (m[:, None] * c + added[:, None] * p) / total[:, None]
        if not batch.model.body_ipos[self.index].any():
            # At the centre of mass a point only weighs; MuJoCo keeps some such bodies in a simplified form.
            mass[heavier, self.index] = total
            return
        tensor = to_tensor(inertia[heavier, self.index], frame[heavier, self.index])
        tensor += spread(m, c - new) + spread(added, p - new)
        mass[heavier, self.index], centre[heavier, self.index] = total, new
        inertia[heavier, self.index], frame[heavier, self.index] = from_tensor(tensor, frame[heavier, self.index])


@register
class ComOffset(Effect):
    r"""A centre of mass elsewhere, :math:`c' = c + (x, y, z)` in the body's frame: MuJoCo's ``inertial pos``.

    Mass, and the inertia about the centre, stay. What a body cannot move along does not show there: of a planar robot
    two of the three numbers do.
    """

    kind = "com_offset"
    place = "body"
    parameters = tuple(Parameter(axis, "m", 0.01) for axis in "xyz")
    equation = "centre of mass + (x, y, z)"
    native = "inertial"
    excite = "accelerations, and poses at which gravity pulls"
    offered = False

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Moving bodies but those of MuJoCo's simplified form, which keeps the centre where it is."""
        names = object_names(model, "body")
        return [name for name in super().places(model) if not model.body_simple[names.index(name)]]

    def why_not(self, model: mujoco.MjModel) -> str:
        """As in :class:`Effect`."""
        moves = self.on in super().places(model)
        return "MuJoCo holds it in a form that keeps the centre where it is" if moves else super().why_not(model)

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Move the centre of mass."""
        batch.field("body_ipos")[:, self.index] += x


@register
class Armature(Effect):
    r"""Inertia of a motor's rotor behind its gear, :math:`-a\,\ddot q`: MuJoCo's ``armature``."""

    kind = "armature"
    place = "joint"
    parameters = (Parameter("inertia", "kg·m²", lambda s: 0.05 * s.inertia, lower=0.0, own="dof_armature"),)
    equation = "-inertia qdd"
    native = "armature"
    excite = "large accelerations"
    same = ("armature",)

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to armature."""
        add(batch.field("dof_armature")[:, self.dof], x[:, 0])


@register
class LinkLength(Effect):
    r"""A link :math:`(1 + r)` times as long: points of its body move to :math:`x' = x + r\,(n \cdot x)\,n`.

    :math:`n` is the axis of its longest capsule. As if the MJCF had another ``fromto`` there, and MuJoCo took the
    inertia from the geoms at their density (``inertiafromgeom``); see :mod:`sb3_rpto.effects.length`.
    """

    kind = "link_length"
    place = "body"
    parameters = (Parameter("change", "", 0.03, lower=-0.5, upper=1.0),)
    equation = "(1 + change) length"
    native = "fromto"
    excite = "accelerations, and poses at which gravity pulls"
    same = ("length",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Moving bodies that have a capsule and that no connect or weld names."""
        ids = {name: i for i, name in enumerate(object_names(model, "body"))}
        have = [name for name in super().places(model) if link_length(model, ids[name]) > 0]
        return [name for name in have if not held_by_constraint(model, ids[name])]

    def bind(self, model: mujoco.MjModel) -> None:
        """As in :class:`Effect`; looks up the length too."""
        super().bind(model)
        self.nominal = link_length(model, self.index)

    def why_not(self, model: mujoco.MjModel) -> str:
        """As in :class:`Effect`."""
        held = held_by_constraint(model, self.index)
        return f"{held} names the body; tie it by sites (site1=)" if held else "the body has no capsule to stretch"

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Stretch the link."""
        write_length(batch, self.index, self.nominal * (1 + x[:, 0]), self.nominal)


@register
class GravityTilt(Effect):
    r"""A base that is not level: gravity becomes :math:`g' = R_x(\alpha)\,R_y(\beta)\,g`; MuJoCo's ``option gravity``.

    Turned about the world's y axis, then about its x axis (rotations about fixed axes, Craig 2005).
    """

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

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Turn gravity."""
        gravity = batch.field("opt.gravity")
        gravity[:] = (rotations(x[:, 0], x[:, 1]) * gravity[:, None]).sum(axis=2)


@register
class GravityScale(Effect):
    r"""Gravity of another strength, :math:`g' = (1 + c)\,g`, as in simulated worlds: MuJoCo's ``option gravity``."""

    kind = "gravity_scale"
    place = "world"
    parameters = (Parameter("change", "", 0.03, lower=-1.0, upper=9.0),)
    equation = "g' = (1 + change) g"
    native = "option gravity"
    excite = "poses at which gravity pulls differently"
    same = ("gravity",)
    offered = False

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The world, where there is gravity."""
        return GravityTilt.places(model)

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale gravity."""
        batch.field("opt.gravity")[:] *= 1 + x


@register
class Wind(Effect):
    r"""A steady wind, :math:`w' = w + (x, y, z)` in the world's frame: MuJoCo's ``option wind``.

    Bodies meet it as a fluid that moves: the velocity in their drag (see :class:`Fluid`) is :math:`v - w'`. Without
    density or viscosity it does nothing.
    """

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

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to the wind."""
        batch.field("opt.wind")[:] += x


@register
class ExternalForce(Effect):
    r"""A constant force :math:`(x, y, z)` in the world's frame at a body's centre of mass: MuJoCo's ``xfrc_applied``.

    What pulls or pushes a base that moves freely; at one that only slides or turns it is a ``torque_offset``.
    """

    kind = "external_force"
    place = "body"
    parameters = tuple(Parameter(axis, "N", lambda s: 0.3 * s.mass) for axis in "xyz")  # 3 % of a weight
    equation = "(x, y, z) at the centre of mass"
    excite = "poses at which the base turns differently"
    offered = False

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Bodies in the world that move in two ways or more."""
        names = object_names(model, "body")
        base = (model.body_weldid[model.body_parentid] == 0) & (model.body_dofnum > 1)
        return [name for name in super().places(model) if base[names.index(name)]]

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the force."""
        batch.pull[:, self.index] += x


@register
class Fluid(Effect):
    r"""A medium that drags every body by its size: MuJoCo's ``option density`` and ``viscosity``.

    With the model's own they make :math:`\rho` and :math:`\beta`. A body has an inertia box of half-sizes
    :math:`r_i = \sqrt{3 (I_j + I_k - I_i) / (2 M)}`, of mean :math:`r`; the force and torque along its axes are

    .. math::

        f_i = -2 \rho\,r_j r_k |v_i| v_i - 6 \pi \beta\,r\,v_i, \qquad
        g_i = -\tfrac12 \rho\,r_i (r_j^4 + r_k^4) |\omega_i| \omega_i - 8 \pi \beta\,r^3 \omega_i

    (MuJoCo documentation, *Fluid forces*, inertia model; geoms with ``fluidshape="ellipsoid"`` have another).
    """

    kind = "fluid"
    place = "world"
    parameters = (
        Parameter("density", "kg/m³", 10.0, lower=0.0, own="opt.density"),
        Parameter("viscosity", "Pa·s", 0.1, lower=0.0, own="opt.viscosity"),
    )
    equation = "drag = density f(v |v|, size) + viscosity f(v, size)"
    native = "option density"
    excite = "fast motion"
    same = ("density", "viscosity")

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to density and viscosity."""
        for column, name in enumerate(("opt.density", "opt.viscosity")):
            add(batch.field(name), x[:, column].reshape(batch.field(name).shape))


@register
class GeomFriction(Effect):
    r"""Another coefficient of sliding friction of a geom, :math:`\mu' = \max(\mu + c, 0)`.

    The first of MuJoCo's ``friction``. A contact has the larger coefficient of its two geoms (at unequal ``priority``
    that of the higher): a smaller one shows where the other's is smaller still.
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
        names = object_names(model, "geom")
        return [names[g] for g in range(model.ngeom) if any(_may_slip(model, g, h) for h in range(model.ngeom))]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Change the coefficient."""
        friction = batch.field("geom_friction")[:, self.index, 0]
        friction[:] = np.maximum(friction + x[:, 0], 0.0)


@register
class ContactSoftness(Effect):
    r"""Softer or bouncier contacts of a geom that stands still: :math:`((1 + s)\,\tau,\ (1 + d)\,\zeta)`.

    :math:`\tau` and :math:`\zeta` are the time constant and the damping ratio of MuJoCo's ``solref``. A contact has the
    mean of its two geoms' (weighted by ``solmix``; at unequal ``priority`` those of the higher), so softer feet show as
    a softer ground, and no :math:`\tau` below twice the time step: a model that is there cannot be harder.
    """

    kind = "contact_softness"
    place = "geom"
    parameters = (
        Parameter("softness", "", 0.1, lower=-0.9, upper=9.0),
        Parameter("damping", "", 0.1, lower=-0.9, upper=9.0),
    )
    equation = "(1 + softness) time constant, (1 + damping) damping ratio of contacts"
    native = "solref"
    excite = "feet that land and lift"
    same = ("timeconst", "dampratio")
    offered = False

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Geoms of the world that may touch another, with a time constant: not with stiffness and damping instead."""
        names = object_names(model, "geom")
        still = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_solref[:, 0] > 0)
        geoms = [g for g in range(model.ngeom) if still[g]]
        return [names[g] for g in geoms if any(may_touch(model, g, h) for h in range(model.ngeom))]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the geom's numbers."""
        batch.field("geom_solref")[:, self.index] *= 1 + x


def may_touch(model: mujoco.MjModel, g: int, h: int) -> bool:
    """Whether two geoms collide, by the model's flags and their bits, and their bodies can move against each other."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return False
    bits = (model.geom_contype[g] & model.geom_conaffinity[h]) | (model.geom_contype[h] & model.geom_conaffinity[g])
    one, other = (int(model.body_weldid[model.geom_bodyid[i]]) for i in (g, h))
    parent = model.body_weldid[model.body_parentid]
    kin = bool(one and other) and (parent[one] == other or parent[other] == one)
    return bool(bits) and one != other and not kin


def _may_slip(model: mujoco.MjModel, g: int, h: int) -> bool:
    """Whether they do, and friction is felt."""
    return may_touch(model, g, h) and max(model.geom_condim[g], model.geom_condim[h]) > 1
