"""Whether phi takes what a trace has found, and whether D_source is still the simulator's own."""

from __future__ import annotations

import math
import warnings

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms.closed_loop.settings import LoopSettings
from sb3_rpto.algorithms.interfaces import Agent
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.onestep import remembered
from sb3_rpto.dynamics.physical import TRIAL_STATES, TRIAL_STEPS, PhysicalDynamics
from sb3_rpto.effects import Declared
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.observations import single_env
from sb3_rpto.sysid import Report


class Acceptance:
    """Lets phi have the effects that a trace found, if that pays.

    A trace begins at the simulator with what its user knows: what it found is the whole explanation, so what an earlier
    one had found and this one has not leaves phi.

    :param env: the source
    :param dynamics: P_phi
    :param report: of the trace
    :param data: D_target
    :param settings: of the loop
    """

    def __init__(
        self, env: VecEnv, dynamics: PhysicalDynamics, report: Report, data: Transitions, settings: LoopSettings
    ) -> None:
        self.env, self.dynamics, self.report, self.data, self.settings = env, dynamics, report, data, settings
        known = {effect.label for effect in dynamics.effects()}
        #: all that was found, labels of what is new, and whether something acts late
        self.found = [traced.effect for traced in (*report.declared, *report.effects)]
        self.new = [e.label for e in self.found if e.label not in known and not isinstance(e, Declared)]
        self.late = any(effect.overrides("late") for effect in self.found)
        #: whether phi has it now, and whether the simulator lacks what is known to be missing
        self.accepted = self.lacking = False

    def decide(self, before: float) -> list[str]:
        """Let phi have the effects, or leave it as it is; the labels of those that are new.

        :param before: error of the data without them; infinite: the report judges
        """
        dynamics, report = self.dynamics, self.report
        if self.late:  # what was seen before a step began tells nothing of one-step errors
            before = math.inf
        nearer = report.verdict != "unexplained" or report.adequacy_after.ratio < report.adequacy_before.ratio
        if before == math.inf and self.new and not nearer:
            return []
        kept = dynamics.effects(), dynamics.covariance.copy()
        dynamics.replace([effect for effect in dynamics.effects() if isinstance(effect, Declared)])
        dynamics.adopt(self.found, report.covariance)
        if not stays_finite(dynamics, self.data, self.env):
            dynamics.replace(*kept)
            return self._refuse_unstable()
        after = dynamics.error(self.data) if before < math.inf else 0.0
        if not after < (self.settings.accepted_error if self.new else 1.0) * before:
            dynamics.replace(*kept)
            return self._refuse_needless(before, after)
        self.accepted = True
        return self.new

    def _refuse_unstable(self) -> list[str]:
        self.lacking = True
        warnings.warn(
            f"the simulator with {', '.join(self.new) or 'the traced values'} becomes unstable: refused, the last one "
            "is kept; give bounds to what you declare",
            stacklevel=5,
        )
        return []

    def _refuse_needless(self, before: float, after: float) -> list[str]:
        if self.new:  # what it lacks is known, and it goes on lacking it
            self.lacking = True
            warnings.warn(
                f"the trace found {', '.join(self.new)}, with which the one-step error of {len(self.data)} target "
                f"transitions is {after:.3g}, not clearly below {before:.3g} without: the last simulator is kept; "
                "what is rare may hardly count in that error, see print(model.loop.reports[-1]), and "
                "dynamics_kwargs={'effects': [...]} adds it all the same",
                stacklevel=5,
            )
        return []


def source_buffer_is_foreign(
    agent: Agent, dynamics: PhysicalDynamics, data: Transitions, settings: LoopSettings
) -> bool:
    """Whether D_source holds what another simulator than the present one produced.

    Where the oldest transitions were overwritten, the next ones have lost the commands that late motors still act on.

    :param data: D_source
    """
    side, lead = agent.replay_buffer.source, 0
    if side.full:
        lead = min(remembered(dynamics.mj_model, dynamics.frame_skip) * int(agent.source_steps), side.size() // 2)
    oldest = data.take(slice(lead + settings.oldest_transitions))
    return dynamics.error(oldest, lead=lead) > settings.foreign_error


def stays_finite(dynamics: PhysicalDynamics, data: Transitions, env: VecEnv) -> bool:
    """Whether the simulator runs on from states of the target under the target's own actions.

    Where there are none, from states that the source resets to, under random actions.

    :param data: transitions of the target, oldest first
    :param env: the source
    """
    return dynamics.runs_on(data) if len(data) else dynamics.runs(*_from_resets(env))


def _from_resets(env: VecEnv) -> tuple[np.ndarray, np.ndarray]:
    """Observations (n, observation_dim) of a copy's resets, and random actions (n, length, action_dim)."""
    copy = copy_env(single_env(env))
    assert copy is not None  # what simulates phi is a copy, too
    observations = np.array([copy.reset(seed=i)[0] for i in range(TRIAL_STATES)])
    copy.action_space.seed(0)
    actions = [[copy.action_space.sample() for _ in range(TRIAL_STEPS)] for _ in range(TRIAL_STATES)]
    return observations, np.array(actions)
