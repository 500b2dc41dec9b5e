"""The paper's inequalities, each as a function of a :class:`Setting` that returns a :class:`Bound`.

Each is rearranged to ``lhs <= rhs`` with the paper's constant alone on the right, in these variants:

- ``"literal"``: every symbol as the text defines it (``r_max = max r``, without the absolute value);
- ``"printed"``: the printed constant with ``r_max = max |r|`` and evident slips of notation read as meant;
- ``"corrected"``: the printed form with what makes it fail put right (only where it fails);
- ``"tight"``: a smaller constant that still holds always (``docs/theory.md`` derives it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from benchmarks.theory.mdp import (
    FloatArray,
    TabularMDP,
    check_worlds,
    expected_return,
    model_error,
    occupancy,
    state_distribution,
    total_variation,
    values,
)

Variant = Literal["literal", "printed", "corrected", "tight"]

#: slack for rounding when an inequality is judged; returns here are of the order 1 to 100
TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Setting:
    """What the paper's statements speak of. The three MDPs share reward, initial distribution and gamma.

    :param target: the dynamics P'
    :param source: the dynamics P (P_phi in Theorem 3)
    :param old_source: the dynamics P_phi', the source before its last update (Theorem 3)
    :param policy: pi(a|s), shape (S, A)
    :param old_policy: pi'(a|s), the policy before its last update
    :raises ValueError: for MDPs that differ in more than their dynamics
    """

    target: TabularMDP
    source: TabularMDP
    old_source: TabularMDP
    policy: FloatArray
    old_policy: FloatArray

    def __post_init__(self) -> None:
        check_worlds(self.source, self.target, self.old_source)

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
    error = model_error(setting.target, setting.source, setting.old_policy)
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
