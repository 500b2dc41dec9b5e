"""SB3's bookkeeping, kept for two worlds where SB3 knows one."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_rpto.algorithms.callback_adapters import count_in_target
from sb3_rpto.algorithms.normalisation import check_normalisation, normalises, rescaled, sharing
from sb3_rpto.algorithms.policy_snapshots import PolicySnapshots
from sb3_rpto.algorithms.rollouts import SourceWorld
from sb3_rpto.algorithms.target import (
    NullShiftCheck,
    TargetLedger,
    check_environment,
    check_pair,
    find_ledger,
    last_observations,
    share_normalisation,
)
from sb3_rpto.algorithms.target_checks import check_machine, check_simulator, doubt, doubt_rules, doubt_what_is_left
from sb3_rpto.algorithms.transition_checks import Answers, check_finite
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.factory import is_mujoco
from sb3_rpto.envs.env_copy import EnvSource, make_env
from sb3_rpto.envs.task_rules import task_rules

if TYPE_CHECKING:
    from sb3_rpto.algorithms.closed_loop.controller import LoopCloser

#: The target's random stream is the seed plus this, so that both worlds never draw the same numbers.
TARGET_SEED_OFFSET = 10_000
DYNAMICS_SEED_OFFSET = 20_000
#: The policy with the highest mean return over this many consecutive target episodes is kept as the best.
RECENT_EPISODES = 5
#: What SB3's collection knows of a step when it calls back, before it stores the transition.
STEP = ("buffer_actions", "new_obs", "rewards", "dones", "infos")
#: Characters that a key may have in the table that SB3 prints: names of effects are long.
LONGEST_KEY = 120


class RuleOfEnvironment:
    """Stands in a checkpoint for a rule that belongs to an environment which does not pickle.

    :param name: of the rule
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, *args: Any) -> Any:
        """Say what is missing.

        :raises RuntimeError: always
        """
        raise RuntimeError(f"{self.name} belongs to an environment; pass env= and target_env= to load()")


