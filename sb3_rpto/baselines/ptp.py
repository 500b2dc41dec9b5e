"""Plan To Predict: of several predictions keep the one from which the model will err least."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_rpto.algorithms.interfaces import Agent, SourceRollouts
from sb3_rpto.algorithms.rollouts import BranchSource, sample_policy
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.regression import regress
from sb3_rpto.dynamics.base import Prediction, Transitions
from sb3_rpto.ranges import check, whole


def squared_error(predicted: Prediction, data: Transitions, beta: float) -> th.Tensor:
    """What the error network learns: ||s_hat' - s'||^2 + beta (r_hat - r)^2, (n,), in the environment's units."""
    of_states = (predicted.next_observations - data.next_observations).square().sum(dim=1)
    return of_states + beta * (predicted.rewards - data.rewards).square()


def foresee(
    step: Callable[[th.Tensor, th.Tensor], Prediction],
    act: Callable[[th.Tensor], th.Tensor],
    error: Callable[[th.Tensor, th.Tensor, Prediction], th.Tensor],
    observations: th.Tensor,
    actions: th.Tensor,
    n_candidates: int,
    horizon: int,
) -> Prediction:
    """Draw candidates for the next state, roll each on under the policy, keep for each state the least erroneous.

    A candidate that ends its episode is rolled on nevertheless: were its later errors left out, an early end would
    always win.

    :param step: the model, (observations, actions) -> a sample for each
    :param act: the policy, observations -> actions in the environment's units
    :param error: predicted error of a prediction, (observations, actions, prediction) -> (n,)
    :param observations: (n, observation_dim)
    :param actions: (n, action_dim), in the environment's units
    :param n_candidates: K
    :param horizon: H, model steps that a candidate is judged by, the first included
    :return: the candidates' first steps, the best of each state
    """
    n = len(observations)
    seen, taken = observations.repeat(n_candidates, 1), actions.repeat(n_candidates, 1)
    first = answer = step(seen, taken)
    errors = error(seen, taken, answer)
    for _ in range(horizon - 1):
        seen = answer.next_observations
        taken = act(seen)
        answer = step(seen, taken)
        errors = errors + error(seen, taken, answer)
    best = errors.view(n_candidates, n).argmin(dim=0)
    rows = best * n + th.arange(n, device=best.device)
    return Prediction(*(part[rows] for part in first))


class ErrorNetwork(nn.Module):
    """e(s, a, s_hat', r_hat): how far a prediction of the model will be from the truth.

    :param observation_dim: of the task
    :param action_dim: of the task
    :param hidden: widths of the hidden layers
    :param learning_rate: Adam's
    """

    input_mean: th.Tensor
    input_std: th.Tensor
    scale: th.Tensor
    fitted: th.Tensor

    def __init__(self, observation_dim: int, action_dim: int) -> None:
        super().__init__()
        n_inputs = 2 * observation_dim + action_dim + 1
        self.network = nn.Sequential(*create_mlp(n_inputs, 1, [256, 256]))
        self.optimizer = th.optim.Adam(self.network.parameters(), lr=5e-4)
        self.register_buffer("input_mean", th.zeros(n_inputs))
        self.register_buffer("input_std", th.ones(n_inputs))
        self.register_buffer("scale", th.ones(()))
        self.register_buffer("fitted", th.tensor(False))

    @th.no_grad()
    def forward(self, observations: th.Tensor, actions: th.Tensor, predicted: Prediction) -> th.Tensor:
        """The predicted error of each prediction, (n,)."""
        return self.scale * self._standardised(_inputs(observations, actions, predicted))

    def _standardised(self, inputs: th.Tensor) -> th.Tensor:
        return self.network((inputs - self.input_mean) / self.input_std)[:, 0]

    def fit(self, data: Transitions, predicted: Prediction, errors: th.Tensor, n_steps: int) -> float:
        """Regress on the errors of ``predicted``; the scales are those of the first call.

        :param data: real transitions, of which only observations and actions are inputs
        :param predicted: what the model says of them
        :param errors: (n,), how far off it is
        :param n_steps: gradient steps
        :return: mean squared error of the last steps, in the scaled units
        """
        inputs = _inputs(data.observations, data.actions, predicted)
        if not self.fitted:
            self.input_mean.copy_(inputs.mean(dim=0))
            self.input_std.copy_(inputs.std(dim=0, unbiased=False).clamp(min=1e-6))
            self.scale.copy_(errors.std(unbiased=False).clamp(min=1e-12))
        error = regress(self._standardised, self.optimizer, inputs, (errors / self.scale).float(), n_steps)
        self.fitted.fill_(True)
        return error


