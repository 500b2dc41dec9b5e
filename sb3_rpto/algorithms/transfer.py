"""SAC over two worlds: everything that RPO, RTO and RPTO share."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Sequence
from typing import Any, Literal, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_rpto.algorithms import (
    argument_ranges,
    arguments,
    dynamics_arguments,
    normalisation,
    plain_sac,
    run_state,
    warm_start,
)
from sb3_rpto.algorithms.callback_adapters import check_callbacks
from sb3_rpto.algorithms.closed_loop.controller import LoopCloser, trace_log
from sb3_rpto.algorithms.closed_loop.looping import Looping
from sb3_rpto.algorithms.rollouts import RolloutStart, SourceWorld, make_source_world, try_source
from sb3_rpto.algorithms.target import check_environment, check_spaces, find_ledger
from sb3_rpto.algorithms.two_env_sac import DYNAMICS_SEED_OFFSET
from sb3_rpto.algorithms.validation import doubt_returns
from sb3_rpto.buffers import DualReplayBuffer
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.factory import dynamics_config, make_dynamics, preset_section
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.weights import WeightingName
from sb3_rpto.envs.env_copy import EnvSource, make_env
from sb3_rpto.envs.task_rules import env_id
from sb3_rpto.presets import resolve_preset
from sb3_rpto.sysid import Measurements

Self = TypeVar("Self", bound="TransferAlgorithm")


class TransferAlgorithm(Looping):
    """Base of :class:`RPO`, :class:`RTO` and :class:`RPTO`; use one of those.

    Here are the constructor and the loop of Algorithm 1 with steps 3 and 4. What it stands on, from SAC up: the updates
    of steps 5 and 6 (:class:`~sb3_rpto.algorithms.update.RelativeUpdate`), policies to go back to
    (:class:`~sb3_rpto.algorithms.policy_snapshots.PolicySnapshots`), the two environments and SB3's accounts of them
    (:class:`~sb3_rpto.algorithms.two_env_sac.TwoWorlds`), files
    (:class:`~sb3_rpto.algorithms.checkpointing.Resumable`), and the closed loop's part
    (:class:`~sb3_rpto.algorithms.closed_loop.looping.Looping`).

    The arguments up to ``device`` are SAC's, with SAC's defaults, except that ``gradient_steps`` counts updates per
    TARGET step and ``learning_starts`` applies to the source alone (no random action is ever taken in the target).

    :param target_env: the scarce world, an environment, a VecEnv, an id or a function that makes one; ``learn()``
        needs it or ``target_data``
    :param target_data: the target recorded beforehand, in place of ``target_env`` (RTO and RPTO): transitions (a replay
        buffer, its pickle or an ``.npz``), or :class:`~sb3_rpto.sysid.Measurements` of a robot, on the joints and
        actuators of ``env``'s MuJoCo model. D_target then holds the steps that ``env`` would have taken there
        (:func:`~sb3_rpto.algorithms.offline_target.transitions`), and with ``dynamics="physical"`` phi comes from one
        :func:`~sb3_rpto.sysid.trace` of the recordings, at the start of ``learn()``, in place of one-step fits
    :param preset: hyperparameters for what is not passed: "default", "paper" or "author"
    :param dynamics: backend of the trainable source: "ensemble" (networks), "physical" (a simulator with trainable
        numbers) or "residual" (that simulator and a small ensemble on what it still misses)
    :param dynamics_kwargs: further arguments of the backend; ``max_steps`` bounds every fit, also the first, of phi_0
    :param declared: names of the physical parameters to fit (physical backend)
    :param close_loop: trace on D_target what the simulator lacks beside the declared numbers, add it to phi and go on
        (``dynamics="physical"`` on MuJoCo); a list looks for effects of these kinds alone, an empty one for
        none, so that the declared numbers are traced and the policy learns on. The reports are in
        ``model.loop.reports`` (with Measurements also where only the declared numbers are fitted)
    :param retrain_steps: source steps after a trace, at most: in the corrected simulator, before the next target step,
        as long as the policy gets better there; eight of them for each update with the default preset
    :param weighting: RTO's weight: "paper", "centred", "value_aware", or None (plain supervised learning)
    :param weight_floor: epsilon of the paper: the smallest weight, above 0 or equal to it
    :param real_ratio: share of target transitions in the critic's batches, in [0, 1); 0 in the paper, and
        where the target is a robot's log that the simulator accounts for
    :param rollout_start: where one-step branches start: "target", "source" or "mix"
    :param source_steps: source transitions per target step, and in how many copies of a simulator they are taken;
        "auto" leaves it to the preset
    :param model_train_freq: target steps between two fits of the dynamics
    :raises ValueError: for an unknown preset, backend, weighting or start, a value out of range, a target equal to the
        source or with other spaces
    :raises NotImplementedError: for Dict, image or discrete spaces, observations or actions that are not flat, n-step
        returns and HER
    """

    #: ``num_timesteps`` where the target rollout under way began
    _rollout_began_at: int

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Remember which arguments the user passed: a preset fills in only the others.

        :raises TypeError: for an argument that does not exist
        """
        arguments.check_names(cls, kwargs)
        self = super().__new__(cls)
        positional = list(inspect.signature(TransferAlgorithm.__init__).parameters)[1:]
        self._passed = frozenset(positional[: len(args)]) | frozenset(kwargs)
        return self

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: EnvSource,
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
        target_env: EnvSource | None = None,
        target_data: ReplayBuffer | str | pathlib.Path | Measurements | None = None,
        preset: str = "default",
        dynamics: Literal["ensemble", "physical", "residual"] = "ensemble",
        dynamics_kwargs: dict[str, Any] | None = None,
        declared: Sequence[str] = (),
        close_loop: bool | Sequence[str] = False,
        retrain_steps: int = 320_000,
        weighting: WeightingName | None = "paper",
        weight_floor: float = 0.5,
        real_ratio: float = 0.05,
        rollout_start: RolloutStart = "mix",
        source_steps: int | Literal["auto"] = "auto",
        model_train_freq: int = 250,
    ) -> None:
        self._passed |= arguments.set_among(TransferAlgorithm.__init__, locals())  # by a subclass's __init__, too
        argument_ranges.check_given(locals())
        if env is not None:  # SB3's load() builds the object before it has an env
            env = make_env(env)
            check_environment(env, "env")
            check_spaces(env.observation_space, env.action_space)
        arguments.check_one_target(target_env, target_data)
        arguments.check_supported(n_steps, optimize_memory_usage, replay_buffer_class)
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
        self.dynamics_kwargs = arguments.plain_effects(dynamics_kwargs or {})
        self.fit_bound = self.dynamics_kwargs.get("max_steps")
        self.declared = arguments.list_of_names(declared)
        self.close_loop, self.retrain_steps = close_loop, retrain_steps
        #: traces what the simulator lacks, and holds the reports; None with the loop open and no log to trace on
        self.loop = None if close_loop is False else LoopCloser(self.declared, close_loop)
        self.weighting = weighting
        self.weight_floor = weight_floor
        self.real_ratio = real_ratio
        self.rollout_start: RolloutStart = rollout_start
        self.source_steps = source_steps
        self.model_train_freq = model_train_freq

        self.target_env = None
        self.target_spent = {}
        self.source_timesteps = 0
        self.dynamics = None
        self.dynamics_config = None
        self.snapshots = {}
        self.best_mean_reward = -np.inf
        self._offline = target_data is not None
        #: the log that stands in for the target; a checkpoint does not hold it
        self.measured = target_data if isinstance(target_data, Measurements) else None
        self._traces_log = False
        self._warm = False
        self._pretraining = False
        self._pretrained_steps = 0
        self._actor_updates = 0
        self._collected = 1
        self._source_due = 0
        self._since_fit = 0
        self._rollout_began_at = 0
        self._round_open = False
        self._source_world = self._source_first_obs = None
        self._null_check = None
        self._has_target_rules = False
        self._callback = None
        self._resume_state = None
        self._new_seed = None

        if _init_setup_model:
            self._apply_preset()
            self._check_arguments()
            if self.env is not None and self.updates_dynamics:
                self.dynamics_config = dynamics_config(
                    self.dynamics_backend, self.env, self.dynamics_kwargs, self.declared
                )
                traces_log = self.measured is not None
                dynamics_arguments.check_kinds(self.close_loop)
                dynamics_arguments.check_backend(self.dynamics_config, self.close_loop, traces_log, self._passed)
                dynamics_arguments.check_something_to_fit(self.dynamics_config, self.close_loop, traces_log)
                dynamics_arguments.check_carried(self.env, self.close_loop)
                dynamics_arguments.check_rules(self.dynamics_kwargs, self.observation_space, self.action_space)
            self._setup_model()
            if self.env is not None:
                try_source(self.env, self.dynamics, self.weighting == "value_aware")
            if target_env is not None:
                self.set_target_env(target_env)
            if self.measured is not None and isinstance(self.dynamics, PhysicalDynamics):
                self._traces_log = True
                self.loop = self.loop or LoopCloser(self.declared, kinds=False)
            if target_data is not None:
                warm_start.fill_target(self, target_data)
                self._since_fit = self.model_train_freq  # all data are there: the first fit need not wait

    # ------------------------------------------------------------------ setting up

    def _apply_preset(self) -> None:
        """Set what the user did not pass; of ``dynamics_kwargs``, which both may give, the entries passed win."""
        backend = preset_section(self.dynamics_backend if self.updates_dynamics else None, self.env)
        source_id = None if self.env is None else env_id(self.env)
        passed = self._passed - {"dynamics_kwargs"} - ({"source_steps"} if self.source_steps == "auto" else set())
        for name, value in resolve_preset(self.preset, backend, source_id, passed).items():
            if name == "dynamics_kwargs":
                value = {**value, **self.dynamics_kwargs}
            setattr(self, name, value)

    def _check_arguments(self) -> None:
        arguments.check_applicable(type(self).__name__, self.updates_dynamics, self._passed)
        if self._offline:
            arguments.check_offline(self._passed)
        arguments.check_values_of(self)

    def _setup_model(self) -> None:
        """Build networks, buffers and dynamics from the spaces alone: ``load()`` has no environment."""
        check_spaces(self.observation_space, self.action_space)
        # SB3 builds the buffer from these two attributes; the user's choice applies to each side.
        side_class, kwargs = self.replay_buffer_class, self.replay_buffer_kwargs
        saved = (self._resume_state or {}).get("target_size")  # while a checkpoint is loaded
        kwargs = {**({} if saved is None else {"target_size": saved}), **kwargs}
        own: dict[str, Any] = {name: value for name, value in kwargs.items() if name == "target_size"}
        own["side_kwargs"] = {name: value for name, value in kwargs.items() if name != "target_size"}
        if side_class not in (None, DualReplayBuffer):
            own["side_class"] = side_class
        self.replay_buffer_class, self.replay_buffer_kwargs = DualReplayBuffer, own
        super()._setup_model()
        self.replay_buffer_class, self.replay_buffer_kwargs = side_class, kwargs
        if self.dynamics_config is not None:
            self.dynamics = self._make_dynamics(self.dynamics_config).to(self.device)
            if self.seed is not None:
                self.dynamics.seed(self.seed + DYNAMICS_SEED_OFFSET)

    def _make_dynamics(self, config: dict[str, Any]) -> Dynamics:
        """The trainable source that :func:`~sb3_rpto.dynamics.factory.dynamics_config` describes."""
        return make_dynamics(config, self.observation_space, self.action_space)

    def _make_source_world(self) -> SourceWorld:
        """The world that step 3 acts in."""
        assert self.env is not None  # learn() has checked
        if self.dynamics is not None and self.weighting == "value_aware":  # which asks for single steps
            self.dynamics.attach(self.env)
        return make_source_world(self.env, self.dynamics, self.rollout_start, int(self.source_steps))

    @classmethod
    def from_source(
        cls: type[Self],
        source_model: SAC | str | pathlib.Path,
        env: EnvSource,
        target_env: EnvSource | None = None,
        *,
        source_data: ReplayBuffer | str | pathlib.Path | None = None,
        vec_normalize: normalisation.Statistics = None,
        weights_only: bool = False,
        **kwargs: Any,
    ) -> Self:
        """Warm start from a SAC trained in the source: actor, critics, their targets and the temperature.

        :param source_model: the SAC model or its zip
        :param env: the source environment
        :param target_env: the target
        :param source_data: transitions of the source (buffer, pickle or ``.npz``); D_source starts with them and the
            dynamics' phi_0 is fitted to them, instead of to fresh source steps
        :param vec_normalize: by which the source model saw observations, or the file that its ``save()`` wrote: ``env``
            is put into a VecNormalize with these statistics. None: those beside the zip, which is said; False: none
        :param weights_only: read the zip without running a pickle of it, which may do anything: for a stranger's
            (:func:`~sb3_rpto.algorithms.plain_sac.sac_of_weights`); statistics beside it are not read, either
        :param kwargs: constructor arguments; they win over the source model's and the preset's
        :raises ValueError: when the source model's spaces are not the environment's, or ``vec_normalize`` is not of it
        """
        env = make_env(env)
        check_environment(env, "env")
        argument_ranges.check_given(kwargs)
        device = kwargs.get("device", "auto")
        if weights_only:
            sac = plain_sac.sac_of_weights(source_model, env, kwargs.get("policy_kwargs"), device)
        else:
            sac = warm_start.load_sac(source_model, device)
        warm_start.check_source_spaces(sac, env)
        env, statistics = normalisation.as_learned(sac, source_model, env, vec_normalize, unpickle=not weights_only)
        given = {**plain_sac.carried_arguments(sac), **kwargs}
        model = cls(cast(type[SACPolicy], sac.policy_class), env, target_env=target_env, **given)
        # "auto" asks for a learned temperature, a number or "auto_0.5" for that one.
        warm_start.carry_over(sac, model, temperature=kwargs.get("ent_coef", "auto") == "auto")
        if not normalisation.check_source_model(sac, statistics, model.get_vec_normalize_env()):
            doubt_returns(sac, env)
        if source_data is not None:
            warm_start.fill_source(model, source_data)
        return model

    # ------------------------------------------------------------------ Algorithm 1

    def learn(
        self: Self,
        total_timesteps: int = 10_000,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        source_timesteps: int | None = None,
    ) -> Self:
        """Transfer the policy: Algorithm 1 (RPTO), or the part of it that the class stands for.

        :param total_timesteps: budget of TARGET steps, never exceeded (with ``target_data``: of source steps, and
            all copies take their last one)
        :param callback: as in SB3; called once per target step
        :param log_interval: target episodes between two logs; None logs nothing
        :param tb_log_name: name of the TensorBoard run, by default the class's name
        :param reset_num_timesteps: whether ``total_timesteps`` counts from zero
        :param progress_bar: show one bar for the source phase and one for the target
        :param source_timesteps: source steps that train a model which is neither warm-started nor trained before;
            default 10 x ``total_timesteps``, at most 300,000; 0 skips the phase
        :raises ValueError: what :func:`~sb3_rpto.algorithms.arguments.check_ready` refuses, such as no target
        """
        arguments.check_ready(
            self,
            total_timesteps,
            source_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
        if source_timesteps is None:
            source_timesteps = min(10 * total_timesteps, 300_000)
        if not self._warm:
            arguments.warn_of_idle_source_phase(self, source_timesteps)
        self._store_step_cut_off()
        if reset_num_timesteps and self._warm:  # else the source phase goes on all the same
            run_state.leave(self)
        run_state.resume_unbegun(self)
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        check_callbacks(callback, self.env, self.target_env)
        self._source_world = self._source_world or self._make_source_world()
        trace_log(self)  # first of all: the log may be refused
        if not self._warm:
            run_state.resume_source_phase(self)
        self.begin_in_source(source_timesteps, progress_bar)
        run_state.resume(self)
        if self.loop is not None:
            self.loop.begin(self)
        self._watch_for_null_shift()
        self._callback = callback
        callback.on_training_start(locals(), globals())
        self._finish_open_round(forget=reset_num_timesteps)
        while self._steps_left() > 0:
            if not self._round_open:
                self.interact_with_source()  # step 3
            self._round_open = True
            if not self.interact_with_target(callback, log_interval):  # step 4
                break
            self.update()  # steps 5 and 6
        if self.loop is not None and (self._offline or self._steps_left() <= 0):
            self.loop.finish(self)
        callback.on_training_end()
        self._callback = None
        return self

    def _finish_open_round(self, forget: bool) -> None:
        """Make up for the steps 5 and 6 before which the last run was stopped or saved; step 3 is not done twice.

        :param forget: a new run begins
        """
        if forget:
            self._round_open, self._source_due = False, 0
        if self._round_open and not self._offline:
            taken = self.num_timesteps - self._rollout_began_at
            if not taken:
                return
            self._collected = taken
        if self._round_open:
            self.update()

    def begin_in_source(self, source_timesteps: int, progress_bar: bool) -> None:
        """What Algorithm 1 takes as its input: a policy, its critic and phi_0 that know the source.

        :param source_timesteps: source steps that train a model which knows nothing of the source
        :param progress_bar: show a bar for them
        """
        warm_start.begin_in_source(self, source_timesteps, progress_bar)

    def interact_with_source(self) -> None:
        """Step 3: act in the source P_phi, ``source_steps`` times for each target step, and fill D_source."""
        assert self._source_world is not None  # learn() has made it
        if not self.learns_at_fits() and (n_steps := self._source_steps_to_take()) > 0:
            self._source_due -= self._source_world.interact(self, n_steps)

    def interact_with_target(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step 4: act in the target and fill D_target; SB3's own code collects, within the budget.

        Without a target environment (``target_data``) this only counts the source steps that were just taken.

        :return: whether to go on
        """
        if self._offline:
            return self._count_source_steps(callback)
        assert self.target_env is not None
        length, ledger = self._rollout_length(), find_ledger(self.target_env)
        allowance = length.frequency * self.target_env.num_envs
        self._rollout_began_at = self.num_timesteps
        with self._targets_normalisation(), ledger.spending("learning", allowance):
            rollout = self.collect_rollouts(
                self.target_env,
                callback,
                length,
                self.replay_buffer,
                action_noise=self.action_noise,
                log_interval=log_interval,
            )
        if not rollout.continue_training:
            self.store_step(callback.locals)  # SB3 drops the step after which a callback stops
        self._collected = rollout.episode_timesteps
        return rollout.continue_training

    def dump_logs(self) -> None:
        """SB3's log plus what the source spent and earned."""
        self.logger.record("time/source_timesteps", self.source_timesteps, exclude="tensorboard")
        if self._source_world is not None:
            for name, value in self._source_world.log().items():
                self.logger.record(f"source/{name}", value)
        super().dump_logs()
