"""The two worlds' environments: what they must satisfy, how target steps are counted, shared normalisation."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize

from sb3_rpto.algorithms.normalisation import share
from sb3_rpto.algorithms.transition_checks import Answers, check_finite
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.env_snapshot import accepts_seed, restore_state, save_state, whereabouts
from sb3_rpto.envs.observations import layers

#: They scale by what their own world has shown so far.
NORMALISERS = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)


class TargetLedger(VecEnvWrapper):
    """Counts every step of the target by purpose and refuses to go over the budget.

    Steps taken inside :meth:`spending` count for the purpose named there, all others (a script that steps the
    target behind the algorithm's back) as ``"other"``. Of steps that somebody takes in the environment inside, past
    this ledger, it can only notice that they were taken.

    :param venv: the target
    :param spent: steps by purpose, counted on in place
    """

    def __init__(self, venv: VecEnv, spent: dict[str, int]) -> None:
        super().__init__(venv)
        self.spent = spent
        #: whether a step was taken whose transition is not stored yet
        self.unstored = False
        #: whether somebody else moved the target since :meth:`begin`
        self.disturbed = False
        self._purpose = "other"
        self._allowance: int | None = None
        self._left_at: list[tuple[Any, ...]] | None = None
        self._stepping = False  # still so after a step that was interrupted
        self._answers = Answers("target")

    @contextmanager
    def spending(self, purpose: str, allowance: int) -> Iterator[None]:
        """Count the steps inside for ``purpose``, at most ``allowance`` of them.

        :raises RuntimeError: on the step that would exceed the allowance, before it is taken
        """
        self._purpose, self._allowance = purpose, allowance
        try:
            yield
        finally:
            self._purpose, self._allowance = "other", None

    def begin(self) -> None:
        """The episode that was just begun, or taken up again, is the algorithm's."""
        self.disturbed = self._stepping = False
        self._left_at = whereabouts(self.venv)

    def check(
        self, observations: np.ndarray, rewards: np.ndarray, *ended: np.ndarray, normalised: bool = False
    ) -> None:
        """Look at what the target answered; if it cannot be stored, its step and its episode are given up.

        :param observations: after the step, or of the reset that followed
        :param rewards: of the step
        :param ended: observations at the ends of episodes
        :param normalised: whether VecNormalize scales the rewards before they are learned from
        :raises ValueError: for what is not finite, or of another shape
        """
        try:
            self._answers.check(observations, rewards, self.observation_space.shape or (), normalised)
            for observation in ended:
                check_finite("target", observation=observation)
        except ValueError:
            self.unstored, self.disturbed = False, True
            raise

    def lost(self, warn: bool) -> bool:
        """Whether somebody's steps have ended the episode under way.

        :param warn: where it was to go on, and the steps were not counted
        """
        moved = self.moved() or self._stepping
        if self._stepping and warn:
            warnings.warn(
                "the last learn() was interrupted within a step of the target: a new episode begins, and that step is "
                "counted but not in D_target",
                stacklevel=5,
            )
        elif moved and warn:
            warnings.warn(
                "the environment that was passed as target_env was stepped or reset since the last learn(): a new "
                "episode begins, and target_spent does not hold those steps; evaluate in an environment of its own",
                stacklevel=5,
            )
        return moved or self.disturbed

    def moved(self) -> bool:
        """Whether somebody has stepped or reset the environment inside since its last step here, where that shows."""
        return self._left_at is not None and self._left_at != whereabouts(self.venv)

    def step_async(self, actions: np.ndarray) -> None:
        """Count, then step.

        :raises RuntimeError: for a step of the algorithm's over its allowance, or in an episode that somebody moved
        """
        self.disturbed |= self._allowance is None
        if self._allowance is not None:
            if self.moved():
                raise RuntimeError(
                    "the environment that was passed as target_env was stepped or reset by somebody else since its "
                    "last step (a callback that evaluates in it?): its episode is lost; evaluate in an environment of "
                    "its own, and go on by learn(..., reset_num_timesteps=False)"
                )
            if self._allowance < self.num_envs:
                raise RuntimeError(
                    f"the target-step budget is spent: {self.spent}; a callback that evaluates needs an "
                    "environment of its own, not model.target_env"
                )
            self._allowance -= self.num_envs
        self.spent[self._purpose] = self.spent.get(self._purpose, 0) + self.num_envs
        self._stepping = True
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """The target's answer, unchanged."""
        with self._answers.received():
            answer = self.venv.step_wait()
        # Not before: the step may be interrupted. A step of somebody else's is none of D_target's.
        self.unstored, self._left_at = self._allowance is not None, whereabouts(self.venv)
        self._stepping = False
        return answer

    def reset(self) -> Any:
        """Reset the target; a reset is not counted as a step."""
        self.unstored, self.disturbed, self._stepping = False, True, False
        with self._answers.received():
            answer = self.venv.reset()
        self._left_at = whereabouts(self.venv)
        return answer


def find_ledger(venv: VecEnv) -> TargetLedger:
    """The ledger inside a target that :func:`share_normalisation` may have wrapped."""
    while not isinstance(venv, TargetLedger):
        venv = venv.venv  # type: ignore[attr-defined]
    return venv


def share_normalisation(venv: VecEnv, source: VecEnv | None) -> VecEnv:
    """Wrap ``venv`` so that it is normalised by the source's running statistics, which it never updates."""
    statistics = unwrap_vec_normalize(source) if source is not None else None
    if statistics is None:
        return venv
    shared = VecNormalize(venv, training=False, norm_obs=statistics.norm_obs)
    share(shared, statistics)
    return shared


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


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Refuse what the algorithms are not written for.

    :raises NotImplementedError: for observations or actions that are not a flat Box
    """
    if not isinstance(observation_space, spaces.Box) or is_image_space(observation_space):
        raise NotImplementedError(
            f"env has the observation space {observation_space}; only flat Box observations are supported "
            "(wrap a Dict in gymnasium.wrappers.FlattenObservation)"
        )
    if len(observation_space.shape) != 1:
        raise NotImplementedError(
            f"env has observations of shape {observation_space.shape}; flatten them with "
            "gymnasium.wrappers.FlattenObservation"
        )
    if not isinstance(action_space, spaces.Box):
        raise NotImplementedError(
            f"env has the action space {action_space}; only continuous (Box) actions are supported"
        )
    if len(action_space.shape) != 1:
        raise NotImplementedError(
            f"env has actions of shape {action_space.shape}; only flat ones are supported (let a "
            "gymnasium.wrappers.TransformAction with a flat Box reshape them for the environment)"
        )


def check_pair(source: VecEnv, target: VecEnv) -> None:
    """Refuse a target that cannot be the source's target.

    :raises ValueError: for the same environment object, unequal spaces, or statistics of one world alone
    """
    if members(source) & members(target):
        raise ValueError("target_env is env: both worlds would step the same object; build a second environment")
    for name, world in (("env", source), ("target_env", target)):
        found = [x for env in _inside(world) for x in layers(env) if isinstance(x, NORMALISERS)]
        if found:
            raise ValueError(
                f"{name} is in gymnasium's {type(found[0]).__name__}, whose statistics are each world's own and drift; "
                "wrap env (the source) in stable_baselines3's VecNormalize instead, the target then shares its "
                "statistics"
            )
    for name in ("observation_space", "action_space"):
        of_source, of_target = getattr(source, name), getattr(target, name)
        if of_source != of_target:
            raise ValueError(
                f"target_env has {name} {of_target}, env has {of_source}; source and target must share their spaces"
            )


def check_environment(env: gym.Env | VecEnv, name: str) -> None:
    """Refuse what is no environment, and one that cannot be reset with a seed.

    :raises TypeError: naming the argument
    :raises ValueError: naming the argument
    """
    if not isinstance(env, gym.Env | VecEnv):
        raise TypeError(
            f"{name} must be a gymnasium environment, a VecEnv, an id or a function that makes one, not "
            f"{type(env).__name__}; stack several by make_vec_env, and pass recordings as target_data="
        )
    if isinstance(env, gym.Env) and not accepts_seed(env):
        raise ValueError(
            f"{name}: reset() of {env} takes no seed=; give it the signature reset(self, *, seed=None, options=None)"
        )


def members(venv: VecEnv) -> set[int]:
    """Identities of the environments that a VecEnv steps; its own where they are in other processes."""
    return {id(env.unwrapped) for env in _inside(venv)} or {id(venv.unwrapped)}


def _inside(venv: VecEnv) -> list[gym.Env]:
    """The environments that are in this process."""
    return list(getattr(venv.unwrapped, "envs", []))


class NullShiftCheck:
    """Watches the first target transitions and tells whether the source would have stepped exactly so.

    The source is stepped in a copy that starts in the target's own state, so no target step is spent. Where the
    state cannot be carried over (processes, environments that cannot save their state) nothing is claimed.

    :param source: the source; untouched
    :param target: the target
    """

    #: transitions to compare
    N_STEPS = 20

    def __init__(self, source: VecEnv, target: VecEnv) -> None:
        self._left = self.N_STEPS
        self._copy: DummyVecEnv | None = None
        start, twin = _single_state(target), copy_env(source)
        if start is None or twin is None:
            return
        copy = DummyVecEnv([lambda: twin])
        copy.reset()
        try:
            restore_state(copy, start)
        except Exception:  # a state of another layout: the worlds differ already
            return
        self._copy = copy

    def agrees(self, actions: np.ndarray, next_observation: np.ndarray, done: bool) -> bool | None:
        """Step the copy along.

        :param actions: (1, action_dim), what the target's first environment received
        :param next_observation: (observation_dim,), what it answered
        :param done: whether its episode ended
        :return: True once all :attr:`N_STEPS` transitions (or the first episode) agreed, False once one did not or
            when nothing can be claimed, None while it is not known
        """
        if self._copy is None:
            return False
        observations, _, copy_done, infos = self._copy.step(actions)
        answer = infos[0].get("terminal_observation", np.asarray(observations)[0])
        alike = answer.shape == next_observation.shape  # the copy is without VecEnvWrappers, such as VecFrameStack
        if not alike or not np.allclose(answer, next_observation, rtol=1e-9, atol=1e-9) or bool(copy_done[0]) != done:
            self._copy = None
            return False
        self._left -= 1
        return True if self._left == 0 or done else None


def _single_state(venv: VecEnv) -> dict[str, Any] | None:
    """State of a one-environment DummyVecEnv around the first environment of ``venv``."""
    inner = venv.unwrapped
    if not isinstance(inner, DummyVecEnv):
        return None
    return save_state(DummyVecEnv([lambda: inner.envs[0]]))
