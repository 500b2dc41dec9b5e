"""Measured data with undeclared effects in them, from simulations that share nothing with MuJoCo or the tracer."""

from benchmarks.tracing.planting.generate import Planted, Truth, generate
from benchmarks.tracing.planting.plants import Plant
from benchmarks.tracing.planting.sizes import KINDS, draw, places
from benchmarks.tracing.planting.systems import SYSTEMS, Link, System

__all__ = ["KINDS", "SYSTEMS", "Link", "Plant", "Planted", "System", "Truth", "draw", "generate", "places"]
