"""Relative Policy-Transition Optimization."""

from __future__ import annotations

from typing import ClassVar

from sb3_rpto.algorithms.transfer import TransferAlgorithm


class RPTO(TransferAlgorithm):
    """Relative Policy-Transition Optimization: RPO and RTO in one closed loop (Algorithm 1 of the paper).

    Paper: https://arxiv.org/abs/2206.06009 (Xu, Zhou, Zhang, Wang, Han: Relative Policy-Transition Optimization for
    Fast Policy Transfer, AAAI 2024).

    The policy acts in the trainable source P_phi and in the target. The critic learns the value of P_phi from
    D_source, the actor ascends it at the states of D_target (RPO), and phi moves towards the target by value-weighted
    fits to D_target (RTO), slowly, so that the policy passes through a curriculum of worlds between the two.
    Arguments as in :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.
    """

    updates_policy: ClassVar[bool] = True
    updates_dynamics: ClassVar[bool] = True
