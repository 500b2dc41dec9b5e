"""Tabular MDPs: exact solves, both sides of Lemma 1, and random worlds to check statements on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def _check_distribution(name: str, array: FloatArray) -> None:
    if np.any(array < 0) or not np.allclose(array.sum(axis=-1), 1.0, atol=1e-9):
        raise ValueError(f"{name} must hold probabilities that sum to 1 over the last axis; normalise it")


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A finite MDP with an infinite horizon.

    :param transition: P(s'|s, a), shape (S, A, S)
    :param reward: r(s, a, s'), shape (S, A, S)
    :param initial: distribution of s_0, shape (S,)
    :param gamma: discount in [0, 1)
    :raises ValueError: if the shapes do not agree, a row is no distribution or gamma is out of range
    """

    transition: FloatArray
    reward: FloatArray
    initial: FloatArray
    gamma: float

    def __post_init__(self) -> None:
        n_states = len(self.initial)
        if self.transition.ndim != 3 or self.transition.shape[::2] != (n_states, n_states):
            raise ValueError(f"transition must have shape (S, A, S) with S={n_states}, got {self.transition.shape}")
        if self.reward.shape != self.transition.shape:
            raise ValueError(f"reward must have transition's shape {self.transition.shape}, got {self.reward.shape}")
        if not 0 <= self.gamma < 1:
            raise ValueError(f"gamma must lie in [0, 1), got {self.gamma}")
        _check_distribution("transition", self.transition)
        _check_distribution("initial", self.initial)


def check_worlds(*worlds: TabularMDP) -> None:
    """Refuse MDPs that differ in more than their dynamics.

    :raises ValueError: naming what else differs
    """
    first = worlds[0]
    for other in worlds[1:]:
        for name in ("reward", "initial", "gamma"):
            if not np.array_equal(getattr(first, name), getattr(other, name)):
                raise ValueError(f"the MDPs may differ in transition alone, but {name} differs; give them the same")


class Values(NamedTuple):
    """The exact values of a policy in an MDP."""

    v: FloatArray  # (S,)
    q: FloatArray  # (S, A)
    advantage: FloatArray  # (S, A), q - v


def _under(mdp: TabularMDP, policy: FloatArray) -> FloatArray:
    """The Markov chain P_pi(s'|s) = sum_a pi(a|s) P(s'|s, a), shape (S, S)."""
    if policy.shape != mdp.transition.shape[:2]:
        raise ValueError(f"policy must have shape (S, A) = {mdp.transition.shape[:2]}, got {policy.shape}")
    _check_distribution("policy", policy)
    chain: FloatArray = np.einsum("sa,sat->st", policy, mdp.transition)
    return chain


def values(mdp: TabularMDP, policy: FloatArray) -> Values:
    """Solve V = r_pi + gamma P_pi V.

    :param policy: pi(a|s), shape (S, A)
    """
    chain = _under(mdp, policy)
    expected_reward = np.einsum("sa,sat,sat->s", policy, mdp.transition, mdp.reward)
    v = np.linalg.solve(np.eye(len(chain)) - mdp.gamma * chain, expected_reward)
    q = np.einsum("sat,sat->sa", mdp.transition, mdp.reward + mdp.gamma * v)
    return Values(v, q, q - v[:, None])


def expected_return(mdp: TabularMDP, policy: FloatArray) -> float:
    """J(P, pi), the expected discounted return from the initial distribution."""
    return float(mdp.initial @ values(mdp, policy).v)


def state_distribution(mdp: TabularMDP, policy: FloatArray, t: int) -> FloatArray:
    """p_t(s), the distribution of s_t counted from time 0, shape (S,)."""
    return np.asarray(mdp.initial @ np.linalg.matrix_power(_under(mdp, policy), t), dtype=np.float64)


def occupancy(mdp: TabularMDP, policy: FloatArray) -> FloatArray:
    """d(s) = (1 - gamma) sum_t gamma^t p_t(s), shape (S,), sums to 1."""
    chain = _under(mdp, policy)
    visits = np.linalg.solve(np.eye(len(chain)) - mdp.gamma * chain.T, mdp.initial)
    return np.asarray((1 - mdp.gamma) * visits, dtype=np.float64)


