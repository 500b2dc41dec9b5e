"""Friction in a joint."""

import numpy as np

from sb3_rpto.effects.effect import Effect, Parameter, register
from sb3_rpto.effects.world import World


@register
class CoulombFriction(Effect):
    r"""Dry friction of constant level, holding at rest: :math:`|\tau_f| \le F_c`, and :math:`-F_c\,\mathrm{sign}(\dot q)` in motion.

    MuJoCo's frictionloss, with the stiffest constraint that the time step allows.
    """

    kind = "coulomb_friction"
    place = "joint"
    parameters = (Parameter("level", "N·m", lambda s: 0.03 * s.torque, lower=0.0),)
    equation = "-level sign(qd)"
    native = "frictionloss"

    def write(self, world: World, x: np.ndarray) -> None:
        """Add to frictionloss."""
        world.rough(self.dof)
        world.field("dof_frictionloss")[:, self.dof] += x[:, 0]


@register
class StribeckFriction(Effect):
    r"""Dry friction that is higher near rest: :math:`F_c + (F_s - F_c) e^{-(\dot q / v_s)^2}` (Stribeck 1902).

    With the Coulomb effect beside it, ``level`` adds up.
    """

    kind = "stribeck_friction"
    place = "joint"
    parameters = (
        Parameter("extra", "N·m", lambda s: 0.03 * s.torque, lower=0.0),
        Parameter("level", "N·m", lambda s: 0.03 * s.torque, lower=0.0),
        Parameter("speed", "rad/s", lambda s: 0.1 * s.velocity, lower=1e-3, null=0.3, shape=True),
    )
    equation = "-(level + extra exp(-(qd/speed)^2)) sign(qd)"

    def act(self, world: World, x: np.ndarray) -> None:
        """Raise the level of dry friction."""
        v = world.qvel[:, self.dof] / x[:, 2]
        world.friction[:, self.dof] += x[:, 1] + x[:, 0] * np.exp(-(v**2))
