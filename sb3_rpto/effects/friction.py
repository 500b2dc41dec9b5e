"""Friction in a joint."""

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import driven, joint_torque, motors
from sb3_rpto.effects.batch import SimulationBatch, add
from sb3_rpto.effects.effect import Effect, Parameter, Scales, register
from sb3_rpto.effects.names import hinges, object_names


def _torque(scales: Scales) -> float:
    return 0.03 * scales.torque


@register
class CoulombFriction(Effect):
    r"""Dry friction of constant level (Coulomb 1785): :math:`-F_c\,\mathrm{sign}(\dot q)`, holding up to :math:`F_c`.

    MuJoCo's frictionloss, with the stiffest constraint that the time step allows.
    """

    kind = "coulomb_friction"
    place = "joint"
    parameters = (Parameter("level", "N·m", _torque, lower=0.0, own="dof_frictionloss"),)
    equation = "-level sign(qd)"
    native = "frictionloss"
    excite = "motion that often reverses, at small and at large speed"
    same = ("frictionloss",)

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to frictionloss."""
        batch.rough(self.dof)
        add(batch.field("dof_frictionloss")[:, self.dof], x[:, 0])


@register
class SoftFriction(CoulombFriction):
    r"""MuJoCo's ``frictionloss`` alone: :math:`-F_c\,\mathrm{sign}(\dot q)`, which gives way near rest.

    It acts in the constraint that the model has (by default over ``solref`` of 0.02 s), so that a loaded joint creeps,
    as no machine's does: a trace looks for it where the robot seems to be simulated
    (:class:`sb3_rpto.sysid.hypotheses.soft_friction.SoftFriction`).
    """

    kind = "soft_friction"
    equation = "-level sign(qd), giving way over solref"
    offered = False

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to frictionloss, and leave its constraint as it is."""
        add(batch.field("dof_frictionloss")[:, self.dof], x[:, 0])


@register
class StribeckFriction(Effect):
    r"""Dry friction that is higher near rest: :math:`F_c + (F_s - F_c) e^{-(\dot q / v_s)^2}` (Stribeck 1902).

    With the Coulomb effect beside it, ``level`` adds up.
    """

    kind = "stribeck_friction"
    place = "joint"
    parameters = (
        Parameter("extra", "N·m", _torque, lower=0.0),
        Parameter("level", "N·m", _torque, lower=0.0),
        Parameter("speed", "rad/s", lambda s: 0.1 * s.velocity, lower=1e-3, null=0.3, shape=True),
    )
    equation = "-(level + extra exp(-(qd/speed)^2)) sign(qd)"
    excite = "slow motion and motion that starts from rest"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Raise the level of dry friction."""
        v = batch.qvel[:, self.dof] / x[:, 2]
        batch.friction[:, self.dof] += x[:, 1] + x[:, 0] * np.exp(-(v**2))


@register
class ViscousFriction(Effect):
    r"""Friction proportional to speed, :math:`-c\,\dot q`: MuJoCo's ``damping``, integrated implicitly."""

    kind = "viscous_friction"
    place = "joint"
    parameters = (
        Parameter("coefficient", "N·m·s/rad", lambda s: _torque(s) / s.velocity, lower=0.0, own="dof_damping"),
    )
    equation = "-coefficient qd"
    native = "damping"
    excite = "motion at several speeds"
    same = ("damping",)

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to damping."""
        add(batch.field("dof_damping")[:, self.dof], x[:, 0])


@register
class QuadraticDrag(Effect):
    r"""Drag of a turbulent flow, :math:`-c\,|\dot q|\,\dot q`.

    MuJoCo's ``dof_dampingpoly`` (:math:`-(d + p_0 |\dot q| + p_1 \dot q^2)\,\dot q`, first coefficient).
    """

    kind = "quadratic_drag"
    place = "joint"
    parameters = (Parameter("coefficient", "N·m·s²/rad²", lambda s: _torque(s) / s.velocity**2, lower=0.0),)
    equation = "-coefficient |qd| qd"
    native = "damping"
    excite = "fast motion"

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to the damping polynomial."""
        batch.field("dof_dampingpoly")[:, self.dof, 0] += x[:, 0]


