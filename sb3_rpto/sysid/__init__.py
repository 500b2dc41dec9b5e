"""Closing the loop with measured data: recorded runs of a machine, what its model lacks to explain them, the report."""

from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.report.report import Report
from sb3_rpto.sysid.trace import trace  # after its module of the same name, which it stands for from here on

__all__ = ["Episode", "Finding", "Measurements", "Report", "trace"]
