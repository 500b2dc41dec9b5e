"""A MuJoCo simulator and a small ensemble on what it still misses, together as trainable dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions, relative_error
from sb3_rpto.dynamics.ensemble import EnsembleDynamics, TransitionFn
from sb3_rpto.dynamics.onestep import as_steps
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import Effect
from sb3_rpto.ranges import MAPPING, NONE, check

#: The ensemble, unless it is told otherwise. The simulator is deterministic, so its predicted variance is doubt.
SMALL: Mapping[str, Any] = {
    **{"n_members": 5, "n_elites": 5, "hidden": (128, 128), "noise": False},
    **{"batch_size": 64, "patience": 10, "max_steps": 2000},
}
#: Share of the data, the newest in one piece, by which a correction is judged.
HOLDOUT = 0.2
#: A correction must take away this share of the simulator's error there: chance takes less.
GAIN = 0.1
#: Residuals count up to so many times their 95 % quantile: a missed touch-down outweighs all other steps.
REACH = 3.0
#: The simulator's errors below this share of the standard one-step change are left alone.
NEGLIGIBLE = 1e-3
#: With fewer transitions nothing is corrected; of more the newest are simulated, one by one (0.1 ms each).
MIN_TRANSITIONS, MAX_TRANSITIONS = 50, 5000


class ResidualDynamics(Dynamics):
    r"""A simulator with trainable numbers, plus a small ensemble trained on its one-step residuals.

    .. math:: s' = f_\phi(s, a) + m \odot g_\theta(s, a)

    :math:`f_\phi` is :class:`~sb3_rpto.dynamics.physical.PhysicalDynamics`, :math:`g_\theta` an
    :class:`~sb3_rpto.dynamics.ensemble.EnsembleDynamics` fitted to :math:`s' - f_\phi(s, a)` (residual physics, Zeng et
    al. 2019), in which outliers are cut off. The mask :math:`m` is 1 for those dimensions of the observation in which
    the correction lowers the error on held-out transitions: what the simulator gets right stays its own. Before the
    first :meth:`fit` it is zero, and the model is the simulator exactly.

    It is rolled out in one-step branches: a running simulation cannot be corrected.

    :param observation_space: the environment's
    :param action_space: the environment's
    :param reward_fn: known reward (obs, act, next_obs) -> (n,), of the corrected next observation; None: the
        simulator's reward for its own step
    :param termination_fn: known rule (obs, act, next_obs) -> (n,) bool, likewise
    :param ensemble_kwargs: arguments of the ensemble other than rules; by default 5 members of 2 x 128 units, which
        answer by their mean
    :param physical_kwargs: arguments of :class:`~sb3_rpto.dynamics.physical.PhysicalDynamics` (``randomise`` is of
        episodes and does nothing in branches)
    :raises ValueError: what either of the two refuses
    """

    rollout: ClassVar[Literal["branches", "episodes"]] = "branches"

    #: which dimensions of the observation are corrected, (observation_dim,), bool
    corrected: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        reward_fn: TransitionFn | None = None,
        termination_fn: TransitionFn | None = None,
        ensemble_kwargs: Mapping[str, Any] | None = None,
        **physical_kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space)
        check({"ensemble_kwargs": MAPPING | NONE}, {"ensemble_kwargs": ensemble_kwargs})
        self.reward_fn, self.termination_fn = reward_fn, termination_fn
        self.physical = PhysicalDynamics(observation_space, action_space, **physical_kwargs)
        # A residual neither ends an episode nor has a reward: no head learns those.
        self.ensemble = EnsembleDynamics(
            observation_space, action_space, termination_fn=_never, **{**SMALL, **(ensemble_kwargs or {})}
        )
        self.optimizer = self.ensemble.optimizer
        self.register_buffer("corrected", th.zeros(observation_space.shape, dtype=th.bool))
        # The simulator describes the source as it is: there is no phi_0 to fit.
        self.register_buffer("fitted", th.tensor(True))

    def seed(self, seed: int) -> None:
        """Seed the random streams of both parts."""
        super().seed(seed)
        self.physical.seed(seed)
        self.ensemble.seed(seed)

    def forgotten(self) -> list[str]:
        """As in :class:`PhysicalDynamics`."""
        return self.physical.forgotten()

    @property
    def attached(self) -> bool:
        """Whether :meth:`attach` was called."""
        return self.physical.attached

    def attach(self, env: gym.Env | VecEnv) -> None:
        """Give the environment that the simulator answers for; see :meth:`PhysicalDynamics.attach`.

        :raises ValueError: it cannot be copied
        """
        self.physical.attach(env)

    def adopt(self, found: Sequence[Effect]) -> None:
        """Take traced effects into phi; nothing is corrected until the next fit, since they explain the residual.

        :param found: as :meth:`PhysicalDynamics.adopt` takes them
        """
        self.physical.adopt(found)
        self.corrected.fill_(False)

    def effects(self) -> list[Effect]:
        """What the simulator's phi is, without the networks' part, for :func:`~sb3_rpto.apply_effects`."""
        return self.physical.effects()

    def describe(self) -> dict[str, float]:
        """The simulator's phi by name, with the standard deviations."""
        return self.physical.describe()

    # ------------------------------------------------------------------ prediction

    def knows(self, observations: np.ndarray) -> np.ndarray:
        """As in :class:`~sb3_rpto.dynamics.physical.PhysicalDynamics`."""
        return self.physical.knows(observations)

    @th.no_grad()
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """The simulator's step from each state, corrected.

        :param observations: (n, observation_dim); the answer has its dtype
        :param actions: (n, action_dim)
        :param deterministic: the ensemble's mean in place of a sample (which it takes only with ``noise``)
        :raises RuntimeError: before :meth:`attach`
        """
        following, rewards, terminations = self.physical.step(observations, actions, deterministic)
        if self.corrected.any():
            correction = self._correction(observations, actions, deterministic)
            following = following + th.where(self.corrected, correction, 0.0).to(following.dtype)
        given = observations, actions, following
        if self.reward_fn is not None:
            rewards = self.reward_fn(*given).reshape(len(following))
        if self.termination_fn is not None:
            terminations = self.termination_fn(*given).bool().reshape(len(following))
        return Prediction(following, rewards, terminations)

    def error(self, data: Transitions) -> float:
        """As in :class:`~sb3_rpto.dynamics.base.Dynamics`, on the newest 5000 transitions with known states.

        :param data: transitions, oldest first
        :return: nan if no state is known
        :raises RuntimeError: before :meth:`attach`
        """
        data = data.take(self._usable(data))
        if not len(data):
            return float("nan")
        prediction = self.step(data.observations, data.actions, deterministic=True)
        return relative_error(prediction.next_observations, data)

    def _usable(self, data: Transitions) -> th.Tensor:
        """Index of the newest transitions whose states are known, (m,); of the others the simulator knows nothing."""
        oldest = max(0, len(data) - MAX_TRANSITIONS)
        newest = data.take(slice(oldest, None))
        rows = as_steps(newest, self.physical.recover, self.physical.mj_model, self.physical.frame_skip).rows
        return th.as_tensor(oldest + rows, device=data.observations.device)

    def _correction(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool) -> th.Tensor:
        """What the ensemble would add to each next observation, (n, observation_dim), in float64."""
        # float32 would round small corrections away at large positions
        observations = observations.double()
        answer = self.ensemble.step(observations, actions.double(), deterministic)
        return answer.next_observations - observations

    # ------------------------------------------------------------------ the fit

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Fit the simulator, then the ensemble to what it misses, and correct where that helps.

        The newest fifth of the transitions is held out of the ensemble's data. As the data grow, they are trained on
        later. The holdout's errors count alike, without weights.

        :param data: transitions, oldest first
        :param weights: (n,), RTO's, for both parts; None weighs all alike
        :param max_steps: cap for each part: of trusted steps, of gradient steps; None leaves it to them
        :return: what the simulator's fit logs; ``residual_on`` (1 if anything is corrected, else 0); and, from 50
            transitions on, the held-out ``physical_error`` and ``combined_error`` (as :meth:`error`)
        :raises RuntimeError: before :meth:`attach`
        :raises ValueError: weights of another shape
        """
        log = self.physical.fit(data, weights, max_steps)
        self.corrected.fill_(False)
        usable = self._usable(data)
        if len(usable) >= MIN_TRANSITIONS:
            log |= self._fit_ensemble(data, usable, weights, max_steps)
        return {**log, "residual_on": float(self.corrected.any())}

    def _fit_ensemble(
        self, every: Transitions, usable: th.Tensor, weights: th.Tensor | None, max_steps: int | None
    ) -> dict[str, float]:
        """Fit the ensemble to what the simulator misses of the ``usable`` rows, (m,), and set the mask."""
        data = every.take(usable)
        observations, next_observations = data.observations.double(), data.next_observations.double()
        missed = next_observations - self.physical.step(observations, data.actions).next_observations
        missed = missed.nan_to_num(0.0, 0.0, 0.0)  # a simulation that blew up tells nothing
        n_train = len(data) - round(HOLDOUT * len(data))
        train, held = slice(None, n_train), slice(n_train, None)
        scale = (next_observations - observations).std(dim=0, unbiased=False)
        moving = scale > 1e-8
        scale = th.where(moving, scale, th.inf)
        reach = REACH * missed[train].abs().quantile(0.95, dim=0)
        before = _rms(missed[held].clamp(-reach, reach) / scale)
        worth = before > NEGLIGIBLE
        correction = th.zeros_like(missed[held])
        shares = None if weights is None else weights[usable][train]
        if worth.any() and (shares is None or shares.any()):  # else nothing that counts is left to learn from
            nothing = th.zeros_like(missed[:, 0])
            wanted = observations + th.where(worth, missed.clamp(-reach, reach), 0.0)
            examples = Transitions(observations, data.actions.double(), nothing, wanted, nothing)
            # The residual shrinks while phi is fitted, and its scaler must follow; the holdout judges the jump.
            self.ensemble.fitted.fill_(False)
            self.ensemble.fit_rows(examples.take(train), usable[train], shares, max_steps)
            correction = self._correction(observations[held], data.actions[held], deterministic=True)
            after = _rms((missed[held] - correction).clamp(-reach, reach) / scale)
            self.corrected.copy_(worth & (after < (1.0 - GAIN) * before))
        left = missed[held] - th.where(self.corrected, correction, 0.0)
        return {
            "physical_error": float(_rms((missed[held] / scale)[:, moving].flatten())),
            "combined_error": float(_rms((left / scale)[:, moving].flatten())),
        }


def _rms(values: th.Tensor) -> th.Tensor:
    """Root of the mean square over the first dimension."""
    return values.square().mean(dim=0).sqrt()


def _never(observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor) -> th.Tensor:
    return th.zeros(len(observations), dtype=th.bool, device=observations.device)
