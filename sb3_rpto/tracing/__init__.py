"""Closing the loop with measured data: recorded runs of a machine, what its model lacks to explain them, the report."""

try:
    from sb3_rpto.tracing.checks import Finding
    from sb3_rpto.tracing.episodes import Episode
    from sb3_rpto.tracing.measurements import Measurements
    from sb3_rpto.tracing.report import Report
    from sb3_rpto.tracing.trace import trace  # after its module of the same name, which it stands for from here on
except ModuleNotFoundError as error:
    if (error.name or "").split(".")[0] not in ("mujoco", "scipy"):
        raise
    raise ImportError(f"sb3_rpto.tracing needs {error.name}: pip install 'sb3-rpto[tracing]'") from error

__all__ = ["Episode", "Finding", "Measurements", "Report", "trace"]
