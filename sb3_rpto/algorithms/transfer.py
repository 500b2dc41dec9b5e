"""SAC over two worlds: everything that RPO, RTO and RPTO share."""

from __future__ import annotations

import inspect
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any, Literal, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    Schedule,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_rpto.algorithms import checkpoint, warm
from sb3_rpto.algorithms.checkpoint import Resumable
from sb3_rpto.algorithms.source import BranchSource, EpisodeSource, RolloutStart
from sb3_rpto.algorithms.worlds import (
    NullShiftCheck,
    TargetLedger,
    check_finite,
    check_pair,
    check_seedable,
    check_spaces,
    find_ledger,
    share_normalisation,
)
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.factory import BACKENDS, dynamics_config, make_dynamics
from sb3_rpto.dynamics.vec_env import DynamicsVecEnv
from sb3_rpto.dynamics.weights import WEIGHTINGS, WeightingName
from sb3_rpto.presets import resolve_preset

Self = TypeVar("Self", bound="TransferAlgorithm")

#: The target's random stream is the seed plus this, so that both worlds never draw the same numbers.
TARGET_SEED_OFFSET = 10_000
DYNAMICS_SEED_OFFSET = 20_000
#: The policy with the highest mean return over this many consecutive target episodes is kept as the best.
RECENT_EPISODES = 5
#: Goals, Dict observations and n-step returns (SB3's HerReplayBuffer is a DictReplayBuffer).
UNSUPPORTED_BUFFERS = (DictReplayBuffer, NStepReplayBuffer)


