"""The physics that a world may contain: what shifts a target, is planted in a test, or corrects a model."""

from sb3_rpto.effects import (  # noqa: F401  (they register their effects)
    bodies,
    commands,
    forces,
    friction,
    sensors,
    zero_order_hold,
)
from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.declared import Declared, declare, parameter_names
from sb3_rpto.effects.effect import LIBRARY, Effect, Parameter, Scales, from_json, register
from sb3_rpto.effects.library import candidates
from sb3_rpto.effects.simulation import Drive, Simulation

__all__ = [
    "LIBRARY",
    "Declared",
    "Drive",
    "Effect",
    "Parameter",
    "Scales",
    "Simulation",
    "SimulationBatch",
    "candidates",
    "declare",
    "from_json",
    "parameter_names",
    "register",
]
