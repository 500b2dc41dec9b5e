"""What a run counts and knows of itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class RunState:
    """Counters and flags of a run, beside those of Stable-Baselines3; a checkpoint holds them as one."""

    #: source steps so far, in the real source or in its model
    source_timesteps: int = 0
    #: source steps of plain SAC before the transfer
    pretraining_timesteps: int = 0
    #: target steps by what they were spent on
    target_spent: dict[str, int] = field(default_factory=dict)
    #: whether the policy knows the source, by a warm start or by training there
    knows_source: bool = False
    #: whether plain SAC in the source is under way; no checkpoint holds it
    pretraining: bool = False

    #: ``num_timesteps`` where the last rollout in the target began
    rollout_start: int = 0
    #: target steps of the last rollout (with a log for a target: calls of the source)
    rollout_timesteps: int = 1
    #: whether step 3 of a round is done and its steps 5 and 6 are not
    update_pending: bool = False
    #: source steps that target steps are still to be matched with in step 3; negative: taken in advance
    source_steps_due: int = 0
    #: target steps that the policy has not learned for yet, as a closed loop puts that off until a fit
    deferred_target_steps: int = 0

    #: updates of the actor so far, by which its batches alternate
    actor_updates: int = 0
    #: target steps since the last fit of the dynamics
    steps_since_fit: int = 0

    #: whether the dynamics have the target's rules of the task, as after their first fit
    has_target_rules: bool = False
    #: whether the simulator was checked after its first fit to this target
    fit_checked: bool = False
    #: whether a known rule was seen not to be this target's
    rules_checked: bool = False
    #: whether what a fit leaves of exact data was checked
    residual_checked: bool = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "pretraining": False}

    def forget_target(self, num_timesteps: int) -> None:
        """Begin with another target: no round is open there, and nothing is due for it.

        :param num_timesteps: target steps so far
        """
        self.update_pending, self.rollout_timesteps, self.rollout_start = False, 1, num_timesteps
        self.source_steps_due = 0
