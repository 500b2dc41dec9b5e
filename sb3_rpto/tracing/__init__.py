"""Closing the loop with measured data: recorded episodes of a machine and the checks on them."""

from sb3_rpto.tracing.checks import Finding
from sb3_rpto.tracing.episodes import Episode
from sb3_rpto.tracing.measurements import Measurements

__all__ = ["Episode", "Finding", "Measurements"]
