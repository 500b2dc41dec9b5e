"""A task whose optimal policy is known in raw and in normalised observations, and zips of it without training."""

from collections import deque
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

#: Observations are MEAN + SCALE u, u uniform in [-1, 1], and the best action is u.
MEAN, SCALE = 100.0, 5.0
#: Standard deviation of u.
SPREAD = 3**-0.5
#: tanh(STEEP u) is near u.
STEEP = 1.3


class Tracking(gym.Env):
    """The action is to be the number that is hidden in the observation."""

    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, steps: int = 20, dtype: type = np.float32, shift: float = 0.0) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), dtype)
        self.steps, self.shift, self.taken = steps, shift, 0

    def _draw(self) -> np.ndarray:
        self.hidden = float(self.np_random.uniform(-1, 1))
        return np.array([MEAN + SCALE * self.hidden], self.observation_space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.taken = 0
        return self._draw(), {}

    def step(self, action):
        self.taken += 1
        reward = -10 * abs(float(action[0]) - self.hidden - self.shift)
        return self._draw(), reward, False, self.taken >= self.steps, {}


def statistics(**kwargs) -> VecNormalize:
    """Trained statistics of the task."""
    env = VecNormalize(DummyVecEnv([lambda: Tracking(**kwargs)]))
    env.obs_rms.mean[:], env.obs_rms.var[:], env.obs_rms.count = MEAN, (SCALE * SPREAD) ** 2, 10_000.0
    env.ret_rms.var = np.float64(4.0)
    return env


def solved(normalised: bool, remembered: float | None = -30.0, **kwargs) -> SAC:
    """A SAC that solves it, by what it sees; its newest episodes earned about ``remembered``."""
    env = Tracking(**kwargs)
    sac = SAC("MlpPolicy", env, policy_kwargs={"net_arch": []}, device="cpu", buffer_size=100)
    weight = STEEP * SPREAD if normalised else STEEP / SCALE
    with th.no_grad():
        sac.actor.mu.weight.fill_(weight)
        sac.actor.mu.bias.fill_(0.0 if normalised else -weight * MEAN)
        sac.actor.log_std.weight.zero_()
        sac.actor.log_std.bias.fill_(-2.5)
    sac.ep_info_buffer = deque(maxlen=100)
    rng = np.random.default_rng(0)
    for _ in range(0 if remembered is None else 20):
        sac.ep_info_buffer.append({"r": remembered + rng.normal(0, 8), "l": env.steps, "t": 0.0})
    return sac


def zipped(
    folder: Path, normalised: bool, remembered: float | None = -30.0, beside: str | None = None, **kwargs
) -> Path:
    """The zip of :func:`solved`, with the statistics in a file beside it where that is named."""
    folder.mkdir(parents=True, exist_ok=True)
    solved(normalised, remembered, **kwargs).save(folder / "best_model.zip")
    if beside is not None:
        statistics(**kwargs).save(str(folder / beside))
    return folder / "best_model.zip"
