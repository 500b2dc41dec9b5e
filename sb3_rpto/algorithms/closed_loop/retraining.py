"""Learning in a simulator that was just corrected, by rounds and while that pays; the target waits meanwhile."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sb3_rpto.algorithms.rollouts import EpisodeSource

if TYPE_CHECKING:
    from sb3_rpto.algorithms.closed_loop.controller import LoopCloser
    from sb3_rpto.algorithms.closed_loop.looping import Looping

#: With D_source made anew the policy learns in the corrected simulator what it can for nothing, before the next target
#: step: in rounds of so many source steps, until so many in a row earned no more than the best one and this share of
#: it, or ``retrain_steps`` are taken. A task that is solved earns a trifle more for ever.
ROUND, PATIENCE, RISE = 80_000, 2, 1e-3


class Rounds:
    """Goes on where it stopped, if it was interrupted.

    What counts is what the best policy so far earns in rehearsals, which are as frequent as beside target steps: from
    one to the next a policy may lose most of what it earns, and win it back. Where the simulator may not judge, it is
    what the round's own episodes earned. A schedule of the learning rate goes from its beginning to its end.
    """

    def __init__(self) -> None:
        #: source steps taken so far, and at the end of the round under way
        self.steps = self._end = 0
        self._bar, self._idle = -math.inf, 0

    def learn(self, model: Looping, loop: LoopCloser) -> None:
        """Learn until the end."""
        if not self.steps:
            self._tell(model, loop, f"learning in the corrected simulator, at most {model.retrain_steps:,} steps")
            loop.rehearse(model)
        source = model._source_world
        assert isinstance(source, EpisodeSource)
        while self._idle < PATIENCE and self.steps < model.retrain_steps:
            if self.steps >= self._end:
                source.returns.clear()
                self._end = min(self.steps + ROUND, model.retrain_steps)
            while self.steps < self._end:
                model._update_current_progress_remaining(self.steps, model.retrain_steps)
                self.steps += learn_for_a_step(model, model.fresh_steps())
                if loop.rehearsals.due(model._n_updates):
                    loop.rehearse(model)
            # Where no episode ended there is nothing to judge by, and learning goes on.
            earned = float(np.mean(source.returns)) if source.returns else math.inf
            if loop.may_judge(model):
                earned = loop.rehearsals.best
            self._tell(
                model, loop, f"learning in the corrected simulator: {self.steps:,} source steps, return {earned:.5g}"
            )
            self._idle = 0 if earned > self._bar else self._idle + 1
            self._bar = earned + RISE * abs(earned) if self._bar < earned < math.inf else self._bar
        if loop.rehearsals.is_behind(model):
            loop.rehearse(model)

    def _tell(self, model: Looping, loop: LoopCloser, what: str) -> None:
        """Tell who waits for it, for minutes."""
        if model.verbose:
            print(what)
        if loop.progress is not None:
            loop.progress(min(self.steps / max(model.retrain_steps, 1), 1.0), what)


def learn_for_a_step(model: Looping, source_steps: int) -> int:
    """Steps 3 (of so many), 5 and 6 of a round with one target step, but for the fit; the number of source steps."""
    assert model._source_world is not None
    taken = model._source_world.interact(model, source_steps)
    model.train(model.updates_per_step, model.batch_size)
    return taken
