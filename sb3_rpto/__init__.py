"""Relative Policy-Transition Optimization for Stable-Baselines3."""

from sb3_rpto.algorithms import RPO, RPTO, RTO
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.dynamics.env import DynamicsEnv
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.tasks import register_tasks
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.version import __version__

register_tasks()

__all__ = [
    "RPO",
    "RPTO",
    "RTO",
    "DualReplayBuffer",
    "DynamicsEnv",
    "Measurements",
    "__version__",
    "apply_effects",
    "trace",
]
