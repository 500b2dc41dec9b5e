"""P_phi as a probabilistic ensemble (PETS, MBPO): stacked networks that predict the step and the reward."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions, relative_error
from sb3_rpto.dynamics.matmul_precision import fast_products, no_denormals
from sb3_rpto.dynamics.networks import Heads, StackedNetworks
from sb3_rpto.ranges import FLAG, POSITIVE, WIDTHS, Rule, check, number, whole

#: a known rule of the task, in torch: (observations, actions, next_observations) -> (n,)
TransitionFn: TypeAlias = Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]

#: what the constructor's arguments may be
RULES = {
    **dict.fromkeys(("reward_fn", "termination_fn"), Rule("be a function or None", lambda x: x is None or callable(x))),
    **dict.fromkeys(("n_members", "n_elites", "batch_size", "max_holdout", "patience", "max_steps"), whole(1)),
    "hidden": WIDTHS,
    "learning_rate": POSITIVE,
    "holdout_ratio": number("be in (0, 0.5]", lambda x: 0 < x <= 0.5),
    "min_holdout_for_elites": whole(0),
    "noise": FLAG,
}
#: gradient steps between two looks at the holdout, where an epoch has fewer
MIN_STEPS_PER_EPOCH = 20
#: what counts as an improvement for the patience, relative to the member's holdout error (MBPO)
IMPROVEMENT = 0.01


@dataclass(frozen=True)
class _Examples:
    """Standardised rows to fit or to judge by; the weights have mean 1."""

    inputs: th.Tensor
    targets: th.Tensor
    terminations: th.Tensor
    weights: th.Tensor

    def take(self, index: th.Tensor) -> _Examples:
        return _Examples(*(getattr(self, field.name)[index] for field in fields(self)))

    def normalised(self) -> _Examples:
        """With weights of mean 1, so that the learning rate keeps its meaning; alike if all of them are 0."""
        mean = self.weights.mean()
        weights = th.where(mean > 0, self.weights / mean, 1.0)
        return _Examples(self.inputs, self.targets, self.terminations, weights)


class EnsembleDynamics(Dynamics):
    """Ensemble of probabilistic networks p(s', r | s, a), rolled out in one-step branches.

    Each member maps a standardised (s, a) to a Gaussian over the standardised (s' - s, r). Loss: the weighted Gaussian
    negative log likelihood (PETS, Chua et al. 2018); initial weights, decays, holdout, patience and elites as in MBPO
    (Janner et al. 2019). RTO weighs the transitions; without weights it is MBPO's model.

    The scaler of inputs and targets is fitted by the first :meth:`fit` (the source data of phi_0) and then kept: were
    it refitted, phi would jump before its first gradient step. All losses are in its units, hence comparable over a
    run. While the data only grow a holdout transition never becomes a training one: the split depends on its index
    alone.

    Patience, snapshots and elites go by the squared error on the holdout, not by the likelihood: that is MBPO's choice
    and gives the better means, but with few transitions the predicted variances become too small (``holdout_nll`` then
    rises while ``holdout_rmse`` falls).

    :param observation_space: flat Box
    :param action_space: flat Box
    :param reward_fn: known reward (obs, act, next_obs) -> (n,), used by :meth:`step` in place of the learned head
    :param termination_fn: known rule (obs, act, next_obs) -> (n,) bool; None learns a Bernoulli head, with a warning
    :param n_members: networks
    :param n_elites: networks that predict: those with the smallest holdout error
    :param hidden: widths of the hidden layers
    :param learning_rate: Adam's; its moments are kept between fits
    :param batch_size: transitions per member and gradient step
    :param holdout_ratio: share of the data held out, in (0, 0.5]
    :param max_holdout: most transitions held out, spread over all data
    :param patience: epochs without an improvement of more than 1 % in any member's holdout error that end a fit
    :param max_steps: gradient steps a fit makes at most, unless it is told otherwise
    :param min_holdout_for_elites: holdout transitions from which on a fit ranks the members anew; below, the ranking is
        noise and the elites stay
    :param noise: False answers every step by the elites' mean. While the target has shown little, the predicted
        variance is doubt, not chance; sampled in an unstable world it ends branches that would go on and drags all
        values down
    :raises ValueError: spaces that are not flat Boxes, or a number out of range
    """

    rollout = "branches"

    input_mean: th.Tensor
    input_std: th.Tensor
    target_mean: th.Tensor
    target_std: th.Tensor
    elites: th.Tensor
    fitted: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        reward_fn: TransitionFn | None = None,
        termination_fn: TransitionFn | None = None,
        n_members: int = 7,
        n_elites: int = 5,
        hidden: Sequence[int] = (400, 400, 400, 400),
        learning_rate: float = 1e-3,
        batch_size: int = 256,
        holdout_ratio: float = 0.2,
        max_holdout: int = 5000,
        patience: int = 5,
        max_steps: int = 5000,
        min_holdout_for_elites: int = 100,
        noise: bool = True,
    ) -> None:
        super().__init__(observation_space, action_space)
        for name, space in (("observation_space", observation_space), ("action_space", action_space)):
            if not isinstance(space, spaces.Box) or len(space.shape) != 1:
                raise ValueError(f"{name} must be a flat Box, got {space}; flatten it with a wrapper first")
            if not np.issubdtype(space.dtype, np.floating):  # changes and rewards are no whole numbers
                raise ValueError(
                    f"{name} holds {space.dtype}, and the model predicts changes; wrap the environments in "
                    "gymnasium.wrappers.DtypeObservation(env, np.float32) or give it a Box of floats"
                )
        check(RULES, locals())
        if n_elites > n_members:
            raise ValueError(f"n_elites must be in 1..n_members ({n_members}), got {n_elites}")
        self.reward_fn = reward_fn
        self.termination_fn = termination_fn
        self.n_members = n_members
        self.n_elites = n_elites
        self.batch_size = batch_size
        self.holdout_ratio = holdout_ratio
        self.max_holdout = max_holdout
        self.patience = patience
        self.max_steps = max_steps
        self.min_holdout_for_elites = min_holdout_for_elites
        self.noise = noise
        self.observation_dim, self.action_dim = observation_space.shape[0], action_space.shape[0]
        if termination_fn is None:
            warnings.warn(
                "EnsembleDynamics learns terminations from data. If the task's rule is known, pass it as "
                "termination_fn=f, with f(observations, actions, next_observations) -> (n,) bool in torch "
                "(from an algorithm: dynamics_kwargs={'termination_fn': f}).",
                stacklevel=2,
            )
        n_inputs, n_targets = self.observation_dim + self.action_dim, self.observation_dim + 1
        self.networks = StackedNetworks(n_members, n_inputs, hidden, n_targets, n_logits=int(termination_fn is None))
        self.optimizer: th.optim.Adam = self.networks.optimizer(learning_rate)
        self.register_buffer("input_mean", th.zeros(n_inputs))
        self.register_buffer("input_std", th.ones(n_inputs))
        self.register_buffer("target_mean", th.zeros(n_targets))
        self.register_buffer("target_std", th.ones(n_targets))
        self.register_buffer("elites", th.arange(n_elites))
        self.register_buffer("fitted", th.tensor(False))

    # ------------------------------------------------------------------ predict

    @th.no_grad()
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """Answer one environment step for each of ``n`` pairs, without gradient.

        A sample asks one random elite per row and draws from its Gaussian; the rows are dealt out evenly and each is
        computed by its elite alone. The deterministic answer is the mean of all elites.

        :param observations: (n, observation_dim); the answer has its dtype
        :param actions: (n, action_dim), in the environment's units
        :param deterministic: the mean prediction instead of a sample
        """
        inputs = self._inputs(observations, actions)
        with fast_products(self.device):
            if deterministic or not self.noise:
                heads = self._ask_elites(inputs)
                targets, ended = heads.mean.mean(dim=0), heads.logit.sigmoid().mean(dim=0) > 0.5
            else:
                targets, ended = self._sample(inputs)
        targets = (targets * self.target_std + self.target_mean).to(observations.dtype)
        next_observations = observations + targets[:, :-1]
        given = observations, actions, next_observations
        rewards = targets[:, -1] if self.reward_fn is None else _call("reward_fn", self.reward_fn, *given)
        terminations = (
            ended[:, 0] if self.termination_fn is None else _call("termination_fn", self.termination_fn, *given).bool()
        )
        return Prediction(next_observations, rewards, terminations)

    def error(self, data: Transitions) -> float:
        """Root mean squared error of the elites' mean on ``data``, in units of each dimension's standard change."""
        prediction = self.step(data.observations, data.actions, deterministic=True)
        return relative_error(prediction.next_observations, data)

    # ---------------------------------------------------------------------- fit

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Train every member from where it stands and keep its best state on the holdout, the start included.

        :param data: at least two transitions, oldest first, those of earlier calls first
        :param weights: (n,), non-negative; scaled to mean 1 over the training set (and over the holdout)
        :param max_steps: cap of gradient steps, at least 1; None for the constructor's
        :return: ``holdout_nll`` and ``holdout_rmse`` (the elites' mean nats per output and root of their mean squared
            error, in the scaler's units), ``train_nll`` (all members, last epoch), ``steps``, ``epochs``,
            ``fit_seconds``
        :raises ValueError: too few transitions, a wrong shape, values that are not finite, bad weights
        """
        return self.fit_rows(data, th.arange(len(data)), weights, max_steps)

    def fit_rows(
        self, data: Transitions, rows: th.Tensor, weights: th.Tensor | None, max_steps: int | None
    ) -> dict[str, float]:
        """:meth:`fit` to some of all transitions that there ever were: what one call trains on no later one holds out.

        :param data: the transitions
        :param rows: their numbers, ascending, (n,)
        :param weights: as there
        :param max_steps: as there
        """
        started = time.perf_counter()
        max_steps = self.max_steps if max_steps is None else max_steps
        check(RULES, {"max_steps": max_steps})
        with fast_products(self.device), no_denormals():
            train, held = self._prepare(data, weights, rows)
            best_nll, best_error = self._judge(held)
            mark, best_state = best_error, [p.detach().clone() for p in self.networks.parameters()]
            steps, epochs, stale, train_nll = 0, 0, 0, math.nan
            while steps < max_steps and stale < self.patience:
                epoch_nll, epoch_steps = self._train_epoch(train, max_steps - steps)
                steps, epochs = steps + epoch_steps, epochs + 1
                nll, error = self._judge(held)
                if not (nll + error).isfinite().all():
                    # Adam's moments are as broken as the weights
                    self.optimizer.state.clear()
                    warnings.warn(
                        f"loss not finite after {steps} steps; restored the ensemble's best state", stacklevel=2
                    )
                    break
                train_nll = float(epoch_nll)
                better = ~(error >= best_error)  # also where the start was not finite
                best_nll, best_error = th.where(better, nll, best_nll), th.where(better, error, best_error)
                for parameter, kept in zip(self.networks.parameters(), best_state):
                    kept.copy_(th.where(better.view(-1, 1, 1), parameter.detach(), kept))
                advanced = ~(error >= (1.0 - IMPROVEMENT) * mark)
                mark = th.where(advanced, error, mark)
                stale = 0 if advanced.any() else stale + 1
        with th.no_grad():
            for parameter, kept in zip(self.networks.parameters(), best_state):
                parameter.copy_(kept)
        if len(held.inputs) >= self.min_holdout_for_elites:
            self.elites.copy_(best_error.argsort()[: self.n_elites])
        self.fitted.fill_(True)  # not before: a first fit that is interrupted is made again
        return {
            "holdout_nll": float(best_nll[self.elites].mean()),
            "holdout_rmse": float(best_error[self.elites].mean().sqrt()),
            "train_nll": train_nll,
            "steps": float(steps),
            "epochs": float(epochs),
            "fit_seconds": time.perf_counter() - started,
        }

    def holdout_mask(self, rows: th.Tensor) -> th.Tensor:
        """Which transitions are held out, (n,) bool.

        Transition i of all that there ever were is held out if the fractional part of i times the golden ratio is
        below ``holdout_ratio``, and among the ``max_holdout`` smallest: an even share of every stretch of data, in
        step with no period of it (several environments, an episode's length). As data are added the bound falls: what
        was trained on is never held out later.

        :param rows: the transitions' numbers, (n,)
        """
        share = (rows.cpu().double() * ((math.sqrt(5.0) - 1.0) / 2.0)).frac()
        held = share <= max(self.holdout_ratio, float(share.min()))  # one at least
        if int(held.sum()) > self.max_holdout:
            held = share <= share.kthvalue(self.max_holdout).values
        return held.to(self.device)

    def _train_epoch(self, train: _Examples, max_steps: int) -> tuple[th.Tensor, int]:
        """Pass through the data, each member in its own order; return the mean NLL and the number of steps."""
        n = len(train.inputs)
        n_batches = math.ceil(n / self.batch_size)
        n_steps = min(max_steps, math.ceil(MIN_STEPS_PER_EPOCH / n_batches) * n_batches)
        total = th.zeros((), device=self.device)
        for step in range(n_steps):
            if step % n_batches == 0:
                order = th.rand(self.n_members, n, generator=self.generator, device=self.device).argsort(dim=1)
                batches = order.tensor_split(n_batches, dim=1)
            batch = train.take(batches[step % n_batches])
            nll = (batch.weights * self.networks(batch.inputs).nll(batch.targets, batch.terminations)).mean(dim=1)
            # members add up, each as if trained alone; MBPO's loss, to which decays and penalty refer, is twice the NLL
            loss = 2.0 * nll.sum() + self.networks.bound_penalty()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            total += nll.detach().mean()
        return total / n_steps, n_steps

    @th.no_grad()
    def _judge(self, held: _Examples) -> tuple[th.Tensor, th.Tensor]:
        """Weighted NLL and squared error of every member on the holdout, (n_members,) each."""
        heads = self.networks(held.inputs.expand(self.n_members, -1, -1))
        nll = (held.weights * heads.nll(held.targets, held.terminations)).mean(dim=1)
        return nll, (held.weights * heads.squared_error(held.targets, held.terminations)).mean(dim=1)

    def _prepare(
        self, data: Transitions, weights: th.Tensor | None, rows: th.Tensor | None = None
    ) -> tuple[_Examples, _Examples]:
        """Check, fit the scaler if nothing was fitted before, standardise and split."""
        n = len(data)
        if n < 2:
            raise ValueError(f"data must hold at least 2 transitions (one to train on, one to hold out), got {n}")
        shapes = {"observations": (n, self.observation_dim), "actions": (n, self.action_dim), "rewards": (n,)}
        shapes |= {"next_observations": (n, self.observation_dim), "terminations": (n,)}
        for name, shape in shapes.items():
            _check(f"data.{name}", getattr(data, name), shape)
        if weights is None:
            weights = th.ones(n, device=self.device)
        _check("weights", weights, (n,))
        if (weights < 0).any() or not (weights > 0).any():
            raise ValueError("weights must be non-negative and not all zero")
        held_out = self.holdout_mask(th.arange(n) if rows is None else rows)
        # the difference in the data's own dtype: float32 would round it away at large positions
        change = data.next_observations - data.observations
        targets = th.cat([change, data.rewards.unsqueeze(1)], dim=1)
        if not self.fitted:
            inputs = th.cat([data.observations, data.actions], dim=1)
            for prefix, values in (("input", inputs), ("target", targets)):
                mean, std = _moments(values[~held_out])
                getattr(self, f"{prefix}_mean").copy_(mean)
                getattr(self, f"{prefix}_std").copy_(std)
        dtype = self.input_mean.dtype
        examples = _Examples(
            self._inputs(data.observations, data.actions),
            ((targets - self.target_mean) / self.target_std).to(dtype),
            data.terminations.to(dtype),
            weights.to(dtype),
        )
        return examples.take(~held_out).normalised(), examples.take(held_out).normalised()

    # ------------------------------------------------------------------ helpers

    @property
    def device(self) -> th.device:
        """Where the model computes."""
        return self.input_mean.device

    def _inputs(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat([observations, actions], dim=1)
        return ((inputs - self.input_mean) / self.input_std).to(self.input_mean.dtype)

    def _sample(self, inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Targets (n, n_targets), standardised, and terminations (n, n_logits) by a random elite for each row."""
        n = len(inputs)
        n_slots = math.ceil(n / self.n_elites) * self.n_elites
        # slots beyond n compute some row again and are dropped, so that even a single row gets a random elite
        order = th.randperm(n_slots, generator=self.generator, device=self.device)
        dealt = inputs[order % max(n, 1)].view(self.n_elites, -1, inputs.shape[1])
        mean, log_variance, logit = self.networks(dealt, self.elites)
        noise = th.empty_like(mean).normal_(generator=self.generator)
        chance = th.empty_like(logit).uniform_(generator=self.generator)
        drawn = mean + (0.5 * log_variance).exp() * noise, logit.sigmoid() > chance
        slot = order.argsort()[:n]
        targets, ended = (part.flatten(0, 1)[slot] for part in drawn)
        return targets, ended

    def _ask_elites(self, inputs: th.Tensor) -> Heads:
        return self.networks(inputs.expand(self.n_elites, -1, -1), self.elites)

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> EnsembleDynamics:
        """Take the random stream and Adam's moments along when the module moves to another device."""
        super()._apply(fn, recurse)
        if self.generator.device != self.device:
            self.generator = th.Generator(self.device).manual_seed(self.generator.initial_seed())
        self.optimizer.load_state_dict(self.optimizer.state_dict())
        return self

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the random stream; one saved on another kind of device starts again from its seed."""
        saved = state["generator"].cpu()
        if saved.shape == self.generator.get_state().shape:
            super().set_extra_state(state)
        else:  # the states of CPU and CUDA generators have nothing in common but the seed in front
            self.generator.manual_seed(int(saved[:8].clone().view(th.int64)) & (2**63 - 1))


def _moments(values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Mean and standard deviation of each column; 1 for columns constant up to float32 rounding."""
    values = values.double()
    mean, std = values.mean(dim=0), values.std(dim=0, unbiased=False)
    return mean, th.where(std > 1e-8 + 1e-7 * mean.abs(), std, 1.0)


def _check(name: str, values: th.Tensor, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(values.shape)}")
    if not values.isfinite().all():
        raise ValueError(f"{name} holds values that are not finite; drop those transitions")


def _call(name: str, function: TransitionFn, *given: th.Tensor) -> th.Tensor:
    values = function(*given)
    if values.shape != (len(given[0]),):
        raise ValueError(f"{name} must return one value a transition, ({len(given[0])},), got {tuple(values.shape)}")
    return values
