"""Learning in a simulator that was just corrected, by rounds and while that pays; the target waits meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sb3_rpto.algorithms.closed_loop.policy_selection import PolicySelection
from sb3_rpto.algorithms.closed_loop.settings import LoopSettings
from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.dynamics.physical import PhysicalDynamics


class Retraining:
    """Goes on where it stopped, if it was interrupted.

    What counts is what the best policy so far earns in evaluations, which are as frequent as beside target steps: from
    one to the next a policy may lose most of what it earns, and win it back. Without evaluations it is what the round's
    own episodes earned. A schedule of the learning rate goes from its beginning to its end.

    :param settings: of the loop
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        #: source steps taken so far, and at the end of the round under way
        self.steps = self._end = 0
        self._bar, self._idle = -math.inf, 0

    def learn(
        self,
        agent: Agent,
        dynamics: PhysicalDynamics,
        selection: PolicySelection | None,
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        """Learn until the end.

        :param selection: evaluates the policy; None where the simulator does not account for the target
        :param progress: called with the share of ``retrain_steps`` and what to say
        """
        if not self.steps:
            self._tell(agent, progress, f"learning in the corrected simulator, at most {agent.retrain_steps:,} steps")
            if selection is not None:
                selection.evaluate(agent, dynamics)
        source = agent.rollouts
        assert isinstance(source, EpisodeSource)
        while self._idle < self.settings.patience and self.steps < agent.retrain_steps:
            if self.steps >= self._end:
                source.returns.clear()
                self._end = min(self.steps + self.settings.round_steps, agent.retrain_steps)
            while self.steps < self._end:
                agent.set_progress(self.steps, agent.retrain_steps)
                self.steps += learn_for_a_step(agent, agent.fresh_source_steps())
                if selection is not None and selection.due(agent.n_updates):
                    selection.evaluate(agent, dynamics)
            # Where no episode ended there is nothing to judge by, and learning goes on.
            earned = float(np.mean(source.returns)) if source.returns else math.inf
            if selection is not None:
                earned = selection.best
            said = f"learning in the corrected simulator: {self.steps:,} source steps, return {earned:.5g}"
            self._tell(agent, progress, said)
            self._idle = 0 if earned > self._bar else self._idle + 1
            gain = self.settings.least_gain * abs(earned)
            self._bar = earned + gain if self._bar < earned < math.inf else self._bar
        if selection is not None and selection.is_behind(agent):
            selection.evaluate(agent, dynamics)

    def _tell(self, agent: Agent, progress: Callable[[float, str], None] | None, what: str) -> None:
        """Tell who waits for it, for minutes."""
        if agent.verbose:
            print(what)
        if progress is not None:
            progress(min(self.steps / max(agent.retrain_steps, 1), 1.0), what)


def learn_for_a_step(agent: Agent, source_steps: int) -> int:
    """Steps 3 (of so many), 5 and 6 of a round with one target step, but for the fit; the number of source steps."""
    assert agent.rollouts is not None
    taken = agent.rollouts.interact(agent, source_steps)
    agent.train(agent.updates_per_step, agent.batch_size)
    return taken


def reset_source_buffer(agent: Agent, fill_steps: int) -> None:
    """Drop what another simulator produced, and take the first steps in the present one.

    They begin with episodes: of one under way the commands before it are dropped too, which late motors still act on.
    """
    assert agent.rollouts is not None
    agent.replay_buffer.source.reset()
    agent.rollouts.begin_anew()
    agent.rollouts.interact(agent, fill_steps)
