"""Algorithm 1 of the paper over SAC with two environments: everything that RPO, RTO and RPTO share."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.policies import SACPolicy

from sb3_rpto.algorithms import (
    argument_ranges,
    arguments,
    batches,
    checkpointing,
    losses,
    normalisation,
    plain_sac,
    pretraining,
    recorded_data,
    rto,
    warm_start,
)
from sb3_rpto.algorithms.callback_adapters import check_callbacks
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop, OpenLoop
from sb3_rpto.algorithms.environment_checks import check_environment, check_spaces
from sb3_rpto.algorithms.fast_update import ManualUpdate, OptimizerSteps, PolyakAverage, supports_manual_gradients
from sb3_rpto.algorithms.interfaces import LoopController, SourceRollouts, Target
from sb3_rpto.algorithms.rollouts import RolloutStart, make_rollouts, try_source
from sb3_rpto.algorithms.target import OfflineTarget, OnlineTarget
from sb3_rpto.algorithms.target_checks import check_fit, check_machine, check_simulator
from sb3_rpto.algorithms.two_env_sac import TwoEnvSAC
from sb3_rpto.algorithms.validation import doubt_returns
from sb3_rpto.buffers import World, chronological
from sb3_rpto.dynamics.base import Dynamics, Transitions
from sb3_rpto.dynamics.factory import dynamics_config, is_mujoco, make_dynamics, preset_section
from sb3_rpto.dynamics.matmul_precision import fast_products
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.weights import WeightingName, rto_weights
from sb3_rpto.envs.env_copy import EnvSource, make_env
from sb3_rpto.envs.task_rules import env_id
from sb3_rpto.presets import resolve_preset
from sb3_rpto.sysid import Measurements

Self = TypeVar("Self", bound="TransferAlgorithm")

#: The dynamics' random stream is the seed plus this.
DYNAMICS_SEED_OFFSET = 20_000


class TransferAlgorithm(TwoEnvSAC):
    """Base of :class:`RPO`, :class:`RTO` and :class:`RPTO`; use one of those.

    It is composed of parts: ``dynamics`` (P_phi), ``rollouts`` (the source that step 3 acts in), ``target`` (where
    D_target comes from), ``loop`` (the closed loop around it), ``snapshots`` (policies to go back to) and ``state``
    (what the run counts).

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
        (``dynamics="physical"`` on MuJoCo). The reports are in ``model.loop.reports`` (with Measurements also where
        only the declared numbers are fitted)
    :param effects: what a closed loop looks for: "all" of the library, or a list of kinds; with an empty one the
        declared numbers alone are traced, and the policy learns on
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

    #: whether step 6 of Algorithm 1 applies RPO, and whether it applies RTO
    updates_policy: ClassVar[bool]
    updates_dynamics: ClassVar[bool]
    #: names of the arguments that the user passed
    given_arguments: frozenset[str]
    target_entropy: float  # SAC's setup has replaced "auto"
    weighting: WeightingName | None
    rollout_start: RolloutStart
    #: source transitions per target step; an integer once the preset is applied
    source_steps: Any

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Remember which arguments the user passed: a preset fills in only the others.

        :raises TypeError: for an argument that does not exist
        """
        arguments.check_names(cls, kwargs)
        self = super().__new__(cls)
        positional = list(inspect.signature(TransferAlgorithm.__init__).parameters)[1:]
        self.given_arguments = frozenset(positional[: len(args)]) | frozenset(kwargs)
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
        close_loop: bool = False,
        effects: Literal["all"] | Sequence[str] = "all",
        retrain_steps: int = 320_000,
        weighting: WeightingName | None = "paper",
        weight_floor: float = 0.5,
        real_ratio: float = 0.05,
        rollout_start: RolloutStart = "mix",
        source_steps: int | Literal["auto"] = "auto",
        model_train_freq: int = 250,
    ) -> None:
        # What a subclass's __init__ passes counts, too.
        self.given_arguments |= arguments.set_among(TransferAlgorithm.__init__, locals())
        argument_ranges.check_given(locals())
        arguments.check_effects(effects)
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
        )
        self.preset = preset
        self.dynamics_backend: str = dynamics
        self.dynamics_kwargs = arguments.plain_effects(dynamics_kwargs or {})
        #: gradient steps of any fit of the dynamics at most, where the user passed a number
        self.fit_bound: int | None = self.dynamics_kwargs.get("max_steps")
        self.declared = arguments.list_of_names(declared)
        self.close_loop, self.effects, self.retrain_steps = close_loop, effects, retrain_steps
        self.weighting, self.weight_floor, self.real_ratio = weighting, weight_floor, real_ratio
        self.rollout_start, self.source_steps, self.model_train_freq = rollout_start, source_steps, model_train_freq
        #: the trainable source P_phi, and what rebuilds it
        self.dynamics: Dynamics | None = None
        self.dynamics_config: dict[str, Any] | None = None
        #: traces what the simulator lacks, and holds the reports
        self.loop: LoopController = ClosedLoop(self.declared, effects) if close_loop else OpenLoop()
        #: the log that stands in for the target; a checkpoint does not hold it
        self.measured = target_data if isinstance(target_data, Measurements) else None
        if _init_setup_model:
            self._begin(target_env, target_data)

    def _begin(self, target_env: EnvSource | None, target_data: Any) -> None:
        """Check the arguments against each other, and build all that a model consists of."""
        self._apply_preset()
        self._check_arguments(offline=target_data is not None)
        if self.env is not None and self.updates_dynamics:
            self.dynamics_config = dynamics_config(self.dynamics_backend, self.env, self.dynamics_kwargs, self.declared)
            self._check_dynamics(self.env, self.dynamics_config)
        self._setup_model()
        if self.env is not None:
            try_source(self.env, self.dynamics, self.weighting == "value_aware")
        if target_env is not None:
            self.set_target_env(target_env)
        if target_data is not None:
            traced = self.measured is not None and isinstance(self.dynamics, PhysicalDynamics)
            self.target = OfflineTarget(traced)
            if traced and not self.close_loop:
                self.loop = ClosedLoop(self.declared, effects=[], traces_transitions=False)
            recorded_data.fill_target(self, target_data)
            self.state.steps_since_fit = self.model_train_freq  # all data are there: the first fit need not wait

    # ------------------------------------------------------------------ setting up

    def _apply_preset(self) -> None:
        """Set what the user did not pass; of ``dynamics_kwargs``, which both may give, the entries passed win."""
        backend = preset_section(self.dynamics_backend if self.updates_dynamics else None, self.env)
        source_id = None if self.env is None else env_id(self.env)
        chosen_by_preset = {"dynamics_kwargs", *(["source_steps"] if self.source_steps == "auto" else [])}
        given = self.given_arguments - chosen_by_preset
        for name, value in resolve_preset(self.preset, backend, source_id, given).items():
            if name == "dynamics_kwargs":
                value = {**value, **self.dynamics_kwargs}
            setattr(self, name, value)

    def _check_arguments(self, offline: bool) -> None:
        """Refuse arguments that the algorithm has no use for, and values out of range.

        :param offline: whether a log stands in for the target
        """
        arguments.check_applicable(type(self).__name__, self.updates_dynamics, self.given_arguments)
        if offline:
            arguments.check_offline(self.given_arguments)
        arguments.check_values_of(self)

    def _check_dynamics(self, env: VecEnv, config: dict[str, Any]) -> None:
        """Refuse, before anything expensive, arguments that do not go together with the dynamics."""
        traces_log = self.measured is not None
        arguments.check_backend(config, self.close_loop, traces_log, self.given_arguments)
        arguments.check_something_to_fit(config, self.close_loop, self.effects, traces_log)
        if self.close_loop:
            arguments.check_carried(env, self.effects)
        arguments.check_rules(self.dynamics_kwargs, self.observation_space, self.action_space)

    def _check_numbers(self) -> None:
        """Refuse numbers of a subclass's own out of range.

        :raises ValueError: naming the argument and its value
        """

    def _setup_model(self) -> None:
        """Build networks, buffers and dynamics from the spaces alone: ``load()`` has no environment."""
        self._check_numbers()
        check_spaces(self.observation_space, self.action_space)
        super()._setup_model()
        if self.dynamics_config is not None:
            self.dynamics = self.make_dynamics(self.dynamics_config).to(self.device)
            if self.seed is not None:
                self.dynamics.seed(self.seed + DYNAMICS_SEED_OFFSET)

    def make_dynamics(self, config: dict[str, Any]) -> Dynamics:
        """The trainable source that :func:`~sb3_rpto.dynamics.factory.dynamics_config` describes."""
        return make_dynamics(config, self.observation_space, self.action_space)

    def make_rollouts(self) -> SourceRollouts:
        """The world that step 3 acts in."""
        assert self.env is not None  # learn() has checked
        if self.dynamics is not None and self.weighting == "value_aware":  # which asks for single steps
            self.dynamics.attach(self.env)
        return make_rollouts(self.env, self.dynamics, self.rollout_start, int(self.source_steps))

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
            recorded_data.fill_source(model, source_data)
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
        run = (reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar)
        total_timesteps, callback = self._start(total_timesteps, source_timesteps, callback, *run)
        callback.on_training_start(locals(), globals())
        self._finish_open_round(forget=reset_num_timesteps)
        while self.steps_left() > 0:
            if not self.state.update_pending:
                self.collect_source()  # step 3
            self.state.update_pending = True
            if not self.collect_target(callback, log_interval):  # step 4
                break
            self.update_policy()  # steps 5 and 6: the critic, and RPO
            self.update_dynamics()  # step 6: RTO
        self.loop.on_end(self)
        callback.on_training_end()
        self._callback = None
        return self

    def _start(
        self,
        total_timesteps: int,
        source_timesteps: int,
        callback: MaybeCallback,
        reset_num_timesteps: bool,
        tb_log_name: str,
        progress_bar: bool,
    ) -> tuple[int, BaseCallback]:
        """Bring a new, a loaded or an interrupted run to its first round.

        :return: target steps at its end, counted from the first run on, and SB3's callback
        """
        knows_source = self.state.knows_source
        if not knows_source:
            arguments.warn_of_idle_source_phase(self, source_timesteps)
        self.store_step_cut_off()
        if reset_num_timesteps and knows_source:  # else the source phase goes on all the same
            checkpointing.leave(self)
        checkpointing.resume_unbegun(self)
        end, called = self._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        check_callbacks(called, self.env, self.target_env)
        self.rollouts = self.rollouts or self.make_rollouts()
        self.loop.identify_log(self)  # first of all: the log may be refused
        if not knows_source:
            checkpointing.resume_pretraining(self)
        self.prepare_in_source(source_timesteps, progress_bar)
        checkpointing.resume(self)
        self.loop.on_start(self)
        self.watch_for_null_shift()
        self._callback = called
        return end, called

    def _finish_open_round(self, forget: bool) -> None:
        """Make up for the steps 5 and 6 before which the last run was stopped or saved; step 3 is not done twice.

        :param forget: a new run begins
        """
        state = self.state
        if forget:
            state.update_pending, state.source_steps_due = False, 0
        if not state.update_pending:
            return
        if self.target_env is not None:
            taken = self.num_timesteps - state.rollout_start
            if not taken:
                return
            state.rollout_timesteps = taken
        self.update_policy()
        self.update_dynamics()

    def prepare_in_source(self, source_timesteps: int, progress_bar: bool) -> None:
        """What Algorithm 1 takes as its input: a policy, its critic and phi_0 that know the source.

        :param source_timesteps: source steps that train a model which knows nothing of the source
        :param progress_bar: show a bar for them
        """
        pretraining.prepare_in_source(self, source_timesteps, progress_bar)

    def collect_source(self) -> None:
        """Step 3: act in the source P_phi, ``source_steps`` times for each target step, and fill D_source."""
        assert self.rollouts is not None  # learn() has made them
        assert self.target is not None  # and checked this
        if not self.loop.defers_learning(self) and (n_steps := self.target.source_steps(self)) > 0:
            self.state.source_steps_due -= self.rollouts.interact(self, n_steps)

    def collect_target(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step 4: act in the target and fill D_target.

        Without a target environment (``target_data``) this only counts the source steps that were just taken.

        :return: whether to go on
        """
        assert self.target is not None  # learn() has checked
        return self.target.collect(self, callback, log_interval)

    def update_policy(self) -> None:
        """Steps 5 and 6: the critic on D_source and the actor by RPO, some updates for each new target step.

        Where a closed loop puts that off, the steps of the round wait for the next fit.
        """
        state = self.state
        if self.loop.defers_learning(self):
            state.deferred_target_steps += state.rollout_timesteps
        else:
            self.train(state.rollout_timesteps * self.updates_per_step, self.batch_size)
            state.source_steps_due += state.rollout_timesteps * self.source_steps_per_target_step()
        self._close_round()

    def _close_round(self) -> None:
        """The round's steps count towards the next fit. Where a fit is interrupted, it alone is made again."""
        self.state.steps_since_fit += self.state.rollout_timesteps
        self.state.update_pending = False

    def update_dynamics(self) -> None:
        """Step 6: RTO, every ``model_train_freq`` target steps, and what a closed loop has put off until then.

        A log that was traced has made phi already.
        """
        traced = self.target is not None and self.target.is_traced
        known = traced or self.replay_buffer.size() >= 2
        if not self.updates_dynamics or self.state.steps_since_fit < self.model_train_freq or not known:
            return
        if not traced:
            self.fit_dynamics()
        self.state.steps_since_fit = 0
        self.loop.learn_deferred(self)
        if self.target_env is None:  # SB3 writes its logs at the end of target episodes; there are none
            self.dump_logs()

    def fit_dynamics(self) -> None:
        """RTO: move phi towards D_target by the weighted loss; then let the loop trace what phi lacks."""
        assert self.dynamics is not None
        self.adopt_target_rules()
        self.policy.set_training_mode(False)  # values for the weights: no dropout, no new batch statistics
        data = self.transitions("target")
        self.logger.record("dynamics/error_before", self.dynamics.error(data))
        if not self.loop.freezes_dynamics:
            rto.fit(self.dynamics, data, self.fit_weights(data), self.logger)
        self.loop.after_fit(self)
        for name, value in self.dynamics.describe().items():
            self.logger.record(f"dynamics/{name}", value)
        error = self.dynamics.error(data)
        self.logger.record("dynamics/error", error)
        check_fit(self.dynamics, error, data, self.state, self.loop)

    def fit_weights(self, data: Transitions) -> th.Tensor | None:
        """RTO's weight of each transition, (n,), 0 of those too old to be fitted; None weighs all alike."""
        if self.weighting is None:
            return None
        assert self.dynamics is not None
        if self.use_sde:  # as in an update: what explored last is no part of a checkpoint
            self.actor.reset_noise()
        return rto_weights(
            self.weighting,
            self.with_critic_rewards(data),
            self.dynamics,
            self.soft_value,
            self.q_value,
            self.gamma,
            self.weight_floor,
        )

    def adopt_target_rules(self) -> None:
        """From the first fit on phi is a model of the target: let it know the target's rules of the task."""
        config = self.dynamics_config
        if self.state.has_target_rules or config is None or "termination_fn" not in config:
            return
        if isinstance(self.target, OnlineTarget):
            rto.adopt_rules(self.dynamics, config, self.dynamics_kwargs, self.target.raw)
            self.state.has_target_rules = True

    # ------------------------------------------------------------------ steps 5 and 6: SAC's update

    @property
    def updates_per_step(self) -> int:
        """Updates of critic and actor for a target step."""
        return self.gradient_steps if self.gradient_steps >= 0 else 1  # SB3: negative means one a step

    @property
    def policy_learns(self) -> bool:
        """Whether updates move actor and temperature: RPO does, and so does plain SAC in the source before."""
        return self.updates_policy or self.state.pretraining

    def source_steps_per_target_step(self) -> int:
        """Source steps for each target step, or for what stands in for one when the target is a log.

        That is many where the simulator accounts for the log, as the policy learns from them alone. Before the log is
        traced it is taken for granted that it will.
        """
        traced = self.target is not None and self.target.is_traced and self.loop.closed
        awaited = traced and not self.loop.found
        if isinstance(self.target, OfflineTarget) and (awaited or self.loop.simulator_validated):
            return self.fresh_source_steps()
        return int(self.source_steps)

    def fresh_source_steps(self) -> int:
        """Source steps for the updates of a target step in a simulator that is new to the policy, of all its copies."""
        copies = int(self.source_steps)
        return max(-(-ClosedLoop.settings.steps_per_update * self.updates_per_step // copies), 1) * copies

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Step 5, the critic on D_source, and step 6, the actor by RPO; given the same batch it is SAC's update.

        :param gradient_steps: number of updates
        :param batch_size: transitions in a batch
        """
        self.policy.set_training_mode(True)
        if not self.policy_learns:  # its batch statistics stay, too
            self.actor.set_training_mode(False)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        steps = OptimizerSteps.of(*optimizers)
        average = PolyakAverage(self.critic_target, self.critic, self.tau)
        manual = self._manual_update()
        logged: dict[str, list[th.Tensor]] = {}
        with fast_products(self.device):
            burst = max(1, batches.GATHERED // batch_size)
            for first in range(0, gradient_steps, burst):
                drawn = self.sample_batches(min(burst, gradient_steps - first), batch_size)
                for step, (critic_batch, actor_batch) in enumerate(drawn, first):
                    steps.forget()
                    if manual is None:
                        found = self.update_once(critic_batch, actor_batch, steps)
                    else:
                        learned_from = actor_batch if self.policy_learns else None
                        found = manual(critic_batch, learned_from, self.temperature(), steps)
                    for name, loss in found.items():
                        logged.setdefault(name, []).append(loss.detach().reshape(()))
                    if step % self.target_update_interval == 0:
                        average()
                        polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logged.items():  # read here at once: reading each would wait for the device every step
            self.logger.record(f"train/{name}", float(np.mean(th.stack(values).tolist())))

    def _manual_update(self) -> ManualUpdate | None:
        """The update without autograd; None for other networks, and for losses of a subclass."""
        names = ("update_once", "critic_loss", "actor_loss", "temperature_loss")
        own = any(getattr(getattr(self, n), "__func__", None) is not getattr(TransferAlgorithm, n) for n in names)
        if own or not supports_manual_gradients(self.policy):
            return None
        return ManualUpdate(self.policy, self.log_ent_coef, self.target_entropy, self.gamma)

    def update_once(
        self, critic_batch: ReplayBufferSamples, actor_batch: ReplayBufferSamples, steps: OptimizerSteps
    ) -> dict[str, th.Tensor]:
        """One update of temperature, critic and actor, in SAC's order: the actor's loss uses the updated critic.

        :param steps: of the optimizers
        :return: the losses, to log
        """
        ent_coef = self.temperature()
        found = {"ent_coef": ent_coef}
        if self.use_sde:  # for the critic's next actions, too
            self.actor.reset_noise()
        if self.policy_learns:
            actions_pi, log_prob = losses.sample_actions(self.actor, actor_batch.observations)
            if steps.ent_coef is not None:
                found["ent_coef_loss"] = self.temperature_loss(log_prob)
                steps.ent_coef(found["ent_coef_loss"])
        found["critic_loss"] = self.critic_loss(critic_batch, ent_coef)
        steps.critic(found["critic_loss"])
        if self.policy_learns:
            found["actor_loss"] = self.actor_loss(actor_batch, actions_pi, log_prob, ent_coef)
            steps.actor(found["actor_loss"])
        return found

    def critic_loss(self, batch: ReplayBufferSamples, ent_coef: th.Tensor) -> th.Tensor:
        """Soft Bellman residual, Eq. soft_q; see :func:`~sb3_rpto.algorithms.losses.critic_loss`."""
        return losses.critic_loss(self.actor, self.critic, self.critic_target, batch, ent_coef, self.gamma)

    def actor_loss(
        self, batch: ReplayBufferSamples, actions_pi: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> th.Tensor:
        """RPO, Eq. sac; see :func:`~sb3_rpto.algorithms.losses.actor_loss`."""
        return losses.actor_loss(self.critic, batch.observations, actions_pi, log_prob, ent_coef)

    def temperature_loss(self, log_prob: th.Tensor) -> th.Tensor:
        """SAC's loss of log alpha; see :func:`~sb3_rpto.algorithms.losses.temperature_loss`."""
        assert self.log_ent_coef is not None  # it is learned
        return losses.temperature_loss(self.log_ent_coef, log_prob, self.target_entropy)

    def sample_batches(self, count: int, batch_size: int) -> Iterator[tuple[ReplayBufferSamples, ReplayBufferSamples]]:
        """For each of ``count`` updates a batch for the critic, mostly of D_source, and one for the actor.

        The actor sees four batches of D_target, then one of D_source; D_source alone as long as D_target could not
        fill a batch, and where the simulator is known to account for the target, whose few states its many stand for
        then; a policy that does not learn sees the critic's. All are gathered at once.
        """
        for_critic = self.critic_batches(count, batch_size)
        if self.state.pretraining or not self.updates_policy:
            yield from ((batch, batch) for batch in for_critic)
            return
        buffer = self.replay_buffer
        scarce = buffer.target.size() < batch_size or self.loop.simulator_validated
        from_source = [turn or scarce for turn in batches.alternation(self.state.actor_updates, count)]
        for_actor = batches.actor_batches(buffer, from_source, batch_size, self._vec_normalize_env)
        for critic_batch, actor_batch in zip(for_critic, for_actor):
            self.state.actor_updates += 1
            yield critic_batch, actor_batch

    def critic_batches(self, count: int, batch_size: int) -> Iterator[ReplayBufferSamples]:
        """Batches of D_source with their share ``real_ratio`` of D_target.

        Of D_source alone while pretraining, where rewards of D_target are not known, and where it is a robot's log that
        the simulator accounts for: the states of a log are estimates, without what has yet to act, and the simulator
        knows better.
        """
        buffer = self.replay_buffer
        traced = self.target is not None and self.target.is_traced
        needless = buffer.unrewarded or (traced and self.loop.simulator_validated)
        real_ratio = 0.0 if self.state.pretraining or needless else self.real_ratio
        return batches.critic_batches(buffer, count, batch_size, real_ratio, self._vec_normalize_env)

    # ------------------------------------------------------------------ values and units

    def temperature(self) -> th.Tensor:
        """The current entropy coefficient alpha, without gradient."""
        return self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())

    def soft_value(self, observations: th.Tensor) -> th.Tensor:
        """V(s) of raw observations (n, d) -> (n,); see :func:`~sb3_rpto.algorithms.losses.soft_value`."""
        seen = self.normalise_observations(observations)
        return losses.soft_value(self.actor, self.critic_target, seen, self.temperature())

    def q_value(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """min_i Q_target,i(s, a) of raw observations (n, d) and actions in the environment's units -> (n,)."""
        with th.no_grad():
            scaled = self.scale_actions(actions).float()
            return losses.smallest_q(self.critic_target, self.normalise_observations(observations), scaled)[:, 0]

    def scale_actions(self, actions: th.Tensor) -> th.Tensor:
        """Actions in the environment's units -> [-1, 1], the scale of the networks and the buffers; (n, action_dim)."""
        low, high = self._action_bounds()
        return 2.0 * (actions - low) / (high - low) - 1.0

    def unscale_actions(self, scaled: th.Tensor) -> th.Tensor:
        """The inverse of :meth:`scale_actions`."""
        low, high = self._action_bounds()
        return low + 0.5 * (scaled + 1.0) * (high - low)

    def _action_bounds(self) -> tuple[th.Tensor, th.Tensor]:
        space = self.action_space
        return th.as_tensor(space.low, device=self.device), th.as_tensor(space.high, device=self.device)

    def transitions(self, world: World) -> Transitions:
        """All transitions of one world, oldest first, actions in the environment's units, on the model's device."""
        return recorded_data.as_transitions(chronological(self.replay_buffer.side(world)), self.policy, self.device)

    def with_critic_rewards(self, data: Transitions) -> Transitions:
        """``data`` with rewards on the critic's scale (VecNormalize may have changed it)."""
        if self._vec_normalize_env is None:
            return data
        rewards = self._vec_normalize_env.normalize_reward(data.rewards.cpu().numpy())
        return replace(data, rewards=th.as_tensor(rewards, device=self.device).float())

    def normalise_observations(self, observations: th.Tensor) -> th.Tensor:
        """Raw observations (n, d) as the networks see them."""
        if self._vec_normalize_env is None:
            return observations.float()
        normalised = self._vec_normalize_env.normalize_obs(observations.cpu().numpy())
        return th.as_tensor(normalised, device=self.device).float()

    # ------------------------------------------------------------------ what the dynamics add to the two environments

    def set_target_env(self, env: EnvSource) -> None:
        """Set the target; the next ``learn()`` starts a new episode there.

        In the place of another target it begins with an empty D_target, no best policy, and a closed loop that has seen
        nothing.

        :param env: an environment, a VecEnv or an id
        :raises ValueError: when it is the source itself, has other spaces, cannot be reset with a seed, or is another
            machine (joints, length of a step) than the simulator that is fitted to it
        :raises TypeError: for what is no environment
        """
        super().set_target_env(env)
        assert isinstance(self.target, OnlineTarget)
        state = self.state
        if state.has_target_rules:
            rto.bind_rules(self.dynamics, self.dynamics_config or {}, self.target.raw)
        state.has_target_rules = False  # but of the last one
        state.fit_checked = state.rules_checked = state.residual_checked = False

    def forget_target(self, target: Target) -> None:
        """Leave a target: the loop has seen nothing of the next one, and nothing is to be learned for the last one."""
        if target.env is not None or target.is_traced:
            self.state.deferred_target_steps = self.state.steps_since_fit = 0
            self.loop.forget_target()
        super().forget_target(target)

    def check_pair(self, source: VecEnv, target: VecEnv) -> None:
        """Refuse a target that cannot be the source's, or not that of the simulator that is fitted to it."""
        super().check_pair(source, target)
        if self.dynamics_config is not None and is_mujoco(self.dynamics_config):
            check_machine(source, target)

    def check_source(self, source: VecEnv) -> None:
        """Refuse a source that phi cannot act in, and warn of another simulator than the one that phi is of."""
        check_simulator(source, self.dynamics, self.weighting == "value_aware")

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the source environment, as in SB3; the target keeps sharing its normalisation."""
        super().set_env(env, force_reset)
        self._bind_source_rules()

    def _bind_source_rules(self) -> None:
        if self.env is not None and not self.state.has_target_rules:
            rto.bind_rules(self.dynamics, self.dynamics_config or {}, self.env)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed both worlds and the model, each with its own stream; with None nothing is seeded.

        After a checkpoint is loaded, the run that goes on draws from the new streams instead of those that were saved.
        """
        super().set_random_seed(seed)
        if seed is not None and self.dynamics is not None:
            self.dynamics.seed(seed + DYNAMICS_SEED_OFFSET)

    def judge_recent_episodes(self) -> None:
        """Keep the policy as the best, where it learns, if the newest target episodes earned more than any before."""
        if self.updates_policy:
            super().judge_recent_episodes()

    def dump_logs(self) -> None:
        """SB3's log plus what the source spent and earned."""
        self.logger.record("time/source_timesteps", self.source_timesteps, exclude="tensorboard")
        if self.rollouts is not None:
            for name, value in self.rollouts.log().items():
                self.logger.record(f"source/{name}", value)
        super().dump_logs()

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """Save all that a resumed run needs, except the replay buffers (``save_replay_buffer``); atomic for paths."""
        kept = self.dynamics_config
        try:
            self.dynamics_config = rto.picklable(kept)
            super().save(path, exclude, include)
        finally:
            self.dynamics_config = kept

    def _finish_loading(self, seed: int | None) -> None:
        arguments.check_values_of(self)
        super()._finish_loading(seed)
        self._bind_source_rules()

    def own_states(self) -> list[str]:
        """Names of modules and optimizers beside SAC's, which a checkpoint holds."""
        if self.dynamics is None:
            return []
        return ["dynamics", *(["dynamics.optimizer"] if hasattr(self.dynamics, "optimizer") else [])]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dynamics", "measured", "given_arguments"]
