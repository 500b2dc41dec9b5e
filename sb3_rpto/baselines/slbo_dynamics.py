"""One network without noise, trained on its own predictions: the model of SLBO."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional

from sb3_rpto.dynamics.base import Prediction, Transitions, predecessors
from sb3_rpto.dynamics.ensemble import EnsembleDynamics, TransitionFn
from sb3_rpto.ranges import check, whole

#: Predictions are kept within so many standard deviations of the states that the scaler saw.
FARTHEST = 100.0
#: Gradients are cut to this norm.
MAX_GRADIENT = 2.0


def open_loop_loss(
    predict: Callable[[th.Tensor, th.Tensor], th.Tensor],
    observations: th.Tensor,
    actions: th.Tensor,
    next_observations: th.Tensor,
    continues: th.Tensor,
    scale: th.Tensor,
) -> th.Tensor:
    r"""SLBO's loss: errors of the changes along predictions that are fed back, a norm and not its square.

    .. math:: \frac{1}{H} \sum_{i=0}^{H-1} \text{mean}
        \lVert ((\hat s_{i+1} - \hat s_i) - (s_{i+1} - s_i)) / \sigma \rVert_2, \quad \hat s_0 = s_0

    Where the data do not go on after a step, the next one starts from its own true state.

    :param predict: (observations, actions) -> next observations, differentiable
    :param observations: (H, b, observation_dim), H consecutive true states
    :param actions: (H, b, action_dim)
    :param next_observations: (H, b, observation_dim)
    :param continues: (H, b) bool, whether the following row is what follows
    :param scale: (observation_dim,), sigma, the standard one-step change
    """
    believed, total = observations[0], observations.new_zeros(())
    horizon = len(observations)
    for i in range(horizon):
        following = predict(believed, actions[i])
        error = (following - believed) - (next_observations[i] - observations[i])
        total = total + (error / scale).norm(dim=1).mean()
        if i < horizon - 1:
            believed = th.where(continues[i, :, None], following, observations[i + 1])
    return total / horizon


class DeterministicDynamics(EnsembleDynamics):
    """s' = s + f(s, a), one network fitted by :func:`open_loop_loss` (SLBO, Luo et al. 2019).

    Rewards and terminations that are not known as rules are heads of the same network, trained by absolute error and
    cross entropy. The scaler is fitted by the first :meth:`fit`, as in
    :class:`~sb3_rpto.dynamics.ensemble.EnsembleDynamics`; nothing is held out but a fifth of the rows of the scaler.

    :param observation_space: flat Box
    :param action_space: flat Box
    :param reward_fn: known reward (obs, act, next_obs) -> (n,)
    :param termination_fn: known rule (obs, act, next_obs) -> (n,) bool
    :param hidden: widths of the hidden layers
    :param learning_rate: Adam's
    :param batch_size: sequences of a gradient step
    :param horizon: H, steps of a sequence
    :param max_steps: gradient steps of a fit, unless it is told otherwise
    :raises ValueError: spaces that are not flat Boxes, or a number out of range
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        reward_fn: TransitionFn | None = None,
        termination_fn: TransitionFn | None = None,
        hidden: Sequence[int] = (500, 500),
        learning_rate: float = 1e-3,
        batch_size: int = 128,
        horizon: int = 2,
        max_steps: int = 5000,
    ) -> None:
        check({"horizon": whole(1)}, {"horizon": horizon})
        super().__init__(
            observation_space,
            action_space,
            reward_fn=reward_fn,
            termination_fn=termination_fn,
            n_members=1,
            n_elites=1,
            hidden=hidden,
            learning_rate=learning_rate,
            batch_size=batch_size,
            max_steps=max_steps,
            noise=False,
        )
        self.horizon = horizon

    @th.no_grad()
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """As in :class:`EnsembleDynamics`, always the mean; a state far beyond all data is held back there."""
        predicted = super().step(observations, actions, deterministic=True)
        n = self.observation_dim
        mean, reach = self.input_mean[:n], FARTHEST * self.input_std[:n]
        held = predicted.next_observations.clamp(mean - reach, mean + reach)
        return predicted._replace(next_observations=held.to(observations.dtype))

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Take ``max_steps`` gradient steps of the open-loop loss.

        A row is followed by the one that begins where it ends, also where rows of several environments are interleaved;
        samples without such rows are fitted by one-step errors.

        :param data: at least two transitions, oldest first
        :param weights: (n,), how often each row begins a sequence, not negative; None: all alike
        :param max_steps: gradient steps, at least 1; None for the constructor's
        :return: ``open_loop_loss`` (mean over the last tenth of the steps), ``steps``, ``fit_seconds``
        :raises ValueError: too few transitions, a wrong shape, values that are not finite, bad weights
        """
        started = time.perf_counter()
        self._prepare(data, weights)  # checks, and fits the scaler if this is the first time
        n_steps = self.max_steps if max_steps is None else max_steps
        if n_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {n_steps}")
        horizon = min(self.horizon, len(data))
        dtype = self.input_mean.dtype
        following = self._successors(data)
        begins = th.ones(len(data), device=self.device) if weights is None else weights.float()
        begins = begins[: len(data) - horizon + 1]
        tensors = (data.observations, data.actions, data.next_observations, data.rewards, data.terminations)
        columns = [tensor.to(dtype) for tensor in tensors]
        losses = []
        for _ in range(n_steps):
            first = begins.multinomial(self.batch_size, replacement=True, generator=self.generator)
            rows = [first]
            for _ in range(horizon - 1):
                after = following[rows[-1]]
                rows.append(th.where(after >= 0, after, rows[-1]))
            observations, actions, reached, rewards, ends = (column[th.stack(rows)] for column in columns)  # (H, b)
            continues = following[th.stack(rows)] >= 0
            scale = self.target_std[:-1]
            loss = open_loop_loss(self._following, observations, actions, reached, continues, scale)
            total = loss + self._head_loss(observations.flatten(0, 1), actions.flatten(0, 1), rewards, ends)
            self.optimizer.zero_grad()
            total.backward()
            th.nn.utils.clip_grad_norm_(self.networks.parameters(), MAX_GRADIENT)
            self.optimizer.step()
            losses.append(loss.detach())
        self.fitted.fill_(True)
        last = th.stack(losses[-max(1, n_steps // 10) :])
        seconds = time.perf_counter() - started
        return {"open_loop_loss": float(last.mean()), "steps": float(n_steps), "fit_seconds": seconds}

    def _successors(self, data: Transitions) -> th.Tensor:
        """The row that goes on from each, (n,); -1 where there is none."""
        arrays = (data.observations, data.next_observations, data.terminations)
        before = predecessors(*(array.cpu().numpy() for array in arrays))
        after = np.full(len(before), -1)
        after[before[before >= 0]] = np.flatnonzero(before >= 0)
        return th.as_tensor(after, device=self.device)

    def _following(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Next observations with gradient."""
        mean = self._ask_elites(self._inputs(observations, actions)).mean[0, :, :-1]
        return observations + mean * self.target_std[:-1] + self.target_mean[:-1]

    def _head_loss(self, observations: th.Tensor, actions: th.Tensor, rewards: th.Tensor, ends: th.Tensor) -> th.Tensor:
        """What teaches the heads that stand in for unknown rules; 0 where both are known."""
        loss = observations.new_zeros(())
        if self.reward_fn is not None and self.termination_fn is not None:
            return loss
        heads = self._ask_elites(self._inputs(observations, actions))
        if self.reward_fn is None:
            goal = (rewards.flatten() - self.target_mean[-1]) / self.target_std[-1]
            loss = loss + (heads.mean[0, :, -1] - goal).abs().mean()
        if self.termination_fn is None:
            logit = heads.logit[0, :, 0]
            loss = loss + functional.binary_cross_entropy_with_logits(logit, ends.flatten())
        return loss
