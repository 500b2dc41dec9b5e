# ruff: noqa: D102  (what methods of an algorithm do is said where they are)
"""The parts that an algorithm is composed of, and what they may use of it.

An algorithm *has* rollouts in the source, a target, and a controller of its closed loop. Each is an interface with two
or three implementations. :class:`Agent` says what they, and the functions beside them, may use of the algorithm in
turn, so that none of them imports its class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_rpto.algorithms.policy_snapshots import PolicySnapshots
from sb3_rpto.algorithms.run_state import RunState
from sb3_rpto.buffers import DualReplayBuffer, World
from sb3_rpto.dynamics.base import Dynamics, Transitions
from sb3_rpto.dynamics.weights import WeightingName
from sb3_rpto.sysid import Measurements, Report


class TwoEnvAgent(Protocol):
    """What checkpoints need of an algorithm: SAC's own attributes, where it stands, and where both worlds do."""

    env: VecEnv | None
    policy: SACPolicy
    observation_space: spaces.Box
    action_space: spaces.Box
    replay_buffer: DualReplayBuffer
    replay_buffer_kwargs: dict[str, Any]
    device: th.device
    num_timesteps: int
    resume_point: Any
    new_seed: int | None
    state: RunState
    snapshots: PolicySnapshots
    rollouts: SourceRollouts | None
    target: Target | None

    @property
    def target_env(self) -> VecEnv | None: ...

    def get_vec_normalize_env(self) -> VecNormalize | None: ...
    def set_random_seed(self, seed: int | None = None) -> None: ...
    def reset_source(self) -> None: ...
    def last_target_observation(self) -> tuple[np.ndarray | None, np.ndarray | None]: ...
    def begin_at(self, last_obs: np.ndarray | None, last_original_obs: np.ndarray | None) -> None: ...
    def unstored_step(self) -> dict[str, Any] | None: ...
    def store_step(self, step: dict[str, Any]) -> None: ...


class Agent(TwoEnvAgent, Protocol):
    """What its parts may use of an algorithm: further attributes of SAC, the other parts, and steps of Algorithm 1."""

    updates_policy: ClassVar[bool]
    updates_dynamics: ClassVar[bool]

    # SAC
    actor: Actor
    critic: ContinuousCritic
    log_ent_coef: th.Tensor | None
    ent_coef_tensor: th.Tensor
    ent_coef_optimizer: th.optim.Adam | None
    policy_class: Any
    policy_kwargs: dict[str, Any]
    seed: int | None
    verbose: int
    batch_size: int
    buffer_size: int
    learning_starts: int
    gradient_steps: int
    use_sde: bool
    sde_sample_freq: int
    use_sde_at_warmup: bool
    train_freq: TrainFreq
    # ours
    dynamics: Dynamics | None
    dynamics_config: dict[str, Any] | None
    dynamics_kwargs: dict[str, Any]
    dynamics_backend: str
    fit_bound: int | None
    measured: Measurements | None
    weighting: WeightingName | None
    real_ratio: float
    source_steps: Any
    retrain_steps: int
    model_train_freq: int
    given_arguments: frozenset[str]
    loop: LoopController

    @property
    def logger(self) -> Logger: ...
    @property
    def n_updates(self) -> int: ...
    @property
    def updates_per_step(self) -> int: ...
    @property
    def logs_to_folder(self) -> bool: ...

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]: ...
    def train(self, gradient_steps: int, batch_size: int = 256) -> None: ...
    def dump_logs(self) -> None: ...
    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None: ...
    def save_replay_buffer(self, path: Any) -> None: ...
    def set_progress(self, taken: int, total: int | None = None) -> None: ...
    def steps_left(self) -> int: ...
    def source_steps_per_target_step(self) -> int: ...
    def fresh_source_steps(self) -> int: ...
    def target_rollout_length(self) -> TrainFreq: ...
    def collect_in_target(self, callback: BaseCallback, log_interval: int | None) -> bool: ...
    def count_steps(self, steps: int, callback: BaseCallback) -> bool: ...
    def take_source_observation(self) -> np.ndarray | None: ...
    def transitions(self, world: World) -> Transitions: ...
    def unscale_actions(self, scaled: th.Tensor) -> th.Tensor: ...
    def take_snapshot(self, name: str) -> None: ...
    def rollback(self, to: str = "best") -> None: ...


