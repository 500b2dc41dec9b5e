"""RPO, RTO and RPTO: which half of the relativity gap each of them closes.

The gap between the return of a policy in the target and that of the source's policy in the source has two parts
(Lemma 1 of the paper): the policy gap, by states of the target and values of the source, and the dynamics gap, by how
far P_phi is from the target. RPO closes the first, RTO the second, RPTO both.

Paper: https://arxiv.org/abs/2206.06009 (Xu, Zhou, Zhang, Wang, Han: Relative Policy-Transition Optimization for Fast
Policy Transfer, AAAI 2024).
"""

from __future__ import annotations

from typing import ClassVar

from sb3_rpto.algorithms.transfer import TransferAlgorithm


class RPO(TransferAlgorithm):
    """Relative Policy Optimization: states from the target, values from the source.

    The policy acts in both worlds. The critic learns the value of the source world from D_source (step 5). The actor
    ascends that value at the states of D_target (Eq. sac), every fifth batch at the states of D_source, which keeps it
    good in the source (step 6). The source is the real simulator and stays as it is, so RPO is for small shifts; see
    :class:`RPTO` for larger ones. Arguments as in :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.

    Paper: section "Relative Policy Optimization" and the appendix's algorithm of that name.
    """

    updates_policy: ClassVar[bool] = True
    updates_dynamics: ClassVar[bool] = False


class RTO(TransferAlgorithm):
    """Relative Transition Optimization: fit the source's dynamics to the target where it matters for the value.

    The policy stays as it is and acts in both worlds. The critic learns its value in the source P_phi (step 5), phi is
    fitted to D_target with the weight (r + gamma V(s'))^2 of Eq. rto_p2 (step 6). Arguments as in
    :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.

    Paper: section "Relative Transition Optimization" and the appendix's algorithm of that name.
    """

    updates_policy: ClassVar[bool] = False
    updates_dynamics: ClassVar[bool] = True


class RPTO(TransferAlgorithm):
    """Relative Policy-Transition Optimization: RPO and RTO in one closed loop (Algorithm 1 of the paper).

    The policy acts in the trainable source P_phi and in the target. The critic learns the value of P_phi from D_source,
    the actor ascends it at the states of D_target (RPO), and phi moves towards the target by value-weighted fits to
    D_target (RTO), slowly, so that the policy passes through a curriculum of worlds between the two. Arguments as in
    :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`.
    """

    updates_policy: ClassVar[bool] = True
    updates_dynamics: ClassVar[bool] = True