class TwoWorlds(PolicySnapshots):
    """The two environments, and SB3's accounts of a run: the source is SB3's ``env``, all accounts are the target's.

    ``num_timesteps``, the last observation, episode statistics, action noise, callbacks and progress follow the target;
    the source is stepped beside them and has counters and a log group of its own.
    """

    target_env: VecEnv | None
    #: source transitions per target step; an integer once the preset is applied
    source_steps: Any
    #: source steps taken so far, in the real source or its model; in plain SAC there; target steps by purpose
    source_timesteps: int
    _pretrained_steps: int
    target_spent: dict[str, int]

    #: what rebuilds the dynamics, and the user's parts of it
    dynamics_config: dict[str, Any] | None
    dynamics_kwargs: dict[str, Any]
    dynamics_backend: str
    #: names of the arguments that the user passed
    _passed: frozenset[str]

    _last_obs: np.ndarray | None  # the target's; observations are flat Boxes, never a Dict
    _last_original_obs: np.ndarray | None
    _source_world: SourceWorld | None
    #: the observation of SB3's reset of the source, where its first episode begins
    _source_first_obs: np.ndarray | None
    _null_check: NullShiftCheck | None
    #: whether the model has the target's rules, after its first fit
    _has_target_rules: bool
    #: traces what the simulator lacks, where that was asked for
    loop: LoopCloser | None
    #: target steps for which the policy has not learned yet: a closed loop may put that off until a fit
    _owed: int = 0
    #: whether the simulator was judged after its first fit to this target
    _judged_target: bool = False
    #: whether a rule of the source was seen not to be this target's
    _judged_rules: bool = False
    #: whether what its fit leaves of exact data was judged
    _judged_rest: bool = False
    #: the run's callbacks while it lasts: they know the step that SB3 has taken and not yet stored
    _callback: BaseCallback | None
    #: where a loaded checkpoint left the worlds, until ``learn()`` puts them back
    _resume_state: dict[str, Any] | None
    #: given to a loaded model, which draws from new random streams then
    _new_seed: int | None

    # ------------------------------------------------------------------ the worlds

    def set_target_env(self, env: EnvSource) -> None:
        """Set the target; the next ``learn()`` starts a new episode there.

        In the place of another target it begins with an empty D_target, no best policy, and a closed loop that has seen
        nothing.

        :param env: an environment, a VecEnv, an id, or a function that makes one
        :raises ValueError: when it is the source itself, has other spaces, cannot be reset with a seed, or is another
            machine (joints, length of a step) than the simulator that is fitted to it
        :raises TypeError: for what is no environment
        """
        env = make_env(env, "target_env")
        check_environment(env, "target_env")
        venv = sharing(self._wrap_env(env, self.verbose), self.env)
        if self.env is not None:
            self._check_pair(self.env, venv)
        if self.target_env is not None or self._traces_log:  # what the last target told holds for it alone
            self.forget_best()
            for earned in (self.ep_info_buffer, self.ep_success_buffer):
                if earned is not None:
                    earned.clear()
            self._owed = self._since_fit = 0
            if self.loop is not None:
                self.loop.forget_target()
            self._drop_target_data()
        if self.target_env is not None or self._offline:
            self._round_open, self._collected, self._rollout_began_at = False, 1, self.num_timesteps
            self._source_due = 0
            if self._resume_state is not None:
                # Where that target stood, and a step of it that is not stored.
                self._resume_state |= {"target": None, "last_obs": None, "unstored_step": None}
        self._bind_rules(venv, of_target=True)
        self._has_target_rules = False  # but of the last one
        self.target_env = share_normalisation(TargetLedger(venv, self.target_spent), self.env)
        self._offline = self._traces_log = self._judged_target = self._judged_rules = self._judged_rest = False
        self._last_obs = self._null_check = None
        seed = self.seed if self._new_seed is None else self._new_seed
        if seed is not None:
            self.target_env.seed(seed + TARGET_SEED_OFFSET)

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

    def _check_pair(self, source: VecEnv, target: VecEnv) -> None:
        """Refuse a target that cannot be the source's, or not that of the simulator that is fitted to it."""
        check_pair(source, target)
        if self.dynamics_config is not None and is_mujoco(self.dynamics_config):
            check_machine(source, target)

    def _doubt_the_target(self, data: Transitions, error: float) -> None:
        """Warn, after the first fit (with the loop closed: after the first trace), where the simulator does not fit."""
        assert self.dynamics is not None
        self._judged_rules = self._judged_rules or doubt_rules(self.dynamics, data)
        if self.loop is None and not self._judged_rest:
            self._judged_rest = doubt_what_is_left(self.dynamics, error, data)
        if self._judged_target or (self.loop is not None and not self.loop.traced):
            return
        self._judged_target = True
        doubt(self.dynamics, 0.0 if self._keeps_phi() else error, data)  # which is mostly noise there

    def _adopt_target_rules(self) -> None:
        """Hopper's healthy heights follow its body, say: phi_0 knew the source's rules, phi shall know the target's.

        Rules that the user passed stay, and so does a rule that the target does not tell.
        """
        config = self.dynamics_config
        if self._has_target_rules or config is None or "termination_fn" not in config or self.target_env is None:
            return
        rules = task_rules(find_ledger(self.target_env).venv)
        for name in ("reward_fn", "termination_fn"):
            rule = getattr(rules, name)
            if rule is not None and name not in self.dynamics_kwargs and config[name] is not None:
                config[name] = rule  # what a checkpoint rebuilds the model from
                setattr(self.dynamics, name, rule)
        self._has_target_rules = True

    def _bind_rules(self, env: VecEnv, of_target: bool) -> None:
        """Give a loaded model the rules that its checkpoint could not hold, from the environment that they belong to.

        :param env: the source or the target
        :param of_target: which of them
        """
        config = self.dynamics_config or {}
        rules = task_rules(env)
        for name in ("reward_fn", "termination_fn"):
            if isinstance(config.get(name), RuleOfEnvironment) and of_target == self._has_target_rules:
                config[name] = getattr(rules, name) or config[name]
                setattr(self.dynamics, name, config[name])

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the source environment, as in SB3; the target keeps sharing its normalisation."""
        source = self._wrap_env(env, self.verbose)
        # All that may refuse it comes before anything changes.
        check_for_correct_spaces(source, self.observation_space, self.action_space)
        check_simulator(source, self.dynamics, self.weighting == "value_aware")
        if self.target_env is not None:
            self._check_pair(source, find_ledger(self.target_env).venv)
        before, after, last_obs = self.get_vec_normalize_env(), unwrap_vec_normalize(source), self._last_obs
        had = (self._resume_state or {}).get("normalised") if self.env is None else normalises(before)
        if had is not None and (self.num_timesteps or self._pretrained_steps):
            check_normalisation(had, after, "the model", before)
        if self.env is not None and last_obs is not None and after is not before:
            last_obs, self._last_original_obs = rescaled(last_obs, self._last_original_obs, before, after)
        super().set_env(source, force_reset)
        self._bind_rules(source, of_target=False)
        self._last_obs = last_obs  # SB3 forgets the observation of what it takes to be the training env
        self._source_world = self._source_first_obs = None
        if self.target_env is not None:
            self.target_env = share_normalisation(find_ledger(self.target_env), source)

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
        self._new_seed = seed
        if self.target_env is not None:
            self.target_env.seed(seed + TARGET_SEED_OFFSET)
        if self.dynamics is not None:
            self.dynamics.seed(seed + DYNAMICS_SEED_OFFSET)

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
        disturbed = self.target_env is not None and find_ledger(self.target_env).lost(warn=not starts_episode)
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
            self._source_world, self._source_first_obs = None, self._last_obs  # SB3 has just reset the source
            if noise is not None and self._resume_state is None:
                noise.reset()
        if self._offline:
            self._last_obs = np.zeros((1, *self.observation_space.shape), self.observation_space.dtype)  # never read
        elif starts_episode or disturbed:  # somebody's steps end an episode, too
            self._start_target_episode()
        return total_timesteps, callback

    def _start_target_episode(self) -> None:
        """Reset the target and what SB3 keeps of it."""
        assert self.target_env is not None  # learn() has checked
        n_envs, noise = self.target_env.num_envs, self.action_noise
        # The last target may have been of another width.
        if noise is not None and n_envs != getattr(noise, "n_envs", 1):
            single = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
            self.action_noise = single if n_envs == 1 else VectorizedActionNoise(single, n_envs)
        self._last_obs = np.asarray(self.target_env.reset())
        find_ledger(self.target_env).begin()
        normaliser = unwrap_vec_normalize(self.target_env)
        self._last_original_obs = None if normaliser is None else np.asarray(normaliser.get_original_obs())
        own = self._last_obs if normaliser is None else self._last_original_obs
        check_finite("target", observation=np.asarray(own))

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        """As SB3's, with what counts environments counting the target's, not the source's."""
        judged_by, self.best_by = self.best_by, "training"
        callbacks = super()._init_callback(callback, progress_bar)
        if self.best_by != judged_by:  # by a callback, or no longer: the two measures cannot be compared
            self.best_mean_reward = -np.inf
        count_in_target(callbacks, self.target_env)
        return callbacks

    def _watch_for_null_shift(self) -> None:
        """Before the first step in a target: begin to compare it with a copy of the source."""
        if self.replay_buffer.target_added == 0 and not self._offline:
            assert self.env is not None
            assert self.target_env is not None  # learn() has checked
            self._null_check = NullShiftCheck(self.env, find_ledger(self.target_env).venv)

    # ------------------------------------------------------------------ steps

    def _steps_left(self) -> int:
        """Steps of the budget that can still be taken; 0 when fewer are left than the target has environments."""
        left = self._total_timesteps - self.num_timesteps
        width = 1 if self._offline or self.target_env is None else self.target_env.num_envs
        return left if left >= width else 0

    def _rollout_length(self) -> TrainFreq:
        """``train_freq``, cut off where the budget ends."""
        assert isinstance(self.train_freq, TrainFreq)  # SB3's setup has made it one
        assert self.target_env is not None
        steps_left = self._steps_left() // self.target_env.num_envs
        if self.train_freq.unit == TrainFrequencyUnit.STEP:
            return TrainFreq(min(self.train_freq.frequency, steps_left), TrainFrequencyUnit.STEP)
        return cast(TrainFreq, EpisodesWithinBudget(self, self.train_freq.frequency, steps_left))

    @contextmanager
    def _targets_normalisation(self) -> Iterator[None]:
        """Inside, ``_vec_normalize_env`` is the target's: SB3 reads a step's original observations from it."""
        assert self.target_env is not None
        kept, self._vec_normalize_env = self._vec_normalize_env, unwrap_vec_normalize(self.target_env)
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
        assert self.target_env is not None
        ended = last_observations("target", self.target_env, dones, infos)
        normaliser = unwrap_vec_normalize(self.target_env)
        raw: Any = new_obs, reward
        if normaliser is not None:  # which clips what is infinite, and what is stored comes from below it
            raw = normaliser.get_original_obs(), normaliser.get_original_reward()
        normalised = normaliser is not None and normaliser.norm_reward
        find_ledger(self.target_env).check(*map(np.asarray, raw), *ended.values(), normalised=normalised)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        if normaliser is not None:  # what SB3 stores is clipped then
            side = self.replay_buffer.target
            for i, observation in ended.items():
                side.next_observations[(side.pos - len(dones) + i) % side.buffer_size, 0] = observation
        find_ledger(self.target_env).unstored = False
        if self._null_check is not None:
            self._compare_with_source(self._null_check, buffer_action, dones)
        if self.updates_policy and self.best_by == "training" and any("episode" in info for info in infos):
            self._judge_recent_episodes()

    def _compare_with_source(self, check: NullShiftCheck, buffer_action: np.ndarray, dones: np.ndarray) -> None:
        """Warn when the transition just stored is the last of many that the source would have answered alike."""
        side = self.replay_buffer.target
        answer = side.next_observations[(side.pos - len(dones)) % side.buffer_size, 0]
        same = check.agrees(self.policy.unscale_action(buffer_action[:1]), answer, bool(dones[0]))
        if same is not None:
            self._null_check = None
        if same:
            warnings.warn(
                "target_env has stepped exactly like env so far: is it the world you meant? (Nothing to transfer.)",
                stacklevel=3,
            )

    def _judge_recent_episodes(self) -> None:
        """Keep the policy as the best if the newest target episodes earned more than any before."""
        assert self.ep_info_buffer is not None
        count = min(RECENT_EPISODES, self._stats_window_size)
        recent = [info["r"] for info in list(self.ep_info_buffer)[-count:]]
        if recent and len(recent) == count:
            self.keep_if_best(float(np.mean(recent)))

    def store_step(self, step: dict[str, Any]) -> None:
        """Finish a target step as SB3 does after its callback, where SB3 itself does not get to it.

        :param step: the locals of SB3's collection that :data:`STEP` names
        """
        with self._targets_normalisation():
            self._update_info_buffer(step["infos"], step["dones"])
            self._store_transition(self.replay_buffer, *(step[name] for name in STEP))
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        for i in np.flatnonzero(step["dones"]):
            self._episode_num += 1
            if self.action_noise is not None:
                self.action_noise.reset(**({"indices": [i]} if len(step["dones"]) > 1 else {}))

    def _store_step_cut_off(self) -> None:
        """Store the target step in whose callback an exception ended the last run."""
        if self.target_env is not None and self._callback is not None and find_ledger(self.target_env).unstored:
            self.store_step(self._callback.locals)

    def _steps_of_round(self) -> int:
        """Source steps for each target step, or for what stands in for one when the target is a log."""
        return int(self.source_steps)

    def _count_source_steps(self, callback: BaseCallback) -> bool:
        """What stands in for a target step when the target is a log: ``num_timesteps`` counts source steps."""
        self.num_timesteps += min(self._steps_of_round(), self._steps_left())
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        callback.update_locals({**locals(), "dones": np.zeros(1, dtype=bool), "infos": [{}]})  # no episode ends
        return callback.on_step()


class EpisodesWithinBudget:
    """Stands in for SB3's ``TrainFreq``: so many episodes, but not more steps than are left.

    SB3's collection reads ``frequency`` before every step, so this may end it at the end of an episode although it
    counts steps (which, unlike SB3's episodes, several environments can be counted in).

    :param model: whose episodes are counted, from now on
    :param n_episodes: episodes after which the collection ends
    :param n_steps: steps (of all environments at once) after which it ends in any case
    """

    unit = TrainFrequencyUnit.STEP

    def __init__(self, model: TwoWorlds, n_episodes: int, n_steps: int) -> None:
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
