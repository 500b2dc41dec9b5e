"""Many simulated episodes at once: the model as an SB3 VecEnv."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.env import check_dynamics, predict, time_limit
from sb3_rpto.envs.env_snapshot import restore_state, save_state


class DynamicsVecEnv(VecEnv):
    """``num_envs`` episodes of the model, stepped by one batched call.

    Initial observations come from resets of the source's first environment (so the source's own running episode there
    is over); nothing else is asked of it. Observations are raw: a VecNormalize around the source is looked through. As
    in SB3's DummyVecEnv an ended episode is reset at once and its last observation is in
    ``info["terminal_observation"]``; as with Monitor ``info["episode"]`` tells its return and length.

    :param dynamics: the model that answers
    :param source: the source environments
    :param num_envs: episodes at a time
    :param max_episode_steps: after how many steps an episode is truncated; None takes the source's limit, if any
    :raises ValueError: if ``num_envs`` or ``max_episode_steps`` is not positive or the model is of another task
    """

    def __init__(self, dynamics: Dynamics, source: VecEnv, num_envs: int, max_episode_steps: int | None = None) -> None:
        for name, value in (("num_envs", num_envs), ("max_episode_steps", max_episode_steps)):
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, not {value}")
        self.dynamics = dynamics
        self.source = source.unwrapped
        check_dynamics(dynamics, self.source.observation_space, self.source.action_space)
        super().__init__(num_envs, self.source.observation_space, self.source.action_space)
        self.max_episode_steps = _time_limit(self.source) if max_episode_steps is None else max_episode_steps
        self._observations = np.zeros((num_envs, *self.observation_space.shape), self.observation_space.dtype)  # type: ignore[misc]
        self._elapsed_steps = np.zeros(num_envs, dtype=np.int64)
        self._returns = np.zeros(num_envs)
        self._actions: np.ndarray | None = None
        self._running = False
        self._t_start = time.time()

    def reset(self) -> np.ndarray:
        """Start all episodes anew; seeds given to :meth:`seed` are used once, the first one for the model too.

        :return: (num_envs, observation_dim)
        """
        if self._seeds[0] is not None:
            self.dynamics.seed(self._seeds[0])
        for index in range(self.num_envs):
            self._start_episode(index, self._seeds[index], self._options[index])
        self._reset_seeds()
        self._reset_options()
        self._running = True
        return self._observations.copy()

    def _start_episode(self, index: int, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        # Passed only when given: an environment whose reset takes neither works too.
        given: dict[str, Any] = ({} if seed is None else {"seed": seed}) | ({"options": options} if options else {})
        self._observations[index], self.reset_infos[index] = self.source.env_method("reset", indices=[0], **given)[0]
        self._elapsed_steps[index] = 0
        self._returns[index] = 0.0

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (num_envs, action_dim) for :meth:`step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Let the model answer.

        :raises gymnasium.error.ResetNeeded: before the first reset
        :raises ValueError: if a prediction is not finite; all episodes stay where they were
        """
        if not self._running or self._actions is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        following, rewards, terminated = predict(self.dynamics, self._observations, self._actions)
        self._observations = following
        self._elapsed_steps += 1
        self._returns += rewards
        truncated = np.zeros(self.num_envs, dtype=bool)
        if self.max_episode_steps is not None:
            truncated = self._elapsed_steps >= self.max_episode_steps
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for index in np.flatnonzero(dones).tolist():
            infos[index] = {
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "terminal_observation": following[index].copy(),
                "episode": {
                    "r": round(float(self._returns[index]), 6),
                    "l": int(self._elapsed_steps[index]),
                    "t": round(time.time() - self._t_start, 6),
                },
            }
            self._start_episode(index)
        return self._observations.copy(), rewards.astype(np.float32), dones, infos

    def get_state(self) -> dict[str, Any] | None:
        """Where the episodes stand, with the stream of initial states; the model keeps its own stream.

        :return: plain data, or None when the source cannot save its state
        """
        source = save_state(self.source)
        if source is None:
            return None
        names = ("_observations", "_elapsed_steps", "_returns", "_running", "_seeds", "_options", "reset_infos")
        return {"source": source, **copy.deepcopy({name: getattr(self, name) for name in names})}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`get_state` was called.

        :raises ValueError: if the state is of another number of episodes or of another source
        """
        if len(state["_observations"]) != self.num_envs:
            raise ValueError(f"state is of {len(state['_observations'])} episodes, num_envs is {self.num_envs}")
        restore_state(self.source, state["source"])
        self.__dict__.update(copy.deepcopy({name: value for name, value in state.items() if name != "source"}))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The source's attribute, once for every episode asked for; there is nothing to render."""
        value = None if attr_name == "render_mode" else self.source.get_attr(attr_name, indices=[0])[0]
        return [value for _ in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Whether the source has the attribute."""
        return self.source.has_attr(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the episodes are the model's.

        :raises NotImplementedError: always
        """
        raise NotImplementedError(
            f"cannot set {attr_name!r}: simulated episodes have no attributes; set it on the source"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the source's first environment, once, and give its answer for every episode asked for.

        :raises NotImplementedError: for ``reset`` and ``step``, which single episodes do not have
        """
        if method_name in ("reset", "step"):
            raise NotImplementedError(f"cannot call {method_name!r} on a simulated episode; use the VecEnv's own")
        answer = self.source.env_method(method_name, *method_args, indices=[0], **method_kwargs)[0]
        return [answer for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """True for Monitor, whose ``info["episode"]`` is here; false for all others, which never see a step."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """None for every episode: the model has no picture."""
        return [None] * self.num_envs

    def close(self) -> None:
        """Leave the source open: it belongs to the caller."""


def _time_limit(source: VecEnv) -> int | None:
    if isinstance(source, DummyVecEnv):
        return time_limit(source.envs[0])
    if source.has_attr("_max_episode_steps"):  # a TimeLimit wrapper's
        return source.get_attr("_max_episode_steps", indices=[0])[0]
    spec = source.get_attr("spec", indices=[0])[0]
    return None if spec is None else spec.max_episode_steps
