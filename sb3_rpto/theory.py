"""The paper's theory on tabular MDPs, where every quantity can be solved exactly, and its estimate from samples.

Lemma 1 splits the relativity gap ``J(P', pi) - J(P, pi')`` into a dynamics-induced and a policy-induced part. It is
exact, and :func:`dynamics_gap_estimate` and :func:`policy_gap_estimate` measure both parts of a learned agent.
The paper's other statements are inequalities. Each is a function of a :class:`Setting` that returns a
:class:`Bound`, rearranged to ``lhs <= rhs`` with the paper's constant alone on the right, in these variants:

- ``"literal"``: every symbol as the text defines it (``r_max = max r``, without the absolute value);
- ``"printed"``: the printed constant with ``r_max = max |r|`` and evident slips of notation read as meant;
- ``"corrected"``: the printed form with what makes it fail put right (only where it fails);
- ``"tight"``: a smaller constant that still holds always (``docs/theory.md`` derives it).

``python -m sb3_rpto.theory`` counts on how many random MDPs each of them holds; ``--search`` also climbs to the
worst case. The bounds are far above any return at a usual discount: they are no diagnostics of a run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Variant = Literal["literal", "printed", "corrected", "tight"]

#: slack for rounding when an inequality is judged; returns here are of the order 1 to 100
TOLERANCE = 1e-9


# ------------------------------------------------------------------------------------------ tabular MDPs, exactly


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


class Values(NamedTuple):
    """The exact values of a policy in an MDP."""

    v: FloatArray  # (S,)
    q: FloatArray  # (S, A)
    advantage: FloatArray  # (S, A), q - v


def _under(mdp: TabularMDP, policy: FloatArray) -> FloatArray:
    """The Markov chain P_pi(s'|s) = sum_a pi(a|s) P(s'|s, a), shape (S, S)."""
    if policy.shape != mdp.transition.shape[:2]:
        raise ValueError(f"policy must have shape (S, A) = {mdp.transition.shape[:2]}, got {policy.shape}")
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


@dataclass(frozen=True, eq=False)
class Setting:
    """What the paper's statements speak of. The three MDPs share reward, initial distribution and gamma.

    :param target: the dynamics P'
    :param source: the dynamics P (P_phi in Theorem 3)
    :param old_source: the dynamics P_phi', the source before its last update (Theorem 3)
    :param policy: pi(a|s), shape (S, A)
    :param old_policy: pi'(a|s), the policy before its last update
    """

    target: TabularMDP
    source: TabularMDP
    old_source: TabularMDP
    policy: FloatArray
    old_policy: FloatArray

    @property
    def gamma(self) -> float:
        """The common discount."""
        return self.source.gamma

    @property
    def delta_1(self) -> float:
        """D_TV^max of the dynamics P' and P."""
        return total_variation(self.target.transition, self.source.transition)

    @property
    def delta_2(self) -> float:
        """D_TV^max of the policies pi' and pi."""
        return total_variation(self.old_policy, self.policy)

    def r_max(self, variant: Variant) -> float:
        """max |r|; the text's max r if ``variant`` is literal."""
        reward = self.source.reward
        return float(reward.max() if variant == "literal" else np.abs(reward).max())


# ------------------------------------------------------------------------------------------ Lemma 1


def dynamics_gap(target: TabularMDP, source: TabularMDP, policy: FloatArray) -> float:
    """J(P', pi) - J(P, pi) by the right-hand side of Eq. (did).

    The expectation over (P', pi) of sum_t gamma^t [r + gamma V(s') - Q(s, a)], with V and Q of (P, pi).
    """
    v, q, _ = values(source, policy)
    error = np.einsum("sat,sat->sa", target.transition, source.reward + source.gamma * v) - q
    return float(occupancy(target, policy) @ (policy * error).sum(axis=1)) / (1 - source.gamma)


def policy_gap(mdp: TabularMDP, policy: FloatArray, old_policy: FloatArray) -> float:
    """J(P, pi) - J(P, pi') by the right-hand side of Eq. (pid): E over (P, pi) of sum_t gamma^t A^{P, pi'}(s, a)."""
    advantage = values(mdp, old_policy).advantage
    return float(occupancy(mdp, policy) @ (policy * advantage).sum(axis=1)) / (1 - mdp.gamma)


