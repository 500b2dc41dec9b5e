"""Back to the best policy by whole episodes in the fitted simulator, which cost no target step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_rpto.algorithms.source import copied
from sb3_rpto.algorithms.worlds import check_finite
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects.stance import StandingEnv

if TYPE_CHECKING:
    from sb3_rpto.algorithms.looping import Looping

#: Episodes of a rehearsal, always from the same starts, and so many more where it seems to beat the best by this share:
#: the luckiest of many policies would be taken otherwise. Their most steps where the task has no end.
EPISODES, MORE, GAIN, LONGEST, SEED = 25, 75, 1e-3, 1_000, 30_000
#: Updates of the policy between two rehearsals.
EVERY = 2_000
#: A policy that earns less than the best by more than this share and the standard error of their difference learns no
#: further, and the best one does: an early fall in one of all episodes is enough.
LOST = 0.03
#: What was earned counts no longer when a number of the simulator has moved by this share of its scale.
MOVED = 1e-3


class Rehearsals:
    """Lets the deterministic policy play in the fitted simulator, and knows the best one so far.

    Warm-started SAC that learns on from what a good policy sees may get worse, and swings from one update to the next,
    which the simulator tells for nothing. The first policy to be beaten is the one that came from the source. The best
    is ``snapshots["simulator"]``; where it acts, the one that learns waits as ``snapshots["learner"]``.
    """

    def __init__(self) -> None:
        #: mean returns of the best policy, and of the last one as long as it acts
        self.best = self.last = -np.inf
        self._errors = 0.0, 0.0  # standard errors of both
        self._first = -np.inf  # mean return of the best one's first episodes
        #: taken so far, of the source's
        self.steps = 0
        self._phi: np.ndarray | None = None
        self._names: list[str] = []
        self._at_update = -np.inf  # the first one as soon as the simulator accounts for the target

    def due(self, updates: int) -> bool:
        """Whether a policy after so many updates has learned enough since the last one."""
        return updates - self._at_update >= EVERY

    def is_behind(self, model: Looping) -> bool:
        """Whether the policy has learned since the last one."""
        return model._n_updates > self._at_update

    def rehearse(self, model: Looping, dynamics: PhysicalDynamics) -> None:
        """Play, and keep the policy if it is the best so far."""
        normaliser = model.get_vec_normalize_env()  # where its statistics move, so does what the best one earns
        if self._has_moved(dynamics) or (normaliser is not None and normaliser.training):
            self._rehearse_best(model, dynamics)
        returns = self._play(model, dynamics, range(EPISODES))
        if returns.mean() > self._first + GAIN * abs(self._first):  # from the same starts
            returns = np.concatenate([returns, self._play(model, dynamics, range(EPISODES, EPISODES + MORE))])
        self.last, error = _mean(returns)
        self._errors = self._errors[0], error
        model.logger.record("source/rehearsed", self.last)
        if self.last >= self.best:
            self.best, self._errors, self._first = self.last, (error, error), float(returns[:EPISODES].mean())
            model.take_snapshot("simulator")
        self._at_update = model._n_updates  # not before: an interrupted one is played again

    def clearly_worse(self) -> bool:
        """Whether the last policy earned much less than the best one, and more so than episodes differ."""
        return self.last < self.best - LOST * abs(self.best) - float(np.hypot(*self._errors))

    def go_back(self, model: Looping) -> None:
        """Take up the best policy again, unless the last one is."""
        if self.last < self.best:
            model.rollback("simulator")
            if model.verbose:
                print(f"back to a policy that earns {self.best:.5g} in the simulator; the last one: {self.last:.5g}")
            self.last = self.best

    def leave_best(self, model: Looping) -> None:
        """Let the best policy act, unless the last one is, which is kept to go on learning."""
        if self.last < self.best:
            self.set_aside(model)

    def set_aside(self, model: Looping) -> None:
        """Keep the present policy to go on learning, and let the best one act."""
        model.take_snapshot("learner")
        learner = model.snapshots["learner"]
        if "simulator" in model.snapshots:  # not so before the first rehearsal
            model.rollback("simulator")
        model.snapshots["learner"] = learner
        self.last = self.best

    def take_up_learner(self, model: Looping) -> None:
        """Go on with the policy that learns, where another one acts."""
        if "learner" in model.snapshots:
            model.rollback("learner")

    def _rehearse_best(self, model: Looping, dynamics: PhysicalDynamics) -> None:
        """The best policy so far, in the simulator as it is now; in the beginning, the one from the source."""
        model.snapshots.setdefault("simulator", model.snapshots["source"])
        model.take_snapshot("present")
        try:
            model.rollback("simulator")
            returns = self._play(model, dynamics, range(EPISODES + MORE))
            self.best, error = _mean(returns)
            self._errors, self._first = (error, self._errors[1]), float(returns[:EPISODES].mean())
        finally:
            model.rollback("present")
            del model.snapshots["present"]
        self._phi, self._names = dynamics.values.copy(), list(dynamics.names)

    def _has_moved(self, dynamics: PhysicalDynamics) -> bool:
        if self._phi is None or self._names != dynamics.names:
            return True
        return bool((np.abs(dynamics.values - self._phi) > MOVED * dynamics.scale).any())

    def _play(self, model: Looping, dynamics: PhysicalDynamics, starts: range) -> np.ndarray:
        """Returns of the deterministic policy in copies of the simulator, an episode each; its steps are counted."""
        assert model.env is not None
        copies = [StandingEnv(copied(model.env), dynamics.effects()) for _ in starts]
        seen = np.array([copy.reset(seed=SEED + i)[0] for i, copy in zip(starts, copies)])
        returns, running, steps = np.zeros(len(starts)), np.ones(len(starts), dtype=bool), 0
        normaliser = model.get_vec_normalize_env()
        for _ in range(LONGEST):
            actions, _ = model.predict(
                seen if normaliser is None else normaliser.normalize_obs(seen), deterministic=True
            )
            for i in np.flatnonzero(running):
                seen[i], reward, terminated, truncated, _ = copies[i].step(actions[i])
                check_finite("source", observation=seen[i], reward=np.array(reward))
                returns[i] += float(reward)
                running[i] = not (terminated or truncated)
                steps += 1
            if not running.any():
                break
        self.steps += steps
        model.source_timesteps += steps
        return returns


def _mean(returns: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(returns.mean()), float(returns.std() / np.sqrt(len(returns)))
