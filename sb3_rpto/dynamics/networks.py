"""The networks of the ensemble: independent Gaussian MLPs stacked, one batched product a layer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional

#: rows a member computes at once: activations stay in the cache
CHUNK = 256
#: weight of the penalty that pulls the log-variance bounds together (PETS)
BOUND_PENALTY = 0.01


class Heads(NamedTuple):
    """What ``m`` members say of ``n`` rows each, in standardised units."""

    mean: th.Tensor  # (m, n, n_targets)
    log_variance: th.Tensor  # (m, n, n_targets)
    logit: th.Tensor  # (m, n, 1) of a termination, (m, n, 0) if the rule is known

    def squared_error(self, targets: th.Tensor, terminations: th.Tensor) -> th.Tensor:
        """Squared error of each row (m, n), the mean over the outputs; a termination counts by its Brier score."""
        brier = (self.logit.sigmoid() - terminations.unsqueeze(-1)).square()
        return th.cat([(self.mean - targets).square(), brier], dim=-1).mean(dim=-1)

    def nll(self, targets: th.Tensor, terminations: th.Tensor) -> th.Tensor:
        """-log p(s', r[, termination] | s, a) of each row (m, n), in nats per output."""
        squared = (self.mean - targets).square() * (-self.log_variance).exp()
        gauss = 0.5 * (squared + self.log_variance + math.log(2.0 * math.pi))
        cross_entropy = functional.softplus(self.logit) - terminations.unsqueeze(-1) * self.logit
        return th.cat([gauss, cross_entropy], dim=-1).mean(dim=-1)


class StackedNetworks(nn.Module):
    """``n_members`` independent Gaussian MLPs, one batched product a layer.

    Every parameter has the members first, the log-variance bounds too: no member sees another's gradient.

    :param n_members: number of networks
    :param n_inputs: input dimensions
    :param hidden: widths of the hidden layers
    :param n_targets: dimensions with a Gaussian each
    :param n_logits: Bernoulli outputs beside them
    """

    def __init__(self, n_members: int, n_inputs: int, hidden: Sequence[int], n_targets: int, n_logits: int) -> None:
        super().__init__()
        self.n_targets = n_targets
        self.n_logits = n_logits
        sizes = [n_inputs, *hidden, 2 * n_targets + n_logits]
        self.weights = nn.ParameterList(
            # a truncated normal of standard deviation 1 / (2 sqrt(fan-in)), as in PETS
            nn.init.trunc_normal_(th.empty(n_members, i, o), std=(s := 0.5 / math.sqrt(i)), a=-2 * s, b=2 * s)
            for i, o in pairwise(sizes)
        )
        self.biases = nn.ParameterList(th.zeros(n_members, 1, o) for o in sizes[1:])
        self.max_log_variance = nn.Parameter(th.full((n_members, 1, n_targets), 0.5))
        self.min_log_variance = nn.Parameter(th.full((n_members, 1, n_targets), -10.0))

    def forward(self, inputs: th.Tensor, members: th.Tensor | None = None) -> Heads:
        """Predict, each member its own rows.

        :param inputs: (m, n, n_inputs), standardised
        :param members: (m,), which members; None for all in their order
        """

        def of(parameter: th.Tensor) -> th.Tensor:
            return parameter if members is None else parameter[members]

        layers = [(of(w), of(b)) for w, b in zip(self.weights, self.biases)]
        bounds = of(self.min_log_variance), of(self.max_log_variance)
        chunks = [self._predict(layers, bounds, x) for x in inputs.split(CHUNK, dim=1)]
        return chunks[0] if len(chunks) == 1 else Heads(*(th.cat(parts, dim=1) for parts in zip(*chunks)))

    def _predict(
        self, layers: Sequence[tuple[th.Tensor, th.Tensor]], bounds: tuple[th.Tensor, th.Tensor], x: th.Tensor
    ) -> Heads:
        """Of rows that fit the cache, (m, n, n_inputs)."""
        *hidden, (last_weight, last_bias) = layers
        for weight, bias in hidden:
            x = functional.silu(th.baddbmm(bias, x, weight))
        outputs = th.baddbmm(last_bias, x, last_weight)
        mean, log_variance, logit = outputs.split([self.n_targets, self.n_targets, self.n_logits], dim=-1)
        low, high = bounds
        log_variance = high - functional.softplus(high - log_variance)
        log_variance = low + functional.softplus(log_variance - low)
        return Heads(mean, log_variance, logit)

    def bound_penalty(self) -> th.Tensor:
        """Sum over members and dimensions of the distance between the bounds."""
        return BOUND_PENALTY * (self.max_log_variance - self.min_log_variance).sum()

    def optimizer(self, learning_rate: float) -> th.optim.Adam:
        """Adam with MBPO's L2 decay of the weights, which grows with depth; biases and bounds have none."""
        n_middle = max(len(self.weights) - 3, 0)
        decays = [*[2.5e-5, 5e-5, *[7.5e-5] * n_middle][: len(self.weights) - 1], 1e-4]
        groups: list[dict[str, Any]] = [{"params": [w], "weight_decay": d} for w, d in zip(self.weights, decays)]
        groups.append({"params": [*self.biases, self.max_log_variance, self.min_log_variance], "weight_decay": 0.0})
        return th.optim.Adam(groups, lr=learning_rate, fused=True)
