"""What SB3's actor and critics answer, in fewer operations where their kind is the usual one; the numbers are SB3's."""

from __future__ import annotations

import math
from functools import reduce

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import Actor

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def sample_actions(actor: Actor, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Draw a ~ pi(.|s), reparametrised.

    With z the standard normal noise, log pi(a|s) = sum_j -z_j²/2 - log sigma_j - log(2 pi)/2 - log(1 - a_j² + eps):
    SB3 computes z back from the action's preimage.

    :param actor: SAC's
    :param observations: (n, observation_dim), normalised
    :return: actions in [-1, 1], (n, action_dim), and log pi(a|s), (n, 1)
    """
    distribution = actor.action_dist
    own = type(actor).action_log_prob is not Actor.action_log_prob
    if own or type(distribution) is not SquashedDiagGaussianDistribution:  # the user's way, gSDE
        actions, log_prob = actor.action_log_prob(observations)
        return actions, log_prob.reshape(-1, 1)
    mean, log_std, _ = actor.get_action_dist_params(observations)
    noise = th.randn_like(mean)
    actions = th.tanh(mean + log_std.exp() * noise)
    terms = 0.5 * noise.square() + log_std + (1.0 - actions.square() + distribution.epsilon).log()
    return actions, -(terms.sum(dim=1, keepdim=True) + actions.shape[1] * HALF_LOG_TWO_PI)


def smallest_q(critic: ContinuousCritic, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """The pessimistic estimate min_i Q_i(s, a), (n, 1).

    :param critic: SAC's, or its target
    :param observations: (n, observation_dim), normalised
    :param actions: (n, action_dim) in [-1, 1]
    """
    return reduce(th.minimum, critic(observations, actions))
