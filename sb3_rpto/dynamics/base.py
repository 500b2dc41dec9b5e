"""The trainable dynamics P_phi behind one small interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict, deque
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn


@dataclass(frozen=True)
class Transitions:
    """A set of ``n`` transitions in the units of the environment, as tensors on one device.

    ``terminations`` is 1 where the MDP ended; a time limit or a model horizon is never a termination.
    Actions are those the environment received (not scaled to [-1, 1] as SB3's buffers keep them).
    """

    observations: th.Tensor  # (n, observation_dim)
    actions: th.Tensor  # (n, action_dim)
    rewards: th.Tensor  # (n,)
    next_observations: th.Tensor  # (n, observation_dim)
    terminations: th.Tensor  # (n,)

    def __len__(self) -> int:
        return len(self.observations)

    def take(self, index: th.Tensor | slice) -> Transitions:
        """The transitions at ``index``."""
        return Transitions(*(getattr(self, field.name)[index] for field in fields(self)))


class Prediction(NamedTuple):
    """What a model says follows ``n`` (observation, action) pairs."""

    next_observations: th.Tensor  # (n, observation_dim)
    rewards: th.Tensor  # (n,)
    terminations: th.Tensor  # (n,), bool


class Dynamics(nn.Module, ABC):
    """Trainable transition function P_phi(s', r | s, a).

    A backend is one ``nn.Module``: everything that predictions depend on is a parameter, a registered buffer or
    extra state, so that ``state_dict`` is a complete checkpoint of phi. Backends that train by gradient keep their
    ``optimizer`` as an attribute.

    :param observation_space: the observation space that source and target share (a flat Box)
    :param action_space: the action space that they share (a flat Box)
    """

    #: how the source world is rolled out: one-step branches from given states, or whole episodes
    rollout: ClassVar[Literal["branches", "episodes"]]
    #: :meth:`fit` takes so many of the newest transitions; None: all
    fits_newest: ClassVar[int | None] = None

    optimizer: th.optim.Optimizer
    #: a backend with branches: false until phi_0 is fitted to the source
    fitted: th.Tensor

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box) -> None:
        super().__init__()
        self.observation_space = observation_space
        self.action_space = action_space
        self.generator = th.Generator()
        with th.random.fork_rng(devices=[]):  # unseeded where torch's own stream is, which goes on undisturbed
            self.generator.manual_seed(int(th.randint(2**62, ())))

    def seed(self, seed: int) -> None:
        """Seed the model's own random stream (sampling, minibatches)."""
        self.generator.manual_seed(seed)

    @abstractmethod
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """Answer one environment step for each of ``n`` pairs, without gradient.

        :param observations: (n, observation_dim)
        :param actions: (n, action_dim), in the environment's units
        :param deterministic: the mean prediction instead of a sample
        """

    @abstractmethod
    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Move phi towards ``data`` by at most ``max_steps`` gradient steps.

        :param data: transitions, oldest first, holding all that is known (a later call passes the same ones and more)
        :param weights: (n,), one non-negative weight a transition (RTO); None weighs all alike
        :param max_steps: cap of gradient steps; None leaves it to the backend
        :return: what to log, without the ``dynamics/`` prefix
        """

    @abstractmethod
    def error(self, data: Transitions) -> float:
        """Root mean squared one-step error on ``data``, in units of each dimension's standard one-step change."""

    def knows(self, observations: np.ndarray) -> np.ndarray:
        """Whether the model can step on from each of the raw observations (n, observation_dim), bool (n,)."""
        return np.ones(len(observations), dtype=bool)

    @property
    def attached(self) -> bool:
        """Whether :meth:`step` has all that it needs."""
        return True

    def attach(self, env: Any) -> None:
        """Give the environment that a simulator's rewards and terminations come from; a network needs none."""

    def forgotten(self) -> list[str]:
        """What :meth:`step`, which answers from one observation, cannot show: effects that remember."""
        return []

    def describe(self) -> dict[str, float]:
        """Named values of phi worth logging (physical parameters); empty for a network."""
        return {}

    def get_extra_state(self) -> dict[str, Any]:
        """The random stream, so that a resumed run continues it."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` returned."""
        self.generator.set_state(state["generator"].cpu())


def predecessors(observations: np.ndarray, next_observations: np.ndarray, dones: np.ndarray) -> np.ndarray:
    """The row that each transition goes on from, (n,); -1 where an episode begins.

    Rows of several environments may be interleaved, as a target of several stores them: of some that ended where one
    begins it goes on from the oldest.

    :param observations: oldest first, (n, d)
    :param next_observations: (n, d)
    :param dones: (n,), after these nothing follows
    """
    found, ends = np.full(len(observations), -1), defaultdict[bytes, deque[int]](deque)
    # Adding zero makes one zero of two.
    for row, (begin, end, done) in enumerate(zip(observations + 0.0, next_observations + 0.0, dones)):
        waiting = ends[begin.tobytes()]
        if waiting:
            found[row] = waiting.popleft()
        if not done:
            ends[end.tobytes()].append(row)
    return found


def relative_error(predicted: th.Tensor, data: Transitions) -> float:
    """RMSE of ``predicted`` next observations in units of the standard one-step change in ``data``.

    Dimensions that never change in ``data`` are left out (they would divide by zero).
    """
    change = (data.next_observations - data.observations).double()
    scale = change.std(dim=0, unbiased=False)
    moving = scale > 1e-8
    if not moving.any():
        return float((predicted - data.next_observations).double().pow(2).mean().sqrt())
    residual = (predicted - data.next_observations).double()[:, moving] / scale[moving]
    return float(residual.pow(2).mean().sqrt())