def relativity_gap(target: TabularMDP, source: TabularMDP, policy: FloatArray, old_policy: FloatArray) -> float:
    """J(P', pi) - J(P, pi') as the sum of its dynamics-induced and its policy-induced part (Lemma 1)."""
    return dynamics_gap(target, source, policy) + policy_gap(source, policy, old_policy)


# ------------------------------------------------------------------------------------------ the inequalities


class Bound(NamedTuple):
    """An inequality ``lhs <= rhs``, both sides evaluated."""

    lhs: float
    rhs: float

    @property
    def holds(self) -> bool:
        """Whether it is true, up to rounding."""
        return self.lhs <= self.rhs + TOLERANCE

    @property
    def ratio(self) -> float:
        """lhs / rhs, 1 where the bound is attained; nan where rhs is too small to divide by."""
        return self.lhs / self.rhs if self.rhs > 1e-6 else float("nan")


def telescoping(setting: Setting, variant: Variant = "printed") -> Bound:
    """Eq. (tele), |left - right| <= 0, averaged over the initial distribution.

    Printed with the factor 1/(1 - gamma) and V alone; corrected to 1/(1 - gamma) and r + gamma V, which is Eq. (did).
    """
    target, source, policy = setting.target, setting.source, setting.policy
    difference = expected_return(target, policy) - expected_return(source, policy)
    inner = values(source, policy).v + np.zeros_like(source.reward)
    if variant == "corrected":
        inner = source.reward + source.gamma * inner
    change = np.einsum("sa,sat,sat->s", policy, target.transition - source.transition, inner)
    return Bound(abs(difference - float(occupancy(target, policy) @ change) / (1 - setting.gamma)), 0.0)


def state_distribution_lemma(
    setting: Setting, t: int, differ: Literal["dynamics", "policy"], variant: Variant = "printed"
) -> Bound:
    """Appendix lemma on states: sum_s |p_t(s) - q_t(s)| <= 2 t delta; tight: 2 (1 - (1 - delta)^t).

    :param t: the time, counted from the common initial distribution
    :param differ: its first line (P' and P, one policy, delta_1) or its second (one dynamics, pi' and pi, delta_2).
        The second line's ``"literal"`` left side is the first one's, as the text has it.
    """
    own = state_distribution(setting.source, setting.policy, t)
    delta = setting.delta_1 if differ == "dynamics" else setting.delta_2
    if differ == "dynamics" or variant == "literal":
        other = state_distribution(setting.target, setting.policy, t)
    else:
        other = state_distribution(setting.source, setting.old_policy, t)
    rhs = 2 * (1 - (1 - delta) ** t) if variant == "tight" else 2 * t * delta
    return Bound(float(np.abs(other - own).sum()), rhs)


def _value_change(r_max: float, delta: float, gamma: float) -> float:
    """The largest change of V at a fixed state when dynamics or policy move by ``delta`` in total variation.

    2 r_max sum_k gamma^k (1 - (1 - delta)^(k + 1)): a coupling of both chains breaks with probability delta a step.
    """
    return 2 * r_max * delta / ((1 - gamma) * (1 - gamma + gamma * delta))


def value_difference_lemma(
    setting: Setting,
    t: int,
    differ: Literal["dynamics", "policy"],
    variant: Variant = "printed",
    reading: Literal["state", "marginal"] = "state",
) -> Bound:
    """Appendix lemma on values, a bound on |V'(s_t) - V(s_t)|.

    It is min(2 r_max delta (t gamma (1 - gamma) + 1) / (1 - gamma)^2, 2 r_max / (1 - gamma)).

    :param t: the time that the text lets the bound depend on
    :param differ: P' against P, or pi' against pi
    :param variant: for ``reading="marginal"``, corrected has t (1 - gamma) in place of t gamma (1 - gamma)
    :param reading: ``"state"``: both values at the same state, the worst one; ``"marginal"``: each value averaged
        over its own p_t, for which alone the dependence on t has a meaning
    """
    gamma, r_max = setting.gamma, setting.r_max(variant)
    if differ == "dynamics":
        other, other_policy, delta = setting.target, setting.policy, setting.delta_1
    else:
        other, other_policy, delta = setting.source, setting.old_policy, setting.delta_2
    v_other, v = values(other, other_policy).v, values(setting.source, setting.policy).v
    if reading == "state":
        lhs = float(np.abs(v_other - v).max())
    else:
        own_mean = state_distribution(setting.source, setting.policy, t) @ v
        lhs = abs(float(state_distribution(other, other_policy, t) @ v_other - own_mean))
    if variant == "tight":
        if reading == "marginal":
            raise ValueError('variant "tight" is only defined for reading="state"')
        return Bound(lhs, _value_change(r_max, delta, gamma))
    growth = t * (1 - gamma) * (1 if variant == "corrected" else gamma)
    return Bound(lhs, min(2 * r_max * delta * (growth + 1) / (1 - gamma) ** 2, 2 * r_max / (1 - gamma)))


