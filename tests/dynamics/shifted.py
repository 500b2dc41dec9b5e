"""Shifted MuJoCo targets and transitions in them, for the tests of physical dynamics."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch as th

from sb3_rpto.dynamics.base import Transitions, predecessors
from sb3_rpto.effects import declare
from sb3_rpto.envs.corrected import apply_effects

POLE, POLES, HOPPER = "InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Hopper-v5"
#: what a target of each task has in place of the nominal numbers
SHIFTS = {
    POLE: {"pole.mass": 7.0, "hinge.damping": 1.3},
    POLES: {"pole.length": 0.7, "pole2.length": 0.5, "hinge.damping": 0.08},
    HOPPER: {"leg.length": 0.55, "foot_joint.damping": 1.4},
}


def shifted(env_id, shift=None, effects=()):
    """A target with other numbers and further effects."""
    env = gym.make(env_id)
    shift = SHIFTS[env_id] if shift is None else shift
    numbers = declare(env.unwrapped.model, [*shift])
    return apply_effects(env, [n.with_values(np.array([shift[n.label]])) for n in numbers] + list(effects))


def collect(env, n, seed=0, scale=0.3):
    """``n`` transitions of random actions, a share ``scale`` of the largest, through the ends of episodes."""
    space = env.action_space
    actions = np.random.default_rng(seed).uniform(scale * space.low, scale * space.high, size=(n, *space.shape))
    observation, rows = env.reset(seed=seed)[0], []
    for action in actions.astype(np.float32):
        reached, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, reward, reached, float(terminated)))
        observation = env.reset()[0] if terminated or truncated else reached
    return Transitions(*(th.as_tensor(np.array(column)) for column in zip(*rows)))


def joined(*parts):
    """Transitions after one another."""
    fields = ("observations", "actions", "rewards", "next_observations", "terminations")
    return Transitions(*(th.cat([getattr(part, field) for part in parts]) for field in fields))


def noisy(data, level, seed=0):
    """The same with noise on what is reached."""
    noise = level * np.random.default_rng(seed).standard_normal(data.next_observations.shape)
    return replace(data, next_observations=data.next_observations + th.as_tensor(noise))


def observed(data, level, seed=0):
    """The same as sensors with noise show it: what ends a transition begins the next."""
    rng = np.random.default_rng(seed)
    before = predecessors(data.observations.numpy(), data.next_observations.numpy(), data.terminations.numpy())
    begins, ends = (level * rng.standard_normal(data.observations.shape) for _ in range(2))
    begins[before >= 0] = ends[before[before >= 0]]
    return replace(
        data,
        observations=data.observations.double() + th.as_tensor(begins),
        next_observations=data.next_observations.double() + th.as_tensor(ends),
    )
