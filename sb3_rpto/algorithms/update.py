"""Steps 5 and 6 of Algorithm 1: the critic on D_source, the actor by RPO, the dynamics by RTO."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch.nn import functional as F

from sb3_rpto.algorithms.fast_forward import sample_actions, smallest_q
from sb3_rpto.algorithms.fast_update import WrittenUpdate, are_usual
from sb3_rpto.algorithms.fused_optimizer import Descent, Follower
from sb3_rpto.buffers import DualReplayBuffer, World, chronological
from sb3_rpto.dynamics.base import Dynamics, Transitions
from sb3_rpto.dynamics.matmul_precision import fast_products
from sb3_rpto.dynamics.weights import WeightingName, effective_sample_size, rto_weights

#: The actor's batches alternate: four from D_target, then one from D_source (f = 5 in the paper's appendix).
ALTERNATION = 5
#: Rows that are gathered at once, of several updates.
GATHERED = 16_384


class Descents(NamedTuple):
    """The steps of SAC's optimizers."""

    actor: Descent
    critic: Descent
    ent_coef: Descent | None = None


class RelativeUpdate(SAC):
    """The updates, on whatever the two replay buffers hold: SAC with a batch of its own for the actor, and RTO."""

    #: whether step 6 of Algorithm 1 applies RPO, and whether it applies RTO
    updates_policy: ClassVar[bool]
    updates_dynamics: ClassVar[bool]

    observation_space: spaces.Box  # check_spaces refuses any other
    action_space: spaces.Box
    replay_buffer: DualReplayBuffer
    target_entropy: float  # SAC's setup has replaced "auto"
    dynamics: Dynamics | None
    weighting: WeightingName | None
    weight_floor: float
    real_ratio: float
    model_train_freq: int
    #: source steps so far
    source_timesteps: int
    #: plain SAC in the source is under way
    _pretraining: bool
    #: step 3 of a round is done, its steps 5 and 6 are not
    _round_open: bool
    #: target steps taken in the last rollout (with recorded target data: calls of the source)
    _collected: int
    #: source steps that target steps are still to be matched with in step 3; negative: taken in advance
    _source_due: int
    #: target steps since the last fit
    _since_fit: int
    #: so far
    _actor_updates: int
    #: recorded data stand in for the target
    _offline: bool
    #: those are measurements, and phi comes from a trace of them instead of from fits to transitions
    _traces_log: bool

    @property
    def updates_per_step(self) -> int:
        """Updates of critic and actor for a target step."""
        return self.gradient_steps if self.gradient_steps >= 0 else 1  # SB3: negative means one a step

    def update(self) -> None:
        """Steps 5 and 6: updates of critic and actor for each new target step, then the dynamics."""
        self.train(self._collected * self.updates_per_step, self.batch_size)
        self._count_for_fit()
        self.fit_dynamics()

    def _count_for_fit(self) -> None:
        """The round's steps count towards the next fit. Where a fit is interrupted, it alone is made again."""
        self._since_fit += self._collected
        self._round_open = False

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Step 5, the critic on D_source, and step 6, the actor by RPO; given the same batch it is SAC's update.

        :param gradient_steps: number of updates
        :param batch_size: transitions in a batch
        """
        self.policy.set_training_mode(True)
        if not (self.updates_policy or self._pretraining):  # its batch statistics stay, too
            self.actor.set_training_mode(False)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        descents = Descents(*(Descent(optimizer) for optimizer in optimizers))
        follow = Follower(self.critic_target, self.critic, self.tau)
        update = WrittenUpdate(self) if self._is_sacs() and are_usual(self) else self.update_once
        losses: dict[str, list[th.Tensor]] = {}
        with fast_products(self.device):
            burst = max(1, GATHERED // batch_size)
            for first in range(0, gradient_steps, burst):
                batches = self.sample_batches(min(burst, gradient_steps - first), batch_size)
                for step, (critic_batch, actor_batch) in enumerate(batches, first):
                    for descent in filter(None, descents):
                        descent.forget()
                    for name, loss in update(critic_batch, actor_batch, descents).items():
                        losses.setdefault(name, []).append(loss.detach().reshape(()))
                    if step % self.target_update_interval == 0:
                        follow()
                        polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in losses.items():  # read here at once: reading each would wait for the device every step
            self.logger.record(f"train/{name}", float(np.mean(th.stack(values).tolist())))

    def _is_sacs(self) -> bool:
        """Whether the losses are these and nobody's own, which autograd would have to differentiate."""
        names = ("update_once", "critic_loss", "actor_loss", "temperature_loss")
        return all(getattr(getattr(self, n), "__func__", None) is getattr(RelativeUpdate, n) for n in names)

    def update_once(
        self, critic_batch: ReplayBufferSamples, actor_batch: ReplayBufferSamples, descend: Descents
    ) -> dict[str, th.Tensor]:
        """One update of temperature, critic and actor, in SAC's order: the actor's loss uses the updated critic.

        :param descend: the optimizers' steps
        :return: the losses, to log
        """
        ent_coef = self.temperature()
        losses = {"ent_coef": ent_coef}
        policy_learns = self.updates_policy or self._pretraining
        if self.use_sde:  # for the critic's next actions, too
            self.actor.reset_noise()
        if policy_learns:
            actions_pi, log_prob = sample_actions(self.actor, actor_batch.observations)
            if descend.ent_coef is not None:
                losses["ent_coef_loss"] = self.temperature_loss(log_prob)
                descend.ent_coef(losses["ent_coef_loss"])
        losses["critic_loss"] = self.critic_loss(critic_batch, ent_coef)
        descend.critic(losses["critic_loss"])
        if policy_learns:
            losses["actor_loss"] = self.actor_loss(actor_batch, actions_pi, log_prob, ent_coef)
            descend.actor(losses["actor_loss"])
        return losses

    def fit_dynamics(self) -> None:
        """Step 6, RTO: every ``model_train_freq`` target steps move phi towards D_target by the weighted loss."""
        ready = self._traces_log or self.replay_buffer.size() >= 2
        if not self.updates_dynamics or self._since_fit < self.model_train_freq or not ready:
            return
        if not self._traces_log:
            self._fit_to_transitions()
        self._since_fit = 0
        self._rehearse()
        if self._offline:  # SB3 writes its logs at the end of target episodes; there are none
            self.dump_logs()

    def _fit_to_transitions(self) -> None:
        assert self.dynamics is not None
        self._adopt_target_rules()
        self.policy.set_training_mode(False)  # values for the weights: no dropout, no new batch statistics
        data = self.transitions("target")
        self.logger.record("dynamics/error_before", self.dynamics.error(data))
        if not self._keeps_phi():
            weights = self.fit_weights(data)
            if weights is not None:
                self.logger.record("rto/effective_samples", effective_sample_size(weights))
            for name, value in self.dynamics.fit(data, weights).items():
                self.logger.record(f"dynamics/{name}", value)
        self._close_the_loop()
        for name, value in self.dynamics.describe().items():
            self.logger.record(f"dynamics/{name}", value)
        error = self.dynamics.error(data)
        self.logger.record("dynamics/error", error)
        self._doubt_the_target(data, error)

    def fit_weights(self, data: Transitions) -> th.Tensor | None:
        """RTO's weight of each transition, (n,), 0 of those too old to be fitted; None weighs all alike."""
        if self.weighting is None:
            return None
        assert self.dynamics is not None
        if self.use_sde:  # as in an update: what explored last is no part of a checkpoint
            self.actor.reset_noise()
        newest = self.dynamics.fits_newest
        older = 0 if newest is None else max(0, len(data) - newest)
        weights = rto_weights(
            self.weighting,
            self._with_critic_rewards(data.take(slice(older, None))),
            self.dynamics,
            self.soft_value,
            self.q_value,
            self.gamma,
            self.weight_floor,
        )
        return F.pad(weights, (older, 0))

    def _adopt_target_rules(self) -> None:
        """From the first fit on the model is one of the target: let what is known of the task be the target's."""

    def _worlds_are_alike(self) -> bool:
        """Whether P_phi is known to account for the target, so that its many states stand for the target's few."""
        return False

    def _keeps_phi(self) -> bool:
        """Whether phi is known better than fits to transitions could tell."""
        return False

    def _close_the_loop(self) -> None:
        """After a fit: trace what the simulator lacks, where that was asked for and is due."""

    def _rehearse(self) -> None:
        """After a fit: learn what was put off until then, where a closed loop judges what comes of it."""

    def _doubt_the_target(self, data: Transitions, error: float) -> None:
        """After a fit that left this one-step error: say once what speaks against the target."""

    def sample_batches(self, count: int, batch_size: int) -> Iterator[tuple[ReplayBufferSamples, ReplayBufferSamples]]:
        """For each of ``count`` updates a batch for the critic, mostly of D_source, and one for the actor.

        The actor sees four batches of D_target, then one of D_source; D_source alone as long as D_target could not
        fill a batch, and where both worlds are known to be alike; a policy that does not learn sees the critic's. All
        are gathered at once.
        """
        for_critic = self.critic_batches(count, batch_size)
        if self._pretraining or not self.updates_policy:
            yield from ((batch, batch) for batch in for_critic)
            return
        scarce = self.replay_buffer.target.size() < batch_size or self._worlds_are_alike()
        turns = [(self._actor_updates + i) % ALTERNATION == ALTERNATION - 1 for i in range(count)]
        from_source = [turn or scarce for turn in turns]
        for_actor = {
            True: self._draw("source", sum(from_source), batch_size),
            False: self._draw("target", count - sum(from_source), batch_size),
        }
        for turn, critic_batch in zip(from_source, for_critic):
            self._actor_updates += 1
            yield critic_batch, next(for_actor[turn])

    def critic_batches(self, count: int, batch_size: int) -> Iterator[ReplayBufferSamples]:
        """Batches of D_source with their share ``real_ratio`` of D_target.

        Of D_source alone while pretraining, where rewards of D_target are not known, and where it is a robot's log that
        the simulator accounts for: the states of a log are estimates, without what has yet to act, and the simulator
        knows better.
        """
        needless = self.replay_buffer.unrewarded or (self._traces_log and self._worlds_are_alike())
        real = not self._pretraining and not needless and self.replay_buffer.target.size() > 0
        n_target = min(round(self.real_ratio * batch_size), batch_size - 1) if real else 0
        drawn = self._draw("source", count, batch_size - n_target)
        return map(_concatenate, drawn, self._draw("target", count, n_target)) if n_target > 0 else drawn

    def _draw(self, world: World, count: int, batch_size: int) -> Iterator[ReplayBufferSamples]:
        """``count`` batches of one world, gathered at once, in the networks' precision."""
        if count == 0:
            return
        drawn = self.replay_buffer.sample(count * batch_size, env=self._vec_normalize_env, world=world)
        for rows in zip(*(values.float().split(int(batch_size)) for values in drawn[:5])):
            yield ReplayBufferSamples(*rows)

    def critic_loss(self, batch: ReplayBufferSamples, ent_coef: th.Tensor) -> th.Tensor:
        """Soft Bellman residual, Eq. soft_q: half the sum over critics of the mean squared error."""
        with th.no_grad():
            next_actions, next_log_prob = sample_actions(self.actor, batch.next_observations)
            next_q = smallest_q(self.critic_target, batch.next_observations, next_actions)
            next_value = next_q - ent_coef * next_log_prob
            target = batch.rewards + (1 - batch.dones) * self.gamma * next_value
        return 0.5 * th.stack([F.mse_loss(q, target) for q in self.critic(batch.observations, batch.actions)]).sum()

    def actor_loss(
        self, batch: ReplayBufferSamples, actions_pi: th.Tensor, log_prob: th.Tensor, ent_coef: th.Tensor
    ) -> th.Tensor:
        """RPO, Eq. sac: states of the target, values of the source; alpha log pi - min_i Q_i(s, a)."""
        return (ent_coef * log_prob - smallest_q(self.critic, batch.observations, actions_pi)).mean()

    def temperature(self) -> th.Tensor:
        """The current entropy coefficient alpha, without gradient."""
        return self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())

    def temperature_loss(self, log_prob: th.Tensor) -> th.Tensor:
        """SAC's loss of log alpha on the batch that the actor sees."""
        assert self.log_ent_coef is not None  # it is learned
        return -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()

    def soft_value(self, observations: th.Tensor) -> th.Tensor:
        """V(s) = min_i Q_target,i(s, a) - alpha log pi(a|s) with a ~ pi(s), raw observations (n, d) -> (n,)."""
        with th.no_grad():
            seen = self._normalised(observations)
            actions, log_prob = sample_actions(self.actor, seen)
            return (smallest_q(self.critic_target, seen, actions) - self.temperature() * log_prob)[:, 0]

    def q_value(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """min_i Q_target,i(s, a) of raw observations (n, d) and actions in the environment's units -> (n,)."""
        with th.no_grad():
            scaled = self.scale_actions(actions).float()
            return smallest_q(self.critic_target, self._normalised(observations), scaled)[:, 0]

    def scale_actions(self, actions: th.Tensor) -> th.Tensor:
        """Actions in the environment's units -> [-1, 1], the scale of the networks and the buffers; (n, action_dim)."""
        low, high = self._action_bounds()
        return 2.0 * (actions - low) / (high - low) - 1.0

    def unscale_actions(self, scaled: th.Tensor) -> th.Tensor:
        """The inverse of :meth:`scale_actions`."""
        low, high = self._action_bounds()
        return low + 0.5 * (scaled + 1.0) * (high - low)

    def _action_bounds(self) -> tuple[th.Tensor, th.Tensor]:
        space = self.action_space
        return th.as_tensor(space.low, device=self.device), th.as_tensor(space.high, device=self.device)

    def transitions(self, world: World) -> Transitions:
        """All transitions of one world, oldest first, actions in the environment's units, on the model's device."""
        return as_transitions(chronological(self.replay_buffer.side(world)), self.policy, self.device)

    def _with_critic_rewards(self, data: Transitions) -> Transitions:
        """``data`` with rewards on the critic's scale (VecNormalize may have changed it)."""
        if self._vec_normalize_env is None:
            return data
        rewards = self._vec_normalize_env.normalize_reward(data.rewards.cpu().numpy())
        return replace(data, rewards=th.as_tensor(rewards, device=self.device).float())

    def _normalised(self, observations: th.Tensor) -> th.Tensor:
        if self._vec_normalize_env is None:
            return observations.float()
        normalised = self._vec_normalize_env.normalize_obs(observations.cpu().numpy())
        return th.as_tensor(normalised, device=self.device).float()


def as_transitions(arrays: dict[str, np.ndarray], policy: SACPolicy, device: th.device) -> Transitions:
    """Arrays of :func:`chronological` as tensors, with actions in the environment's units."""
    tensors = {name: th.as_tensor(array, device=device) for name, array in arrays.items()}
    tensors["actions"] = th.as_tensor(policy.unscale_action(arrays["actions"]), device=device)
    return Transitions(**tensors)


def _concatenate(a: ReplayBufferSamples, b: ReplayBufferSamples) -> ReplayBufferSamples:
    rows = (th.cat(pair) for pair in zip(a[:5], b[:5]))
    return ReplayBufferSamples(*rows)