class SourceRollouts(ABC):
    """Step 3 of Algorithm 1: acts in the source world and fills D_source."""

    @abstractmethod
    def interact(self, agent: Agent, n_steps: int) -> int:
        """Take at least ``n_steps`` steps and store every transition.

        :param agent: whose policy acts and whose D_source is filled; its ``source_timesteps`` count them
        :param n_steps: number of transitions
        :return: the number of transitions stored
        """

    def log(self) -> dict[str, float]:
        """What to log of the source's episodes; empty where it has none."""
        return {}

    def begin_anew(self) -> None:  # noqa: B027
        """Leave the episodes under way: the next step is the first of others."""

    def get_state(self) -> dict[str, Any]:
        """Where the episodes stand, beside the source environment's own state; empty where there are none."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:  # noqa: B027
        """Continue where :meth:`get_state` was called; the source environment's own state is restored elsewhere."""

    def reseed(self) -> None:  # noqa: B027
        """Draw new random streams of its own from the dynamics', which were seeded just now."""


class Target(ABC):
    """Where the transitions of D_target come from: an environment, or a log that was recorded in one."""

    #: the environment, as the policy sees it; None for a log
    env: VecEnv | None
    #: environments that step side by side; 1 for a log
    n_envs: int
    #: whether phi comes from a trace of the log, in place of fits to its transitions
    is_traced: bool

    @abstractmethod
    def source_steps(self, agent: Agent) -> int:
        """Source steps of step 3, for the target steps that step 4 will take."""

    @abstractmethod
    def collect(self, agent: Agent, callback: BaseCallback, log_interval: int | None) -> bool:
        """Step 4: fill D_target within the budget, or count what stands in for that.

        :return: whether to go on
        """


class LoopController:
    """What closes the loop around Algorithm 1: a trace's effects join phi, and the simulator judges policies.

    By itself it does nothing of the kind.
    """

    #: whether it does anything at all
    closed = False
    #: called with each report, before the policy learns in what it corrects; no checkpoint holds it
    on_report: Callable[[Report], None] | None = None
    #: called while it traces, as :func:`~sb3_rpto.sysid.trace` calls it, and while the policy then learns in the
    #: corrected simulator, with the share of ``retrain_steps``; no checkpoint holds it
    progress: Callable[[float, str], None] | None = None
    #: whether the simulator accounts for the target by the last trace
    simulator_validated = False
    #: whether a trace made phi that knows better than one-step fits: of noisy transitions, or of late sensors
    freezes_dynamics = False

    def __init__(self) -> None:
        #: of this process; a checkpoint keeps what they said, :attr:`found`
        self.reports: list[Report] = []
        self.found: list[dict[str, Any]] = []

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name not in ("on_report", "progress")}
        return {**kept, "reports": []}

    def identify_log(self, agent: Agent) -> None:
        """Before anything is learned: phi from a trace of the log, where the target is one."""

    def on_start(self, agent: Agent) -> None:
        """Before the first round of ``learn()``."""

    def after_fit(self, agent: Agent) -> None:
        """After a fit of phi to transitions: trace what the simulator lacks, where that is due."""

    def learn_deferred(self, agent: Agent) -> None:
        """After a fit: let the policy learn what was put off until then."""

    def on_end(self, agent: Agent) -> None:
        """After the last round of ``learn()``."""

    def defers_learning(self, agent: Agent) -> bool:
        """Whether steps 3 and 5 wait for the next fit."""
        return False

    def awaits_trace(self) -> bool:
        """Whether this target is still to be traced."""
        return False

    def first_trace_after(self, agent: Agent) -> int:
        """Target steps until the first trace; 0 or less where it is due, was made, or none is to be."""
        return 0

    def forget_target(self) -> None:
        """Begin anew with another target: what was seen of the last one does not count there."""
