"""Stochastic Lower Bound Optimization: a model trained along its own predictions, TRPO on whole rollouts in it."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_rpto.algorithms.normalisation import share_normalisation
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.policy_distillation import SquashedMeanPolicy, clone, clone_kwargs
from sb3_rpto.baselines.slbo_dynamics import DeterministicDynamics
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.vec_env import DynamicsVecEnv
from sb3_rpto.ranges import check, whole


class SLBO(MBPO):
    """Stochastic Lower Bound Optimization, warm-started.

    Paper: https://arxiv.org/abs/1807.03858 (Luo, Xu, Li, Tian, Darrell, Ma: Algorithmic Framework for Model-based Deep
    Reinforcement Learning with Theoretical Guarantees, ICLR 2019).

    In the loop of MBPO the model is :class:`~sb3_rpto.baselines.slbo_dynamics.DeterministicDynamics`, and the policy is
    ``trpo`` (``sb3_contrib.TRPO``), cloned from the SAC policy on states of the source before the first target step.
    Every ``model_train_freq`` target steps there is a stage: ``iterations`` times ``model_steps`` gradient steps of the
    model and ``policy_updates`` TRPO updates, each on ``rollout_samples`` steps of the model from initial states of the
    source. SAC's actor and critics are only the teacher.

    :param args: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`
    :param iterations: of a stage
    :param model_steps: gradient steps of the model in an iteration
    :param policy_updates: TRPO updates in an iteration
    :param rollout_samples: model steps of a TRPO update
    :param rollout_length: after how many of them an episode in the model is cut off
    :param trpo_kwargs: arguments of ``sb3_contrib.TRPO``
    :param kwargs: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`; ``dynamics_kwargs`` are those of
        :class:`~sb3_rpto.baselines.slbo_dynamics.DeterministicDynamics`
    :raises ValueError: for numbers that are not positive, or rollouts longer than the samples
    :raises ImportError: without sb3-contrib
    """

    NUMBERS: ClassVar[dict[str, Any]] = {
        "gradient_steps": 0,
        "source_steps": 1,
        "model_train_freq": 10_000,
        "real_ratio": 0.0,
        "rollout_start": "source",
    }
    NUMBERS_OF_TASKS: ClassVar[dict[str, dict[str, Any]]] = {}
    unused = MBPO.unused | {"gradient_steps", "source_steps", "real_ratio", "rollout_start"}

    def __init__(
        self,
        *args: Any,
        iterations: int = 20,
        model_steps: int = 100,
        policy_updates: int = 40,
        rollout_samples: int = 4_000,
        rollout_length: int = 500,
        trpo_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        numbers = {"iterations": iterations, "model_steps": model_steps, "policy_updates": policy_updates}
        numbers |= {"rollout_samples": rollout_samples, "rollout_length": rollout_length}
        for name, value in numbers.items():
            setattr(self, name, value)
        self.trpo_kwargs = dict(trpo_kwargs or {})
        self._cloned = False
        #: of the stage under way, which goes on there where it was interrupted
        self._iterations_done = 0
        super().__init__(*args, **kwargs)

    iterations: int
    model_steps: int
    policy_updates: int
    rollout_samples: int
    rollout_length: int

    def _check_numbers(self) -> None:
        super()._check_numbers()
        counts = ("iterations", "model_steps", "policy_updates", "rollout_samples", "rollout_length")
        check(dict.fromkeys(counts, whole(1)), vars(self))
        if self.rollout_samples % self.rollout_length:
            raise ValueError(
                f"rollout_samples={self.rollout_samples} is no multiple of rollout_length={self.rollout_length}; the "
                "model runs rollout_samples / rollout_length episodes side by side"
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        from sb3_contrib import TRPO  # an extra

        settings = {"gamma": self.gamma, "batch_size": min(128, self.rollout_samples), **self.trpo_kwargs}
        settings["policy_kwargs"] = {**clone_kwargs(self), **settings.get("policy_kwargs", {})}
        self.trpo = TRPO(
            SquashedMeanPolicy,
            None,  # type: ignore[arg-type]  # a stage sets it, load() has none
            n_steps=self.rollout_length,
            device=self.device,
            _init_setup_model=False,
            **settings,
        )
        self.trpo.observation_space, self.trpo.action_space = self.observation_space, self.action_space
        self.trpo.n_envs = self.rollout_samples // self.rollout_length
        self.trpo._setup_model()
        self.trpo.set_logger(Logger(None, []))

    def make_dynamics(self, config: dict[str, Any]) -> Dynamics:
        """The deterministic model that SLBO trains along its own predictions."""
        settings = {name: value for name, value in config.items() if name != "backend"}
        return DeterministicDynamics(self.observation_space, self.action_space, **settings)

    # ------------------------------------------------------------------ the policy is TRPO's

    def prepare_in_source(self, source_timesteps: int, progress_bar: bool) -> None:
        """As for all, then clone the policy."""
        super().prepare_in_source(source_timesteps, progress_bar)
        if not self._cloned:
            states = self.normalise_observations(self.transitions("source").observations).cpu().numpy()
            for name, value in clone(self.trpo.policy, self, states).items():
                self.logger.record(f"slbo/{name}", value)
            self._cloned = True
            self.take_snapshot("source")

    def predict(
        self,
        observation: PyTorchObs | np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The action of TRPO's policy, before it is cloned of the teacher's; arguments as in SB3."""
        if not self._cloned:
            return super().predict(observation, state, episode_start, deterministic)  # type: ignore[arg-type]
        return self.trpo.policy.predict(observation, state, episode_start, deterministic)  # type: ignore[arg-type]

    def take_snapshot(self, name: str) -> None:
        """Keep TRPO's policy too."""
        super().take_snapshot(name)
        state = {key: value.detach().cpu().clone() for key, value in self.trpo.policy.state_dict().items()}
        self.snapshots[name]["trpo"] = state

    def rollback(self, to: str = "best") -> None:
        """Go back to an earlier policy, TRPO's included."""
        super().rollback(to)
        self.trpo.policy.load_state_dict(self.snapshots[to]["trpo"])

    # ------------------------------------------------------------------ the loop

    def collect_source(self) -> None:
        """Nothing: TRPO makes its own rollouts, in :meth:`update_dynamics`."""

    def update_policy(self) -> None:
        """Nothing but to count the round: TRPO learns in a stage of :meth:`update_dynamics`."""
        self._close_round()

    def update_dynamics(self) -> None:
        """A stage every ``model_train_freq`` target steps."""
        if self.state.steps_since_fit < self.model_train_freq or self.replay_buffer.size() < 2:
            return
        assert self.dynamics is not None
        assert self.env is not None  # learn() has checked
        self.adopt_target_rules()
        data = self.transitions("target")
        self.logger.record("dynamics/error_before", self.dynamics.error(data))
        rollouts = DynamicsVecEnv(self.dynamics, self.env, self.trpo.n_envs, self.rollout_length)
        self.trpo.env = share_normalisation(rollouts, self.env)
        log: dict[str, float] = {}
        while self._iterations_done < self.iterations:
            log = self.dynamics.fit(data, max_steps=self.model_steps)
            for _ in range(self.policy_updates):  # a call collects one rollout from initial states, and learns of it
                self.trpo.learn(self.rollout_samples, log_interval=2)  # never: it has one iteration
                self.source_timesteps += self.rollout_samples
            self._iterations_done += 1
        self._iterations_done = self.state.steps_since_fit = 0
        self._n_updates += self.iterations * self.policy_updates
        for name, value in log.items():
            self.logger.record(f"dynamics/{name}", value)
        for name in ("policy_objective", "value_loss", "kl_divergence_loss", "std"):
            self.logger.record(f"slbo/{name}", self.trpo.logger.name_to_value[f"train/{name}"])
        self.logger.record("dynamics/error", self.dynamics.error(data))
        if self.target_env is None:  # as for all
            self.dump_logs()

    def to_sac(self) -> SAC:
        """Refuse: what acts is TRPO's policy, which no SAC holds.

        :raises NotImplementedError: always
        """
        raise NotImplementedError("SLBO acts by TRPO's policy, which no SAC holds; save it, and load it by SLBO.load()")

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "trpo.policy", "trpo.policy.optimizer"], variables
