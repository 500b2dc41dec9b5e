"""Close the loop inside ``learn()``: identify what the simulator lacks, accept it, retrain in it, select the policy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import gymnasium as gym
import numpy as np

from sb3_rpto.algorithms.closed_loop.acceptance import Acceptance, source_buffer_is_foreign
from sb3_rpto.algorithms.closed_loop.policy_selection import PolicySelection
from sb3_rpto.algorithms.closed_loop.retraining import Retraining, learn_for_a_step, reset_source_buffer
from sb3_rpto.algorithms.closed_loop.settings import LoopSettings
from sb3_rpto.algorithms.interfaces import Agent, LoopController
from sb3_rpto.algorithms.recorded_data import fill_recorded
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import from_json
from sb3_rpto.envs.observations import single_env
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.contacts import contact_changes
from sb3_rpto.sysid.selection.adequacy import SETTLED
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.windows import noise_levels

#: Findings that say what would account for the target in place of effects.
OTHERWISE = {
    FindingKind.BEYOND_THE_LIBRARY,
    FindingKind.TIME_STEP,
    FindingKind.EARLY_RESPONSE,
    FindingKind.EXCHANGED,
    FindingKind.REVERSED,
}


class OpenLoop(LoopController):
    """Does nothing: phi is fitted to transitions, and the policy learns beside every target step."""


class ClosedLoop(LoopController):
    """Decides when to trace, traces, and takes what is found into phi; it never spends a target step.

    From the moment on at which the simulator accounts for the target, target steps teach the policy nothing that the
    simulator does not. Then steps 3, 5 and 6 of the rounds between two fits are done together at the second of them,
    the simulator judges what came of it, and only the best policy so far acts in the target.

    :param declared: names of the numbers that the user declared
    :param effects: kinds of effects to look for, or "all"; with none the declared numbers alone are fitted
    :param traces_transitions: whether transitions of the target are traced; else a log alone is
    """

    closed = True
    settings: ClassVar[LoopSettings] = LoopSettings()

    def __init__(
        self,
        declared: tuple[str, ...],
        effects: Literal["all"] | Sequence[str] = "all",
        traces_transitions: bool = True,
    ) -> None:
        super().__init__()
        self.declared, self.effects, self.traces_transitions = declared, effects, traces_transitions
        #: transitions of the target that were ever added before the last trace, and their one-step error after it
        self.traced_at: int | None = None
        self.traced_error = math.inf
        #: whether the last transitions held too few windows to be traced
        self.trace_failed = False
        #: whether D_source holds what an uncorrected source produced, and the policy is to learn in the corrected one
        self.source_buffer_stale = False
        #: learning there, as long as it lasts
        self.retraining: Retraining | None = None
        #: encoder offsets that differ by run in the log that was traced; None where none do
        self.encoder_offsets: EncoderOffsets | None = None
        #: whether a log was traced that holds no transition of the task
        self.log_is_empty = False
        #: of the policy in the simulator as it is fitted
        self.selection = PolicySelection(self.settings)

    def forget_target(self) -> None:
        """Begin anew with another target: neither what was seen nor how well it was predicted counts there."""
        self.traced_at, self.traced_error, self.retraining = None, math.inf, None
        self.selection = PolicySelection(self.settings)
        self.trace_failed = self.simulator_validated = self.freezes_dynamics = False

    # ------------------------------------------------------------------ the steps of learn()

    def identify_log(self, agent: Agent) -> None:
        """Once, before anything is learned: phi from a trace of the log, where one was given.

        :raises ValueError: it is to be traced and is not there
        """
        if agent.target is None or not agent.target.is_traced:
            return
        if self.found and (self.log_is_empty or agent.replay_buffer.target.size() > 0):
            return
        if agent.measured is None:
            raise ValueError(
                "this model was saved before its recordings were traced, or is loaded without its buffers, and a "
                "checkpoint does not hold them: load_replay_buffer(), or set model.measured = "
                "Measurements.from_csv(...) again"
            )
        if self.found:
            self._fill_target(agent, simulator_of(agent), agent.measured)
        else:
            self.trace_log(agent, simulator_of(agent), agent.measured)

    def on_start(self, agent: Agent) -> None:
        """Before the rounds of ``learn()``: what the last one left undone."""
        self.retrain(agent)
        if agent.target_env is None:
            self.selection.take_up_learner(agent)

    def after_fit(self, agent: Agent) -> None:
        """Trace the transitions of the target, where that is due."""
        if self.traces_transitions and self.trace_due(agent, simulator_of(agent)):
            self.trace_transitions(agent, simulator_of(agent))

    def learn_deferred(self, agent: Agent) -> None:
        """Where enough was put off or learned since the last evaluation, learn, evaluate, and let the best policy act.

        With a log for a target the policy acts in the simulator alone, and goes on unless it clearly got worse.
        """
        deferred = agent.state.deferred_target_steps
        if not self.can_evaluate_policies(agent):
            if deferred:  # the last trace has taken the simulator's word away
                self.learn_deferred_steps(agent)
        elif self.selection.due(agent.n_updates + deferred * agent.updates_per_step):
            self.learn_deferred_steps(agent)
            if agent.target_env is not None:
                self.selection.leave_best(agent)

    def on_end(self, agent: Agent) -> None:
        """At the end of the budget: learn what was put off, judge the last policy, and let the best one act."""
        stopped = agent.target_env is not None and agent.steps_left() > 0  # by a callback
        if stopped or not self.can_evaluate_policies(agent):
            return
        if agent.state.deferred_target_steps or self.selection.is_behind(agent):
            self.learn_deferred_steps(agent)
        self.selection.leave_best(agent)
        if agent.verbose:
            print(f"the policy that acts, the best so far, earns {self.selection.best:.5g} in the simulator")

    def defers_learning(self, agent: Agent) -> bool:
        """Where the simulator may judge, with a target that is stepped in."""
        return agent.target_env is not None and self.can_evaluate_policies(agent)

    def can_evaluate_policies(self, agent: Agent) -> bool:
        """Whether evaluations say anything: the policy learns, and the simulator accounts for the target."""
        return agent.updates_policy and self.simulator_validated

    # ------------------------------------------------------------------ identify

    def awaits_trace(self) -> bool:
        """Whether transitions are traced, and this target's were not, nor told that they could not be."""
        return self.traces_transitions and self.traced_at is None

    def first_trace_after(self, agent: Agent) -> int:
        """How many target steps the first trace still waits for; 0 or less where it is due or was made."""
        side = agent.replay_buffer.target
        most = side.size() if agent.target_env is None else side.buffer_size  # recorded transitions become no more
        return min(self.settings.first_trace, most) - side.size() if self.awaits_trace() else 0

    def trace_due(self, agent: Agent, dynamics: PhysicalDynamics) -> bool:
        """Whether enough was seen for a first trace, for a better one than the last, or is no longer predicted."""
        settings, buffer = self.settings, agent.replay_buffer
        size, capacity = buffer.target.size(), buffer.target.buffer_size
        if self.traced_at is None:
            return self.first_trace_after(agent) <= 0
        traced_at = self.traced_at if self.traced_at <= buffer.target_added else 0  # loaded without its buffer
        new = min(buffer.target_added - traced_at, size)
        if new < min(settings.next_trace, capacity):
            return False
        more = buffer.target_added >= settings.data_growth * traced_at
        blurred = dynamics.observation_noise is not None and traced_at < settings.enough_transitions
        if more and (blurred or self.trace_failed or not self.found or self.found[-1]["verdict"] not in SETTLED):
            return True
        error = dynamics.error(agent.transitions("target").take(slice(size - new, None)))
        return error > max(settings.error_growth * self.traced_error, settings.rounding)

    def trace_transitions(self, agent: Agent, dynamics: PhysicalDynamics) -> None:
        """Trace on D_target, keep what lowers the error, log it, and retrain where another simulator made D_source.

        The one-step error of noisy observations is mostly noise: where there is some, the report judges. Transitions
        that hold no window, or too few, are said to be such, and learning goes on.
        """
        assert agent.env is not None
        data = agent.transitions("target")
        noise, before = dynamics.observation_noise, dynamics.error(data)
        try:
            measured = Measurements.from_replay(agent.replay_buffer, agent.env, noise=noise)
            report = self.identify(agent, measured, horizon_of(measured, single_env(agent.env), self.settings))
        except ValueError as error:  # of the data: what was passed was looked at before; a run must not end by it
            self.traced_at, self.traced_error, self.trace_failed = agent.replay_buffer.target_added, before, True
            warnings.warn(
                f"{len(data)} target transitions were not traced: {error}; a trace is tried again when there are twice "
                "as many",
                stacklevel=2,
            )
            return
        self.traced_at, self.trace_failed = agent.replay_buffer.target_added, False
        added = self.accept(agent, dynamics, report, data, before if noise is None else math.inf)
        self.traced_error = dynamics.error(data)
        self._tell(agent, report, added, f"{len(data)} target transitions", before, self.traced_error)
        foreign = bool(added) or source_buffer_is_foreign(agent, dynamics, agent.transitions("source"), self.settings)
        self.source_buffer_stale = foreign
        self.retrain(agent)

    def trace_log(self, agent: Agent, dynamics: PhysicalDynamics, measured: Measurements) -> None:
        """Trace a robot's log itself, by multiple shooting: one-step errors of noisy samples tell next to nothing.

        phi takes all that is found, as long as the simulator with it is stable, and where the verdict is
        ``unexplained`` errs less on the log; D_target is read anew, as the corrected environment shows it, and without
        encoder offsets that differ by run. What the uncorrected source produced is stale from then on.

        :raises ValueError: the log cannot be traced, e.g. is too short
        """
        data = agent.transitions("target")
        before = dynamics.error(data)
        try:
            report = self.identify(agent, measured, None)
        except ValueError as error:
            raise ValueError(f"target_data: {error}") from error
        added = self.accept(agent, dynamics, report, data, math.inf)
        self.encoder_offsets = report.zeros
        self._fill_target(agent, dynamics, measured)
        self.log_is_empty = agent.replay_buffer.target.size() == 0
        self.source_buffer_stale = agent.replay_buffer.source.size() > 0 or not agent.state.knows_source
        self._tell(agent, report, added, f"{len(measured.episodes)} recorded episodes", before, dynamics.error(data))

    def identify(self, agent: Agent, measured: Measurements, horizon: float | None) -> Report:
        """Trace what the simulator lacks.

        :param measured: the target's motion
        :param horizon: length of the windows in s; None leaves it to the trace
        """
        assert agent.env is not None
        if agent.verbose:
            print("tracing what the simulator lacks, which takes a minute or several")
        report = trace(
            single_env(agent.env),
            measured,
            self.declared,
            known=[from_json(stored) for stored in agent.dynamics_kwargs.get("effects", ())],
            seed=agent.seed or 0,
            candidates=None if self.effects == "all" else self.effects,
            horizon=horizon,
            threads=simulator_of(agent).threads,
            progress=self.progress,
        )
        self.reports.append(report)
        self.found.append(report.to_json())
        self.simulator_validated = report.verdict in SETTLED
        return report

    def accept(
        self, agent: Agent, dynamics: PhysicalDynamics, report: Report, data: Transitions, before: float
    ) -> list[str]:
        """Let phi have the effects that were found, if that pays; the labels of those that are new.

        :param before: error of ``data`` without them; infinite: the report judges
        """
        assert agent.env is not None
        acceptance = Acceptance(agent.env, dynamics, report, data, self.settings)
        added = acceptance.decide(before)
        if acceptance.lacking:
            self.simulator_validated = False
        if acceptance.accepted:
            self.freezes_dynamics = dynamics.observation_noise is not None or acceptance.late
            assert agent.dynamics_config is not None
            agent.dynamics_config["effects"] = dynamics.added()  # what a checkpoint rebuilds the model from
        return added

    def _fill_target(self, agent: Agent, dynamics: PhysicalDynamics, measured: Measurements) -> None:
        """Let D_target hold a log that was traced, as the corrected machine would have shown it."""
        homed = measured if self.encoder_offsets is None else self.encoder_offsets.taken_off(measured)
        fill_recorded(agent, homed, dynamics.effects())

    # ------------------------------------------------------------------ retrain

    def retrain(self, agent: Agent) -> None:
        """Where D_source is stale, drop it and learn anew; a budget of source steps learns by itself.

        Where that is interrupted it goes on with the run.
        """
        if not self.source_buffer_stale:
            return
        if self.retraining is None:
            agent.snapshots.pop("learner", None)  # of the simulator that is dropped
            reset_source_buffer(agent, self.settings.fill_steps)
            self.retraining = Retraining(self.settings)
        learns = agent.updates_policy and agent.target_env is not None and agent.updates_per_step
        if learns and self.traced_at is not None:  # else what was corrected for is a target that was left
            self._retrain_policy(agent, self.retraining)
        self.source_buffer_stale, self.retraining = False, None

    def _retrain_policy(self, agent: Agent, retraining: Retraining) -> None:
        selection = self.selection if self.can_evaluate_policies(agent) else None
        self.selection.take_up_learner(agent)
        try:
            retraining.learn(agent, simulator_of(agent), selection, self.progress)
            if selection is not None:
                selection.go_back(agent)
        except BaseException:
            if selection is not None:
                selection.set_aside(agent)  # nobody is left with a policy that was not judged
            raise
        finally:
            agent.set_progress(agent.num_timesteps)

    # ------------------------------------------------------------------ select

    def learn_deferred_steps(self, agent: Agent) -> None:
        """Learn what target steps have paid for, and judge what comes of it; where interrupted, it goes on later."""
        judges, state = self.can_evaluate_policies(agent), agent.state
        if state.deferred_target_steps:
            self.selection.take_up_learner(agent)
        try:
            while state.deferred_target_steps:
                # A schedule's learning rate is that of the step that paid.
                agent.set_progress(max(agent.num_timesteps - state.deferred_target_steps, 0))
                learn_for_a_step(agent, int(agent.source_steps))
                state.deferred_target_steps -= 1
                if judges and state.deferred_target_steps and self.selection.due(agent.n_updates):
                    self._judge(agent)
            if judges:
                self._judge(agent)
        except BaseException:
            if judges and agent.target_env is not None:
                self.selection.set_aside(agent)
            raise

    def _judge(self, agent: Agent) -> None:
        self.selection.evaluate(agent, simulator_of(agent))
        if self.selection.clearly_worse():
            self.selection.go_back(agent)

    # ------------------------------------------------------------------ tell

    def _tell(self, agent: Agent, report: Report, added: list[str], data: str, before: float, after: float) -> None:
        """Tell and log what a trace found, and what it did to the one-step error."""
        if self.on_report is not None:
            self.on_report(report)
        logger = agent.logger
        logger.record("gap/residual_before", before)
        logger.record("gap/residual_after", after)
        logger.record("gap/adequacy_before", report.adequacy_before.ratio)
        logger.record("gap/adequacy_after", report.adequacy_after.ratio)
        logger.record("gap/verdict", report.verdict)
        logger.record("gap/effects", ", ".join(added) or "none")
        for name, value in simulator_of(agent).describe().items():
            logger.record(f"dynamics/{name}", value)
        agent.dump_logs()  # SB3 waits for the end of some episodes, before which a short run is over
        if agent.verbose:
            print(f"traced on {data}: {report.verdict}; {', '.join(added) or 'nothing'} added")
        self._warn_of_doubts(agent, report, data)

    def _warn_of_doubts(self, agent: Agent, report: Report, data: str) -> None:
        doubtful = {FindingKind.UNDETERMINED}
        if report.verdict != "unexplained":
            doubtful.add(FindingKind.AT_ITS_BOUND)
        doubts = [f"{f.where}: {f.message}" for f in report.findings if f.kind in doubtful]
        if doubts and agent.target is not None and agent.target.is_traced:  # of transitions the fits say so
            warnings.warn(f"the trace on {data}: {'. '.join(doubts)}", stacklevel=4)
        if report.verdict == "unexplained":
            known = agent.measured is not None or agent.dynamics_kwargs.get("observation_noise") is not None
            others = "".join(f". {f.message}" for f in report.findings if f.kind in OTHERWISE)
            bounds = "".join(f". {f.where}: {f.message}" for f in report.findings if f.kind == FindingKind.AT_ITS_BOUND)
            noise = "" if known else "whether they are noisy (dynamics_kwargs={'observation_noise': ...}), "
            warnings.warn(
                f"the trace on {data} is 'unexplained': what it looked for does not account for the difference, and "
                "the policy learns in a simulator that still errs; see print(model.loop.reports[-1]) for which joints, "
                f"and whether the observations hold the model's joints in its order, {noise}what else could be "
                f"declared, and dynamics='residual'{others}{bounds}",
                stacklevel=4,
            )


