"""The updates of SAC's networks in fewer operations on a CPU: the same numbers as autograd and torch's optimizers give.

Optional: for chains of Linear and ReLU, SB3's usual networks, gradients are a few lines and are written out here; other
networks go through autograd. Plain Adam takes torch's fused step on lists that are made once. What it saves:
docs/speed.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn
from torch.nn import functional as F
from torch.optim.adam import adam
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sb3_rpto.algorithms.losses import HALF_LOG_TWO_PI


class OptimizerStep:
    """Steps of an optimizer down losses; only its own parameters get gradients, so an actor's loss spares the critic's.

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


class PolyakAverage:
    """Polyak's average of a target network, all its tensors in one call: target <- (1 - tau) target + tau tensor.

    :param target: the average
    :param network: what is averaged
    :param tau: share of the network in each step
    """

    def __init__(self, target: nn.Module, network: nn.Module, tau: float) -> None:
        self._targets, self._tensors = list(target.parameters()), list(network.parameters())
        self._average = get_ema_multi_avg_fn(1.0 - tau)

    def __call__(self) -> None:
        """One step."""
        with th.no_grad():
            self._average(self._targets, self._tensors, 0)


class OptimizerSteps(NamedTuple):
    """The steps of SAC's optimizers; that of the temperature where it is learned."""

    actor: OptimizerStep
    critic: OptimizerStep
    ent_coef: OptimizerStep | None = None

    @classmethod
    def of(cls, *optimizers: th.optim.Optimizer | None) -> OptimizerSteps:
        """Of the optimizers of actor, critic and temperature."""
        return cls(*(OptimizerStep(optimizer) for optimizer in optimizers if optimizer is not None))

    def forget(self) -> None:
        """Let go of the last gradients of all."""
        for step in filter(None, self):
            step.forget()


class ReluLayers:
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
    """One Q_i: hidden layers, and the head that makes one number of their answer."""

    layers: ReluLayers
    head: nn.Linear

    def values(self, seen: list[th.Tensor]) -> th.Tensor:
        """Q_i of each row, (n,), from what the layers have seen."""
        return (seen[-1] * self.head.weight).sum(1) + self.head.bias  # a third of what torch's mv takes

    def slope(self, slopes: th.Tensor) -> th.Tensor:
        """From a loss's gradient of the values (n,) to that of the layers' answer."""
        return slopes[:, None] * self.head.weight


class SquashedSample(NamedTuple):
    """Actions a = tanh(mu + sigma z) of a policy, and what their gradient needs."""

    actions: th.Tensor  # (n, action_dim)
    log_prob: th.Tensor  # (n, 1)
    spread: th.Tensor  # sigma z
    room: th.Tensor  # 1 - a^2, the slope of tanh
    free: th.Tensor  # whether log sigma is within SB3's bounds


