"""The paper's theory on tabular MDPs, where every quantity can be solved exactly, and its estimate from samples.

Lemma 1 splits the relativity gap ``J(P', pi) - J(P, pi')`` into a dynamics-induced and a policy-induced part. It is
exact (:mod:`~benchmarks.theory.mdp`), and :mod:`~sb3_rpto.evaluation.relativity_gap` measures both parts of a learned
agent. The paper's other statements are inequalities (:mod:`~benchmarks.theory.bounds`).

``python -m benchmarks theory`` counts on how many random MDPs each of them holds; ``--search`` also climbs to the
worst case. The bounds are far above any return at a usual discount: they are no diagnostics of a run.
"""