def simulator_of(agent: Agent) -> PhysicalDynamics:
    """P_phi of an algorithm whose loop is closed, which the constructor has checked."""
    assert isinstance(agent.dynamics, PhysicalDynamics)
    return agent.dynamics


def horizon_of(measured: Measurements, env: gym.Env, settings: LoopSettings = ClosedLoop.settings) -> float:
    """Length in s of the windows of a trace of transitions.

    :param measured: the transitions
    :param env: the source
    :param settings: of the loop
    """
    base: Any = env.unwrapped
    changes = contact_changes(base.model, measured, noise_levels(measured))
    return (window(measured, changes, settings) - 1) * float(base.dt)


def window(measured: Measurements, contacts: float, settings: LoopSettings = ClosedLoop.settings) -> int:
    """Number of samples in the windows of a trace of transitions with so many ``contacts`` that change a second."""
    if measured.exact or contacts > DEFAULTS.problem.contact_changes:
        return settings.window
    ends = [np.flatnonzero(~np.concatenate([[False], episode.placed, [False]])) for episode in measured.episodes]
    stretches = np.concatenate([np.diff(end) - 1 for end in ends])  # of samples whose positions are known
    usual = int(np.quantile(stretches[stretches > 0], settings.short_stretches)) if stretches.any() else 0
    return min(max(usual, settings.window), settings.noisy_window)
