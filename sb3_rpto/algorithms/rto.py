"""Relative Transition Optimization."""

from __future__ import annotations

from typing import ClassVar

from sb3_rpto.algorithms.transfer import TransferAlgorithm


class RTO(TransferAlgorithm):
    """Relative Transition Optimization: fit the source's dynamics to the target where it matters for the value.

    Paper: https://arxiv.org/abs/2206.06009, section "Relative Transition Optimization" and the appendix's algorithm of
    that name.

    The policy stays as it is and acts in both worlds. The critic learns its value in the source P_phi (step 5), phi
    is fitted to D_target with the weight (r + gamma V(s'))^2 of Eq. rto_p2 (step 6). Arguments as in
    :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.
    """

    updates_policy: ClassVar[bool] = False
    updates_dynamics: ClassVar[bool] = True
