"""The table of all statements: how often each holds on random MDPs, and how near it comes to its bound."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runner import Row, Study
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


@dataclass(frozen=True)
class Job:
    """A statement, on random settings."""

    name: str
    settings: int
    seed: int
    search: int


def check(job: Job, folder: Path) -> list[Row]:
    """On how many random settings a statement holds and fails, and how near it comes to its bound.

    :param job: which statement; with ``search`` steps, also climb to its worst case
    :param folder: not needed
    """
    statement = STATEMENTS[job.name]
    drawn = (random_setting(np.random.default_rng([job.seed, index]), index) for index in range(job.settings))
    bounds = [statement(setting) for setting in drawn]
    holds, ratios = sum(bound.holds for bound in bounds), [b.ratio for b in bounds if not np.isnan(b.ratio)]
    row: Row = {"holds": holds, "fails": len(bounds) - holds, "largest": max(ratios, default=None)}
    if job.search:
        bound, _ = worst_case(statement, job.seed, job.search)
        row |= {"searched": bound.ratio, "searched_holds": bound.holds}
    return [row]


def summary(rows: Sequence[Row]) -> str:
    """A line for each statement."""
    searched = any(row["search"] for row in rows)
    lines = [f"{'lhs <= rhs':<40}{'holds':>7}{'fails':>7}{'largest lhs/rhs':>17}" + "    by search" * searched]
    for row in rows:
        # A ratio is nothing where both sides are zero.
        largest, found = (np.nan if row.get(name) is None else row[name] for name in ("largest", "searched"))
        line = f"{row['name']:<40}{row['holds']:>7}{row['fails']:>7}{largest:>17.3f}"
        line += f"{found:>13.3f}" if searched else ""
        lines.append(line + "  fails" * (searched and not row["searched_holds"]))
    return "\n".join(lines)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--n", type=int, default=500, help="random settings (default 500)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--search", type=int, default=0, metavar="STEPS", help="also climb so many steps a statement")


main = Study(
    "theory",
    "theory",
    __doc__,
    jobs=lambda asked: [Job(name, asked.n, asked.seed, asked.search) for name in STATEMENTS],
    run=check,
    summary=summary,
    options=_options,
    keeps=False,
).main
