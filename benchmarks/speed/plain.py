"""The same mathematics written plainly: what the fast versions are measured against."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_rpto.algorithms import RPTO
from sb3_rpto.dynamics.base import Dynamics
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.dynamics.networks import Heads


class PlainMember(nn.Module):
    """One Gaussian MLP, its bounds and its own Adam, as a textbook writes it."""

    def __init__(self, n_inputs: int, hidden: Sequence[int], n_targets: int, n_logits: int) -> None:
        super().__init__()
        sizes = [n_inputs, *hidden, 2 * n_targets + n_logits]
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes):
            layers += [nn.Linear(n_in, n_out), nn.SiLU()]
        self.body = nn.Sequential(*layers[:-1])
        self.split = [n_targets, n_targets, n_logits]
        self.max_log_variance = nn.Parameter(th.full((n_targets,), 0.5))
        self.min_log_variance = nn.Parameter(th.full((n_targets,), -10.0))
        for layer in self.body:
            if isinstance(layer, nn.Linear):
                std = 0.5 / math.sqrt(layer.in_features)
                nn.init.trunc_normal_(layer.weight, std=std, a=-2 * std, b=2 * std)
                nn.init.zeros_(layer.bias)
        self.optimizer = th.optim.Adam(self.parameters(), lr=1e-3, weight_decay=5e-5)

    def forward(self, inputs: th.Tensor) -> Heads:
        """Predict (n, n_inputs)."""
        mean, log_variance, logit = self.body(inputs).split(self.split, dim=-1)
        log_variance = self.max_log_variance - F.softplus(self.max_log_variance - log_variance)
        log_variance = self.min_log_variance + F.softplus(log_variance - self.min_log_variance)
        return Heads(mean, log_variance, logit)

    def descend(self, inputs: th.Tensor, targets: th.Tensor, terminations: th.Tensor, weights: th.Tensor) -> th.Tensor:
        """One step of the weighted likelihood; returns the mean NLL."""
        nll = (weights * self(inputs).nll(targets, terminations)).mean()
        loss = 2.0 * nll + 0.01 * (self.max_log_variance - self.min_log_variance).sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return nll.detach()


class PlainNetworks(nn.Module):
    """An ensemble as a list of members, asked one after the other."""

    def __init__(self, n_members: int, *sizes: Any) -> None:
        super().__init__()
        self.members = nn.ModuleList(PlainMember(*sizes) for _ in range(n_members))

    def forward(self, inputs: th.Tensor, members: th.Tensor | None = None) -> Heads:
        """Each member its own rows, (m, n, n_inputs)."""
        asked = range(len(self.members)) if members is None else members.tolist()
        chosen = th.get_float32_matmul_precision()
        th.set_float32_matmul_precision("highest")  # plain code leaves torch's default
        answers = [self.members[m](x) for m, x in zip(asked, inputs)]
        th.set_float32_matmul_precision(chosen)
        return Heads(*(th.stack(parts) for parts in zip(*answers)))


class PlainEnsemble(EnsembleDynamics):
    """The ensemble with a loop over its members, and rollouts that ask all elites and then take one answer a row."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        n_inputs, n_targets = len(self.input_mean), len(self.target_mean)
        hidden = [w.shape[2] for w in self.networks.weights][:-1]
        self.networks = PlainNetworks(  # type: ignore[assignment]
            self.n_members, n_inputs, hidden, n_targets, self.networks.n_logits
        )

    def fit(self, data: Any, weights: th.Tensor | None = None, max_steps: int | None = None) -> dict[str, float]:
        """As many steps and looks at the holdout as the patience allows."""
        train, held = self._prepare(data, weights)
        limit, steps, stale, best = max_steps or self.max_steps, 0, 0, math.inf
        while steps < limit and stale < self.patience:
            steps += self._train_epoch(train, limit - steps)[1]
            error = float(self._judge(held)[1].mean())
            stale, best = (0, error) if error < 0.99 * best else (stale + 1, best)
        return {"steps": float(steps)}

    def _train_epoch(self, train: Any, max_steps: int) -> tuple[th.Tensor, int]:
        n = len(train.inputs)
        n_batches = math.ceil(n / self.batch_size)
        n_steps = min(max_steps, math.ceil(20 / n_batches) * n_batches)
        total = th.zeros(())
        for step in range(n_steps):
            if step % n_batches == 0:
                orders = [th.randperm(n).tensor_split(n_batches) for _ in range(self.n_members)]
            for member, order in zip(self.networks.members, orders):  # type: ignore[arg-type]
                batch = train.take(order[step % n_batches])
                total += member.descend(batch.inputs, batch.targets, batch.terminations, batch.weights)
        return total / n_steps, n_steps

    def _sample(self, inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        heads = self.networks(inputs.expand(self.n_elites, -1, -1), self.elites)
        chosen, rows = th.randint(self.n_elites, (len(inputs),)), th.arange(len(inputs))
        mean, log_variance, logit = (part[chosen, rows] for part in heads)
        return mean + (0.5 * log_variance).exp() * th.randn_like(mean), logit.sigmoid() > th.rand_like(logit)


class PlainRPTO(RPTO):
    """RPTO with the update as SB3 writes it, drawing each batch when it is needed, and the plain ensemble."""

    def make_dynamics(self, config: dict[str, Any]) -> Dynamics:
        arguments = {name: value for name, value in config.items() if name != "backend"}
        return PlainEnsemble(self.observation_space, self.action_space, **arguments)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """SB3's statements, on a batch for the critic and one for the actor."""
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer, self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)  # type: ignore[arg-type]
        losses = []
        log_ent_coef = self.log_ent_coef
        assert log_ent_coef is not None  # it is learned
        for _ in range(gradient_steps):
            ((critic_batch, actor_batch),) = self.sample_batches(1, batch_size)
            actions_pi, log_prob = self.actor.action_log_prob(actor_batch.observations)
            log_prob = log_prob.reshape(-1, 1)
            ent_coef = th.exp(log_ent_coef.detach())
            ent_coef_loss = -(log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
            self.ent_coef_optimizer.zero_grad()  # type: ignore[union-attr]
            ent_coef_loss.backward()
            self.ent_coef_optimizer.step()  # type: ignore[union-attr]
            with th.no_grad():
                next_actions, next_log_prob = self.actor.action_log_prob(critic_batch.next_observations)
                next_q = th.cat(self.critic_target(critic_batch.next_observations, next_actions), dim=1)
                next_q, _ = th.min(next_q, dim=1, keepdim=True)
                next_q = next_q - ent_coef * next_log_prob.reshape(-1, 1)
                target_q = critic_batch.rewards + (1 - critic_batch.dones) * self.gamma * next_q
            current_q = self.critic(critic_batch.observations, critic_batch.actions)
            critic_loss = 0.5 * sum(F.mse_loss(q, target_q) for q in current_q)
            self.critic.optimizer.zero_grad()
            critic_loss.backward()  # type: ignore[union-attr]
            self.critic.optimizer.step()
            q_pi = th.cat(self.critic(actor_batch.observations, actions_pi), dim=1)
            min_q, _ = th.min(q_pi, dim=1, keepdim=True)
            actor_loss = (ent_coef * log_prob - min_q).mean()
            self.actor.optimizer.zero_grad()
            actor_loss.backward()
            self.actor.optimizer.step()
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            losses.append((ent_coef.item(), critic_loss.item(), actor_loss.item()))  # type: ignore[union-attr]
        self._n_updates += gradient_steps
        for name, value in zip(("ent_coef", "critic_loss", "actor_loss"), np.mean(losses, axis=0)):
            self.logger.record(f"train/{name}", value)