class ManualUpdate:
    """An update without autograd, for networks that :func:`supports_manual_gradients` knows.

    :param policy: whose networks are updated
    :param log_ent_coef: the logarithm of the temperature, where it is learned
    :param target_entropy: SAC's
    :param gamma: discount factor
    """

    def __init__(self, policy: SACPolicy, log_ent_coef: th.Tensor | None, target_entropy: float, gamma: float) -> None:
        self.log_ent_coef, self.target_entropy, self.gamma = log_ent_coef, target_entropy, gamma
        actor = policy.actor
        self.actor = ReluLayers(_linears(actor.latent_pi))
        self.mean: nn.Linear = actor.mu  # type: ignore[assignment]
        self.log_std: nn.Linear = actor.log_std  # type: ignore[assignment]
        self.epsilon: float = actor.action_dist.epsilon
        self.critics, self.targets = _critics(policy.critic), _critics(policy.critic_target)

    def __call__(
        self,
        critic_batch: ReplayBufferSamples,
        actor_batch: ReplayBufferSamples | None,
        ent_coef: th.Tensor,
        steps: OptimizerSteps,
    ) -> dict[str, th.Tensor]:
        """One update of temperature, critic and actor, in SAC's order.

        :param actor_batch: None leaves actor and temperature as they are
        :param ent_coef: the temperature
        :param steps: of the optimizers
        :return: the losses, to log
        """
        losses = {"ent_coef": ent_coef}
        states, n = [critic_batch.next_observations], len(critic_batch.next_observations)
        if actor_batch is not None:  # the actor is the same for both batches: it is asked once
            states.insert(0, actor_batch.observations)
        seen, sample = self._act(states)
        next_actions, next_log_prob = sample.actions[-n:], sample.log_prob[-n:]
        if actor_batch is not None:
            m = len(actor_batch.observations)
            seen, sample = [answer[:m] for answer in seen], SquashedSample(*(part[:m] for part in sample))
            if steps.ent_coef is not None:
                losses["ent_coef_loss"], slope = self._temperature_loss(sample.log_prob)
                steps.ent_coef.step([slope])
        losses["critic_loss"], gradients = self._critic_loss(critic_batch, next_actions, next_log_prob, ent_coef)
        steps.critic.step(gradients)
        if actor_batch is not None:
            losses["actor_loss"], gradients = self._actor_loss(seen, sample, ent_coef)
            steps.actor.step(gradients)
        return losses

    @th.no_grad()
    def _act(self, states: list[th.Tensor]) -> tuple[list[th.Tensor], SquashedSample]:
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
        return seen, SquashedSample(actions, log_prob, spread, room, log_std == raw)

    def _heads(self, answer: th.Tensor) -> Sequence[th.Tensor]:
        weight = th.cat([self.mean.weight, self.log_std.weight])
        return F.linear(answer, weight, th.cat([self.mean.bias, self.log_std.bias])).chunk(2, dim=1)

    @th.no_grad()
    def _temperature_loss(self, log_prob: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """SAC's loss of log alpha, which is linear in it, and its gradient."""
        log_ent_coef = self.log_ent_coef
        assert log_ent_coef is not None  # it is learned
        slope = -(log_prob + self.target_entropy).mean().expand_as(log_ent_coef)
        return log_ent_coef * slope, slope

    @th.no_grad()
    def _critic_loss(
        self, batch: ReplayBufferSamples, next_actions: th.Tensor, next_log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """Soft Bellman residual, Eq. soft_q, and its gradient for the critics' parameters."""
        following = th.cat([batch.next_observations, next_actions], dim=1)
        next_q = th.stack([q.values(q.layers.forward(following)) for q in self.targets]).amin(0)
        next_value = next_q - ent_coef * next_log_prob[:, 0]
        target = batch.rewards[:, 0] + (1 - batch.dones[:, 0]) * self.gamma * next_value
        pairs, n = th.cat([batch.observations, batch.actions], dim=1), len(target)
        gradients, errors = [], []
        for q in self.critics:
            seen = q.layers.forward(pairs)
            error = q.values(seen) - target
            slopes = error / n
            gradients += q.layers.descent(seen, q.slope(slopes))
            gradients += [(seen[-1] * slopes[:, None]).sum(0, keepdim=True), slopes.sum(0, keepdim=True)]
            errors.append(error)
        return 0.5 * th.stack(errors).square().mean(1).sum(), gradients

    @th.no_grad()
    def _actor_loss(
        self, seen: list[th.Tensor], sample: SquashedSample, ent_coef: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """RPO, Eq. sac: the mean of alpha log pi - min_i Q_i(s, a), and its gradient for the actor's parameters."""
        pairs, n, d = th.cat([seen[0], sample.actions], dim=1), len(sample.actions), seen[0].shape[1]
        answers = [q.layers.forward(pairs) for q in self.critics]
        smallest, which = th.stack([q.values(answer) for q, answer in zip(self.critics, answers)]).min(0)
        loss = (ent_coef * sample.log_prob[:, 0] - smallest).mean()
        # d log pi / d a = 2 a / (1 - a^2 + epsilon); d Q / d a through the critic that is the smallest in its row
        slope = ent_coef / n * (2.0 * sample.actions / (sample.room + self.epsilon))
        for i, (q, answer) in enumerate(zip(self.critics, answers)):
            *_, first = q.layers.backward(answer, q.slope((which == i) / -n))
            slope += first @ q.layers.weights[0][:, d:]
        for_mean = slope * sample.room
        for_log_std = (for_mean * sample.spread - ent_coef / n) * sample.free
        both = th.cat([for_mean, for_log_std], dim=1)
        gradients = self.actor.descent(seen, both @ th.cat([self.mean.weight, self.log_std.weight]))
        for weight, bias in zip((both.T @ seen[-1]).chunk(2), both.sum(0).chunk(2)):
            gradients += [weight, bias]
        return loss, gradients


def supports_manual_gradients(policy: SACPolicy) -> bool:
    """Whether actor and critics are SB3's own, chains of Linear and ReLU without hooks, all of them learned."""
    actor, critics = policy.actor, (policy.critic, policy.critic_target)
    if type(actor) is not Actor or any(type(critic) is not ContinuousCritic for critic in critics):
        return False
    if type(actor.action_dist) is not SquashedDiagGaussianDistribution:
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
    theirs = [p for network in policy.critic.q_networks for p in network.parameters()]
    biased = all(layer.bias is not None for layer in modules if isinstance(layer, nn.Linear))
    return biased and _learns(actor.optimizer, own) and _learns(policy.critic.optimizer, theirs)


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
    return [Critic(ReluLayers(hidden), head) for *hidden, head in chains]
