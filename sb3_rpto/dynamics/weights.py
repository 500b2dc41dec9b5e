"""RTO's weights: how much each target transition matters to the value gap (Eq. rto_p2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch as th
from torch.nn import functional as F

from sb3_rpto.dynamics.base import Dynamics, Transitions

WeightingName = Literal["paper", "centred", "value_aware"]
WEIGHTINGS = get_args(WeightingName)


def rto_weights(
    weighting: WeightingName,
    data: Transitions,
    dynamics: Dynamics,
    soft_value: Callable[[th.Tensor], th.Tensor],
    q_value: Callable[[th.Tensor, th.Tensor], th.Tensor],
    gamma: float,
    floor: float,
) -> th.Tensor:
    """The weight of every transition, normalised over those that a fit reads (the newest); 0 of older ones.

    - ``"paper"``: (r + gamma (1 - done) V(s'))^2, Eq. rto_p2 with the temperature that the paper leaves out.
    - ``"centred"``: (r + gamma (1 - done) V(s') - Q(s, a))^2: unlike the literal weight it does not change when a
      constant is added to the reward, as the gap it comes from does not.
    - ``"value_aware"``: ((1 - done_hat) V(s_hat') - (1 - done) V(s'))^2, what the model's own error costs in value.

    :param data: transitions of the target
    :param dynamics: the model that is being fitted, for ``"value_aware"``
    :param soft_value: observations (n, d) -> V(s) = min_i Q_i(s, a) - alpha log pi(a|s), (n,)
    :param q_value: (observations, actions in env units) -> min_i Q_i(s, a), (n,)
    :param gamma: discount factor
    :param floor: epsilon of the paper, the smallest weight
    :return: (n,), min-max normalised over what is fitted, plus ``floor``
    :raises ValueError: there is no such weighting
    """
    if weighting not in WEIGHTINGS:
        raise ValueError(f"weighting={weighting!r} does not exist; choose one of {list(WEIGHTINGS)}")
    older = 0 if dynamics.fits_newest is None else max(0, len(data) - dynamics.fits_newest)
    data = data.take(slice(older, None))
    with th.no_grad():
        if weighting == "value_aware":
            predicted = dynamics.step(data.observations, data.actions, deterministic=True)
            alive = 1.0 - data.terminations.float()
            expected_alive = 1.0 - predicted.terminations.float()
            with same_noise(data.observations.device):
                predicted_value = soft_value(predicted.next_observations)
            with same_noise(data.observations.device):
                value = soft_value(data.next_observations)
            raw = expected_alive * predicted_value - alive * value
        else:
            raw = data.rewards + gamma * (1.0 - data.terminations) * soft_value(data.next_observations)
            if weighting == "centred":
                raw = raw - q_value(data.observations, data.actions)
        return F.pad(normalise(raw.square(), floor), (older, 0))


@contextmanager
def same_noise(device: th.device) -> Iterator[None]:
    """Draw the same random numbers in every such block, and leave those outside as they would be.

    V is drawn from one action; of a difference of two, different draws would be most.
    """
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        th.manual_seed(0)
        yield


def normalise(weights: th.Tensor, floor: float) -> th.Tensor:
    """(w - min) / (max - min) + floor; equal weights of 1 + floor where all are the same."""
    spread = weights.max() - weights.min()
    if spread <= 0:
        return th.full_like(weights, 1.0 + floor)
    return (weights - weights.min()) / spread + floor


def effective_sample_size(weights: th.Tensor) -> float:
    """Kish's (sum w)^2 / sum w^2: as how many equally weighted transitions the set counts, in [1, n]."""
    return float(weights.sum() ** 2 / weights.square().sum())
