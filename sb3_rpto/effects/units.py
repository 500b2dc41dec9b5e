"""The joint that an effect acts on, and the units of its parameters there."""

from __future__ import annotations

import mujoco

from sb3_rpto.effects.actuation import drivers
from sb3_rpto.effects.declared import Declared
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.names import object_id


def units_at(effect: Effect, model: mujoco.MjModel) -> tuple[str, ...]:
    """Units of an effect's parameters where it sits: stated for hinges, a slide has m for rad and N for N·m."""
    units, joint = tuple(p.unit for p in effect.parameters), joint_of(effect, model)
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
        return units
    return tuple(u.replace("kg·m²", "kg").replace("N·m", "N").replace("(N)", "N").replace("rad", "m") for u in units)


def joint_of(effect: Effect, model: mujoco.MjModel) -> int:
    """Id of the joint that an effect of a joint, a sensor or an actuator acts on, or that a declared number is of.

    :return: -1 where there is none
    """
    place = effect.owner if isinstance(effect, Declared) else effect.place
    if place not in ("joint", "sensor", "actuator"):
        return -1
    kind = "actuator" if place == "actuator" else "joint"
    index = effect.index if isinstance(effect, Declared) else object_id(model, kind, effect.on)
    if kind == "joint":
        return index
    return next((j for j in range(model.njnt) if index in drivers(model, j)), -1)
