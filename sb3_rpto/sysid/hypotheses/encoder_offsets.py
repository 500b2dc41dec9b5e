"""Encoder offsets that differ from run to run, as of encoders homed anew where friction lets the machine rest."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from sb3_rpto.effects import Scales, Simulation
from sb3_rpto.effects.sensors import readers
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.adequacy import adequacy
from sb3_rpto.sysid.selection.model_comparison import Evidence, compare, folds, unseen_errors
from sb3_rpto.sysid.selection.search import SearchResult, SelectorPair, assess, search
from sb3_rpto.sysid.selection.stepwise_selection import Model
from sb3_rpto.sysid.settings import DEFAULTS, Settings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.windows import cut


class OffsetsOfRuns(Hypothesis):
    """The encoders' zeros clearly differ from run to run, beside what a search has found.

    Looked for where a bias of the sensor is, and in runs of a machine: a simulator has one zero. Not where a servo
    regulates what the encoder shows, and not in runs that are so many and short that few have two windows; nor where
    the model accounts for all runs.
    """

    def applies(self, problem: IdentificationProblem, result: SearchResult) -> bool:
        """Where there may be such offsets, and the model does not account for all runs."""
        data = problem.data
        if data.exact or data.simulated or len(problem.runs) < 2 or not _joints(result):
            return False
        # Few select runs may have zeros like each other's.
        return not (result.explains and _accounts_for_fitted(problem, result))

    def alternative(self, problem: IdentificationProblem, result: SearchResult) -> IdentificationProblem | None:
        """With the offsets taken off the fitted runs; None where none clearly differ."""
        offsets = find_offsets(problem, result)
        return None if offsets is None else problem.without_offsets(offsets)

    def search(
        self, alternative: IdentificationProblem, result: SearchResult
    ) -> tuple[IdentificationProblem, SearchResult]:
        """Search, and fit the offsets once more beside the effects that are found with them taken off.

        What was missing when the offsets were fitted first has led them astray a little.
        """
        problem, found = _refit_offsets(alternative, search(alternative))
        return problem, replace(found, as_recorded=result)

    def accepts(self, result: SearchResult, alternative: SearchResult) -> bool:
        """Where nothing is left, or less."""
        return alternative.after.adequate or alternative.after.ratio < result.after.ratio

    def finding(self, alternative: IdentificationProblem, result: SearchResult) -> Finding | None:
        """The offsets."""
        return None if alternative.offsets is None else alternative.offsets.finding()


class ProblemWithOffsets(Problem):
    """Windows of several runs, in each of which encoders may have a zero of their own.

    After the simulation's parameters come the offsets, run by run: what the sensor's bias is more in that run. They act
    on its own windows alone. So one derivative by each joint's bias tells those by the offsets of all runs.

    :param problem: windows, and a simulation with sensor biases among its effects
    :param run: number of each window's run, (W,)
    :param count: of the runs; those without windows have no offsets that differ
    :param joints: whose encoders they are, J of them
    """

    def __init__(self, problem: Problem, run: np.ndarray, count: int, joints: Sequence[str]) -> None:
        super().__init__(problem.simulation, problem.windows, problem.scales)
        places = zip(self.simulation.effects, self.simulation.slices)
        biases = {effect.on: s.start for effect, s in places if effect.kind == "sensor_bias"}
        #: (J,) indices of the parameters of the biases
        self.bias = np.array([biases[joint] for joint in joints])
        self.run, self.common = run, len(self.size)
        #: (R, J) indices of the offsets
        self.own = self.common + np.arange(count * len(joints)).reshape(count, len(joints))
        every = np.concatenate([np.arange(self.common), np.tile(self.bias, count)])
        self.size, self.lower, self.upper = self.size[every], self.lower[every], self.upper[every]
        self.null = np.concatenate([self.null, np.zeros(self.own.size)])
        self.known = np.concatenate([self.known, np.zeros(self.own.size, dtype=bool)])

    def begin(self, values: np.ndarray) -> np.ndarray:
        """The simulation's parameters, followed by offsets that do not differ."""
        return np.concatenate([values, np.zeros(self.own.size)])

    def predict(self, values: np.ndarray, starts: np.ndarray, index: np.ndarray) -> np.ndarray:
        """As of a problem with one zero, with each window's own."""
        inner = values[:, : self.common].copy()
        inner[:, self.bias] += np.take_along_axis(values, self.own[self.run[index]], axis=1)
        return super().predict(inner, starts, index)

    def linearise(
        self,
        values: np.ndarray,
        starts: np.ndarray,
        free: np.ndarray,
        base: np.ndarray | None = None,
        down: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As of a problem with one zero; the derivatives by those of other runs vanish."""
        joints = np.flatnonzero(np.isin(self.own, free).any(axis=0))
        moved = np.union1d(free[free < self.common], self.bias[joints])
        r, found, jx = super().linearise(values, starts, moved, base, down)
        jt = np.zeros((*r.shape, len(free)))
        for i, parameter in enumerate(free):
            if parameter < self.common:
                jt[:, :, i] = found[:, :, np.searchsorted(moved, parameter)]
            else:
                run, joint = divmod(parameter - self.common, len(self.bias))
                there = self.run == run
                jt[there, :, i] = found[there, :, np.searchsorted(moved, self.bias[joint])]
        return r, jt, jx


@dataclass(frozen=True)
class _OffsetFit:
    """What fits of offsets work on.

    :param problem: windows and offsets
    :param result: what was found beside them
    """

    problem: ProblemWithOffsets
    result: SearchResult

    @classmethod
    def of(cls, problem: IdentificationProblem, result: SearchResult, joints: Sequence[str]) -> _OffsetFit:
        """The windows and the model that a search ended with, in the usual steps in time."""
        selector, runs = result.on.fine, problem.runs
        if selector.simulation is not problem.fine:  # offsets show in kinks no more than elsewhere
            selector = SelectorPair.on(problem, selector.horizon, selector.settings).fine
        episodes = [problem.fitted.episodes[i] for i in selector.train.windows.episode]
        if selector.select is not None:
            episodes += [problem.split.select[i] for i in selector.select.windows.episode]
        run = np.array([runs.index(episode.run) for episode in episodes])
        return cls(ProblemWithOffsets(selector.all_windows(), run, len(runs), joints), result)

    @property
    def model_free(self) -> np.ndarray:
        """Indices of the parameters of the model."""
        return self.result.on.fine.free(self.result.selection.model.effects)

    @property
    def named(self) -> np.ndarray:
        """Which of the biases are in the model, (J,)."""
        return np.isin(self.problem.bias, self.model_free)

    def free(self, joints: Sequence[int]) -> np.ndarray:
        """Indices of what is fitted beside the offsets of some joints: the model, and the zero of all runs."""
        model = np.union1d(self.model_free, self.problem.bias)
        return np.union1d(model, self.problem.own[:, list(joints)])

    def fit(self, joints: Sequence[int], begin: Fit) -> Fit:
        """A fit with offsets of some joints alone."""
        free, values = self.free(joints), begin.values.copy()
        values[np.setdiff1d(self.problem.own, free)] = 0.0
        return self.problem.fit(values, free, begin.starts)

    def differing(self) -> tuple[list[int], Evidence, np.ndarray]:
        """The joints whose encoders clearly have another zero in each run, by elimination.

        :return: numbers of the joints; what their offsets gain together over none; the parameters with them
        """
        selector, windows = self.result.on.fine, self.problem.windows
        settings = selector.settings.comparison
        parts, blocks = folds(windows, selector.horizon, settings.folds), windows.block

        def fitted(kept: Sequence[int], begin: Fit) -> tuple[Fit, np.ndarray]:
            fit = self.fit(kept, begin)
            return fit, unseen_errors(self.problem, fit, self.free(kept), parts, settings.prior)

        first = self.problem.score(self.problem.begin(self.result.selection.model.fit.values))
        kept = list(range(len(self.problem.bias)))
        begin, without = fitted([], first)
        fit, errors = fitted(kept, begin)
        while kept:
            trials = {j: fitted([k for k in kept if k != j], fit) for j in kept}
            evidence = {j: compare(trial[1], errors, blocks, settings=settings) for j, trial in trials.items()}
            limit = selector.limit(Model((), fit, errors))
            weak = [j for j in kept if not evidence[j].clear(*limit)]
            if not weak:
                break
            worst = min(weak, key=lambda j: evidence[j].t)
            kept, (fit, errors) = [k for k in kept if k != worst], trials[worst]
        together = compare(without, errors, blocks, settings=settings)
        # So many numbers fit a little of whatever lacks: far from the noise, too, all of t* is asked of them together.
        return kept if together.t > selector.thresholds.threshold else [], together, fit.values

    def offsets(self, values: np.ndarray) -> np.ndarray:
        """What encoders show in each run beyond what the model says, rad or m, (R, J); 0 where no window is."""
        own, there = values[self.problem.own], np.isin(np.arange(len(self.problem.own)), self.problem.run)
        more = np.where(self.named, own - own[there].mean(axis=0), own + values[self.problem.bias])
        return np.where(there[:, None], more, 0.0)


def find_offsets(problem: IdentificationProblem, result: SearchResult) -> EncoderOffsets | None:
    """The encoder offsets of single runs that clearly differ, beside what a search has found; None where none do."""
    joints = _joints(result)
    problem.inputs.say(0.8, "looking for encoder zeros that differ by run")
    task = _OffsetFit.of(problem, result, joints)
    if np.median(np.bincount(task.problem.run)) < problem.settings.hypotheses.windows_of_a_run:
        return None
    kept, evidence, values = task.differing()
    if not kept:
        return None
    there = np.unique(task.problem.run)
    offsets = task.offsets(values)[there][:, kept]
    mean, spread = offsets.mean(axis=0), offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets))
    common = np.abs(mean) > student.ppf(0.975, len(offsets) - 1) * spread
    names, runs = tuple(joints[j] for j in kept), tuple(problem.runs[r] for r in there)
    return EncoderOffsets(names, runs, offsets - np.where(common, mean, 0.0), evidence.gain, float(evidence.t))


def offsets_of(
    simulation: Simulation,
    values: np.ndarray,
    data: Measurements,
    sigma: np.ndarray,
    horizon: float,
    joints: Sequence[str],
    settings: Settings = DEFAULTS,
) -> EncoderOffsets:
    """The encoder offsets of other runs, by a model that is known.

    :param simulation: with sensor biases of the joints among its effects
    :param values: its parameters, which stay, (p,)
    :param data: recordings
    :param sigma: noise of the position columns, (m,)
    :param horizon: length of the windows in s
    :param joints: whose encoders they are
    :param settings: thresholds
    :raises ValueError: a run has no episode that is as long as a window
    """
    windows = cut(simulation.model, data, sigma, horizon, sys.maxsize)
    names = tuple(dict.fromkeys(data.episodes[i].run for i in windows.episode))
    without = sorted({episode.run for episode in data.episodes} - set(names))
    if without:
        raise ValueError(
            f"runs {', '.join(without)} hold no window of {horizon:g} s: their zeros do not show; leave them out"
        )
    run = np.array([names.index(data.episodes[i].run) for i in windows.episode])
    every = settings.problem.train_windows + settings.problem.select_windows
    most = max(settings.hypotheses.windows_of_a_run, every // len(names))
    chosen = np.sort(np.concatenate([_spread(np.flatnonzero(run == r), most) for r in range(len(names))]))
    windows, run = windows.take(chosen), run[chosen]
    task = ProblemWithOffsets(
        Problem(simulation, windows, [Scales()] * len(simulation.effects)), run, len(names), joints
    )
    fit = task.fit(task.begin(values), task.own.ravel())
    saved = 1 - float(np.median(fit.errors) / np.median(task.score(task.begin(values)).errors))
    return EncoderOffsets(tuple(joints), names, fit.values[task.own], saved, np.nan)


def _spread(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the rows, evenly chosen."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]


def _joints(result: SearchResult) -> list[str]:
    """Joints whose encoders may have a bias that no servo regulates, and are seen."""
    simulation, seen = result.on.fine.simulation, set(result.on.fine.train.windows.columns.tolist())
    return [
        effect.on
        for effect in simulation.effects
        if effect.kind == "sensor_bias" and effect.adr in seen and not len(readers(effect, simulation.model))
    ]


def _accounts_for_fitted(problem: IdentificationProblem, result: SearchResult) -> bool:
    """Whether a model that accounts for the windows that it was judged on does so for those that it was fitted to."""
    if result.on.fine.select is None:
        return True  # they are the same
    train = result.on.fine.train
    fit = train.score(result.selection.model.fit.values)
    return adequacy(train, fit, problem.inputs.seed, problem.settings.adequacy).adequate


def _refit_offsets(problem: IdentificationProblem, result: SearchResult) -> tuple[IdentificationProblem, SearchResult]:
    """Fit the offsets once more beside the effects that were found, and those effects with them.

    :param problem: with offsets taken off
    :param result: of the search on it
    :return: the problem with the new offsets taken off, and what was found with its fit to it
    """
    before, model = problem.offsets, result.selection.model
    assert before is not None
    task = _OffsetFit.of(problem, result, before.joints)
    fit = task.problem.fit(task.problem.begin(model.fit.values), task.free(range(len(before.joints))))
    rows = [problem.runs.index(run) for run in before.runs]
    values = fit.values[: task.problem.common].copy()
    bias = task.problem.bias
    values[bias] = np.where(task.named, values[bias], model.fit.values[bias])
    finer = result.on.fine.simulation is not problem.fine
    problem = problem.without_offsets(replace(before, offsets=task.offsets(fit.values)[rows]))
    stepped = problem.in_finer_steps() if finer else problem
    assert stepped is not None  # it was there for the search
    on = SelectorPair.on(stepped, result.on.horizon, result.on.settings)
    model = on.fine.fit_model(model.effects, on.fine.train.score(values), iterations=10)
    after = assess(on.fine, model, problem.inputs.seed)
    return problem, replace(result, on=on, selection=replace(result.selection, model=model), after=after)
