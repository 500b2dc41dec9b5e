"""Measured data with undeclared effects in them, from simulations that share nothing with MuJoCo or the tracer."""

from sb3_rpto.experiments.planting.generate import Planted, Truth, generate
from sb3_rpto.experiments.planting.plants import Plant
from sb3_rpto.experiments.planting.sizes import KINDS, draw, places
from sb3_rpto.experiments.planting.systems import SYSTEMS, Link, System

__all__ = ["KINDS", "SYSTEMS", "Link", "Plant", "Planted", "System", "Truth", "draw", "generate", "places"]
