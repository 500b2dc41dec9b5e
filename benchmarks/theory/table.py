"""The table of all statements: how often each holds on random MDPs, and how near it comes to its bound."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.theory.bounds import (
    Bound,
    Setting,
    policy_improvement,
    proposition_1,
    state_distribution_lemma,
    telescoping,
    theorem_2,
    theorem_3,
    value_difference_lemma,
)
from benchmarks.theory.mdp import expected_return, relativity_gap
from benchmarks.theory.search import random_setting, worst_case


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Print on how many random settings each statement holds and fails, and how near it comes to its bound."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks theory", description=main.__doc__)
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
