"""Forces that a wrapper puts on a joint: what they are at a step's beginning acts until its end.

So does what is written to ``data.qfrc_applied`` before an environment steps, for all the substeps of that step. No
machine does that: a trace looks for it where nothing else explains a simulator's states
(:class:`sb3_rpto.sysid.hypotheses.held_forces.HeldForces`).
"""

from dataclasses import replace

import numpy as np

from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.effect import Effect, register
from sb3_rpto.effects.friction import CoulombFriction, QuadraticDrag, ViscousFriction


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
    parameters = tuple(replace(p, own="") for p in CoulombFriction.parameters)  # it takes nothing of the model away
    equation = "-level sign(qd), held"
    excite = "motion that often reverses, at small and at large speed"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the force."""
        batch.force[:, self.dof] -= x[:, 0] * np.sign(batch.qvel[:, self.dof])


@register
class HeldDamping(_Held):
    r"""A force :math:`-c\,\dot q`, written to MuJoCo's ``qfrc_applied`` at a step's beginning."""

    kind = "held_damping"
    parameters = tuple(replace(p, own="") for p in ViscousFriction.parameters)
    equation = "-coefficient qd, held"
    excite = "motion at several speeds"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the force."""
        batch.force[:, self.dof] -= x[:, 0] * batch.qvel[:, self.dof]


@register
class HeldDrag(_Held):
    r"""Drag :math:`-c\,|\dot q|\,\dot q`, written to MuJoCo's ``qfrc_applied`` at a step's beginning."""

    kind = "held_drag"
    parameters = QuadraticDrag.parameters
    equation = "-coefficient |qd| qd, held"
    excite = "fast motion"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the force."""
        v = batch.qvel[:, self.dof]
        batch.force[:, self.dof] -= x[:, 0] * np.abs(v) * v
