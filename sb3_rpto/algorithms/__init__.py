"""RPO, RTO and RPTO."""

from sb3_rpto.algorithms.rpto import RPO, RPTO, RTO

__all__ = ["RPO", "RPTO", "RTO"]
