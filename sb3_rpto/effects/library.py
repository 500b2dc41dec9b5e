"""Which effects a model may lack."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco

from sb3_rpto.effects.declared import declare
from sb3_rpto.effects.effect import LIBRARY, Effect
from sb3_rpto.effects.names import object_id


def candidates(model: mujoco.MjModel, exclude: Iterable[str] = ()) -> list[Effect]:
    """Every registered effect at every place of a model where it makes sense, all at their null values.

    =====================================================  ==========================================================
    place                                                  effects
    =====================================================  ==========================================================
    hinge or slide                                         coulomb_friction, stribeck_friction, viscous_friction,
                                                           quadratic_drag, asymmetric_damping, torque_offset, spring,
                                                           armature, sensor_delay, sensor_bias, sensor_gain
    hinge only                                             torque_ripple, position_friction
    hinge or slide with a motor                            load_friction, directional_load_friction
    actuator                                               command_delay, command_deadband, command_gain,
                                                           command_saturation, backlash, actuator_lag
    actuator on a hinge or slide without activation        dc_motor
    moving body that has mass                              payload
    moving body that has a capsule                         link_length
    geom that may touch another                            geom_friction
    world                                                  gravity_tilt (with gravity), wind (in a fluid), fluid
    =====================================================  ==========================================================

    An effect is left out where the same number is declared: ``hinge.damping`` leaves out viscous_friction(hinge),
    ``frictionloss`` coulomb_friction, ``stiffness`` spring, ``armature`` armature, ``arm.length`` link_length(arm), a
    geom's ``friction`` geom_friction, an actuator's ``gain``, ``gear`` or ``strength`` command_gain, ``option.density``
    and ``option.viscosity`` fluid. A declared mass leaves payload in: it moves the centre of mass too.

    :param model: the compiled model
    :param exclude: names of declared parameters, as :func:`~sb3_rpto.effects.declare` takes them
    :raises ValueError: a name in ``exclude`` is unknown
    """
    declared = {(d.owner, d.index, d.label.rpartition(".")[2]) for d in declare(model, exclude)}
    found = []
    for kind in LIBRARY.values():
        for on in kind.places(model):
            owner = "option" if kind.place == "world" else kind.place
            index = 0 if kind.place in ("world", "sensor") else object_id(model, owner, on)
            if not any((owner, index, name) in declared for name in kind.same):
                found.append(kind(on))
    return found
