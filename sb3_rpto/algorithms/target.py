"""Where D_target comes from: an environment whose every step is counted, or a log."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize

from sb3_rpto.algorithms.interfaces import Agent, Target
from sb3_rpto.algorithms.normalisation import share_normalisation
from sb3_rpto.algorithms.transition_checks import Answers, check_finite, last_observations
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.env_snapshot import restore_state, save_state, whereabouts


class OnlineTarget(Target):
    """An environment: it counts its steps, shares the source's normalisation, and notices where it is no target.

    :param venv: the environment
    :param source: the source, whose VecNormalize it shares where there is one; None before it is known
    :param spent: target steps by what they were spent on, counted on in place
    """

    is_traced = False
    env: VecEnv

    def __init__(self, venv: VecEnv, source: VecEnv | None, spent: dict[str, int]) -> None:
        self.ledger = TargetLedger(venv, spent)
        self.share(source)
        self.n_envs = venv.num_envs
        #: compares its first steps with the source's, as long as nothing is known
        self.null_shift: NullShiftCheck | None = None

    @property
    def raw(self) -> VecEnv:
        """The environment itself, not normalised and not counted."""
        return self.ledger.venv

    @property
    def normaliser(self) -> VecNormalize | None:
        """By which the policy sees it."""
        return unwrap_vec_normalize(self.env)

    def share(self, source: VecEnv | None) -> None:
        """Be normalised by the source's running statistics."""
        self.env = share_normalisation(self.ledger, source)

    def source_steps(self, agent: Agent) -> int:
        """Those for the target steps of the next rollout; of whole episodes, as many as in the last one.

        What several copies took too much, or the last rollout turned out to need more or less, is made up for.
        """
        coming = min(agent.state.rollout_timesteps, agent.steps_left())
        if agent.train_freq.unit == TrainFrequencyUnit.STEP:
            coming = agent.target_rollout_length().frequency * self.n_envs
        return agent.state.source_steps_due + coming * agent.source_steps_per_target_step()

    def collect(self, agent: Agent, callback: BaseCallback, log_interval: int | None) -> bool:
        """Act in the environment and fill D_target; SB3's own code collects, within the budget."""
        return agent.collect_in_target(callback, log_interval)

    def check_step(self, new_obs: Any, rewards: Any, dones: np.ndarray, infos: list[dict[str, Any]]) -> dict[int, Any]:
        """Look at a step before it is stored.

        :return: the observations at the ends of episodes, by the index of the environment
        :raises ValueError: for what cannot be stored
        """
        ended = last_observations("target", self.env, dones, infos)
        normaliser = self.normaliser
        raw: Any = new_obs, rewards
        if normaliser is not None:  # which clips what is infinite, and what is stored comes from below it
            raw = normaliser.get_original_obs(), normaliser.get_original_reward()
        normalised = normaliser is not None and normaliser.norm_reward
        self.ledger.check(*map(np.asarray, raw), *ended.values(), normalised=normalised)
        return ended

    def compare_with_source(self, action: np.ndarray, next_observation: np.ndarray, done: bool) -> None:
        """Warn when the step just stored is the last of many that the source would have answered alike.

        :param action: (1, action_dim), what the first environment received
        :param next_observation: (observation_dim,), what it answered
        :param done: whether its episode ended
        """
        assert self.null_shift is not None  # else there is nothing to compare
        same = self.null_shift.agrees(action, next_observation, done)
        if same is not None:
            self.null_shift = None
        if same:
            warnings.warn(
                "target_env has stepped exactly like env so far: is it the world you meant? (Nothing to transfer.)",
                stacklevel=3,
            )


class OfflineTarget(Target):
    """A log that stands in for the target: ``num_timesteps`` counts source steps then.

    :param is_traced: whether it is one of measurements, and phi comes from a trace of it
    """

    env = None
    n_envs = 1

    def __init__(self, is_traced: bool = False) -> None:
        self.is_traced = is_traced

    def source_steps(self, agent: Agent) -> int:
        """Those of a round, within the budget, which is one of source steps."""
        return min(agent.state.source_steps_due + agent.source_steps_per_target_step(), agent.steps_left())

    def collect(self, agent: Agent, callback: BaseCallback, log_interval: int | None) -> bool:
        """Only count the source steps that were just taken."""
        return agent.count_steps(agent.source_steps_per_target_step(), callback)


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
