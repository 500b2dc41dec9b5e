"""The Swimmer with five links and four motors."""

from __future__ import annotations

from typing import Any

import mujoco
from gymnasium.envs.mujoco.swimmer_v5 import SwimmerEnv

#: Links of the task's own swimmer and of ours.
_OWN, LINKS = 3, 5


def swimmer_spec(path: str) -> mujoco.MjSpec:
    """Gymnasium's swimmer with two more links behind its last one, each with a hinge and a motor like the last one's.

    The paper "adds 4 more joints ... which creates additional 2 actions", which cannot be: with a motor at each hinge,
    two more actions are two more hinges and links.

    :param path: of the task's MJCF
    """
    spec = mujoco.MjSpec.from_file(path)
    last = spec.body("back")
    hinge, motor, capsule = last.joints[0], spec.actuators[-1], last.geoms[0]
    for number in range(_OWN, LINKS):
        last = last.add_body(name=f"back{number - 1}", pos=last.pos)
        last.add_geom(
            spec.default, type=capsule.type, fromto=capsule.fromto, size=capsule.size, density=capsule.density
        )
        name = f"motor{number}_rot"
        last.add_joint(
            spec.default, name=name, type=hinge.type, axis=hinge.axis, range=hinge.range, limited=hinge.limited
        )
        spec.add_actuator(
            spec.default,
            trntype=motor.trntype,
            target=name,
            gear=motor.gear,
            ctrllimited=motor.ctrllimited,
            ctrlrange=motor.ctrlrange,
        )
    return spec


class Swimmer5Env(SwimmerEnv):
    """Gymnasium's Swimmer-v5 with five links: 12 observations, 4 actions.

    Observed are the angle of the first link, four hinges, and their velocities with those of the first link.

    :param kwargs: of gymnasium's ``SwimmerEnv``
    """

    def mjcf(self) -> str:
        """The model's MJCF, which is in no file."""
        spec = swimmer_spec(self.fullpath)
        spec.compile()
        return spec.to_xml()

    def _initialize_simulation(self) -> tuple[Any, Any]:
        model = swimmer_spec(self.fullpath).compile()
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self.height)
        return model, mujoco.MjData(model)