def surrogate(setting: Setting) -> float:
    """L_{pi'}(pi) of Theorem 2: states from (P', pi'), values of (P, pi'), one action of pi and one step of P'."""
    v, q, _ = values(setting.source, setting.old_policy)
    error = np.einsum("sat,sat->sa", setting.target.transition, setting.source.reward + setting.gamma * v) - q
    visits = occupancy(setting.target, setting.old_policy) / (1 - setting.gamma)
    return float(visits @ (setting.policy * error).sum(axis=1))


def _c1(setting: Setting, variant: Variant) -> float:
    gamma, delta_1, delta_2, r_max = setting.gamma, setting.delta_1, setting.delta_2, setting.r_max(variant)
    if variant == "tight":
        return 8 * gamma * r_max * delta_1 * delta_2 / ((1 - gamma) ** 2 * (1 - gamma + gamma * delta_2))
    shrink = min(delta_2 * (gamma**2 + 2) / (1 - gamma), 1 + delta_2 / (1 - gamma))
    return 4 * gamma * r_max * delta_1 / (1 - gamma) ** 2 * shrink


def theorem_2(setting: Setting, variant: Variant = "printed") -> Bound:
    """Theorem 2, L_{pi'}(pi) - [J(P', pi) - J(P, pi)] <= C_1."""
    gap = expected_return(setting.target, setting.policy) - expected_return(setting.source, setting.policy)
    return Bound(surrogate(setting) - gap, _c1(setting, variant))


def policy_improvement(setting: Setting, variant: Variant = "printed") -> Bound:
    """Eq. (mod_trpo), E_{P', pi'} sum_t gamma^t A^{P, pi'}(s, a) - [J(P, pi) - J(P, pi')] <= constant.

    The constant is 2 gamma epsilon (delta_1 + 2 delta_2^2) / (1 - gamma)^2. With a ~ pi' as printed the expectation is
    zero by definition of the advantage; corrected draws a ~ pi, as TRPO does.
    """
    gamma, delta_1, delta_2 = setting.gamma, setting.delta_1, setting.delta_2
    advantage = values(setting.source, setting.old_policy).advantage
    actor = setting.old_policy if variant in ("literal", "printed") else setting.policy
    mean = float(occupancy(setting.target, setting.old_policy) @ (actor * advantage).sum(axis=1)) / (1 - gamma)
    gap = expected_return(setting.source, setting.policy) - expected_return(setting.source, setting.old_policy)
    epsilon = float(np.abs(advantage).max())
    if variant == "tight":
        drift = delta_2 / (1 - gamma + gamma * delta_2) + delta_1 / (1 - gamma + gamma * delta_1)
        return Bound(mean - gap, 2 * gamma * epsilon * min(1, 2 * delta_2) * drift / (1 - gamma))
    return Bound(mean - gap, 2 * gamma * epsilon * (delta_1 + 2 * delta_2**2) / (1 - gamma) ** 2)


