"""SAC's losses and their gradients written out for SB3's usual networks: autograd's numbers in fewer operations.

For chains of Linear and ReLU the gradients are a few lines, so they are written here; other networks go through
autograd. What it saves on a CPU: docs/speed.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor
from torch import nn
from torch.nn import functional as F

from sb3_rpto.algorithms.fast_forward import HALF_LOG_TWO_PI

if TYPE_CHECKING:
    from sb3_rpto.algorithms.update import Descents, RelativeUpdate


class Chain:
    """Linear layers, each followed by a ReLU.

    :param layers: in their order
    """

    def __init__(self, layers: Sequence[nn.Linear]) -> None:
        self.weights = [layer.weight for layer in layers]
        self.biases = [layer.bias for layer in layers]

    def forward(self, inputs: th.Tensor) -> list[th.Tensor]:
        """The inputs (n, d), then what each layer answers."""
        seen = [inputs]
        for weight, bias in zip(self.weights, self.biases):
            seen.append(F.linear(seen[-1], weight, bias).relu_())
        return seen

    def backward(self, seen: list[th.Tensor], slope: th.Tensor) -> Iterator[th.Tensor]:
        """From a loss's gradient of the last answer to those before each ReLU, the last layer's first.

        :param seen: of :meth:`forward`
        :param slope: (n, width of the last layer)
        """
        for layer in reversed(range(len(self.weights))):
            slope = slope * seen[layer + 1].sign()  # of what a ReLU answers, its slope
            yield slope
            if layer:
                slope = slope @ self.weights[layer]

    def descent(self, seen: list[th.Tensor], slope: th.Tensor) -> list[th.Tensor]:
        """Gradients of all weights and biases, as ``parameters()`` lists them; arguments as of :meth:`backward`."""
        found: list[th.Tensor] = []
        for before, inner in zip(reversed(seen[:-1]), self.backward(seen, slope)):
            found[:0] = inner.T @ before, inner.sum(0)
        return found


class Critic(NamedTuple):
    """One Q_i: a chain, and the layer that makes one number of its answer."""

    chain: Chain
    head: nn.Linear

    def values(self, seen: list[th.Tensor]) -> th.Tensor:
        """Q_i of each row, (n,), from what the chain has seen."""
        return (seen[-1] * self.head.weight).sum(1) + self.head.bias  # a third of what torch's mv takes

    def slope(self, slopes: th.Tensor) -> th.Tensor:
        """From a loss's gradient of the values (n,) to that of the chain's answer."""
        return slopes[:, None] * self.head.weight


class Sample(NamedTuple):
    """Actions a = tanh(mu + sigma z) of a policy, and what their gradient needs."""

    actions: th.Tensor  # (n, action_dim)
    log_prob: th.Tensor  # (n, 1)
    spread: th.Tensor  # sigma z
    room: th.Tensor  # 1 - a^2, the slope of tanh
    free: th.Tensor  # whether log sigma is within SB3's bounds


class WrittenUpdate:
    """:meth:`RelativeUpdate.update_once` without autograd, for networks that :func:`are_usual` knows.

    :param model: whose networks are updated
    """

    def __init__(self, model: RelativeUpdate) -> None:
        self.model = model
        actor = model.actor
        self.actor = Chain(_linears(actor.latent_pi))
        self.mean: nn.Linear = actor.mu  # type: ignore[assignment]
        self.log_std: nn.Linear = actor.log_std  # type: ignore[assignment]
        self.epsilon: float = actor.action_dist.epsilon
        self.critics, self.targets = _critics(model.critic), _critics(model.critic_target)

    def __call__(
        self, critic_batch: ReplayBufferSamples, actor_batch: ReplayBufferSamples, descend: Descents
    ) -> dict[str, th.Tensor]:
        """One update of temperature, critic and actor, in SAC's order; arguments as of ``update_once``."""
        model = self.model
        ent_coef = model.temperature()
        losses = {"ent_coef": ent_coef}
        learns = model.updates_policy or model._pretraining
        states, n = [critic_batch.next_observations], len(critic_batch.next_observations)
        if learns:  # the actor is the same for both batches: it is asked once
            states.insert(0, actor_batch.observations)
        seen, sample = self._act(states)
        next_actions, next_log_prob = sample.actions[-n:], sample.log_prob[-n:]
        if learns:
            m = len(actor_batch.observations)
            seen, sample = [answer[:m] for answer in seen], Sample(*(part[:m] for part in sample))
            if descend.ent_coef is not None:
                losses["ent_coef_loss"], slope = self._temperature_loss(sample.log_prob)
                descend.ent_coef.step([slope])
        losses["critic_loss"], gradients = self._critic_loss(critic_batch, next_actions, next_log_prob, ent_coef)
        descend.critic.step(gradients)
        if learns:
            losses["actor_loss"], gradients = self._actor_loss(seen, sample, ent_coef)
            descend.actor.step(gradients)
        return losses

    @th.no_grad()
    def _act(self, states: list[th.Tensor]) -> tuple[list[th.Tensor], Sample]:
        """a ~ pi(s) in all batches of states, drawn a batch after the other, as SB3 draws them."""
        seen = self.actor.forward(th.cat(states))
        mean, raw = self._heads(seen[-1])
        noise = th.cat([th.randn_like(part) for part in mean.split([len(s) for s in states])])
        log_std = raw.clamp(LOG_STD_MIN, LOG_STD_MAX)
        spread = log_std.exp() * noise
        actions = th.tanh(mean + spread)
        room = 1.0 - actions.square()
        terms = 0.5 * noise.square() + log_std + (room + self.epsilon).log()
        log_prob = -(terms.sum(dim=1, keepdim=True) + actions.shape[1] * HALF_LOG_TWO_PI)
        return seen, Sample(actions, log_prob, spread, room, log_std == raw)

    def _heads(self, answer: th.Tensor) -> Sequence[th.Tensor]:
        weight = th.cat([self.mean.weight, self.log_std.weight])
        return F.linear(answer, weight, th.cat([self.mean.bias, self.log_std.bias])).chunk(2, dim=1)

    @th.no_grad()
    def _temperature_loss(self, log_prob: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """SAC's loss of log alpha, which is linear in it, and its gradient."""
        log_ent_coef = self.model.log_ent_coef
        assert log_ent_coef is not None  # it is learned
        slope = -(log_prob + self.model.target_entropy).mean().expand_as(log_ent_coef)
        return log_ent_coef * slope, slope

    @th.no_grad()
    def _critic_loss(
        self, batch: ReplayBufferSamples, next_actions: th.Tensor, next_log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """Soft Bellman residual, Eq. soft_q, and its gradient for the critics' parameters."""
        following = th.cat([batch.next_observations, next_actions], dim=1)
        next_q = th.stack([q.values(q.chain.forward(following)) for q in self.targets]).amin(0)
        next_value = next_q - ent_coef * next_log_prob[:, 0]
        target = batch.rewards[:, 0] + (1 - batch.dones[:, 0]) * self.model.gamma * next_value
        pairs, n = th.cat([batch.observations, batch.actions], dim=1), len(target)
        gradients, errors = [], []
        for q in self.critics:
            seen = q.chain.forward(pairs)
            error = q.values(seen) - target
            slopes = error / n
            gradients += q.chain.descent(seen, q.slope(slopes))
            gradients += [(seen[-1] * slopes[:, None]).sum(0, keepdim=True), slopes.sum(0, keepdim=True)]
            errors.append(error)
        return 0.5 * th.stack(errors).square().mean(1).sum(), gradients

    @th.no_grad()
    def _actor_loss(
        self, seen: list[th.Tensor], sample: Sample, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """RPO, Eq. sac: the mean of alpha log pi - min_i Q_i(s, a), and its gradient for the actor's parameters."""
        pairs, n, d = th.cat([seen[0], sample.actions], dim=1), len(sample.actions), seen[0].shape[1]
        answers = [q.chain.forward(pairs) for q in self.critics]
        smallest, which = th.stack([q.values(answer) for q, answer in zip(self.critics, answers)]).min(0)
        loss = (ent_coef * sample.log_prob[:, 0] - smallest).mean()
        # d log pi / d a = 2 a / (1 - a^2 + epsilon); d Q / d a through the critic that is the smallest in its row
        slope = ent_coef / n * (2.0 * sample.actions / (sample.room + self.epsilon))
        for i, (q, answer) in enumerate(zip(self.critics, answers)):
            *_, first = q.chain.backward(answer, q.slope((which == i) / -n))
            slope += first @ q.chain.weights[0][:, d:]
        for_mean = slope * sample.room
        for_log_std = (for_mean * sample.spread - ent_coef / n) * sample.free
        both = th.cat([for_mean, for_log_std], dim=1)
        gradients = self.actor.descent(seen, both @ th.cat([self.mean.weight, self.log_std.weight]))
        for weight, bias in zip((both.T @ seen[-1]).chunk(2), both.sum(0).chunk(2)):
            gradients += [weight, bias]
        return loss, gradients


def are_usual(model: RelativeUpdate) -> bool:
    """Whether actor and critics are SB3's own, chains of Linear and ReLU without hooks, all of them learned."""
    actor, critics = model.actor, (model.critic, model.critic_target)
    if type(actor) is not Actor or any(type(critic) is not ContinuousCritic for critic in critics):
        return False
    if model.use_sde or type(actor.action_dist) is not SquashedDiagGaussianDistribution:
        return False
    modules = [module for network in (actor, *critics) for module in network.modules()]
    known = (Actor, ContinuousCritic, FlattenExtractor, nn.Flatten, nn.Sequential, nn.Linear, nn.ReLU)
    hooks = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
    if any(type(module) not in known or any(getattr(module, hook) for hook in hooks) for module in modules):
        return False
    heads = [actor.mu, actor.log_std]
    if any(not isinstance(head, nn.Linear) for head in heads):
        return False
    chains = [(actor.latent_pi, 0), *((network, 1) for critic in critics for network in critic.q_networks)]
    if not all(_is_chain(chain, end) for chain, end in chains):
        return False
    own = [p for layer in (actor.latent_pi, *heads) for p in layer.parameters()]
    theirs = [p for network in model.critic.q_networks for p in network.parameters()]
    biased = all(layer.bias is not None for layer in modules if isinstance(layer, nn.Linear))
    return biased and _learns(actor.optimizer, own) and _learns(model.critic.optimizer, theirs)


def _is_chain(layers: nn.Module, end: int) -> bool:
    """Whether Linear and ReLU take turns, at least once, with ``end`` more of the first at the end."""
    kinds = [type(layer) for layer in layers.children()]
    n = len(kinds) // 2
    return n > 0 and kinds == [nn.Linear, nn.ReLU] * n + [nn.Linear] * end


def _learns(optimizer: th.optim.Optimizer, parameters: list[nn.Parameter]) -> bool:
    stepped = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    same = len(stepped) == len(parameters) and all(a is b for a, b in zip(stepped, parameters))
    hooked = any(p._backward_hooks or p._post_accumulate_grad_hooks for p in parameters)
    return same and not hooked and all(parameter.requires_grad for parameter in parameters)


def _linears(layers: nn.Module) -> list[nn.Linear]:
    return [layer for layer in layers.children() if isinstance(layer, nn.Linear)]


def _critics(critic: ContinuousCritic) -> list[Critic]:
    chains = [_linears(network) for network in critic.q_networks]
    return [Critic(Chain(hidden), head) for *hidden, head in chains]
