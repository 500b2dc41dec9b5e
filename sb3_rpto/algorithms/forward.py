"""What SB3's actor and critics answer, in fewer operations where their kind is the usual one; the numbers are SB3's."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import Actor
from torch.optim.swa_utils import get_ema_multi_avg_fn

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def sample_actions(actor: Actor, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Draw a ~ pi(.|s), reparametrised.

    With z the standard normal noise, log pi(a|s) = sum_j -z_j²/2 - log sigma_j - log(2 pi)/2 - log(1 - a_j² + eps):
    SB3 computes z back from the action's preimage.

    :param actor: SAC's
    :param observations: (n, observation_dim), normalised
    :return: actions in [-1, 1], (n, action_dim), and log pi(a|s), (n, 1)
    """
    distribution = actor.action_dist
    if type(distribution) is not SquashedDiagGaussianDistribution:  # gSDE
        actions, log_prob = actor.action_log_prob(observations)
        return actions, log_prob.reshape(-1, 1)
    mean, log_std, _ = actor.get_action_dist_params(observations)
    noise = th.randn_like(mean)
    actions = th.tanh(mean + log_std.exp() * noise)
    terms = 0.5 * noise.square() + log_std + (1.0 - actions.square() + distribution.epsilon).log()
    return actions, -(terms.sum(dim=1, keepdim=True) + actions.shape[1] * _HALF_LOG_TWO_PI)


def smallest_q(critic: ContinuousCritic, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """The pessimistic estimate min_i Q_i(s, a), (n, 1).

    :param critic: SAC's, or its target
    :param observations: (n, observation_dim), normalised
    :param actions: (n, action_dim) in [-1, 1]
    """
    return th.cat(critic(observations, actions), dim=1).min(dim=1, keepdim=True)[0]


def follow(targets: Iterable[th.Tensor], tensors: Iterable[th.Tensor], tau: float) -> None:
    """Polyak's average in place: target <- (1 - tau) target + tau tensor, all tensors in one call."""
    with th.no_grad():
        get_ema_multi_avg_fn(1.0 - tau)(list(targets), list(tensors), 0)


def descend(optimizer: th.optim.Optimizer, loss: th.Tensor) -> None:
    """One step of ``optimizer``; only its own parameters get gradients (the actor's loss spares the critic's)."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for parameter, gradient in zip(parameters, th.autograd.grad(loss, parameters, allow_unused=True)):
        parameter.grad = gradient
    optimizer.step()


def fuse(optimizer: th.optim.Optimizer) -> None:
    """Let Adam take its fused step where the user has not chosen another: the same formula in one call.

    :param optimizer: of any kind; only torch's own Adam and AdamW are changed
    """
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
        return
    for group in optimizer.param_groups:
        if group["fused"] is None and group["foreach"] is None and not group["capturable"]:
            group["fused"] = True
            for parameter in group["params"]:
                state = optimizer.state.get(parameter)
                if state and "step" in state:  # fused steps count on the parameter's device
                    state["step"] = state["step"].to(parameter.device)