def proposition_1(
    setting: Setting,
    variant: Variant = "printed",
    constant: Literal["appendix", "main"] = "appendix",
    epsilon_of: Literal["old", "new"] = "old",
) -> Bound:
    """Proposition 1: RPO's objective - [J(P', pi) - J(P, pi')] <= C.

    :param variant: tight is not a sum of two bounds but comes from Lemma 1 at once, and vanishes with delta_2
    :param constant: the appendix' C, or the main text's C_2, which lacks a factor delta_1
    :param epsilon_of: the policy whose largest |advantage| is epsilon: pi' (TRPO), or pi as the text defines it
    """
    gamma, delta_1, delta_2 = setting.gamma, setting.delta_1, setting.delta_2
    v, _, old_advantage = values(setting.source, setting.old_policy)
    error = setting.source.reward + gamma * v - v[:, None, None]
    inner = np.einsum("sa,sat,sat->s", setting.policy, setting.target.transition, error)
    objective = float(occupancy(setting.target, setting.old_policy) @ inner) / (1 - gamma)
    gap = expected_return(setting.target, setting.policy) - expected_return(setting.source, setting.old_policy)
    advantage = old_advantage if epsilon_of == "old" else values(setting.source, setting.policy).advantage
    epsilon, r_max = float(np.abs(advantage).max()), setting.r_max(variant)
    if variant == "tight":
        step = min(1, 2 * delta_2) * epsilon + 2 * delta_1 * r_max / (1 - gamma)
        return Bound(objective - gap, 2 * gamma * delta_2 * step / ((1 - gamma) * (1 - gamma + gamma * delta_2)))
    dynamics = _c1(setting, variant)
    if constant == "main" and delta_1 > 0:
        dynamics /= delta_1
    return Bound(objective - gap, 2 * gamma * epsilon * (delta_1 + 2 * delta_2**2) / (1 - gamma) ** 2 + dynamics)


def theorem_3(
    setting: Setting, variant: Variant = "printed", delta: Literal["main", "target", "step"] = "main"
) -> Bound:
    """Theorem 3, |J(P', pi) - J(P_phi, pi)| - |L_{phi'}(phi)| <= 4 gamma outer r_max / (1 - gamma)^2 min(...).

    The min is of inner (gamma^2 + 1) / (1 - gamma) and 1. Corrected: outer = D_TV(P', P_phi) and inner =
    D_TV(P_phi, P_phi').

    :param delta: what the printed form takes for inner: ``"main"``, delta_2, which is 0 as pi is fixed; ``"target"``,
        the appendix' delta_1 = D_TV(P', P_phi); ``"step"``, D_TV(P_phi, P_phi') for inner and outer alike (the
        appendix' closing remark)
    """
    gamma, r_max = setting.gamma, setting.r_max(variant)
    source, target, policy = setting.source, setting.target, setting.policy
    gap = expected_return(target, policy) - expected_return(source, policy)
    inside = source.reward + gamma * values(setting.old_source, policy).v
    change = np.einsum("sa,sat,sat->s", policy, target.transition - source.transition, inside)
    approximation = float(occupancy(target, policy) @ change) / (1 - gamma)
    step = total_variation(source.transition, setting.old_source.transition)
    lhs, outer = abs(gap) - abs(approximation), setting.delta_1
    if variant == "tight":
        return Bound(lhs, 2 * gamma * outer / (1 - gamma) * _value_change(r_max, step, gamma))
    inner = step
    if variant != "corrected":
        inner = {"main": 0.0, "target": setting.delta_1, "step": step}[delta]
        outer = step if delta == "step" else outer
    shrink = min(inner * (gamma**2 + 1) / (1 - gamma), 1)
    return Bound(lhs, 4 * gamma * outer * r_max / (1 - gamma) ** 2 * shrink)


# ------------------------------------------------------------------------------------------ the table


def random_setting(rng: np.random.Generator, index: int) -> Setting:
    """Draw a setting of one of six kinds, which take turns with ``index``.

    Dense; near-deterministic with sparse rewards; two states at a small discount; tiny perturbations; rewards that are
    never positive; unrelated dynamics and policies.
    """
    kind = index % 6
    n_states, n_actions = (2, 2) if kind == 2 else (int(rng.integers(2, 7)), int(rng.integers(2, 5)))
    gamma = float(rng.uniform(0.02, 0.3) if kind == 2 else rng.choice([0.3, 0.5, 0.9, 0.99]))
    concentration = 0.05 if kind == 1 else 1.0
    source = random_mdp(
        rng,
        n_states,
        n_actions,
        gamma,
        concentration,
        reward_range=(-1.0, 0.0) if kind == 4 else (-1.0, 1.0),
        reward_density=0.2 if kind == 1 else 1.0,
    )
    policy = random_policy(rng, n_states, n_actions, concentration)
    if kind == 5:
        others = [random_mdp(rng, n_states, n_actions, gamma).transition for _ in range(2)]
        old_policy = random_policy(rng, n_states, n_actions)
    else:
        sizes = 10 ** rng.uniform(-3, -2, 3) if kind == 3 else rng.uniform(0, 0.5, 3)
        others = [perturb(rng, source.transition, size) for size in sizes[:2]]
        old_policy = perturb(rng, policy, sizes[2])
    target, old_source = (replace(source, transition=transition) for transition in others)
    return Setting(target, source, old_source, policy, old_policy)


