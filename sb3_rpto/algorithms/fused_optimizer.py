"""Steps of SB3's optimizers and of the target networks with little around the arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn
from torch.optim.adam import adam
from torch.optim.swa_utils import get_ema_multi_avg_fn


class Descent:
    """Steps an optimizer down losses; only its own parameters get gradients (the actor's loss spares the critic's).

    Plain Adam takes torch's fused step on lists that are made once, not at every step; its state stays the optimizer's.
    Other optimizers, and Adam with options of the user's, step as they are. Frozen parameters stay; the gradients of
    the last step stay in ``grad``, for callbacks.

    :param optimizer: of any kind
    """

    def __init__(self, optimizer: th.optim.Optimizer) -> None:
        self.optimizer = optimizer
        self._own = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        self.parameters = [parameter for parameter in self._own if parameter.requires_grad]
        self._plain = _is_plain_adam(optimizer)
        self._state: tuple[list[th.Tensor], ...] = ()

    def forget(self) -> None:
        """Let go of the last gradients, so that the next ones take their memory, and what is frozen now has none."""
        for parameter in self._own:
            parameter.grad = None

    def __call__(self, loss: th.Tensor) -> None:
        """One step down the gradient of ``loss``; hooks of the parameters act on it."""
        self.forget()
        if self.parameters:
            loss.backward(inputs=self.parameters)
            self.step([parameter.grad for parameter in self.parameters])

    def step(self, gradients: Sequence[th.Tensor | None]) -> None:
        """One step down gradients that are known, one for each parameter that learns, in the optimizer's order."""
        for parameter, gradient in zip(self.parameters, gradients):
            parameter.grad = gradient
        # The first step of each makes its state.
        begun = bool(self._state) or all(self.optimizer.state.get(parameter) for parameter in self.parameters)
        if self._plain and begun and all(gradient is not None for gradient in gradients):
            self._step_adam(list(gradients))
        else:
            self.optimizer.step()

    def _step_adam(self, gradients: list[Any]) -> None:
        group = self.optimizer.param_groups[0]
        if not self._state:
            states = [self.optimizer.state[parameter] for parameter in self.parameters]
            for state, parameter in zip(states, self.parameters):  # fused steps are counted where the parameter is
                state["step"] = state["step"].to(parameter.device)
            self._state = tuple([s[name] for s in states] for name in ("exp_avg", "exp_avg_sq", "step"))
        means, squares, steps = self._state
        beta1, beta2 = group["betas"]
        options = {name: group[name] for name in ("lr", "weight_decay", "eps")}
        with th.no_grad():
            adam(
                self.parameters,
                gradients,
                means,
                squares,
                [],
                steps,
                fused=True,
                amsgrad=False,
                beta1=beta1,
                beta2=beta2,
                maximize=False,
                **options,
            )


def _is_plain_adam(optimizer: th.optim.Optimizer) -> bool:
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1:
        return False
    group = optimizer.param_groups[0]
    asked = ("amsgrad", "maximize", "capturable", "differentiable", "foreach", "fused", "decoupled_weight_decay")
    hooked = optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks
    return not hooked and not any(group.get(name) for name in asked)


class Follower:
    """Polyak's average of a target network, all its tensors in one call: target <- (1 - tau) target + tau tensor.

    :param target: that follows
    :param network: that is followed
    :param tau: share of the network in each step
    """

    def __init__(self, target: nn.Module, network: nn.Module, tau: float) -> None:
        self._targets, self._tensors = list(target.parameters()), list(network.parameters())
        self._average = get_ema_multi_avg_fn(1.0 - tau)

    def __call__(self) -> None:
        """One step."""
        with th.no_grad():
            self._average(self._targets, self._tensors, 0)
