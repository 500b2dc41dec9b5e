"""Back to the best policy by whole episodes in the fitted simulator, which cost no target step."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_rpto.algorithms.closed_loop.settings import LoopSettings
from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.algorithms.rollouts import copied
from sb3_rpto.algorithms.transition_checks import check_finite
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects.walker_reset import StandingEnv


class PolicySelection:
    """Evaluates the deterministic policy in the fitted simulator, and knows the best one so far.

    Warm-started SAC that learns on from what a good policy sees may get worse, and swings from one update to the next,
    which the simulator tells for nothing. The first policy to be beaten is the one that came from the source. The best
    is ``snapshots["simulator"]``; where it acts, the one that learns waits as ``snapshots["learner"]``.

    :param settings: of the loop
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        #: mean returns of the best policy, and of the last one as long as it acts
        self.best = self.last = -np.inf
        self._returns = np.empty(0)  # of the best one's episodes
        #: whether the last one is the best; if not, by how much it is ahead from the same starts, and how sure that is
        self.last_leads, self._lead, self._error = True, 0.0, 0.0
        #: taken so far, of the source's
        self.steps = 0
        self._phi: np.ndarray | None = None
        self._seen_by = np.empty(0)
        self._names: list[str] = []
        self._at_update = -np.inf  # the first one as soon as the simulator accounts for the target

    def due(self, updates: int) -> bool:
        """Whether a policy after so many updates has learned enough since the last one."""
        return updates - self._at_update >= self.settings.updates_between

    def is_behind(self, agent: Agent) -> bool:
        """Whether the policy has learned since the last one."""
        return agent.n_updates > self._at_update

    def evaluate(self, agent: Agent, dynamics: PhysicalDynamics) -> None:
        """Let the policy play, and keep it if it is the best so far."""
        seen_by = _statistics(agent)  # where they move, so does what the best one earns
        if self.has_moved(dynamics) or not np.array_equal(seen_by, self._seen_by):
            agent.snapshots.setdefault("simulator", agent.snapshots["source"])
            self._seen_by = seen_by
            self._phi, self._names, self._returns = dynamics.values.copy(), list(dynamics.names), np.empty(0)
        settings, returns = self.settings, np.empty(0)
        for episodes in (settings.few_episodes, settings.some_episodes, settings.all_episodes):
            if len(self._returns) < episodes:
                self._evaluate_best(agent, dynamics, episodes)
            returns = np.append(returns, self.play(agent, dynamics, range(len(returns), episodes)))
            self._lead, self._error = _mean(returns - self._returns[:episodes])
            self.last_leads = self._lead > settings.least_lead * self._size()
            loss = settings.clear_loss * self._size()
            if episodes == settings.few_episodes and self._lead < -loss - settings.sure * self._error:
                break
            # Where the best one falls in episodes that are yet to come, this one may show that it does not.
            if episodes == settings.some_episodes and not self.last_leads and returns.mean() <= self.best + loss:
                break
        self.last = float(returns.mean())
        agent.logger.record("source/evaluated_return", self.last)
        agent.logger.record("source/evaluation_timesteps", self.steps, exclude="tensorboard")
        if self.last_leads:
            self.best, self._returns = self.last, returns
            agent.take_snapshot("simulator")
        self._at_update = agent.n_updates  # not before: an interrupted one is played again

    def clearly_worse(self) -> bool:
        """Whether the last policy earned much less than the best one, and more so than episodes differ."""
        return not self.last_leads and self._lead < -self.settings.clear_loss * self._size() - self._error

    def go_back(self, agent: Agent) -> None:
        """Take up the best policy again, unless the last one is."""
        if not self.last_leads:
            agent.rollback("simulator")
            if agent.verbose:
                print(f"back to a policy that earns {self.best:.5g} in the simulator; the last one: {self.last:.5g}")
            self.last, self.last_leads = self.best, True

    def leave_best(self, agent: Agent) -> None:
        """Let the best policy act, unless the last one is, which is kept to go on learning."""
        if not self.last_leads:
            self.set_aside(agent)

    def set_aside(self, agent: Agent) -> None:
        """Keep the present policy to go on learning, and let the best one act."""
        agent.take_snapshot("learner")
        learner = agent.snapshots["learner"]
        if "simulator" in agent.snapshots:  # not so before the first evaluation
            agent.rollback("simulator")
        agent.snapshots["learner"] = learner
        self.last, self.last_leads = self.best, True

    def take_up_learner(self, agent: Agent) -> None:
        """Go on with the policy that learns, where another one acts."""
        if "learner" in agent.snapshots:
            agent.rollback("learner")

    def has_moved(self, dynamics: PhysicalDynamics) -> bool:
        """Whether the simulator is another one than that in which the best policy earned what it did."""
        if self._phi is None or self._names != dynamics.names:
            return True
        return bool((np.abs(dynamics.values - self._phi) > self.settings.moved * dynamics.scale).any())

    def play(self, agent: Agent, dynamics: PhysicalDynamics, starts: range) -> np.ndarray:
        """Returns of the deterministic policy in copies of the simulator, an episode each; its steps are counted."""
        assert agent.env is not None
        copies = [StandingEnv(copied(agent.env), dynamics.effects()) for _ in starts]
        seen = np.array([copy.reset(seed=self.settings.seed + i)[0] for i, copy in zip(starts, copies)])
        returns, running, steps = np.zeros(len(starts)), np.ones(len(starts), dtype=bool), 0
        normaliser = agent.get_vec_normalize_env()
        for _ in range(self.settings.longest_episode):
            shown = seen if normaliser is None else normaliser.normalize_obs(seen)
            actions, _ = agent.predict(shown, deterministic=True)
            for i in np.flatnonzero(running):
                seen[i], reward, terminated, truncated, _ = copies[i].step(actions[i])
                check_finite("source", observation=seen[i], reward=np.array(reward))
                returns[i] += float(reward)
                running[i] = not (terminated or truncated)
                steps += 1
            if not running.any():
                break
        self.steps += steps
        agent.state.source_timesteps += steps
        return returns

    def _evaluate_best(self, agent: Agent, dynamics: PhysicalDynamics, episodes: int) -> None:
        """Let the best policy so far, in the beginning the one from the source, play until it has so many episodes."""
        agent.take_snapshot("present")
        try:
            agent.rollback("simulator")
            further = self.play(agent, dynamics, range(len(self._returns), episodes))
            self._returns = np.append(self._returns, further)
            self.best = float(self._returns.mean())
        finally:
            agent.rollback("present")
            del agent.snapshots["present"]

    def _size(self) -> float:
        """Of what the best policy earns; its mean may be near zero."""
        return float(np.sqrt(np.mean(self._returns**2)))


def _mean(values: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _statistics(agent: Agent) -> np.ndarray:
    """What observations are normalised by, mean and variance; empty where they are not."""
    normaliser = agent.get_vec_normalize_env()
    if normaliser is None or not normaliser.norm_obs:
        return np.empty(0)
    assert isinstance(normaliser.obs_rms, RunningMeanStd)  # not of a Dict
    return np.concatenate([normaliser.obs_rms.mean, normaliser.obs_rms.var])
