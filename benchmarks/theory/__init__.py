"""The paper's theory on tabular MDPs, where every quantity can be solved exactly, and its estimate from samples.

Lemma 1 splits the relativity gap ``J(P', pi) - J(P, pi')`` into a dynamics-induced and a policy-induced part. It is
exact (:mod:`~benchmarks.theory.mdp`), and :mod:`~sb3_rpto.evaluation.relativity_gap` measures both parts of a learned
agent. The paper's other statements are inequalities (:mod:`~benchmarks.theory.bounds`).

``python -m benchmarks theory`` counts on how many random MDPs each of them holds; ``--search`` also climbs to the
worst case. The bounds are far above any return at a usual discount: they are no diagnostics of a run.
"""

from benchmarks.theory.bounds import (
    TOLERANCE,
    Bound,
    Setting,
    Variant,
    policy_improvement,
    proposition_1,
    state_distribution_lemma,
    surrogate,
    telescoping,
    theorem_2,
    theorem_3,
    value_difference_lemma,
)
from benchmarks.theory.mdp import (
    FloatArray,
    TabularMDP,
    Values,
    dynamics_gap,
    expected_return,
    occupancy,
    perturb,
    policy_gap,
    random_mdp,
    random_policy,
    relativity_gap,
    state_distribution,
    total_variation,
    values,
)
from benchmarks.theory.search import random_setting, worst_case
from benchmarks.theory.table import STATEMENTS, main
from sb3_rpto.evaluation.relativity_gap import Estimate, dynamics_gap_estimate, policy_gap_estimate

__all__ = [
    "STATEMENTS",
    "TOLERANCE",
    "Bound",
    "Estimate",
    "FloatArray",
    "Setting",
    "TabularMDP",
    "Values",
    "Variant",
    "dynamics_gap",
    "dynamics_gap_estimate",
    "expected_return",
    "main",
    "occupancy",
    "perturb",
    "policy_gap",
    "policy_gap_estimate",
    "policy_improvement",
    "proposition_1",
    "random_mdp",
    "random_policy",
    "random_setting",
    "relativity_gap",
    "state_distribution",
    "state_distribution_lemma",
    "surrogate",
    "telescoping",
    "theorem_2",
    "theorem_3",
    "total_variation",
    "value_difference_lemma",
    "values",
    "worst_case",
]
