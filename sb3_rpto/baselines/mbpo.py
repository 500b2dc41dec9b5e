"""Model-Based Policy Optimization, and the loop that PDML, PTP and SLBO hook into."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.envs.task_rules import env_id
from sb3_rpto.presets import bare_name

#: Arguments of RPTO that have no meaning where the model is fitted without weights and nothing is declared.
UNUSED = frozenset(
    {"preset", "dynamics", "declared", "close_loop", "effects", "retrain_steps", "weighting", "weight_floor"}
)


class MBPO(TransferAlgorithm):
    """Model-Based Policy Optimization, warm-started: SAC on branches of a model that is fitted to the target.

    Paper: https://arxiv.org/abs/1906.08253 (Janner, Fu, Zhang, Levine: When to Trust Your Model: Model-Based Policy
    Optimization, NeurIPS 2019).

    It is the loop of :class:`~sb3_rpto.RPTO` with RTO's weights left out (``weighting=None``), branches from states of
    D_target alone, and one batch for critic and actor alike: D_source with a share ``real_ratio`` of D_target.

    Of it PDML and PTP change above all ``make_rollouts`` (where branches start, which answer is kept) and how the
    model is fitted (``fit_weights``, ``fit_dynamics``), SLBO ``make_dynamics`` and ``update_dynamics`` (another loss,
    another policy optimiser).

    :param args: as those of :class:`~sb3_rpto.algorithms.transfer.TransferAlgorithm`
    :param kwargs: likewise, without those in :attr:`unused`; what is not passed is :meth:`published`
    :raises ValueError: for an argument in :attr:`unused`
    """

    updates_policy: ClassVar[bool] = True
    updates_dynamics: ClassVar[bool] = True

    unused: ClassVar[frozenset[str]] = UNUSED
    #: the paper's numbers, in constructor arguments; of the tasks by their names where they differ
    NUMBERS: ClassVar[dict[str, Any]] = {
        "gradient_steps": 20,
        "source_steps": 400,
        "buffer_size": 400_000,
        "model_train_freq": 250,
        "real_ratio": 0.05,
        "rollout_start": "target",
    }
    NUMBERS_OF_TASKS: ClassVar[dict[str, dict[str, Any]]] = {"HalfCheetah": {"gradient_steps": 40}}

    @classmethod
    def published(cls, task_id: str | None) -> dict[str, Any]:
        """The paper's numbers for a task, as constructor arguments.

        :param task_id: "HalfCheetah-v5" and "rpto/HalfCheetah-v0" are the same task; None: no task in particular
        """
        return {**cls.NUMBERS, **cls.NUMBERS_OF_TASKS.get(bare_name(task_id), {})}

    def _apply_preset(self) -> None:
        given = self.given_arguments - ({"source_steps"} if self.source_steps == "auto" else set())
        for name, value in self.published(None if self.env is None else env_id(self.env)).items():
            if name not in given:
                setattr(self, name, value)
        self.weighting = None

    def _check_arguments(self, offline: bool) -> None:
        self.refuse_unused(self.given_arguments)
        super()._check_arguments(offline)

    def sample_batches(self, count: int, batch_size: int) -> Iterator[tuple[ReplayBufferSamples, ReplayBufferSamples]]:
        """The critic's batches of RPTO, for the actor too."""
        return ((batch, batch) for batch in self.critic_batches(count, batch_size))