def _lemma_1(setting: Setting) -> Bound:
    gap = expected_return(setting.target, setting.policy) - expected_return(setting.source, setting.old_policy)
    return Bound(abs(relativity_gap(setting.target, setting.source, setting.policy, setting.old_policy) - gap), 0.0)


#: every statement of the table by name; equations appear as |left - right| <= 0
STATEMENTS: dict[str, Callable[[Setting], Bound]] = {
    "Lemma 1": _lemma_1,
    "Eq. tele, printed": lambda s: telescoping(s),
    "Eq. tele, corrected": lambda s: telescoping(s, "corrected"),
    "States, P'/P, t=3, printed": lambda s: state_distribution_lemma(s, 3, "dynamics"),
    "States, P'/P, t=3, tight": lambda s: state_distribution_lemma(s, 3, "dynamics", "tight"),
    "States, pi'/pi, t=3, literal": lambda s: state_distribution_lemma(s, 3, "policy", "literal"),
    "States, pi'/pi, t=3, printed": lambda s: state_distribution_lemma(s, 3, "policy"),
    "States, pi'/pi, t=3, tight": lambda s: state_distribution_lemma(s, 3, "policy", "tight"),
    "Values, P'/P, t=0, literal": lambda s: value_difference_lemma(s, 0, "dynamics", "literal"),
    "Values, P'/P, t=0, printed": lambda s: value_difference_lemma(s, 0, "dynamics"),
    "Values, P'/P, tight": lambda s: value_difference_lemma(s, 0, "dynamics", "tight"),
    "Values, pi'/pi, t=0, printed": lambda s: value_difference_lemma(s, 0, "policy"),
    "Values, pi'/pi, tight": lambda s: value_difference_lemma(s, 0, "policy", "tight"),
    "Values, P'/P, marginal t=3, printed": lambda s: value_difference_lemma(s, 3, "dynamics", "printed", "marginal"),
    "Values, P'/P, marginal t=3, corrected": lambda s: value_difference_lemma(
        s, 3, "dynamics", "corrected", "marginal"
    ),
    "Theorem 2, literal": lambda s: theorem_2(s, "literal"),
    "Theorem 2, printed": lambda s: theorem_2(s),
    "Theorem 2, tight": lambda s: theorem_2(s, "tight"),
    "Eq. mod_trpo, printed (a ~ pi')": lambda s: policy_improvement(s),
    "Eq. mod_trpo, corrected (a ~ pi)": lambda s: policy_improvement(s, "corrected"),
    "Eq. mod_trpo, tight": lambda s: policy_improvement(s, "tight"),
    "Proposition 1, literal": lambda s: proposition_1(s, "literal"),
    "Proposition 1, C_2 of the main text": lambda s: proposition_1(s, "printed", "main"),
    "Proposition 1, C, epsilon of pi": lambda s: proposition_1(s, epsilon_of="new"),
    "Proposition 1, C, epsilon of pi'": lambda s: proposition_1(s),
    "Proposition 1, tight": lambda s: proposition_1(s, "tight"),
    "Theorem 3, main text": lambda s: theorem_3(s),
    "Theorem 3, appendix, D(P', P_phi)": lambda s: theorem_3(s, delta="target"),
    "Theorem 3, appendix, D(P_phi, P_phi')": lambda s: theorem_3(s, delta="step"),
    "Theorem 3, corrected": lambda s: theorem_3(s, "corrected"),
    "Theorem 3, tight": lambda s: theorem_3(s, "tight"),
}