def _inputs(observations: th.Tensor, actions: th.Tensor, predicted: Prediction) -> th.Tensor:
    """[s, a, s_hat' - s, r_hat], (n, n_inputs)."""
    change = predicted.next_observations - observations
    return th.cat([observations, actions, change, predicted.rewards[:, None]], dim=1).float()


class ForeseenBranches(BranchSource):
    """Branches whose answer is the best of several; a plain sample until the error network has been fitted."""

    def answer(self, agent: Agent, observations: th.Tensor, actions: th.Tensor) -> Prediction:
        """See :func:`foresee`."""
        assert isinstance(agent, PTP)
        if not agent.errors.fitted:
            return super().answer(agent, observations, actions)
        return foresee(
            self.dynamics.step,
            agent.act,
            agent.errors,
            observations,
            actions,
            agent.n_candidates,
            agent.horizon,
        )


class PTP(MBPO):
    """Plan To Predict, warm-started: MBPO whose model is a decision maker that avoids its own future errors.

    Paper: https://arxiv.org/abs/2301.08502 (Wu, Yu, Chen, Hao, Zhuo: Plan To Predict: Learning an
    Uncertainty-Foreseeing Model for Model-Based Reinforcement Learning, NeurIPS 2022), the variant that plans.

    An error network e(s, a, s_hat', r_hat) is regressed on ||s_hat' - s'||^2 + beta (r_hat - r)^2 of the model on
    D_target after each of its fits. At each branch the model offers ``n_candidates`` samples, each is rolled on under
    the policy, and the one with the smallest sum of predicted errors is kept.

    :param args: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`
    :param n_candidates: K; None takes the paper's (4, HalfCheetah 6)
    :param horizon: H, model steps that a candidate is judged by, the first included
    :param beta: weight of the reward's error
    :param error_steps: gradient steps of the error network after each fit of the model
    :param kwargs: as those of :class:`~sb3_rpto.baselines.mbpo.MBPO`
    :raises ValueError: for numbers that are not positive
    """

    NUMBERS: ClassVar[dict[str, Any]] = {**MBPO.NUMBERS, "n_candidates": 4}
    NUMBERS_OF_TASKS: ClassVar[dict[str, dict[str, Any]]] = {"HalfCheetah": {"gradient_steps": 40, "n_candidates": 6}}

    errors: ErrorNetwork

    def __init__(
        self,
        *args: Any,
        n_candidates: int | None = None,
        horizon: int = 6,
        beta: float = 1.0,
        error_steps: int = 500,
        **kwargs: Any,
    ) -> None:
        if n_candidates is None:
            self.given_arguments -= {"n_candidates"}
        self.n_candidates = self.NUMBERS["n_candidates"] if n_candidates is None else n_candidates
        self.horizon, self.beta, self.error_steps = horizon, beta, error_steps
        super().__init__(*args, **kwargs)

    def _check_numbers(self) -> None:
        super()._check_numbers()
        check(dict.fromkeys(("n_candidates", "horizon", "error_steps"), whole(1)), vars(self))

    def _setup_model(self) -> None:
        super()._setup_model()
        self.errors = ErrorNetwork(self.observation_space.shape[0], self.action_space.shape[0]).to(self.device)

    def make_rollouts(self) -> SourceRollouts:
        """Branches whose answer is the best of several."""
        assert self.dynamics is not None  # it updates them
        return ForeseenBranches(self.dynamics, self.rollout_start)

    def act(self, observations: th.Tensor) -> th.Tensor:
        """Actions of the stochastic policy in the environment's units; raw observations (n, d) -> (n, action_dim)."""
        return self.unscale_actions(sample_policy(self, self.normalise_observations(observations)))

    def fit_dynamics(self) -> None:
        """Fit the model as MBPO does, then the error network to what it still errs by."""
        super().fit_dynamics()
        assert self.dynamics is not None
        data = self.transitions("target")
        predicted = self.dynamics.step(data.observations, data.actions)
        errors = squared_error(predicted, data, self.beta)
        self.logger.record("dynamics/mean_squared_error", float(errors.mean()))
        self.logger.record("dynamics/error_network_loss", self.errors.fit(data, predicted, errors, self.error_steps))

    def own_states(self) -> list[str]:
        """Those of all, and the error network with its optimizer."""
        return [*super().own_states(), "errors", "errors.optimizer"]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "errors"]
