"""SAC with a second environment: what Stable-Baselines3 counts and keeps for one is kept for two."""

from __future__ import annotations

import inspect
import io
import os
import pathlib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_rpto.algorithms import checkpointing, model_zip
from sb3_rpto.algorithms.arguments import begin_temperature, constructor_names, one_kind_of_temperature
from sb3_rpto.algorithms.callback_adapters import count_in_target
from sb3_rpto.algorithms.checkpointing import TARGET_SEED_OFFSET, ResumePoint
from sb3_rpto.algorithms.environment_checks import check_environment, check_pair
from sb3_rpto.algorithms.interfaces import SourceRollouts, Target
from sb3_rpto.algorithms.normalisation import check_normalisation, normalises, rescaled, sharing
from sb3_rpto.algorithms.plain_sac import sac_of_model
from sb3_rpto.algorithms.policy_snapshots import PolicySnapshots
from sb3_rpto.algorithms.run_state import RunState
from sb3_rpto.algorithms.target import NullShiftCheck, OnlineTarget
from sb3_rpto.algorithms.transition_checks import Answers, check_finite
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.envs.env_copy import EnvSource, make_env
from sb3_rpto.files import write_atomically

Self = TypeVar("Self", bound="TwoEnvSAC")

#: The policy with the highest mean return over this many consecutive target episodes is kept as the best.
RECENT_EPISODES = 5
#: What SB3's collection knows of a step when it calls back, before it stores the transition.
STEP = ("buffer_actions", "new_obs", "rewards", "dones", "infos")
#: Characters that a key may have in the table that SB3 prints: names of effects are long.
LONGEST_KEY = 120
#: Kept out of the zip: saved by other means, rebuilt, or of no use without the environments.
NOT_SAVED = ("rollouts", "_last_obs", "_last_original_obs", "_source_first_obs", "_callback")


