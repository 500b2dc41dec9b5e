"""The losses of critic, actor and temperature, and the values that RTO weighs transitions by."""

from __future__ import annotations

import math
from functools import reduce

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import Actor
from torch.nn import functional as F

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def sample_actions(actor: Actor, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Draw a ~ pi(.|s), reparametrised.

    With z the standard normal noise, log pi(a|s) = sum_j -z_j²/2 - log sigma_j - log(2 pi)/2 - log(1 - a_j² + eps):
    SB3 computes z back from the action's preimage, which takes more operations.

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


def critic_loss(
    actor: Actor,
    critic: ContinuousCritic,
    critic_target: ContinuousCritic,
    batch: ReplayBufferSamples,
    ent_coef: th.Tensor,
    gamma: float,
) -> th.Tensor:
    """Soft Bellman residual, Eq. soft_q: half the sum over critics of the mean squared error."""
    with th.no_grad():
        next_actions, next_log_prob = sample_actions(actor, batch.next_observations)
        next_q = smallest_q(critic_target, batch.next_observations, next_actions)
        next_value = next_q - ent_coef * next_log_prob
        target = batch.rewards + (1 - batch.dones) * gamma * next_value
    return 0.5 * th.stack([F.mse_loss(q, target) for q in critic(batch.observations, batch.actions)]).sum()


def actor_loss(
    critic: ContinuousCritic,
    observations: th.Tensor,
    actions: th.Tensor,
    log_prob: th.Tensor,
    ent_coef: th.Tensor,
) -> th.Tensor:
    """RPO, Eq. sac: states of the target, values of the source; alpha log pi - min_i Q_i(s, a)."""
    return (ent_coef * log_prob - smallest_q(critic, observations, actions)).mean()


def temperature_loss(log_ent_coef: th.Tensor, log_prob: th.Tensor, target_entropy: float) -> th.Tensor:
    """SAC's loss of log alpha on the batch that the actor sees."""
    return -(log_ent_coef * (log_prob + target_entropy).detach()).mean()


@th.no_grad()
def soft_value(
    actor: Actor, critic_target: ContinuousCritic, observations: th.Tensor, ent_coef: th.Tensor
) -> th.Tensor:
    """V(s) = min_i Q_target,i(s, a) - alpha log pi(a|s) with a ~ pi(s); normalised observations (n, d) -> (n,)."""
    actions, log_prob = sample_actions(actor, observations)
    return (smallest_q(critic_target, observations, actions) - ent_coef * log_prob)[:, 0]