class TransferAlgorithm(Resumable):
    """Base of :class:`RPO`, :class:`RTO` and :class:`RPTO`; use one of those.

    The arguments up to ``device`` are SAC's, with SAC's defaults, except that ``gradient_steps`` counts updates per
    TARGET step and ``learning_starts`` applies to the source alone (no random action is ever taken in the target).

    :param target_env: the scarce world, an environment, a VecEnv or an id; ``learn()`` needs it or ``target_data``
    :param target_data: transitions of the target recorded beforehand (a replay buffer, its pickle or an ``.npz``),
        in place of ``target_env`` (RTO and RPTO)
    :param preset: hyperparameters for what is not passed: "default", "paper" or "author"
    :param dynamics: backend of the trainable source, "ensemble" or "physical"
    :param dynamics_kwargs: further arguments of the backend
    :param declared: names of the physical parameters to fit (physical backend)
    :param close_loop: trace effects that nobody declared; not available yet
    :param weighting: RTO's weight: "paper", "centred", "value_aware", or None (plain supervised learning)
    :param weight_floor: epsilon of the paper: the smallest weight, above 0 or equal to it
    :param real_ratio: share of target transitions in the critic's batches, in [0, 1); 0 in the paper
    :param rollout_start: where one-step branches start: "target", "source" or "mix"
    :param source_steps: source transitions per target step; "auto" leaves it to the preset
    :param model_train_freq: target steps between two fits of the dynamics
    :raises ValueError: for an unknown preset, backend, weighting or start, a value out of range, a target equal to the
        source or with other spaces
    :raises NotImplementedError: for Dict, image or discrete spaces, n-step returns and HER
    """

    _passed: frozenset[str]
    _last_obs: np.ndarray | None  # observations are flat Boxes, never a Dict
    _last_original_obs: np.ndarray | None

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Remember which arguments the user passed: a preset fills in only the others."""
        self = super().__new__(cls)
        positional = list(inspect.signature(TransferAlgorithm.__init__).parameters)[1:]
        self._passed = frozenset(positional[: len(args)]) | frozenset(kwargs)
        return self

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        target_env: GymEnv | str | None = None,
        target_data: ReplayBuffer | str | pathlib.Path | None = None,
        preset: str = "default",
        dynamics: Literal["ensemble", "physical"] = "ensemble",
        dynamics_kwargs: dict[str, Any] | None = None,
        declared: Sequence[str] = (),
        close_loop: bool = False,
        weighting: WeightingName | None = "paper",
        weight_floor: float = 0.5,
        real_ratio: float = 0.05,
        rollout_start: RolloutStart = "mix",
        source_steps: int | Literal["auto"] = "auto",
        model_train_freq: int = 250,
    ) -> None:
        if isinstance(env, str):
            env = gym.make(env)
        if env is not None:  # SB3's load() builds the object before it has an env
            check_spaces(env.observation_space, env.action_space)
            check_seedable(env, "env")
        if n_steps != 1 or optimize_memory_usage:
            raise NotImplementedError("n_steps > 1 and optimize_memory_usage are not supported: branches are one step")
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class,
            replay_buffer_kwargs,
            optimize_memory_usage,
            n_steps,
            ent_coef,
            target_update_interval,
            target_entropy,
            use_sde,
            sde_sample_freq,
            use_sde_at_warmup,
            stats_window_size,
            tensorboard_log,
            policy_kwargs,
            verbose,
            seed,
            device,
            _init_setup_model=False,
        )
        self.preset = preset
        self.dynamics_backend = dynamics
        self.dynamics_kwargs = dict(dynamics_kwargs or {})
        self.declared = tuple(declared)
        self.weighting = weighting
        self.weight_floor = weight_floor
        self.real_ratio = real_ratio
        self.rollout_start: RolloutStart = rollout_start
        self.source_steps = source_steps
        self.model_train_freq = model_train_freq

        self.target_env: VecEnv | None = None
        self.dynamics: Dynamics | None = None
        self.dynamics_config: dict[str, Any] | None = None
        self.source_timesteps = 0
        self.target_spent: dict[str, int] = {}
        #: policies to go back to, by name: "source" (as it came) and "best" (highest recent target return)
        self.snapshots: dict[str, dict[str, Any]] = {}
        self.best_mean_reward = -np.inf
        self._offline = target_data is not None
        self._warm = False
        self._pretraining = False
        self._pretrained_steps = 0
        self._actor_updates = 0
        self._collected = 1
        self._since_fit = 0
        self._source_world: EpisodeSource | BranchSource | None = None
        self._source_first_obs: np.ndarray | None = None
        self._null_check: NullShiftCheck | None = None
        self._callback: BaseCallback | None = None
        self._rollout_start = 0
        self._resume_state: dict[str, Any] | None = None

        if _init_setup_model:
            self._apply_preset()
            self._check_arguments(close_loop)
            if self.env is not None and self.updates_dynamics:
                self.dynamics_config = dynamics_config(
                    self.dynamics_backend, self.env, self.dynamics_kwargs, self.declared
                )
            self._setup_model()
            if target_env is not None:
                self.set_target_env(target_env)
            if target_data is not None:
                warm.fill_target(self, target_data)

    # ------------------------------------------------------------------ setting up

    def _apply_preset(self) -> None:
        backend = self.dynamics_backend if self.updates_dynamics else "real"
        spec = None if self.env is None else self.env.get_attr("spec", indices=[0])[0]
        for name, value in resolve_preset(
            self.preset, backend, spec.id if spec else None, self._passed - {"dynamics_kwargs"}
        ).items():
            if name == "dynamics_kwargs":
                value = {**value, **self.dynamics_kwargs}
            setattr(self, name, value)

    def _check_arguments(self, close_loop: bool) -> None:
        """Refuse what cannot work, before anything expensive.

        :raises ValueError: naming the argument and the remedy
        """
        if close_loop:
            raise NotImplementedError("close_loop=True needs the effect tracer, which this version does not have yet")
        if isinstance(self.replay_buffer_class, type) and issubclass(self.replay_buffer_class, UNSUPPORTED_BUFFERS):
            raise NotImplementedError(f"replay_buffer_class={self.replay_buffer_class.__name__} is not supported")
        inapplicable = self._passed & self._inapplicable()
        if inapplicable:
            raise ValueError(f"{type(self).__name__} does not use {sorted(inapplicable)}; leave them out or use RPTO")
        for name, value, choices in (
            ("dynamics", self.dynamics_backend, BACKENDS),
            ("weighting", self.weighting, (*WEIGHTINGS, None)),
            ("rollout_start", self.rollout_start, ("target", "source", "mix")),
        ):
            if value not in choices:
                raise ValueError(f"{name}={value!r} does not exist; choose one of {list(choices)}")
        if not 0 <= self.real_ratio < 1:
            raise ValueError(f"real_ratio must lie in [0, 1), got {self.real_ratio}")
        if self.weight_floor < 0:
            raise ValueError(f"weight_floor must not be negative, got {self.weight_floor}")
        for name in ("source_steps", "model_train_freq"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a positive integer, got {value!r}")

    @classmethod
    def _inapplicable(cls) -> set[str]:
        """Arguments of this class's signature that the algorithm has no use for."""
        if cls.updates_dynamics:
            return set()
        return {
            "target_data",
            "dynamics",
            "dynamics_kwargs",
            "declared",
            "weighting",
            "weight_floor",
            "rollout_start",
            "model_train_freq",
        }

    def _setup_model(self) -> None:
        """Build networks, buffers and dynamics from the spaces alone: ``load()`` has no environment."""
        check_spaces(self.observation_space, self.action_space)
        # SB3 builds the buffer from these two attributes; the user's choice applies to each side.
        chosen = self.replay_buffer_class, self.replay_buffer_kwargs
        sides = {} if chosen[0] in (None, DualReplayBuffer) else {"side_class": chosen[0]}
        own = {name: value for name, value in chosen[1].items() if name == "target_size"}
        side_kwargs = {name: value for name, value in chosen[1].items() if name not in own}
        self.replay_buffer_class = DualReplayBuffer
        self.replay_buffer_kwargs = {**sides, **own, "side_kwargs": side_kwargs}
        super()._setup_model()
        self.replay_buffer_class, self.replay_buffer_kwargs = chosen
        if self.dynamics_config is not None:
            self.dynamics = make_dynamics(self.dynamics_config, self.observation_space, self.action_space).to(
                self.device
            )
            if self.seed is not None:
                self.dynamics.seed(self.seed + DYNAMICS_SEED_OFFSET)

    def set_target_env(self, env: GymEnv | str) -> None:
        """Set the target; the next ``learn()`` starts a new episode there.

        :param env: an environment, a VecEnv or an id
        :raises ValueError: when it is the source itself, has other spaces, or cannot be reset with a seed
        """
        if isinstance(env, str):
            env = gym.make(env)
        check_seedable(env, "target_env")
        venv = self._wrap_env(env, self.verbose)
        if self.env is not None:
            check_pair(self.env, venv)
        self.target_env = share_normalisation(TargetLedger(venv, self.target_spent), self.env)
        self._offline = False
        self._last_obs = None
        if self.seed is not None:
            self.target_env.seed(self.seed + TARGET_SEED_OFFSET)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the source environment, as in SB3; the target keeps sharing its normalisation."""
        last_obs = self._last_obs
        super().set_env(env, force_reset)
        self._last_obs = last_obs  # SB3 forgets the observation of what it takes to be the training env
        self._source_world = None
        if self.env is not None and self.target_env is not None:
            check_pair(self.env, find_ledger(self.target_env))
            self.target_env = share_normalisation(find_ledger(self.target_env), self.env)

    def get_vec_normalize_env(self) -> VecNormalize | None:
        """The source's VecNormalize, which learns the statistics, also while SB3 collects in the target."""
        return None if self.env is None else unwrap_vec_normalize(self.env)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed both worlds and the model, each with its own stream; with None nothing is seeded."""
        super().set_random_seed(seed)
        if seed is None:
            return
        if self.target_env is not None:
            self.target_env.seed(seed + TARGET_SEED_OFFSET)
        if self.dynamics is not None:
            self.dynamics.seed(seed + DYNAMICS_SEED_OFFSET)

    @classmethod
    def from_source(
        cls: type[Self],
        source_model: SAC | str | pathlib.Path,
        env: GymEnv | str,
        target_env: GymEnv | str | None = None,
        *,
        source_data: ReplayBuffer | str | pathlib.Path | None = None,
        **kwargs: Any,
    ) -> Self:
        """Warm start from a SAC trained in the source: actor, critics, their targets and the temperature.

        :param source_model: the SAC model or its zip
        :param env: the source environment
        :param target_env: the target
        :param source_data: transitions of the source (buffer, pickle or ``.npz``); D_source starts with them and the
            dynamics' phi_0 is fitted to them, instead of to fresh source steps
        :param kwargs: constructor arguments; they win over the source model's and the preset's
        :raises ValueError: when the source model's spaces are not the environment's
        """
        return warm.from_source(cls, source_model, env, target_env, source_data, kwargs)

    # ------------------------------------------------------------------ Algorithm 1

    def learn(
        self: Self,
        total_timesteps: int = 10_000,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        source_timesteps: int | None = None,
    ) -> Self:
        """Transfer the policy: Algorithm 1 (RPTO), or the part of it that the class stands for.

        :param total_timesteps: budget of TARGET steps (with ``target_data``: of source steps); never exceeded
        :param callback: as in SB3; called once per target step
        :param log_interval: target episodes between two logs
        :param tb_log_name: name of the TensorBoard run, by default the class's name
        :param reset_num_timesteps: whether ``total_timesteps`` counts from zero
        :param progress_bar: show one bar for the source phase and one for the target
        :param source_timesteps: source steps that train a model which is neither warm-started nor trained before;
            default 10 x ``total_timesteps``, at most 300,000; 0 skips the phase
        :raises ValueError: without a target, or for a budget that is not positive
        """
        self._check_ready(total_timesteps, source_timesteps)
        if source_timesteps is None:
            source_timesteps = min(10 * total_timesteps, 300_000)
        if reset_num_timesteps:
            self._resume_state = None
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        self._source_world = self._source_world or self._make_source_world()
        warm.begin_in_source(self, source_timesteps, progress_bar)
        inside_rollout = checkpoint.resume(self)
        self._callback = callback
        callback.on_training_start(locals(), globals())
        while self._steps_left() > 0 or inside_rollout:
            if inside_rollout:  # a callback's checkpoint: steps 3 and 4 were done, their update was not
                inside_rollout, self._collected = False, self.num_timesteps - self._rollout_start
            else:
                self.interact_with_source()
                if not self.interact_with_target(callback, log_interval):
                    break
            updates = self.gradient_steps if self.gradient_steps >= 0 else 1  # SB3: negative means one a step
            self.train(self._collected * updates, self.batch_size)
            self.fit_dynamics()
        callback.on_training_end()
        self._callback = None
        return self

    def interact_with_source(self) -> None:
        """Step 3: act in the source P_phi, ``source_steps`` times for each target step, and fill D_source."""
        if self.use_sde:
            self.actor.reset_noise()
        assert self._source_world is not None  # set by begin_in_source
        self.source_timesteps += self._source_world.interact(self, self._collected * int(self.source_steps))

    def interact_with_target(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step 4: act in the target and fill D_target; SB3's own code collects, within the budget.

        Without a target environment (``target_data``) this only counts the source steps that were just taken.

        :return: whether to go on
        """
        if self._offline:
            return self._count_source_steps(callback)
        assert self.target_env is not None
        assert isinstance(self.train_freq, TrainFreq)
        n_envs, ledger = self.target_env.num_envs, find_ledger(self.target_env)
        whole_episodes = self.train_freq.unit == TrainFrequencyUnit.EPISODE
        source_normaliser, self._vec_normalize_env = self._vec_normalize_env, unwrap_vec_normalize(self.target_env)
        taken = episodes = 0
        self._rollout_start = self.num_timesteps
        try:
            while True:
                steps = 1 if whole_episodes else min(self.train_freq.frequency, self._steps_left() // n_envs)
                with ledger.spending("learning", steps * n_envs):
                    rollout = self.collect_rollouts(
                        self.target_env,
                        callback,
                        TrainFreq(steps, TrainFrequencyUnit.STEP),
                        self.replay_buffer,
                        action_noise=self.action_noise,
                        log_interval=log_interval,
                    )
                if not rollout.continue_training:
                    self.store_step(callback.locals)  # SB3 drops the step after which a callback stops
                taken, episodes = taken + rollout.episode_timesteps, episodes + rollout.n_episodes
                finished = not whole_episodes or episodes >= self.train_freq.frequency or self._steps_left() == 0
                if finished or not rollout.continue_training:
                    break
        finally:
            self._vec_normalize_env = source_normaliser
            self.target_spent = dict(ledger.spent)
        self._collected = taken
        return rollout.continue_training

    # ------------------------------------------------------------------ bookkeeping around SB3

    def _steps_left(self) -> int:
        """Steps of the budget that can still be taken; 0 when fewer are left than the target has environments."""
        left = self._total_timesteps - self.num_timesteps
        width = 1 if self._offline or self.target_env is None else self.target_env.num_envs
        return left if left >= width else 0

    def _check_ready(self, total_timesteps: int, source_timesteps: int | None) -> None:
        if self.env is None:
            raise ValueError("learn() needs the source environment: pass env= to load(), or call set_env()")
        if self.target_env is None and not self._offline:
            raise ValueError(
                "learn() needs the target: pass target_env= (an environment to interact with) or target_data= "
                "(recorded transitions, RTO and RPTO) to the constructor, or call set_target_env()"
            )
        if total_timesteps <= 0:
            raise ValueError(f"total_timesteps must be positive, got {total_timesteps}")
        if self.target_env is not None and total_timesteps < self.target_env.num_envs:
            raise ValueError(
                f"total_timesteps={total_timesteps} is less than one step of target_env's {self.target_env.num_envs} "
                "environments; raise it or use fewer"
            )
        if source_timesteps is not None and source_timesteps < 0:
            raise ValueError(f"source_timesteps must not be negative, got {source_timesteps}")
        if self._offline and self.weighting is not None and not self.replay_buffer.target.rewards.any():
            raise ValueError("target_data holds no rewards, which RTO's weight needs; pass weighting=None")
        if self.target_env is not None and total_timesteps > self.replay_buffer.target.buffer_size:
            warnings.warn(
                f"D_target holds {self.replay_buffer.target.buffer_size} transitions, fewer than the budget of "
                f'{total_timesteps}; pass replay_buffer_kwargs={{"target_size": ...}} to keep them all',
                stacklevel=3,
            )

    def _make_source_world(self) -> EpisodeSource | BranchSource:
        assert self.env is not None
        if self.dynamics is None:
            return EpisodeSource(self.env)
        if self.dynamics.rollout == "branches":
            return BranchSource(self.dynamics, self.rollout_start)
        modelled = DynamicsVecEnv(self.dynamics, self.env, num_envs=int(self.source_steps))
        return EpisodeSource(share_normalisation(modelled, self.env))

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
        noise, self.action_noise = self.action_noise, None  # SB3 would size it by the source
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self.action_noise = noise
        if starts_episode:
            self._source_world, self._source_first_obs = None, self._last_obs  # SB3 has just reset the source
            if noise is not None and self._resume_state is None:
                noise.reset()
        if self._offline:
            self._last_obs = np.zeros((1, *self.observation_space.shape), self.observation_space.dtype)  # never read
        elif starts_episode:
            assert self.env is not None  # _check_ready has seen both
            assert self.target_env is not None
            n_envs = self.target_env.num_envs
            if noise is not None and n_envs > 1 and not isinstance(noise, VectorizedActionNoise):
                self.action_noise = VectorizedActionNoise(noise, n_envs)
            self._last_obs = np.asarray(self.target_env.reset())
            self._last_episode_starts = np.ones(n_envs, dtype=bool)
            normaliser = unwrap_vec_normalize(self.target_env)
            self._last_original_obs = None if normaliser is None else np.asarray(normaliser.get_original_obs())
            check_finite("target", observation=self._last_obs)
            if self.num_timesteps == 0:
                self._null_check = NullShiftCheck(self.env, find_ledger(self.target_env).venv)
        return total_timesteps, callback

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
        check_finite("target", observation=np.asarray(new_obs), reward=reward)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        assert self.target_env is not None
        find_ledger(self.target_env).unstored = False
        if self._null_check is not None:
            side = self.replay_buffer.target
            answer = side.next_observations[(side.pos - len(dones)) % side.buffer_size, 0]
            if self._null_check.agrees(self.policy.unscale_action(buffer_action[:1]), answer, bool(dones[0])):
                warnings.warn(
                    "target_env has stepped exactly like env so far: is it the world you meant? (Nothing to transfer.)",
                    stacklevel=2,
                )
        judged = self.updates_policy and self.best_by == "training" and any("episode" in info for info in infos)
        if judged and self.ep_info_buffer is not None:
            recent = [info["r"] for info in list(self.ep_info_buffer)[-RECENT_EPISODES:]]
            if len(recent) == RECENT_EPISODES:
                self.keep_if_best(float(np.mean(recent)))

    def store_step(self, step: dict[str, Any]) -> None:
        """Finish a target step as SB3 does after its callback, where SB3 itself does not get to it.

        :param step: the locals of SB3's collection that ``checkpoint.STEP`` names
        """
        assert self.target_env is not None
        normaliser, self._vec_normalize_env = self._vec_normalize_env, unwrap_vec_normalize(self.target_env)
        self._update_info_buffer(step["infos"], step["dones"])
        self._store_transition(self.replay_buffer, *(step[name] for name in checkpoint.STEP))
        self._vec_normalize_env = normaliser
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        for i in np.flatnonzero(step["dones"]):
            self._episode_num += 1
            if self.action_noise is not None:
                self.action_noise.reset(**({"indices": [i]} if len(step["dones"]) > 1 else {}))

    def _count_source_steps(self, callback: BaseCallback) -> bool:
        """What stands in for a target step when the target is a log: ``num_timesteps`` counts source steps."""
        self.num_timesteps += int(self.source_steps)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        callback.update_locals(locals())
        return callback.on_step()

    def dump_logs(self) -> None:
        """SB3's log plus what the source spent and earned."""
        self.logger.record("time/source_timesteps", self.source_timesteps, exclude="tensorboard")
        if self._source_world is not None:
            for name, value in self._source_world.log().items():
                self.logger.record(f"source/{name}", value)
        super().dump_logs()

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        """As SB3's, with what counts environments counting the target's, not the source's."""
        judged_by, self.best_by = self.best_by, "training"
        callbacks = super()._init_callback(callback, progress_bar)
        if self.best_by != judged_by:  # by a callback, or no longer: the two measures cannot be compared
            self.best_mean_reward = -np.inf
        for item in _flatten(callbacks):
            if isinstance(item, ProgressBarCallback):
                item.__class__ = TargetProgressBar
            elif isinstance(item, StopTrainingOnMaxEpisodes) and self.target_env is not None:
                item._total_max_episodes = item.max_episodes * self.target_env.num_envs
        return callbacks


class TargetProgressBar(ProgressBarCallback):
    """SB3's progress bar, advancing by the steps that count: those of ``num_timesteps``."""

    def _on_step(self) -> bool:
        self.pbar.update(self.model.num_timesteps - self.model._num_timesteps_at_start - self.pbar.n)
        return True


def _flatten(callback: BaseCallback) -> list[BaseCallback]:
    if isinstance(callback, CallbackList):
        return [item for child in callback.callbacks for item in _flatten(child)]
    return [callback]
