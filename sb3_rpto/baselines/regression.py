"""Least squares by gradient steps: what distillation and error networks need."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

BATCH = 256


def regress(
    predict: Callable[[th.Tensor], th.Tensor],
    optimizer: th.optim.Optimizer,
    inputs: th.Tensor,
    goals: th.Tensor,
    n_steps: int,
) -> float:
    """Minimise the mean squared error of ``predict(inputs)`` in minibatch steps.

    :param predict: (b, n_inputs) -> the shape of the goals' rows
    :param optimizer: of the parameters that move
    :param inputs: (n, n_inputs)
    :param goals: (n, ...)
    :param n_steps: gradient steps, each on :data:`BATCH` rows drawn with replacement
    :return: mean loss over the last tenth of the steps
    """
    losses = []
    for _ in range(n_steps):
        rows = th.randint(len(inputs), (BATCH,))
        loss = (predict(inputs[rows]) - goals[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    return float(th.stack(losses[-max(1, n_steps // 10) :]).mean())
