"""Back to the best policy by whole episodes in the fitted simulator, which cost no target step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_rpto.algorithms.rollouts import copied
from sb3_rpto.algorithms.transition_checks import check_finite
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects.walker_reset import StandingEnv

if TYPE_CHECKING:
    from sb3_rpto.algorithms.closed_loop.looping import Looping

#: Episodes of a rehearsal, always from the same starts. After a few a policy that is clearly behind the best one plays
#: no further, nor does after some more one that is not ahead. All of them show who leads: of many policies the luckiest
#: would be taken otherwise, or one that falls now and then. Their most steps where the task has no end.
FEW, SOME, ALL, LONGEST, SEED = 5, 25, 100, 1_000, 30_000
#: A lead is none by less than this share of what the best policy earns (root mean square of its episodes). A policy is
#: clearly behind by more than :data:`LOST` of it and so many standard errors.
GAIN, SURE = 1e-3, 2.0
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
        self._returns = np.empty(0)  # of the best one's episodes
        #: whether the last one is the best; if not, by how much it is ahead from the same starts, and how sure that is
        self._leads, self._lead, self._error = True, 0.0, 0.0
        #: taken so far, of the source's
        self.steps = 0
        self._phi: np.ndarray | None = None
        self._seen_by = np.empty(0)
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
        seen_by = _statistics(model)  # where they move, so does what the best one earns
        if self._has_moved(dynamics) or not np.array_equal(seen_by, self._seen_by):
            model.snapshots.setdefault("simulator", model.snapshots["source"])
            self._seen_by = seen_by
            self._phi, self._names, self._returns = dynamics.values.copy(), list(dynamics.names), np.empty(0)
        returns = np.empty(0)
        for episodes in (FEW, SOME, ALL):
            if len(self._returns) < episodes:
                self._rehearse_best(model, dynamics, episodes)
            returns = np.append(returns, self._play(model, dynamics, range(len(returns), episodes)))
            self._lead, self._error = _mean(returns - self._returns[:episodes])
            self._leads = self._lead > GAIN * self._size()
            lost = LOST * self._size()
            if episodes == FEW and self._lead < -lost - SURE * self._error:
                break
            # Where the best one falls in episodes that are yet to come, this one may show that it does not.
            if episodes == SOME and not self._leads and returns.mean() <= self.best + lost:
                break
        self.last = float(returns.mean())
        model.logger.record("source/rehearsed", self.last)
        model.logger.record("source/rehearsal_timesteps", self.steps, exclude="tensorboard")
        if self._leads:
            self.best, self._returns = self.last, returns
            model.take_snapshot("simulator")
        self._at_update = model._n_updates  # not before: an interrupted one is played again

    def clearly_worse(self) -> bool:
        """Whether the last policy earned much less than the best one, and more so than episodes differ."""
        return not self._leads and self._lead < -LOST * self._size() - self._error

    def go_back(self, model: Looping) -> None:
        """Take up the best policy again, unless the last one is."""
        if not self._leads:
            model.rollback("simulator")
            if model.verbose:
                print(f"back to a policy that earns {self.best:.5g} in the simulator; the last one: {self.last:.5g}")
            self.last, self._leads = self.best, True

    def leave_best(self, model: Looping) -> None:
        """Let the best policy act, unless the last one is, which is kept to go on learning."""
        if not self._leads:
            self.set_aside(model)

    def set_aside(self, model: Looping) -> None:
        """Keep the present policy to go on learning, and let the best one act."""
        model.take_snapshot("learner")
        learner = model.snapshots["learner"]
        if "simulator" in model.snapshots:  # not so before the first rehearsal
            model.rollback("simulator")
        model.snapshots["learner"] = learner
        self.last, self._leads = self.best, True

    def take_up_learner(self, model: Looping) -> None:
        """Go on with the policy that learns, where another one acts."""
        if "learner" in model.snapshots:
            model.rollback("learner")

    def _rehearse_best(self, model: Looping, dynamics: PhysicalDynamics, episodes: int) -> None:
        """Let the best policy so far, in the beginning the one from the source, play until it has so many episodes."""
        model.take_snapshot("present")
        try:
            model.rollback("simulator")
            further = self._play(model, dynamics, range(len(self._returns), episodes))
            self._returns = np.append(self._returns, further)
            self.best = float(self._returns.mean())
        finally:
            model.rollback("present")
            del model.snapshots["present"]

    def _size(self) -> float:
        """Of what the best policy earns; its mean may be near zero."""
        return float(np.sqrt(np.mean(self._returns**2)))

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


def _mean(values: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _statistics(model: Looping) -> np.ndarray:
    """What observations are normalised by, mean and variance; empty where they are not."""
    normaliser = model.get_vec_normalize_env()
    if normaliser is None or not normaliser.norm_obs:
        return np.empty(0)
    assert isinstance(normaliser.obs_rms, RunningMeanStd)  # not of a Dict
    return np.concatenate([normaliser.obs_rms.mean, normaliser.obs_rms.var])
