"""What the worlds answer, looked at before it is stored; every error says which world and what."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

#: Networks learn float32: with rewards above the first the losses drown all else, above the second they overflow.
LARGE, OVERFLOWS = 1e7, 1e15


class NotFiniteError(ValueError):
    """A world answered with NaN or infinity, or with numbers whose squares are."""


def check_finite(world: str, **arrays: np.ndarray) -> None:
    """Refuse NaN and infinity before they reach a buffer.

    :raises NotFiniteError: naming the world and the offending values
    """
    for name, array in arrays.items():
        if array.dtype == object:  # workers in other processes return anything
            raise ValueError(f"the {world} environment returned, as {name}, what is no number: {array}; mend it")
        if not np.isfinite(array).all():
            raise NotFiniteError(
                f"the {world} environment returned, as {name}, what is not finite: {array}; "
                "mend the environment (stable_baselines3.common.vec_env.VecCheckNan finds the step)"
            )


def check_rewards(what: str, rewards: np.ndarray, warn: bool = True) -> bool:
    """Refuse rewards that no network can learn from, and warn of those that one hardly can.

    :param what: returned or holds them, a verb included
    :param rewards: as they are learned from
    :param warn: whether that was not said before
    :return: whether some are so large
    :raises NotFiniteError: the squares of their returns are infinite in float32
    """
    largest = float(np.abs(rewards).max(initial=0.0))
    if largest > OVERFLOWS:
        raise NotFiniteError(
            f"{what} a reward of {largest:.3g} in size, and the critic's loss, a square, overflows in float32; "
            "scale the rewards"
        )
    if warn and largest > LARGE:
        warnings.warn(
            f"{what} a reward of {largest:.3g} in size: the critic's loss is a square and drowns all else in float32; "
            "scale the rewards to about 1, by a wrapper or by VecNormalize(norm_reward=True)",
            stacklevel=4,
        )
    return largest > LARGE


class Answers:
    """Looks at what one world answers.

    :param world: what to call it
    """

    def __init__(self, world: str) -> None:
        self.world = world
        self._warned = False

    @contextmanager
    def received(self) -> Iterator[None]:
        """Inside, its VecEnv is stepped or reset.

        :raises ValueError: the VecEnv cannot hold what an environment returned
        """
        try:
            yield
        except (TypeError, ValueError) as error:
            what = _unfit(error)
            if what is None:  # an error of the environment's own
                raise
            raise ValueError(
                f"the {self.world} environment returned, as {what}, what its VecEnv cannot store ({error}); mend the "
                "environment (stable_baselines3.common.env_checker.check_env says what it must return)"
            ) from error

    def check(
        self, observations: np.ndarray, rewards: np.ndarray, shape: tuple[int, ...], normalised: bool = False
    ) -> None:
        """Look at a step.

        :param observations: (n, *shape), as the environments returned them
        :param rewards: (n,), likewise
        :param shape: of an observation
        :param normalised: whether VecNormalize scales the rewards before they are learned from
        :raises ValueError: naming what is of another shape or not finite
        """
        for name, array, expected in (("observation", observations, shape), ("reward", rewards, ())):
            if array.shape[1:] != expected:
                raise ValueError(
                    f"the {self.world} environment returned, as {name}, an array of shape {array.shape[1:]}, and its "
                    f"space says {expected}; mend the environment"
                )
        check_finite(self.world, observation=observations, reward=rewards)
        if not normalised:
            self._warned |= check_rewards(f"the {self.world} environment returned", rewards, not self._warned)


def _unfit(error: Exception) -> str | None:
    """What of an environment's answer SB3 could not store; None for an error that did not arise in storing it."""
    walked = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    named = [(frame.f_globals.get("__name__", ""), frame.f_code.co_name) for frame in walked]
    module, function = [name for name in named if not name[0].startswith("numpy")][-1]
    if not module.startswith(("stable_baselines3.common.vec_env", "stable_baselines3.common.monitor")):
        return None
    if function in ("_save_obs", "_stack_obs"):
        return "observation"
    return "the end of the episode" if "truth value" in str(error) else "reward"


def last_observations(
    world: str, env: VecEnv, dones: np.ndarray, infos: Sequence[dict[str, Any]]
) -> dict[int, np.ndarray]:
    """The observations at the ends of episodes as the environments gave them, by the index of the environment.

    What a step returns there is of the episode that follows.

    :param world: what to call it
    :param env: the world's VecEnv with all its wrappers, just stepped
    :param dones: (n,), whether an episode ended
    :param infos: (n,), what came with it
    :raises ValueError: a VecEnv that does not tell
    """
    found = {}
    for i in map(int, np.flatnonzero(dones)):
        if "terminal_observation" not in infos[i]:
            raise ValueError(
                f"the {world}'s VecEnv ended an episode without info['terminal_observation'], so its last transition "
                "is unknown; put it there, as the VecEnvs of Stable-Baselines3 do"
            )
        found[i] = _raw_terminal(env, i, infos[i]["terminal_observation"])
    return found


def _raw_terminal(env: VecEnv, index: int, terminal: np.ndarray) -> np.ndarray:
    """The observation at the end of an episode as the environment gave it.

    A VecNormalize clips what it hands on: far out states, such as falls are, cannot be had back from that. A
    DummyVecEnv still holds them.

    :param env: the worlds' VecEnv with all its wrappers, just stepped
    :param index: of the environment whose episode ended
    :param terminal: ``info["terminal_observation"]`` as it came out of ``env``
    """
    normaliser = unwrap_vec_normalize(env)
    if normaliser is None:
        return terminal
    inner = env.unwrapped
    held = inner.buf_infos[index].get("terminal_observation") if isinstance(inner, DummyVecEnv) else None
    if held is None or np.shape(held) != terminal.shape:  # as it is below a VecFrameStack
        return normaliser.unnormalize_obs(terminal)  # type: ignore[return-value]
    if np.allclose(np.asarray(normaliser.normalize_obs(held)), terminal):
        return np.asarray(held)
    return normaliser.unnormalize_obs(terminal)  # type: ignore[return-value]
