"""A target whose actions come late, as people write them."""

from typing import Any

import gymnasium as gym
import numpy as np


class Queue(gym.Wrapper):
    """Sends each action one step late, and zeros first."""

    def reset(self, **kwargs: Any) -> Any:
        self.queue = [np.zeros_like(self.action_space.sample())]
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        self.queue.append(action)
        return self.env.step(self.queue.pop(0))
