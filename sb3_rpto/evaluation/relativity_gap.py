"""Both parts of the relativity gap of a learned agent, estimated from whole episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Estimate(NamedTuple):
    """A mean over episodes."""

    mean: float
    standard_error: float  # nan for a single episode
    n_episodes: int


def _discounted(name: str, episodes: Sequence[FloatArray], gamma: float) -> Estimate:
    if not len(episodes):
        raise ValueError(f"{name} holds no episode; collect at least one")
    totals = np.array([np.sum(gamma ** np.arange(len(episode)) * episode) for episode in episodes])
    n = len(totals)
    return Estimate(float(totals.mean()), float(totals.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan"), n)


def _episodes(gamma: float, **columns: Sequence[FloatArray]) -> list[list[FloatArray]]:
    """Per episode one float array of each column, all of the same length."""
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must lie in [0, 1), got {gamma}")
    counts = {name: len(column) for name, column in columns.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"every argument needs the same number of episodes, got {counts}")
    episodes = []
    for index, parts in enumerate(zip(*columns.values())):
        arrays = [np.asarray(part, dtype=np.float64) for part in parts]
        shapes = dict(zip(columns, (array.shape for array in arrays)))
        if len(set(shapes.values())) > 1 or arrays[0].ndim != 1:
            raise ValueError(f"episode {index} needs one-dimensional arrays of one length, got {shapes}")
        episodes.append(arrays)
    return episodes


def dynamics_gap_estimate(
    rewards: Sequence[FloatArray],
    next_values: Sequence[FloatArray],
    q_values: Sequence[FloatArray],
    terminations: Sequence[FloatArray],
    gamma: float,
) -> Estimate:
    """Estimate J(P', pi) - J(P, pi) from whole episodes of pi in the TARGET, Eq. (did).

    An episode gives sum_t gamma^t [r + gamma (1 - d) V(s') - Q(s, a)], in the unit of the return. It is unbiased for
    the exact V and Q of pi in the source. With SAC's soft values (V of s' including its entropy bonus) it is the gap
    between the soft returns. An episode cut at T by a time limit leaves out what follows, of the order gamma^T.

    :param rewards: r, one array of shape (T,) an episode, from its reset on
    :param next_values: V(s'), the same shapes
    :param q_values: Q(s, a), the same shapes
    :param terminations: 1 where the MDP ended; a time limit is no termination
    :param gamma: in [0, 1)
    :raises ValueError: if there is no episode, shapes differ or gamma is out of range
    """
    episodes = _episodes(gamma, rewards=rewards, next_values=next_values, q_values=q_values, terminations=terminations)
    residuals = [reward + gamma * (1 - done) * value - q for reward, value, q, done in episodes]
    return _discounted("rewards", residuals, gamma)


def policy_gap_estimate(q_values: Sequence[FloatArray], values: Sequence[FloatArray], gamma: float) -> Estimate:
    """Estimate J(P, pi) - J(P, pi') from whole episodes of the new policy pi in the SOURCE, Eq. (pid).

    An episode gives sum_t gamma^t [Q'(s, a) - V'(s)], with the values of the old policy pi' in the source. For soft
    values pass Q'(s, a) - alpha log pi(a|s), so that the new policy is credited with its entropy as V' is.

    :param q_values: Q'(s, a) of the old policy, one array of shape (T,) an episode, from its reset on
    :param values: V'(s) of the old policy, the same shapes
    :param gamma: in [0, 1)
    :raises ValueError: if there is no episode, shapes differ or gamma is out of range
    """
    episodes = _episodes(gamma, q_values=q_values, values=values)
    return _discounted("q_values", [q - value for q, value in episodes], gamma)
