"""Which effects a model may lack."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence

import mujoco

from sb3_rpto.effects.declared import Declared, declare
from sb3_rpto.effects.effect import LIBRARY, Effect
from sb3_rpto.effects.names import near, object_id


def candidates(model: mujoco.MjModel, exclude: Iterable[str] = (), kinds: Container[str] | None = None) -> list[Effect]:
    """Registered effects at every place of a model where they make sense, all at their null values.

    =====================================================  ==========================================================
    place                                                  effects
    =====================================================  ==========================================================
    hinge or slide                                         coulomb_friction, stribeck_friction, viscous_friction,
                                                           quadratic_drag, asymmetric_damping, torque_offset, spring,
                                                           armature, sensor_delay, sensor_bias, sensor_gain
    hinge only                                             torque_ripple, position_friction
    hinge or slide with limits                             end_stop
    hinge or slide with a motor                            load_friction, directional_load_friction
    actuator                                               command_delay, command_deadband, command_gain,
                                                           command_saturation, backlash, actuator_lag
    actuator on a hinge or slide without activation        dc_motor
    position servo                                         servo_gain
    position servo with damping                            servo_damping
    velocity servo                                         velocity_servo_gain
    moving body that has mass                              payload
    moving body that has a capsule                         link_length
    geom that may touch another with friction              geom_friction
    world                                                  gravity_tilt (with gravity), wind (in a fluid), fluid
    =====================================================  ==========================================================

    An effect is left out where the same number is declared: ``hinge.damping`` leaves out viscous_friction(hinge),
    ``frictionloss`` coulomb_friction, ``stiffness`` spring, ``range`` end_stop, ``armature`` armature, ``arm.length``
    link_length(arm), a geom's ``friction`` geom_friction, its ``timeconst`` or ``dampratio`` contact_softness, an
    actuator's ``gain``, ``gear`` or ``strength`` command_gain, its ``kp`` or ``strength`` servo_gain,
    its ``kv`` servo_damping or, of a velocity servo, velocity_servo_gain, ``option.density`` and ``option.viscosity``
    fluid. A declared mass leaves payload in: it moves the centre of mass too.
    soft_friction, held forces and gravity_scale, which no machine has, mass_scale, inertia_scale, com_offset,
    contact_softness, external_force, command_offset and command_smoothing are left out unless they are named.

    :param model: the compiled model
    :param exclude: names of declared parameters, as :func:`~sb3_rpto.effects.declare` takes them
    :param kinds: of effects; None: all that are :attr:`~sb3_rpto.effects.Effect.offered`
    :raises ValueError: a name in ``exclude`` is unknown
    """
    declared = {(d.owner, d.index, d.label.rpartition(".")[2]) for d in declare(model, exclude)}
    found = []
    for kind in LIBRARY.values():
        if not (kind.offered if kinds is None else kind.kind in kinds):
            continue
        for on in kind.places(model):
            owner = "option" if kind.place == "world" else kind.place
            index = 0 if kind.place in ("world", "sensor") else object_id(model, owner, on)
            if not any((owner, index, name) in declared for name in kind.same):
                found.append(kind(on))
    return found


def given(
    model: mujoco.MjModel, declared: Sequence[str], known: Sequence[Effect] = (), soft: bool = False
) -> list[Effect]:
    """What a model has from the start: declared numbers at their nominal values, and effects that are known beforehand.

    :param model: the compiled model
    :param declared: names, as :func:`~sb3_rpto.effects.declare` takes them
    :param known: effects of the library with the values that are known; declared numbers among them count as declared,
        and begin where the model has them
    :param soft: whether declared friction of joints that have none in the model gives way near rest, as MuJoCo's own
    :raises ValueError: a name or an effect that the model does not have, or has twice; a known effect that does nothing
    :raises TypeError: ``known`` holds something else
    """
    try:  # what is wrong with it is said first
        declare(model, declared)
    except ValueError as error:
        raise ValueError(f"declared: {error}") from None
    if isinstance(known, Effect):
        raise TypeError(f"known must be a list of effects; write [{known.label}]")
    for effect in known:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"known must hold effects such as LIBRARY['command_delay']('motor', delay=0.02), not {effect!r}"
            )
    # Bounds are those of the last entry: what the user declared.
    names = [*(effect.label for effect in known if isinstance(effect, Declared)), *declared]
    numbers = declare(model, names)
    for number in numbers:
        number.soft = soft and number.firm
    found: list[Effect] = [*numbers]
    everywhere, free = ({e.label for e in candidates(model, taken, LIBRARY)} for taken in ((), names))
    for effect in [effect for effect in known if not isinstance(effect, Declared)]:
        label = effect.label
        if label not in everywhere:
            raise ValueError(f"known: no registered effect is {label!r} in this model; {near(label, everywhere)}")
        if label not in free:
            raise ValueError(f"known: {label!r} is a number that is declared, too; leave one of them out")
        if label in {e.label for e in found}:
            raise ValueError(f"known: {label!r} is there twice; leave one of them out")
        found.append(effect.as_known())
    return found
