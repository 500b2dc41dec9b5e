"""RPO, RTO and RPTO."""

from sb3_rpto.algorithms.rpo import RPO
from sb3_rpto.algorithms.rpto import RPTO
from sb3_rpto.algorithms.rto import RTO

__all__ = ["RPO", "RPTO", "RTO"]
