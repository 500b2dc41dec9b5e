"""Relative Policy Optimization."""

from __future__ import annotations

from typing import ClassVar

from sb3_rpto.algorithms.transfer import TransferAlgorithm


class RPO(TransferAlgorithm):
    """Relative Policy Optimization: states from the target, values from the source.

    Paper: https://arxiv.org/abs/2206.06009 (Xu, Zhou, Zhang, Wang, Han: Relative Policy-Transition Optimization for
    Fast Policy Transfer, AAAI 2024), section "Relative Policy Optimization" and the appendix's algorithm of that name.

    The policy acts in both worlds. The critic learns the value of the source world from D_source (step 5); the actor
    ascends that value at the states of D_target (Eq. sac), every fifth batch at the states of D_source, which keeps
    it good in the source (step 6). The source is the real simulator and stays as it is, so RPO is for small shifts;
    see :class:`~sb3_rpto.RPTO` for larger ones. Arguments as in
    :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.
    """

    updates_policy: ClassVar[bool] = True
    updates_dynamics: ClassVar[bool] = False