def total_variation(first: FloatArray, second: FloatArray) -> float:
    """D_TV^max: half the L1 distance over the last axis, its largest value over all rows; in [0, 1]."""
    return float(0.5 * np.abs(first - second).sum(axis=-1).max())


# ------------------------------------------------------------------------------------------ Lemma 1


def model_error(target: TabularMDP, source: TabularMDP, policy: FloatArray) -> FloatArray:
    """E over P' of r + gamma V(s'), less Q(s, a), with V and Q of (P, pi): what one step in P' adds, shape (S, A).

    :raises ValueError: for MDPs that differ in more than their dynamics
    """
    check_worlds(target, source)
    v, q, _ = values(source, policy)
    return np.einsum("sat,sat->sa", target.transition, source.reward + source.gamma * v) - q


def dynamics_gap(target: TabularMDP, source: TabularMDP, policy: FloatArray) -> float:
    """J(P', pi) - J(P, pi) by the right-hand side of Eq. (did).

    The expectation over (P', pi) of sum_t gamma^t [r + gamma V(s') - Q(s, a)], with V and Q of (P, pi).
    """
    error = model_error(target, source, policy)
    return float(occupancy(target, policy) @ (policy * error).sum(axis=1)) / (1 - source.gamma)


def policy_gap(mdp: TabularMDP, policy: FloatArray, old_policy: FloatArray) -> float:
    """J(P, pi) - J(P, pi') by the right-hand side of Eq. (pid): E over (P, pi) of sum_t gamma^t A^{P, pi'}(s, a)."""
    advantage = values(mdp, old_policy).advantage
    return float(occupancy(mdp, policy) @ (policy * advantage).sum(axis=1)) / (1 - mdp.gamma)


def relativity_gap(target: TabularMDP, source: TabularMDP, policy: FloatArray, old_policy: FloatArray) -> float:
    """J(P', pi) - J(P, pi') as the sum of its dynamics-induced and its policy-induced part (Lemma 1)."""
    return dynamics_gap(target, source, policy) + policy_gap(source, policy, old_policy)


# ------------------------------------------------------------------------------------------ random worlds


def random_mdp(
    rng: np.random.Generator,
    n_states: int,
    n_actions: int,
    gamma: float,
    concentration: float = 1.0,
    reward_range: tuple[float, float] = (-1.0, 1.0),
    reward_density: float = 1.0,
) -> TabularMDP:
    """Draw an MDP.

    :param concentration: of the Dirichlet that every row is drawn from; near 0 makes the dynamics near-deterministic
    :param reward_range: rewards are uniform in it
    :param reward_density: share of (s, a, s') with a reward; the others have 0
    """
    shape = (n_states, n_actions, n_states)
    reward = rng.uniform(*reward_range, shape) * (rng.random(shape) < reward_density)
    row = np.full(n_states, concentration)
    return TabularMDP(rng.dirichlet(row, shape[:2]), reward, rng.dirichlet(row), gamma)


def random_policy(rng: np.random.Generator, n_states: int, n_actions: int, concentration: float = 1.0) -> FloatArray:
    """Draw pi(a|s), shape (S, A), every row from a Dirichlet."""
    return rng.dirichlet(np.full(n_actions, concentration), n_states)


def perturb(rng: np.random.Generator, rows: FloatArray, distance: float) -> FloatArray:
    """Move every distribution along the last axis (dynamics or a policy) to exactly a total-variation distance.

    Each row goes straight towards one outcome: a random one, or its least likely one if that is too near.

    :param rows: distributions over n outcomes, shape (..., n)
    :param distance: in [0, 1 - 1/n], which every row can reach
    :return: same shape as ``rows``
    :raises ValueError: if ``distance`` is out of range
    """
    n = rows.shape[-1]
    if not 0 <= distance <= 1 - 1 / n:
        raise ValueError(f"distance must lie in [0, {1 - 1 / n:.3g}] for {n} outcomes, got {distance}")
    goal = rng.integers(n, size=rows.shape[:-1])
    reach = 1 - np.take_along_axis(rows, goal[..., None], axis=-1)[..., 0]
    goal = np.where(reach < distance, rows.argmin(axis=-1), goal)
    vertex = np.eye(n)[goal]
    reach = 1 - (rows * vertex).sum(axis=-1, keepdims=True)
    share = np.divide(distance, reach, out=np.zeros_like(reach), where=reach > 0)
    return (1 - share) * rows + share * vertex
