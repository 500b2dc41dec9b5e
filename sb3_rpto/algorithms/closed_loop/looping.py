"""The closed loop's part in Algorithm 1: traces after fits, and a policy that the simulator judges before it acts."""

from __future__ import annotations

from collections.abc import Sequence

from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_rpto.algorithms.checkpointing import Resumable
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.sysid import Measurements

#: Source steps for each update in a simulator that is new to the policy. Updates cost far more, and of few steps of its
#: own a policy learns slowly there, or loses what it knows.
FRESH = 8


class Looping(Resumable):
    """Calls :class:`~sb3_rpto.algorithms.closed_loop.controller.LoopCloser`, where there is one, when it is its turn.

    From the moment on at which the simulator accounts for the target, target steps teach the policy nothing that the
    simulator does not. Then steps 3, 5 and 6 of the rounds between two fits are done together at the second of them,
    the simulator judges what came of it, and only the best policy so far acts in the target.
    """

    #: what to look for, as the user asked
    close_loop: bool | Sequence[str]
    #: source steps that may follow a trace
    retrain_steps: int
    #: the robot's log, where one was given
    measured: Measurements | None

    def learns_at_fits(self) -> bool:
        """Whether steps 3 and 5 wait for the next fit."""
        return self.loop is not None and not self._offline and self.loop.may_judge(self)

    def update(self) -> None:
        """Steps 5 and 6, or the latter's fit alone where the policy learns at fits."""
        if self.learns_at_fits():
            self._owed += self._collected
            self._count_for_fit()
            self.fit_dynamics()
        else:
            super().update()

    def _source_steps_to_take(self) -> int:
        """Those for the target steps of the next rollout; of whole episodes, as many as in the last one.

        What several copies took too much, or the last rollout turned out to need more or less, is made up for.
        """
        assert isinstance(self.train_freq, TrainFreq)  # SB3's setup has made it one
        if self._offline:  # the budget is one of source steps then
            return min(self._source_due + self._steps_of_round(), self._steps_left())
        come = min(self._collected, self._steps_left())
        if self.train_freq.unit == TrainFrequencyUnit.STEP:
            assert self.target_env is not None
            come = self._rollout_length().frequency * self.target_env.num_envs
        return self._source_due + come * self._steps_of_round()

    def _count_for_fit(self) -> None:
        if not self.learns_at_fits():
            self._source_due += self._collected * self._steps_of_round()
        super()._count_for_fit()

    def fresh_steps(self) -> int:
        """Source steps for the updates of a target step in a simulator that is new to the policy, of all its copies."""
        copies = int(self.source_steps)
        return max(-(-FRESH * self.updates_per_step // copies), 1) * copies

    def _steps_of_round(self) -> int:
        """With a log for a target: many where the simulator accounts for it, as the policy learns from them alone.

        Before the log is traced it is taken for granted that it will.
        """
        awaited = self._traces_log and self.loop is not None and not self.loop.found
        return (
            self.fresh_steps() if self._offline and (awaited or self._worlds_are_alike()) else super()._steps_of_round()
        )

    def _worlds_are_alike(self) -> bool:
        return self.loop is not None and self.loop.accounts

    def _keeps_phi(self) -> bool:
        return self.loop is not None and self.loop.keeps_phi

    def _close_the_loop(self) -> None:
        if self.loop is not None and self.loop.kinds is not False:
            assert isinstance(self.dynamics, PhysicalDynamics)  # checked by the constructor
            if self.loop.due(self, self.dynamics):
                self.loop.close(self, self.dynamics)

    def _rehearse(self) -> None:
        if self.loop is not None:
            self.loop.watch(self)
