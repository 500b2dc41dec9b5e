"""Forces that a wrapper puts on a joint: what they are at a step's beginning acts until its end.

So does what is written to ``data.qfrc_applied`` before an environment steps, for all the substeps of that step. No
machine does that: a trace looks for it where nothing else explains a simulator's states
(:func:`sb3_rpto.tracing.conclude.conclude`).
"""

import numpy as np

from sb3_rpto.effects.effect import Effect, Parameter, Scales, register
from sb3_rpto.effects.world import World


def _torque(scales: Scales) -> float:
    return 0.03 * scales.torque


class _Held(Effect):
    place = "joint"
    held = True
    offered = False


@register
class HeldFriction(_Held):
    r"""A force :math:`-F\,\mathrm{sign}(\dot q)`, written to MuJoCo's ``qfrc_applied`` at a step's beginning.

    It pushes a joint back that has come to rest meanwhile, as dry friction does not.
    """

    kind = "held_friction"
    parameters = (Parameter("level", "N·m", _torque, lower=0.0),)
    equation = "-level sign(qd), held"
    excite = "motion that often reverses, at small and at large speed"

    def act(self, world: World, x: np.ndarray) -> None:
        """Add the force."""
        world.force[:, self.dof] -= x[:, 0] * np.sign(world.qvel[:, self.dof])


@register
class HeldDamping(_Held):
    r"""A force :math:`-c\,\dot q`, written to MuJoCo's ``qfrc_applied`` at a step's beginning."""

    kind = "held_damping"
    parameters = (Parameter("coefficient", "N·m·s/rad", lambda s: _torque(s) / s.velocity, lower=0.0),)
    equation = "-coefficient qd, held"
    excite = "motion at several speeds"

    def act(self, world: World, x: np.ndarray) -> None:
        """Add the force."""
        world.force[:, self.dof] -= x[:, 0] * world.qvel[:, self.dof]


@register
class HeldDrag(_Held):
    r"""Drag :math:`-c\,|\dot q|\,\dot q`, written to MuJoCo's ``qfrc_applied`` at a step's beginning."""

    kind = "held_drag"
    parameters = (Parameter("coefficient", "N·m·s²/rad²", lambda s: _torque(s) / s.velocity**2, lower=0.0),)
    equation = "-coefficient |qd| qd, held"
    excite = "fast motion"

    def act(self, world: World, x: np.ndarray) -> None:
        """Add the force."""
        v = world.qvel[:, self.dof]
        world.force[:, self.dof] -= x[:, 0] * np.abs(v) * v
