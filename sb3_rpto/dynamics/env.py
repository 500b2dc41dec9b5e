"""The model as an environment: any SB3 algorithm can be trained in it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_rpto.dynamics.base import Dynamics, Transitions


def predict(dynamics: Dynamics, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Ask the model for one step of ``n`` transitions at once.

    Predictions are clipped to the observation space, which a model does not know the bounds of.

    :param observations: (n, observation_dim)
    :param actions: (n, action_dim), in the environment's units
    :return: next observations (n, observation_dim) in the observations' dtype, rewards (n,) float64 and
        terminations (n,) bool
    :raises ValueError: if a prediction is not finite, with the values that led to it
    """
    tensor = next((tensor for tensors in (dynamics.parameters(), dynamics.buffers()) for tensor in tensors), None)
    device = th.device("cpu") if tensor is None else tensor.device
    with th.no_grad():
        answer = dynamics.step(th.tensor(observations, device=device), th.tensor(actions, device=device))
    following = answer.next_observations.cpu().numpy().astype(observations.dtype)
    rewards = answer.rewards.cpu().numpy().astype(np.float64).reshape(-1)
    broken = np.flatnonzero(~(np.isfinite(following).all(axis=1) & np.isfinite(rewards)))
    if len(broken):
        row = broken[0]
        raise ValueError(
            f"dynamics predicted the next observation {following[row]} and the reward {rewards[row]} for the "
            f"observation {observations[row]} and the action {actions[row]} ({len(broken)} of {len(rewards)} "
            "predictions are not finite); fit it on finite data, or with fewer steps or a smaller learning rate"
        )
    space = dynamics.observation_space
    return (
        np.clip(following, space.low, space.high),
        rewards,
        answer.terminations.cpu().numpy().astype(bool).reshape(-1),
    )


def check_dynamics(dynamics: Dynamics, observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse a model of another task, and one whose steps would lose what acts late.

    :raises ValueError: if the model's spaces have other shapes, or an effect of phi remembers
    """
    for name, space in (("observation_space", observation_space), ("action_space", action_space)):
        if getattr(dynamics, name).shape != space.shape:
            raise ValueError(
                f"dynamics has {name} {getattr(dynamics, name)}, the environment has {space}; "
                "build the dynamics from this environment's spaces"
            )
    late = dynamics.forgotten()
    if late:
        raise ValueError(
            f"the model answers each step from its observation alone, where {', '.join(late)} would be lost; the "
            "corrected simulator itself is sb3_rpto.apply_effects(env, dynamics.effects())"
        )


class DynamicsEnv(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], gym.utils.RecordConstructorArgs):
    """Answers ``step()`` by a :class:`~sb3_rpto.dynamics.base.Dynamics` instead of the wrapped environment.

    The wrapped environment gives the spaces, the initial observations and the time limit; it is never stepped. A
    time limit truncates, only the model's own terminal flag terminates. The model has no picture: ``render_mode``
    is None and ``render()`` returns None.

    >>> model = SAC("MlpPolicy", DynamicsEnv(gym.make("Pendulum-v1"), dynamics=dynamics))  # doctest: +SKIP

    :param env: the source environment, with flat Box observations and Box actions
    :param dynamics: the model that answers
    :raises ValueError: if the model's spaces have other shapes than the environment's, or phi holds effects that act
        late (delays, lags, play), which an answer from one observation cannot show
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], dynamics: Dynamics) -> None:
        # By reference: an environment made again from the spec is answered by the same model.
        gym.utils.RecordConstructorArgs.__init__(self, dynamics=dynamics, _disable_deepcopy=True)
        gym.Wrapper.__init__(self, env)
        check_dynamics(dynamics, env.observation_space, env.action_space)
        if not dynamics.attached:
            dynamics.attach(env)
        self.dynamics = dynamics
        self.metadata = {**env.metadata, "render_modes": []}
        self.max_episode_steps = time_limit(env)
        self._observation: np.ndarray | None = None
        self._elapsed_steps = 0

    @property
    def render_mode(self) -> None:  # type: ignore[override]
        """Always None: the model has no picture."""
        return None

    def render(self) -> None:
        """Draw nothing: the model has no picture."""
        return None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode where the wrapped environment starts one.

        :param seed: seeds the wrapped environment and the model, when given
        :param options: handed to the wrapped environment
        """
        if seed is not None:
            self.dynamics.seed(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = np.array(observation)
        self._elapsed_steps = 0
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Let the model answer; ``info`` is empty.

        :param action: (action_dim,)
        :raises gymnasium.error.ResetNeeded: before the first reset
        :raises ValueError: if the prediction is not finite; the episode stays where it was
        """
        if self._observation is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        (following,), (reward,), (terminated,) = self.branch(self._observation[None], np.asarray(action)[None])
        self._observation = following
        self._elapsed_steps += 1
        truncated = self.max_episode_steps is not None and self._elapsed_steps >= self.max_episode_steps
        return following.copy(), float(reward), bool(terminated), truncated, {}

    def branch(self, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Thousands of one-step branches at once; the running episode is not touched.

        :param observations: (n, observation_dim)
        :param actions: (n, action_dim), in the environment's units
        :return: next observations (n, observation_dim), rewards (n,) and terminations (n,), bool
        :raises ValueError: if a prediction is not finite
        """
        return predict(self.dynamics, observations, actions)

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Fit the model; see :meth:`sb3_rpto.dynamics.base.Dynamics.fit`."""
        return self.dynamics.fit(data, weights, max_steps)


def time_limit(env: gym.Env) -> int | None:
    """After how many steps ``env`` truncates an episode; None if never.

    :param env: looked through for TimeLimit wrappers, then for a spec
    """
    limits = []
    layer = env
    while isinstance(layer, gym.Wrapper):
        if isinstance(layer, gym.wrappers.TimeLimit):
            limits.append(layer._max_episode_steps)
        layer = layer.env
    if not limits and env.spec is not None and env.spec.max_episode_steps is not None:
        limits.append(env.spec.max_episode_steps)
    return min(limits, default=None)