class TwoEnvSAC(SAC):
    """The source is SB3's ``env``, and all that SB3 counts is the target's.

    ``num_timesteps``, the last observation, episode statistics, action noise, callbacks and progress follow the target;
    the source is stepped beside them and has counters and a log group of its own.

    :param args: SAC's
    :param kwargs: SAC's
    """

    #: arguments that other algorithms have and this one does not use
    unused: ClassVar[frozenset[str]] = frozenset()

    observation_space: spaces.Box  # check_spaces refuses any other
    action_space: spaces.Box
    replay_buffer: DualReplayBuffer
    replay_buffer_kwargs: dict[str, Any]
    train_freq: TrainFreq  # type: ignore[assignment]  # SB3's setup makes it one
    _last_obs: np.ndarray | None  # the target's; observations are flat Boxes, never a Dict
    _last_original_obs: np.ndarray | None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "_init_setup_model": False})
        self.state = RunState()
        #: policies to go back to, by name
        self.snapshots = PolicySnapshots()
        #: where D_target comes from; ``learn()`` needs one
        self.target: Target | None = None
        #: the world that step 3 acts in; ``learn()`` makes it
        self.rollouts: SourceRollouts | None = None
        #: where a loaded checkpoint left the worlds, until ``learn()`` puts them back
        self.resume_point: ResumePoint | None = None
        #: given to a loaded model, which draws from new random streams then
        self.new_seed: int | None = None
        #: the run's callbacks while it lasts: they know the step that SB3 has taken and not yet stored
        self._callback: BaseCallback | None = None
        #: the observation of SB3's reset of the source, where its first episode begins
        self._source_first_obs: np.ndarray | None = None

    # ------------------------------------------------------------------ what it counts

    @property
    def source_timesteps(self) -> int:
        """Source steps so far, in the real source or its model."""
        return self.state.source_timesteps

    @source_timesteps.setter
    def source_timesteps(self, steps: int) -> None:
        self.state.source_timesteps = steps

    @property
    def target_spent(self) -> dict[str, int]:
        """Target steps by what they were spent on: "learning", and "other" for those of a script."""
        return self.state.target_spent

    @property
    def n_updates(self) -> int:
        """Updates of the critic so far."""
        return self._n_updates

    @property
    def logs_to_folder(self) -> bool:
        """Whether the user gave the logger a folder."""
        return bool(self._custom_logger or self.tensorboard_log is not None or "SB3_LOGDIR" in os.environ)

    def set_progress(self, taken: int, total: int | None = None) -> None:
        """Let schedules, as of the learning rate, be where a run is.

        :param taken: steps
        :param total: of so many; None: of the budget of target steps
        """
        self._update_current_progress_remaining(taken, self._total_timesteps if total is None else total)

    def steps_left(self) -> int:
        """Steps of the budget that can still be taken; 0 when fewer are left than the target has environments."""
        left = self._total_timesteps - self.num_timesteps
        return left if left >= (1 if self.target is None else self.target.n_envs) else 0

    # ------------------------------------------------------------------ the two environments

    @property
    def target_env(self) -> VecEnv | None:
        """The target as the policy sees it; None with a log in its place, or before one is set."""
        return None if self.target is None else self.target.env

    def set_target_env(self, env: EnvSource) -> None:
        """Set the target; the next ``learn()`` starts a new episode there.

        In the place of another target it begins with an empty D_target and no best policy.

        :param env: an environment, a VecEnv or an id
        :raises ValueError: when it is the source itself, has other spaces, or cannot be reset with a seed
        :raises TypeError: for what is no environment
        """
        env = make_env(env, "target_env")
        check_environment(env, "target_env")
        venv = sharing(self._wrap_env(env, self.verbose), self.env)
        if self.env is not None:
            self.check_pair(self.env, venv)
        if self.target is not None:
            self.forget_target(self.target)
        self.target = OnlineTarget(venv, self.env, self.state.target_spent)
        self._last_obs = None
        seed = self.seed if self.new_seed is None else self.new_seed
        if seed is not None:
            self.target.env.seed(seed + TARGET_SEED_OFFSET)

    def forget_target(self, target: Target) -> None:
        """Leave a target: what it told holds for it alone.

        :param target: which is left
        """
        if target.env is not None or target.is_traced:
            self.snapshots.forget_best()
            for earned in (self.ep_info_buffer, self.ep_success_buffer):
                if earned is not None:
                    earned.clear()
            self._drop_target_data()
        self.state.forget_target(self.num_timesteps)
        if self.resume_point is not None:  # where that target stood, and a step of it that is not stored
            self.resume_point = self.resume_point.without_target()

    def _drop_target_data(self) -> None:
        """D_target without what another target told."""
        buffer = self.replay_buffer
        if buffer.target.size() > 0:
            whose = (
                "log, whose states are estimates"
                if buffer.estimated
                else "target before; to go on in the same one, save, and load with target_env="
            )
            warnings.warn(f"D_target loses {buffer.target.size()} transitions of the {whose}", stacklevel=3)
        buffer.reset()

    def check_pair(self, source: VecEnv, target: VecEnv) -> None:
        """Refuse a target that cannot be the source's."""
        check_pair(source, target)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the source environment, as in SB3; the target keeps sharing its normalisation."""
        source = self._wrap_env(env, self.verbose)
        # All that may refuse it comes before anything changes.
        check_for_correct_spaces(source, self.observation_space, self.action_space)
        self.check_source(source)
        online = self.target if isinstance(self.target, OnlineTarget) else None
        if online is not None:
            self.check_pair(source, online.raw)
        before, after, last_obs = self.get_vec_normalize_env(), unwrap_vec_normalize(source), self._last_obs
        had: bool | None = normalises(before)
        if self.env is None:
            had = None if self.resume_point is None else self.resume_point.normalised
        if had is not None and (self.num_timesteps or self.state.pretraining_timesteps):
            check_normalisation(had, after, "the model", before)
        if self.env is not None and last_obs is not None and after is not before:
            last_obs, self._last_original_obs = rescaled(last_obs, self._last_original_obs, before, after)
        super().set_env(source, force_reset)
        self._last_obs = last_obs  # SB3 forgets the observation of what it takes to be the training env
        self.rollouts = self._source_first_obs = None
        if online is not None:
            online.share(source)

    def check_source(self, source: VecEnv) -> None:
        """Refuse a source that is none for this model; nothing has changed yet."""

    def get_vec_normalize_env(self) -> VecNormalize | None:
        """The source's VecNormalize, which learns the statistics, also while SB3 collects in the target."""
        return None if self.env is None else unwrap_vec_normalize(self.env)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed both worlds and the model, each with its own stream; with None nothing is seeded.

        After a checkpoint is loaded, the run that goes on draws from the new streams instead of those that were saved.
        """
        super().set_random_seed(seed)
        if seed is None:
            return
        self.new_seed = seed
        if self.target_env is not None:
            self.target_env.seed(seed + TARGET_SEED_OFFSET)

    def take_source_observation(self) -> np.ndarray | None:
        """The observation of a reset of the source after which no step was taken, for whoever takes it; None: none."""
        observation, self._source_first_obs = self._source_first_obs, None
        return observation

    def reset_source(self) -> None:
        """Begin an episode in the source."""
        assert self.env is not None  # learn() has checked
        self._source_first_obs = np.asarray(self.env.reset())

    # ------------------------------------------------------------------ a run's start

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """As SB3's, with the last observation and the action noise belonging to the target."""
        starts_episode = reset_num_timesteps or self._last_obs is None
        online = self.target if isinstance(self.target, OnlineTarget) else None
        disturbed = online is not None and online.ledger.lost(warn=not starts_episode)
        noise, self.action_noise = self.action_noise, None  # SB3 would size it by the source
        try:
            with Answers("source").received():  # SB3 resets it
                total_timesteps, callback = super()._setup_learn(
                    total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
                )
        finally:
            self.action_noise = noise
        _make_room_for_names(self.logger)
        if starts_episode:
            self.rollouts, self._source_first_obs = None, self._last_obs  # SB3 has just reset the source
            if noise is not None and self.resume_point is None:
                noise.reset()
        if online is None:
            self._last_obs = np.zeros((1, *self.observation_space.shape), self.observation_space.dtype)  # never read
        elif starts_episode or disturbed:  # somebody's steps end an episode, too
            self._start_target_episode(online)
        return total_timesteps, callback

    def _start_target_episode(self, target: OnlineTarget) -> None:
        """Reset the target and what SB3 keeps of it."""
        noise = self.action_noise
        # The last target may have been of another width.
        if noise is not None and target.n_envs != getattr(noise, "n_envs", 1):
            single = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
            self.action_noise = single if target.n_envs == 1 else VectorizedActionNoise(single, target.n_envs)
        self._last_obs = np.asarray(target.env.reset())
        target.ledger.begin()
        normaliser = target.normaliser
        self._last_original_obs = None if normaliser is None else np.asarray(normaliser.get_original_obs())
        own = self._last_obs if normaliser is None else self._last_original_obs
        check_finite("target", observation=np.asarray(own))

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        """As SB3's, with what counts environments counting the target's, not the source's."""
        snapshots = self.snapshots
        judged_by, snapshots.best_by = snapshots.best_by, "training"
        callbacks = super()._init_callback(callback, progress_bar)
        if snapshots.best_by != judged_by:  # by a callback, or no longer: the two measures cannot be compared
            snapshots.best_mean_reward = -np.inf
        count_in_target(callbacks, self.target_env)
        return callbacks

    def watch_for_null_shift(self) -> None:
        """Before the first step in a target: begin to compare it with a copy of the source."""
        if self.replay_buffer.target_added == 0 and isinstance(self.target, OnlineTarget):
            assert self.env is not None  # learn() has checked
            self.target.null_shift = NullShiftCheck(self.env, self.target.raw)

    # ------------------------------------------------------------------ steps in the target

    def target_rollout_length(self) -> TrainFreq:
        """``train_freq``, cut off where the budget ends."""
        assert self.target_env is not None
        steps_left = self.steps_left() // self.target_env.num_envs
        if self.train_freq.unit == TrainFrequencyUnit.STEP:
            return TrainFreq(min(self.train_freq.frequency, steps_left), TrainFrequencyUnit.STEP)
        return cast(TrainFreq, EpisodesWithinBudget(self, self.train_freq.frequency, steps_left))

    def collect_in_target(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Take a rollout in the target by SB3's own code, within the budget; whether to go on."""
        assert isinstance(self.target, OnlineTarget)
        length = self.target_rollout_length()
        allowance = length.frequency * self.target.n_envs
        self.state.rollout_start = self.num_timesteps
        with self._normalised_as_target(self.target), self.target.ledger.spending("learning", allowance):
            rollout = self.collect_rollouts(
                self.target.env,
                callback,
                length,
                self.replay_buffer,
                action_noise=self.action_noise,
                log_interval=log_interval,
            )
        if not rollout.continue_training:
            self.store_step(callback.locals)  # SB3 drops the step after which a callback stops
        self.state.rollout_timesteps = rollout.episode_timesteps
        return rollout.continue_training

    def count_steps(self, steps: int, callback: BaseCallback) -> bool:
        """Let ``num_timesteps`` count steps that are none of the target's, within the budget; whether to go on."""
        self.num_timesteps += min(steps, self.steps_left())
        self.set_progress(self.num_timesteps)
        callback.update_locals({**locals(), "dones": np.zeros(1, dtype=bool), "infos": [{}]})  # no episode ends
        return callback.on_step()

    @contextmanager
    def _normalised_as_target(self, target: OnlineTarget) -> Iterator[None]:
        """Inside, ``_vec_normalize_env`` is the target's: SB3 reads a step's original observations from it."""
        kept, self._vec_normalize_env = self._vec_normalize_env, target.normaliser
        try:
            yield
        finally:
            self._vec_normalize_env = kept

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store a target transition as SB3 does, after a look at it."""
        target, side = self.target, self.replay_buffer.target
        assert isinstance(target, OnlineTarget)
        ended = target.check_step(new_obs, reward, dones, infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        first = side.pos - len(dones)
        if target.normaliser is not None:  # what SB3 stores is clipped then
            for i, observation in ended.items():
                side.next_observations[(first + i) % side.buffer_size, 0] = observation
        target.ledger.unstored = False
        if target.null_shift is not None:
            answer = side.next_observations[first % side.buffer_size, 0]
            target.compare_with_source(self.policy.unscale_action(buffer_action[:1]), answer, bool(dones[0]))
        if any("episode" in info for info in infos):
            self.judge_recent_episodes()

    def judge_recent_episodes(self) -> None:
        """Keep the policy as the best if the newest target episodes earned more than any before."""
        assert self.ep_info_buffer is not None
        count = min(RECENT_EPISODES, self._stats_window_size)
        recent = [info["r"] for info in list(self.ep_info_buffer)[-count:]]
        if self.snapshots.best_by == "training" and recent and len(recent) == count:
            self.keep_if_best(float(np.mean(recent)))

    def store_step(self, step: dict[str, Any]) -> None:
        """Finish a target step as SB3 does after its callback, where SB3 itself does not get to it.

        :param step: the locals of SB3's collection that :data:`STEP` names
        """
        assert isinstance(self.target, OnlineTarget)
        with self._normalised_as_target(self.target):
            self._update_info_buffer(step["infos"], step["dones"])
            self._store_transition(self.replay_buffer, *(step[name] for name in STEP))
        self.set_progress(self.num_timesteps)
        for i in np.flatnonzero(step["dones"]):
            self._episode_num += 1
            if self.action_noise is not None:
                self.action_noise.reset(**({"indices": [i]} if len(step["dones"]) > 1 else {}))

    def store_step_cut_off(self) -> None:
        """Store the target step in whose callback an exception ended the last run."""
        target, callback = self.target, self._callback
        if isinstance(target, OnlineTarget) and callback is not None and target.ledger.unstored:
            self.store_step(callback.locals)

    # ------------------------------------------------------------------ policies to go back to

    def keep_if_best(self, mean_reward: float) -> bool:
        """Keep the current policy as "best" if it earned more than any before.

        :param mean_reward: its return in the target, however it was measured
        :return: whether it was kept
        """
        if not self.snapshots.is_best(mean_reward):
            return False
        self.take_snapshot("best")
        return True

    def take_snapshot(self, name: str) -> None:
        """Keep actor, critics and temperature under ``name``, on the CPU."""
        alpha = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()
        self.snapshots.take(name, self.policy, alpha)

    def rollback(self, to: str = "best") -> None:
        """Go back to a policy that was kept; a VecNormalize keeps the statistics that it has now.

        :param to: "best" (in the target), "source" (as it came) or, where a trace accounts for the target,
            "simulator" (the best in the fitted one); restores actor, critics and temperature
        :raises ValueError: when there is no such policy yet
        """
        self.snapshots.put_back(to, self.policy, self.log_ent_coef)

    # ------------------------------------------------------------------ files

    def last_target_observation(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The target's last observation as the policy sees it, and the same as it was before a VecNormalize."""
        return self._last_obs, self._last_original_obs

    def begin_at(self, last_obs: np.ndarray | None, last_original_obs: np.ndarray | None) -> None:
        """Go on in the target from an observation of :meth:`last_target_observation`."""
        self._last_obs, self._last_original_obs = last_obs, last_original_obs

    def unstored_step(self) -> dict[str, Any] | None:
        """The target step that is taken and not yet stored: SB3 calls callbacks, which may save, between the two."""
        target, callback = self.target, self._callback
        if not isinstance(target, OnlineTarget) or callback is None or not target.ledger.unstored:
            return None
        normaliser = target.normaliser
        raw = None if normaliser is None else {name: getattr(normaliser, name) for name in checkpointing.RAW}
        return {"raw": raw, "known": {name: callback.locals[name] for name in STEP}}

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all that a resumed run needs, except the replay buffers (``save_replay_buffer``); atomic for paths."""
        kept = self.resume_point, self.replay_buffer_kwargs
        try:
            self.resume_point = checkpointing.capture(self)
            # SAC's buffer, in a SAC that loads the zip, has no target.
            self.replay_buffer_kwargs = {name: value for name, value in kept[1].items() if name != "target_size"}
            write_atomically(path, lambda file: self._write_zip(file, exclude, include))
        finally:
            self.resume_point, self.replay_buffer_kwargs = kept

    def _write_zip(self, file: Any, exclude: Iterable[str] | None, include: Iterable[str] | None) -> None:
        """SB3's zip, and in it what SB3 does not read, so that ``SAC.load`` takes the file."""
        # What is no path may be open for writing alone.
        whole = file if isinstance(file, str | pathlib.Path) else io.BytesIO()
        super().save(whole, exclude, include)
        states = {name: recursive_getattr(self, name).state_dict() for name in self.own_states()}
        model_zip.append_states(whole, states)
        if isinstance(whole, io.BytesIO):
            file.write(whole.getbuffer())

    def own_states(self) -> list[str]:
        """Names of modules and optimizers beside SAC's, which a checkpoint holds."""
        return []

    def to_sac(self) -> SAC:
        """The policy in a plain SAC of Stable-Baselines3, with its critics, temperature and optimisers.

        It has no environment and no buffers, acts as this model does, learns on after ``set_env()``, and its zip needs
        nothing of this package.
        """
        return sac_of_model(self)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Save both replay buffers as one pickle; atomic for paths."""
        write_atomically(path, super().save_replay_buffer, suffix="pkl")

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Load both replay buffers.

        :param path: what ``save_replay_buffer`` wrote
        :param truncate_last_traj: as in SB3; without effect here
        :raises ValueError: for the buffer of another algorithm or of other environments; the model keeps its own then
        """
        read = super().load_replay_buffer
        checkpointing.read_buffer(self, path, lambda: read(path, truncate_last_traj))
        if self.replay_buffer.estimated and self.target_env is not None:  # a target has taken the log's place
            self._drop_target_data()

    @classmethod
    def load(
        cls: type[Self],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: EnvSource | None = None,
        *args: Any,
        target_env: EnvSource | None = None,
        **kwargs: Any,
    ) -> Self:
        """Load a checkpoint; without environments the model can predict, with them it resumes.

        :param path: of the zip
        :param env: the source, or its id
        :param args: as SB3's ``load``
        :param target_env: the target, or its id
        :param kwargs: as SB3's ``load``
        :raises ValueError: for a file that is no zip of this algorithm's, or a damaged one, a target that is not passed
            by name, and arguments that a saved model does not change
        :raises TypeError: for what is no path, or no environment
        """
        cls.refuse_unused(kwargs)
        known = constructor_names(cls) | set(inspect.signature(SAC.load).parameters)
        file = checkpointing.check_load(cls.__name__, path, args, kwargs, known)
        env = None if env is None else make_env(env)
        if env is not None:
            check_environment(env, "env")
        with one_kind_of_temperature(kwargs):
            model = super().load(file, env, *args, **kwargs)
        model._put_states(model_zip.read_states(file, model.own_states(), model.device))
        begin_temperature(model, kwargs.get("ent_coef"))
        model._finish_loading(kwargs.get("seed"))
        if target_env is not None:
            model.set_target_env(target_env)
        return model

    @classmethod
    def refuse_unused(cls, given: Iterable[str]) -> None:
        """Refuse arguments in :attr:`unused`.

        :param given: names of the arguments
        :raises ValueError: naming those
        """
        unused = sorted(cls.unused.intersection(given))
        if unused:
            raise ValueError(f"{cls.__name__} does not use {unused}; leave them out or use RPTO")

    def _finish_loading(self, seed: int | None) -> None:
        """What SB3's ``load()`` has changed, as the checkpoint has it.

        :param seed: given now
        """
        point = self.resume_point
        assert point is not None  # it is in the zip
        # The seed of its beginning is not one given now; one that was given before it was saved anew is.
        self.new_seed = None
        self.set_random_seed(point.seed if seed is None else seed)
        self.state.knows_source = point.knows_source  # set_parameters() takes it for a warm start
        if point.learner is not None:  # and has dropped this one
            self.snapshots["learner"] = point.learner
        if self.env is not None:
            self.check_source(self.env)
            if point.normalised is not None:
                check_normalisation(point.normalised, self.get_vec_normalize_env(), "the model")

    def set_parameters(self, load_path_or_dict: Any, exact_match: bool = True, device: Any = "auto") -> None:
        """As in SB3; a model that was given parameters counts as warm-started and is not trained in the source.

        The parameters are SAC's. A zip of this package brings the dynamics, too.
        """
        given, own = load_path_or_dict, self.own_states()
        if not isinstance(given, dict):
            file = model_zip.located(given, "load_path_or_dict")
            given = load_from_zip_file(file, load_data=False, device=device)[1] | model_zip.read_states(
                file, own, self.device
            )
        super().set_parameters({name: value for name, value in given.items() if name not in own}, exact_match, device)
        self._put_states({name: value for name, value in given.items() if name in own})
        self.snapshots.pop("learner", None)  # what goes on learning is this one
        self.state.knows_source = True

    def _put_states(self, states: dict[str, Any]) -> None:
        """Restore modules and optimizers.

        :param states: by the names of :meth:`own_states`
        """
        for name, state in states.items():
            recursive_getattr(self, name).load_state_dict(state)

    def _setup_model(self) -> None:
        """Build networks and buffers from the spaces alone: ``load()`` has no environment."""
        saved_by = None if self.resume_point is None else self.resume_point.algorithm  # while a checkpoint is loaded
        if saved_by is not None and saved_by != checkpointing.algorithm_of(type(self)):
            raise ValueError(f"this was saved by {saved_by}, {type(self).__name__} cannot continue it; load it there")
        # SB3 builds the buffer from these two attributes; the user's choice applies to each side.
        side_class, kwargs = self.replay_buffer_class, self.replay_buffer_kwargs
        saved = None if self.resume_point is None else self.resume_point.target_size
        kwargs = {**({} if saved is None else {"target_size": saved}), **kwargs}
        own: dict[str, Any] = {name: value for name, value in kwargs.items() if name == "target_size"}
        own["side_kwargs"] = {name: value for name, value in kwargs.items() if name != "target_size"}
        if side_class not in (None, DualReplayBuffer):
            own["side_class"] = side_class
        self.replay_buffer_class, self.replay_buffer_kwargs = DualReplayBuffer, own
        super()._setup_model()
        self.replay_buffer_class, self.replay_buffer_kwargs = side_class, kwargs

    def _excluded_save_params(self) -> list[str]:
        target = [] if self.target_env is None else ["target"]  # a log's is plain data
        return [*super()._excluded_save_params(), *NOT_SAVED, *target]


class EpisodesWithinBudget:
    """Stands in for SB3's ``TrainFreq``: so many episodes, but not more steps than are left.

    SB3's collection reads ``frequency`` before every step, so this may end it at the end of an episode although it
    counts steps (which, unlike SB3's episodes, several environments can be counted in).

    :param model: whose episodes are counted, from now on
    :param n_episodes: episodes after which the collection ends
    :param n_steps: steps (of all environments at once) after which it ends in any case
    """

    unit = TrainFrequencyUnit.STEP

    def __init__(self, model: TwoEnvSAC, n_episodes: int, n_steps: int) -> None:
        self._model = model
        self._last_episode = model._episode_num + n_episodes
        self._n_steps = n_steps

    @property
    def frequency(self) -> int:
        """Steps of this collection as far as it is known."""
        return self._n_steps if self._model._episode_num < self._last_episode else 0


def _make_room_for_names(logger: Logger) -> None:
    """SB3's table cuts keys at 36 characters and refuses two that are the same then, as names of effects may be."""
    for output in logger.output_formats:
        if isinstance(output, HumanOutputFormat):
            output.max_length = max(output.max_length, LONGEST_KEY)
