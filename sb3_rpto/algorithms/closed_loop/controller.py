"""Close the loop inside ``learn()``: trace on D_target or on a robot's log what the simulator lacks, add it to phi."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.algorithms import warm_start
from sb3_rpto.algorithms.closed_loop.looping import Looping
from sb3_rpto.algorithms.closed_loop.policy_selection import Rehearsals
from sb3_rpto.algorithms.closed_loop.retraining import Rounds, learn_for_a_step
from sb3_rpto.algorithms.closed_loop.source_buffer import outdated, renew_source
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.physical import TRIAL_STATES, TRIAL_STEPS, PhysicalDynamics
from sb3_rpto.effects import Declared, from_json
from sb3_rpto.envs.env_copy import copy_env
from sb3_rpto.envs.observations import single_env
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.contacts import contact_changes
from sb3_rpto.sysid.problem.problem import Progress
from sb3_rpto.sysid.selection.adequacy import SETTLED
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.windows import noise_levels

if TYPE_CHECKING:
    from sb3_rpto.algorithms.two_env_sac import TwoWorlds

#: Target transitions before the first trace, and new ones before another.
FIRST, AGAIN = 200, 200
#: Another trace is due when the one-step error of new transitions is so many times that after the last.
RISEN = 2.0
#: Smaller errors, in units of a typical step's change, are the rounding of observations.
ROUNDING = 1e-6
#: And, where the last one did not account for everything, when there are so many times as many transitions.
MORE = 2
#: Findings that say what would account for the target in place of effects.
OTHERWISE = {
    FindingKind.BEYOND_THE_LIBRARY,
    FindingKind.TIME_STEP,
    FindingKind.EARLY_RESPONSE,
    FindingKind.EXCHANGED,
    FindingKind.REVERSED,
}
#: Samples in a window: several steps show what acts late, and contacts do not amplify errors yet.
WINDOW = 4
#: What is missing grows with the square of the time, noise does not: where there is some and no contacts come and go,
#: windows may have so many, as long as three of four stretches of known states hold them.
NOISY_WINDOW, SHORT_STRETCHES = 6, 0.25
#: So many transitions fill all windows of a trace: up to there more of noisy ones tell more.
ENOUGH = 400
#: What is found is kept when the one-step error falls below this share of the best without it.
WORTH = 0.9


class LoopCloser:
    """Decides when to trace, traces, and takes what is found into phi; it never spends a target step.

    :param declared: names of the numbers that the user declared
    :param kinds: of effects to look for; True: all; none of them: the declared numbers alone are fitted; False: those
        on a robot's log, and transitions are never traced
    """

    #: called with each report, before the policy learns in what it corrects; no checkpoint holds it
    on_report: Callable[[Report], None] | None = None

    def __init__(self, declared: tuple[str, ...], kinds: bool | Sequence[str] = True) -> None:
        self.declared, self.kinds = declared, kinds
        #: of this process; a checkpoint keeps what they said, :attr:`found`
        self.reports: list[Report] = []
        self.found: list[dict[str, Any]] = []
        #: transitions of the target that were ever added before the last trace
        self._traced_at: int | None = None
        self._error = math.inf
        #: called while it traces, as :func:`~sb3_rpto.sysid.trace.trace` calls it, and while the policy then learns
        #: in the corrected simulator, with the share of ``retrain_steps``; no checkpoint holds it
        self.progress: Progress | None = None
        #: whether the last transitions held too few windows to be traced
        self._untraced = False
        #: whether D_source holds what an uncorrected source produced, and the policy is to learn in the corrected one
        self.stale = False
        #: of learning there, as long as they last
        self.rounds: Rounds | None = None
        #: whether a trace made phi that knows better than one-step errors: of noisy transitions, or of late sensors
        self.keeps_phi = False
        #: whether the simulator accounts for the target by the last trace, so that it may judge policies
        self.accounts = False
        #: encoder zeros that differ by run in the robot's log that was traced; None where none do
        self.zeros: EncoderOffsets | None = None
        #: whether a robot's log was traced that holds no transition of the task
        self.log_is_empty = False
        #: of the policy in the simulator as it is fitted
        self.rehearsals = Rehearsals()

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name != "on_report"}
        return {**kept, "reports": [], "progress": None}

    def forget_target(self) -> None:
        """Begin anew with another target: neither what was seen nor how well it was predicted counts there."""
        self._traced_at, self._error, self.rehearsals, self.rounds = None, math.inf, Rehearsals(), None
        self._untraced = self.accounts = self.keeps_phi = False

    @property
    def traced(self) -> bool:
        """Whether this target was traced, a trace of it told that it could not be, or none is to be."""
        return self.kinds is False or self._traced_at is not None

    def due(self, model: Looping, dynamics: PhysicalDynamics) -> bool:
        """Whether enough was seen for a first trace, for a better one than the last, or is no longer predicted."""
        buffer = model.replay_buffer
        size, capacity = buffer.target.size(), buffer.target.buffer_size
        if self._traced_at is None:
            return self.first_comes_after(model) <= 0
        traced_at = self._traced_at if self._traced_at <= buffer.target_added else 0  # loaded without its buffer
        new = min(buffer.target_added - traced_at, size)
        if new < min(AGAIN, capacity):
            return False
        more = buffer.target_added >= MORE * traced_at
        blurred = dynamics.observation_noise is not None and traced_at < ENOUGH
        if more and (blurred or self._untraced or not self.found or self.found[-1]["verdict"] not in SETTLED):
            return True
        error = dynamics.error(model.transitions("target").take(slice(size - new, None)))
        return error > max(RISEN * self._error, ROUNDING)

    def first_comes_after(self, model: TwoWorlds) -> int:
        """How many target steps the first trace still waits for; 0 or less where it is due or was made."""
        side = model.replay_buffer.target
        most = side.size() if model._offline else side.buffer_size  # recorded transitions become no more
        return 0 if self.traced else min(FIRST, most) - side.size()

    def close(self, model: Looping, dynamics: PhysicalDynamics) -> None:
        """Trace on D_target, keep what lowers the error, log it, and renew D_source where another simulator made it.

        The one-step error of noisy observations is mostly noise: where there is some, the report judges. Transitions
        that hold no window, or too few, are said to be such, and learning goes on.
        """
        assert model.env is not None
        data = model.transitions("target")
        noise, before = dynamics.observation_noise, dynamics.error(data)
        try:
            measured = Measurements.from_replay(model.replay_buffer, model.env, noise=noise)
            report = self._trace(model, dynamics, measured, horizon_of(measured, single_env(model.env)))
        except ValueError as error:  # of the data: what was passed was looked at before; a run must not end by it
            self._traced_at, self._error, self._untraced = model.replay_buffer.target_added, before, True
            warnings.warn(
                f"{len(data)} target transitions were not traced: {error}; a trace is tried again when there are twice "
                "as many",
                stacklevel=2,
            )
            return
        self._traced_at, self._untraced = model.replay_buffer.target_added, False
        added = self._take(model, dynamics, report, data, before if noise is None else math.inf)
        self._error = dynamics.error(data)
        self._say(model, report, added, f"{len(data)} target transitions", before, self._error)
        self.stale = bool(added) or outdated(model, dynamics)
        self.renew(model)

    def close_on_log(self, model: Looping, dynamics: PhysicalDynamics, measured: Measurements) -> None:
        """Trace on a robot's log itself, by multiple shooting: one-step errors of noisy samples tell next to nothing.

        phi takes all that is found, as long as the simulator with it is stable, and where the verdict is
        ``unexplained`` errs less on the log; D_target is read anew, as the corrected environment shows it, and without
        encoder zeros that differ by run. What the uncorrected source produced is :attr:`stale` from then on.

        :raises ValueError: the log cannot be traced, e.g. is too short
        """
        data = model.transitions("target")
        before = dynamics.error(data)
        try:
            report = self._trace(model, dynamics, measured, None)
        except ValueError as error:
            raise ValueError(f"target_data: {error}") from error
        added = self._take(model, dynamics, report, data, math.inf)
        self.zeros = report.zeros
        self.fill_target(model, dynamics, measured)
        self.log_is_empty = model.replay_buffer.target.size() == 0
        self.stale = model.replay_buffer.source.size() > 0 or not model._warm
        self._say(model, report, added, f"{len(measured.episodes)} recorded episodes", before, dynamics.error(data))

    def fill_target(self, model: Looping, dynamics: PhysicalDynamics, measured: Measurements) -> None:
        """Let D_target hold a log that was traced, as the corrected machine would have shown it."""
        homed = measured if self.zeros is None else self.zeros.taken_off(measured)
        warm_start.fill_recorded(model, homed, dynamics.effects())

    def begin(self, model: Looping) -> None:
        """Before the rounds of ``learn()``: what the last one left undone."""
        self.renew(model)
        if model._offline:
            self.rehearsals.take_up_learner(model)

    def finish(self, model: Looping) -> None:
        """After the rounds: learn what is still owed, judge the last policy, and let the best one act."""
        if self.may_judge(model):
            if model._owed or self.rehearsals.is_behind(model):
                self._learn_what_is_owed(model)
            self.rehearsals.leave_best(model)
            if model.verbose:
                print(f"the policy that acts, the best so far, earns {self.rehearsals.best:.5g} in the simulator")

    def renew(self, model: Looping) -> None:
        """Drop what is :attr:`stale`, if anything is, and learn anew; a budget of source steps learns by itself.

        Where that is interrupted it goes on with the run.
        """
        if not self.stale:
            return
        if self.rounds is None:
            model.snapshots.pop("learner", None)  # of the simulator that is dropped
            renew_source(model)
            self.rounds = Rounds()
        learns = model.updates_policy and not model._offline and model.updates_per_step
        if learns and self._traced_at is not None:  # else what was corrected for is a target that was left
            judges = self.may_judge(model)
            self.rehearsals.take_up_learner(model)
            try:
                self.rounds.learn(model, self)
                if judges:
                    self.rehearsals.go_back(model)
            except BaseException:
                if judges:
                    self.rehearsals.set_aside(model)  # nobody is left with a policy that was not judged
                raise
            finally:
                model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)
        self.stale, self.rounds = False, None

    def may_judge(self, model: Looping) -> bool:
        """Whether rehearsals say anything: the policy learns, and the simulator accounts for the target."""
        return model.updates_policy and self.accounts

    def rehearse(self, model: Looping) -> None:
        """Let the policy play in the simulator, where that may judge it."""
        if self.may_judge(model):
            assert isinstance(model.dynamics, PhysicalDynamics)  # what was traced
            self.rehearsals.rehearse(model, model.dynamics)

    def watch(self, model: Looping) -> None:
        """Where enough is owed or was learned since the last rehearsal, learn, rehearse, and let the best policy act.

        With a log for a target the policy acts in the simulator alone, and goes on unless it clearly got worse.
        """
        if not self.may_judge(model):
            if model._owed:  # the last trace has taken the simulator's word away
                self._learn_what_is_owed(model)
        elif self.rehearsals.due(model._n_updates + model._owed * model.updates_per_step):
            self._learn_what_is_owed(model)
            if not model._offline:
                self.rehearsals.leave_best(model)

    def _learn_what_is_owed(self, model: Looping) -> None:
        """Learn what target steps have paid for, and judge what comes of it; where interrupted, it goes on later."""
        judges = self.may_judge(model)
        if model._owed:
            self.rehearsals.take_up_learner(model)
        try:
            while model._owed:
                paid_by = max(model.num_timesteps - model._owed, 0)  # a schedule's learning rate is that of then
                model._update_current_progress_remaining(paid_by, model._total_timesteps)
                learn_for_a_step(model, int(model.source_steps))
                model._owed -= 1
                if judges and model._owed and self.rehearsals.due(model._n_updates):
                    self._judge(model)
            if judges:
                self._judge(model)
        except BaseException:
            if judges and not model._offline:
                self.rehearsals.set_aside(model)
            raise

    def _judge(self, model: Looping) -> None:
        self.rehearse(model)
        if self.rehearsals.clearly_worse():
            self.rehearsals.go_back(model)

    def _trace(
        self, model: Looping, dynamics: PhysicalDynamics, measured: Measurements, horizon: float | None
    ) -> Report:
        assert model.env is not None
        if model.verbose:
            print("tracing what the simulator lacks, which takes a minute or several")
        report = trace(
            single_env(model.env),
            measured,
            self.declared,
            known=[from_json(stored) for stored in model.dynamics_kwargs.get("effects", ())],
            seed=model.seed or 0,
            candidates=None if self.kinds is True else self.kinds or [],
            horizon=horizon,
            threads=dynamics.threads,
            progress=self.progress,
        )
        self.reports.append(report)
        self.found.append(report.to_json())
        self.accounts = report.verdict in SETTLED
        return report

    def _say(self, model: Looping, report: Report, added: list[str], data: str, before: float, after: float) -> None:
        """Tell and log what a trace found, and what it did to the one-step error."""
        if self.on_report is not None:
            self.on_report(report)
        logger = model.logger
        logger.record("gap/residual_before", before)
        logger.record("gap/residual_after", after)
        logger.record("gap/adequacy_before", report.adequacy_before.ratio)
        logger.record("gap/adequacy_after", report.adequacy_after.ratio)
        logger.record("gap/verdict", report.verdict)
        logger.record("gap/effects", ", ".join(added) or "none")
        assert isinstance(model.dynamics, PhysicalDynamics)  # what was traced
        for name, value in model.dynamics.describe().items():
            logger.record(f"dynamics/{name}", value)
        model.dump_logs()  # SB3 waits for the end of some episodes, before which a short run is over
        if model.verbose:
            print(f"traced on {data}: {report.verdict}; {', '.join(added) or 'nothing'} added")
        doubtful = {FindingKind.UNDETERMINED}
        if report.verdict != "unexplained":
            doubtful.add(FindingKind.AT_ITS_BOUND)
        doubts = [f"{f.where}: {f.message}" for f in report.findings if f.kind in doubtful]
        if doubts and model._traces_log:  # of transitions the fits say so
            warnings.warn(f"the trace on {data}: {'. '.join(doubts)}", stacklevel=3)
        if report.verdict == "unexplained":
            known = model.measured is not None or model.dynamics_kwargs.get("observation_noise") is not None
            others = "".join(f". {f.message}" for f in report.findings if f.kind in OTHERWISE)
            bounds = "".join(f". {f.where}: {f.message}" for f in report.findings if f.kind == FindingKind.AT_ITS_BOUND)
            noise = "" if known else "whether they are noisy (dynamics_kwargs={'observation_noise': ...}), "
            warnings.warn(
                f"the trace on {data} is 'unexplained': what it looked for does not account for the difference, and "
                "the policy learns in a simulator that still errs; see print(model.loop.reports[-1]) for which joints, "
                f"and whether the observations hold the model's joints in its order, {noise}what else could be "
                f"declared, and dynamics='residual'{others}{bounds}",
                stacklevel=3,
            )

    def _take(
        self,
        model: Looping,
        dynamics: PhysicalDynamics,
        report: Report,
        data: Transitions,
        before: float,
    ) -> list[str]:
        """Let phi have the effects that were found, if that pays; the labels of those that are new.

        A trace begins at the simulator with what its user knows: what it found is the whole explanation, so what an
        earlier one had found and this one has not leaves phi.

        :param before: error of ``data`` without them; infinite: the report judges
        """
        known = {effect.label for effect in dynamics.effects()}
        found = [traced.effect for traced in (*report.declared, *report.effects)]
        new = [effect.label for effect in found if effect.label not in known and not isinstance(effect, Declared)]
        late = any(effect.overrides("late") for effect in found)
        if late:  # what was seen before a step began tells nothing of one-step errors
            before = math.inf
        nearer = report.verdict != "unexplained" or report.adequacy_after.ratio < report.adequacy_before.ratio
        if before == math.inf and new and not nearer:
            return []
        kept = dynamics.effects(), dynamics.covariance.copy()
        dynamics.replace([effect for effect in dynamics.effects() if isinstance(effect, Declared)])
        dynamics.adopt(found, report.covariance)
        assert model.env is not None
        if not stays_finite(dynamics, data, model.env):
            dynamics.replace(*kept)
            warnings.warn(
                f"the simulator with {', '.join(new) or 'the traced values'} becomes unstable: refused, the last one "
                "is kept; give bounds to what you declare",
                stacklevel=4,
            )
            self.accounts = False
            return []
        after = dynamics.error(data) if before < math.inf else 0.0
        if not after < (WORTH if new else 1.0) * before:
            dynamics.replace(*kept)
            if new:  # what it lacks is known, and it goes on lacking it
                self.accounts = False
                warnings.warn(
                    f"the trace found {', '.join(new)}, with which the one-step error of {len(data)} target "
                    f"transitions is {after:.3g}, not clearly below {before:.3g} without: the last simulator is kept; "
                    "what is rare may hardly count in that error, see print(model.loop.reports[-1]), and "
                    "dynamics_kwargs={'effects': [...]} adds it all the same",
                    stacklevel=4,
                )
            return []
        self.keeps_phi = dynamics.observation_noise is not None or late
        assert model.dynamics_config is not None
        model.dynamics_config["effects"] = dynamics.added()  # what a checkpoint rebuilds the model from
        return new


def trace_log(model: Looping) -> None:
    """Once, before anything is learned: phi from a trace of the robot's log, where one was given.

    :raises ValueError: it is to be traced and is not there
    """
    loop, dynamics = model.loop, model.dynamics
    if not model._traces_log or loop is None:
        return
    if loop.found and (loop.log_is_empty or model.replay_buffer.target.size() > 0):
        return
    assert isinstance(dynamics, PhysicalDynamics)  # else there is nothing to trace for
    if model.measured is None:
        raise ValueError(
            "this model was saved before its recordings were traced, or is loaded without its buffers, and a "
            "checkpoint does not hold them: load_replay_buffer(), or set model.measured = "
            "Measurements.from_csv(...) again"
        )
    if loop.found:
        loop.fill_target(model, dynamics, model.measured)
    else:
        loop.close_on_log(model, dynamics, model.measured)


def horizon_of(measured: Measurements, env: gym.Env) -> float:
    """Length in s of the windows of a trace of transitions.

    :param measured: the transitions
    :param env: the source
    """
    base: Any = env.unwrapped
    changes = contact_changes(base.model, measured, noise_levels(measured))
    return (window(measured, changes) - 1) * float(base.dt)


def window(measured: Measurements, contacts: float) -> int:
    """Number of samples in the windows of a trace of transitions with so many ``contacts`` that change a second."""
    if measured.exact or contacts > DEFAULTS.problem.contact_changes:
        return WINDOW
    ends = [np.flatnonzero(~np.concatenate([[False], episode.placed, [False]])) for episode in measured.episodes]
    stretches = np.concatenate([np.diff(end) - 1 for end in ends])  # of samples whose positions are known
    usual = int(np.quantile(stretches[stretches > 0], SHORT_STRETCHES)) if stretches.any() else 0
    return min(max(usual, WINDOW), NOISY_WINDOW)


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