def _mutate(setting: Setting, rng: np.random.Generator) -> Setting:
    """Change one row of one distribution, one reward or the initial distribution."""
    source, target, old_source = setting.source, setting.target, setting.old_source
    transitions = [target.transition.copy(), source.transition.copy(), old_source.transition.copy()]
    policies = [setting.policy.copy(), setting.old_policy.copy()]
    reward, initial = source.reward.copy(), source.initial.copy()
    state, action = int(rng.integers(reward.shape[0])), int(rng.integers(reward.shape[1]))
    share = float(rng.choice([1.0, 0.3, 0.03, 0.003]))

    def towards_vertex(row: FloatArray) -> None:
        row *= 1 - share
        row[rng.integers(len(row))] += share
        row /= row.sum()

    choice = int(rng.integers(7))
    if choice == 0:
        towards_vertex(initial)
    elif choice == 1:
        reward[state, action] = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], size=len(initial) if share < 1 else ())
    elif choice <= 3:
        rows = [array[state, action] for array in transitions]
        towards_vertex(rows[int(rng.integers(3))])
        if choice == 3:  # most rows should agree, or the worst of them sets delta for nothing
            rows[int(rng.choice([0, 2]))][:] = rows[1]
    elif choice == 4:
        for array in transitions:
            array[state, action] = transitions[1][state, action]
    else:
        towards_vertex(policies[int(rng.integers(2))][state])
        if choice == 6:
            policies[1][state] = policies[0][state]
    mdps = [TabularMDP(transition, reward, initial, setting.gamma) for transition in transitions]
    return Setting(mdps[0], mdps[1], mdps[2], policies[0], policies[1])


def worst_case(statement: Callable[[Setting], Bound], seed: int, steps: int) -> tuple[Bound, Setting]:
    """Climb to a setting with the largest lhs / rhs without gradients, from one random start at each of four discounts.

    :param statement: one of :data:`STATEMENTS`
    :param seed: makes the search reproducible
    :param steps: evaluations in all
    :return: the worst bound and the setting that attains it
    """

    def score(bound: Bound) -> float:
        return bound.lhs / max(bound.rhs, 1e-4)

    gammas, found = (0.05, 0.3, 0.6, 0.9), []
    for start, gamma in enumerate(gammas):
        rng = np.random.default_rng([seed, start])
        drawn = random_setting(rng, 0)
        mdps = [replace(mdp, gamma=gamma) for mdp in (drawn.target, drawn.source, drawn.old_source)]
        best = Setting(mdps[0], mdps[1], mdps[2], drawn.policy, drawn.old_policy)
        bound = statement(best)
        for _ in range(steps // len(gammas)):
            candidate = _mutate(best, rng)
            value = statement(candidate)
            if score(value) >= score(bound):
                best, bound = candidate, value
        found.append((bound, best))
    return max(found, key=lambda pair: score(pair[0]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print on how many random settings each statement holds and fails, and how near it comes to its bound."""
    parser = argparse.ArgumentParser(prog="python -m sb3_rpto.theory", description=main.__doc__)
    parser.add_argument("--n", type=int, default=500, help="random settings (default 500)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--search", type=int, default=0, metavar="STEPS", help="also climb so many steps a statement")
    options = parser.parse_args(arguments)
    settings = [random_setting(np.random.default_rng([options.seed, index]), index) for index in range(options.n)]
    print(f"{'lhs <= rhs':<40}{'holds':>7}{'fails':>7}{'largest lhs/rhs':>17}" + "    by search" * bool(options.search))
    for name, statement in STATEMENTS.items():
        bounds = [statement(setting) for setting in settings]
        holds = sum(bound.holds for bound in bounds)
        ratios = [bound.ratio for bound in bounds if not np.isnan(bound.ratio)]
        line = f"{name:<40}{holds:>7}{len(bounds) - holds:>7}{max(ratios, default=float('nan')):>17.3f}"
        if options.search:
            bound, _ = worst_case(statement, options.seed, options.search)
            line += f"{bound.ratio:>13.3f}" + ("" if bound.holds else "  fails")
        print(line)


# ------------------------------------------------------------------------------------------ from samples


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


if __name__ == "__main__":
    main()
