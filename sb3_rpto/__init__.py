"""Relative Policy-Transition Optimization for Stable-Baselines3."""

import gymnasium as gym

from sb3_rpto.algorithms import RPO, RPTO, RTO
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.dynamics.env import DynamicsEnv
from sb3_rpto.tracing import trace
from sb3_rpto.version import __version__

gym.register(
    "rpto/ContinuousCartPole-v0", entry_point="sb3_rpto.envs.cartpole:ContinuousCartPoleEnv", max_episode_steps=500
)

__all__ = ["RPO", "RPTO", "RTO", "DualReplayBuffer", "DynamicsEnv", "__version__", "trace"]