@register
class AsymmetricDamping(Effect):
    r"""Viscous friction that depends on the direction: :math:`-c_+ \max(\dot q, 0) - c_- \min(\dot q, 0)`.

    Friction of machines is often unequal in the two directions (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994).
    It acts explicitly: a coefficient above twice the joint's inertia over the time step makes energy.
    """

    kind = "asymmetric_damping"
    place = "joint"
    parameters = (
        Parameter("forward", "N·m·s/rad", lambda s: _torque(s) / s.velocity, lower=0.0),
        Parameter("backward", "N·m·s/rad", lambda s: _torque(s) / s.velocity, lower=0.0),
    )
    equation = "-forward max(qd, 0) - backward min(qd, 0)"
    excite = "motion at several speeds in both directions"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the torque."""
        v = batch.qvel[:, self.dof]
        batch.force[:, self.dof] -= x[:, 0] * np.maximum(v, 0.0) + x[:, 1] * np.minimum(v, 0.0)


class _LoadDependent(Effect):
    """Friction that grows with what the motors put on the joint."""

    place = "joint"
    excite = "large and small torques at the same speed"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Joints that a motor drives."""
        names = object_names(model, "joint")
        moved = {names[joint] for joint in driven(model)}
        return [name for name in super().places(model) if name in moved]

    def bind(self, model: mujoco.MjModel) -> None:
        """As in :class:`Effect`; looks up the motors too."""
        super().bind(model)
        self.motors = motors(model, self.index)
        self.asks_simulator = self.motors is None

    def torque(self, batch: SimulationBatch) -> np.ndarray:
        """The motors' torque at the joint, (n,)."""
        return joint_torque(batch, self.motors, self.dof, self.adr)


@register
class LoadFriction(_LoadDependent):
    r"""Dry friction that grows with the load of a gear: :math:`F = \mu\,|\tau_m|` (Bittencourt & Gunnarsson 2012)."""

    kind = "load_friction"
    parameters = (Parameter("mu", "", 0.03, lower=0.0, upper=1.0),)
    equation = "-mu |tau_motor| sign(qd)"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Raise the level of dry friction."""
        batch.friction[:, self.dof] += x[:, 0] * np.abs(self.torque(batch))


@register
class DirectionalLoadFriction(_LoadDependent):
    r"""Load-dependent friction that differs when the motor drives the load and when the load drives the motor.

    :math:`F = \mu_d |\tau_m|` while :math:`\tau_m \dot q > 0`, else :math:`F = \mu_b |\tau_m|`: the two efficiencies of
    a gear (Duclusaud et al. 2025). A gear at rest is driven by its load.
    """

    kind = "directional_load_friction"
    parameters = (
        Parameter("mu_driving", "", 0.03, lower=0.0, upper=1.0),
        Parameter("mu_driven", "", 0.03, lower=0.0, upper=1.0),
    )
    equation = "-(mu_driving if tau_motor qd > 0 else mu_driven) |tau_motor| sign(qd)"
    excite = "accelerating and braking with large torques"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Raise the level of dry friction."""
        torque = self.torque(batch)
        mu = np.where(torque * batch.qvel[:, self.dof] > 0, x[:, 0], x[:, 1])
        batch.friction[:, self.dof] += mu * np.abs(torque)


@register
class PositionFriction(Effect):
    r"""Dry friction that varies over a turn, as of a bent shaft: :math:`F = A\,(1 + \cos(q - \varphi)) / 2`.

    A mean and the first harmonic of friction that depends on the position (Armstrong-Hélouvry, Dupont & Canudas de
    Wit 1994).
    """

    kind = "position_friction"
    place = "joint"
    parameters = (
        Parameter("amplitude", "N·m", _torque, lower=0.0),
        Parameter("phase", "rad", 0.5, lower=-np.pi, upper=np.pi, shape=True, starts=(-3.2, 3.2, 6.2)),
    )
    equation = "-amplitude (1 + cos(q - phase))/2 sign(qd)"
    excite = "slow motion over a whole turn"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Hinges."""
        return hinges(model)

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Raise the level of dry friction."""
        q = batch.qpos[:, self.adr]
        batch.friction[:, self.dof] += x[:, 0] * (1 + np.cos(q - x[:, 1])) / 2
