"""Encoder zeros that differ from run to run, as of encoders homed anew where friction lets the machine rest."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from sb3_rpto.effects import Scales, Simulation
from sb3_rpto.effects.sensors import readers
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.problem.prepare import SELECT, TRAIN, Progress, SetUp
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.selection.adequacy import adequacy
from sb3_rpto.sysid.selection.cross_validation import unseen_errors
from sb3_rpto.sysid.selection.model_comparison import Evidence, compare, folds
from sb3_rpto.sysid.selection.pipeline import Found, judged
from sb3_rpto.sysid.selection.stepwise_selection import Model
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.windows import cut

#: Windows that the typical run must have: one tells its zero, and another is to confirm it.
LEAST = 2


@dataclass(frozen=True)
class Zeros:
    """Zeros of encoders in single runs.

    :param joints: whose encoders they are, J of them
    :param runs: names, R of them
    :param offsets: what the encoder shows in a run beyond the true position, rad or m, (R, J); where the mean of all
        runs is beyond chance, beyond that: it is a bias of the sensor, as any other that all runs have
    :param gain: share of the typical window error that they save, where they were found by a trace on windows that they
        were not fitted to
    :param t: of that gain; NaN where a known model found them
    """

    joints: tuple[str, ...]
    runs: tuple[str, ...]
    offsets: np.ndarray
    gain: float
    t: float

    def rows(self) -> list[list[str]]:
        """A row for each joint: its name, how far its zeros scatter, and those of single runs."""
        spread = self.offsets.std(axis=0, ddof=min(1, len(self.runs) - 1))
        each = (", ".join(f"{run} {x:+.3g}" for run, x in zip(self.runs, column)) for column in self.offsets.T)
        return [[joint, descriptions.number(s, 3), runs] for joint, s, runs in zip(self.joints, spread, each)]

    def finding(self) -> Finding:
        """For the report."""
        each = "; ".join(f"{joint} by {spread} ({runs})" for joint, spread, runs in self.rows())
        message = (
            f"differ: {each}, in rad or m. That saves {self.gain:.0%} of the window error (t = {self.t:.1f}). Such are "
            "encoders that are zeroed anew where friction holds the machine, or that slip. They are taken off the "
            "fitted runs; those of other runs are not known, and predictions err by that much more there. Home the "
            "machine at a stop or a mark"
        )
        return Finding(FindingKind.RUN_ZEROS, "fitted runs, encoders", message)

    def to_json(self) -> dict[str, Any]:
        """Offsets by joint and run, and the evidence for them."""
        each = {joint: dict(zip(self.runs, column)) for joint, column in zip(self.joints, self.offsets.T.tolist())}
        return {"offsets": each, "gain": self.gain, "t": self.t}

    def taken_off(self, data: Measurements) -> Measurements:
        """The recordings as encoders with one zero would have shown them; runs of other names as they are."""
        columns = [data.columns.qpos.index(name) for name in self.joints]
        episodes = []
        for episode in data.episodes:
            if episode.run in self.runs:
                qpos = episode.qpos.copy()
                qpos[:, columns] -= self.offsets[self.runs.index(episode.run)]
                episode = replace(episode, qpos=qpos)
            episodes.append(episode)
        return replace(data, episodes=episodes)


class Homing(Problem):
    """Windows of several runs, in each of which encoders may have a zero of their own.

    After the simulation's parameters come the zeros, run by run: what the sensor's bias is more in that run. They act
    on its own windows alone. So one derivative by each joint's bias tells those by the zeros of all runs.

    :param problem: windows, and a simulation with sensor biases among its effects
    :param run: number of each window's run, (W,)
    :param count: of the runs; those without windows have no zeros that differ
    :param bias: indices of the parameters of the biases, (J,)
    """

    def __init__(self, problem: Problem, run: np.ndarray, count: int, bias: np.ndarray) -> None:
        super().__init__(problem.simulation, problem.windows, problem.scales)
        self.run, self.bias, self.common = run, bias, len(self.size)
        #: (R, J) indices of the zeros
        self.own = self.common + np.arange(count * len(bias)).reshape(count, len(bias))
        every = np.concatenate([np.arange(self.common), np.tile(bias, count)])
        self.size, self.lower, self.upper = self.size[every], self.lower[every], self.upper[every]
        self.null = np.concatenate([self.null, np.zeros(self.own.size)])
        self.known = np.concatenate([self.known, np.zeros(self.own.size, dtype=bool)])

    def begin(self, values: np.ndarray) -> np.ndarray:
        """The simulation's parameters, followed by zeros that do not differ."""
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


def zeros_by_run(set_up: SetUp, found: Found, explained: bool, say: Progress, seed: int) -> Zeros | None:
    """The encoders whose zeros clearly differ from run to run, beside what a search has found; None where none do.

    Looked for where a bias of the sensor is, and in runs of a machine: a simulator has one zero. Not where a servo
    regulates what the encoder shows, and not in runs that are so many and short that few have two windows; nor where
    the model accounts for all runs.

    :param set_up: recordings
    :param found: by the search on them
    :param explained: whether that accounts for the runs that it was judged on
    :param say: progress
    :param seed: of the resampling
    """
    data, simulation = set_up.fitted, found.on.fine.simulation
    seen = set(found.on.fine.train.windows.columns.tolist())
    joints = [
        effect.on
        for effect in simulation.effects
        if effect.kind == "sensor_bias" and effect.adr in seen and not len(readers(effect, simulation.model))
    ]
    if data.exact or data.simulated or len(_runs(set_up)) < 2 or not joints:
        return None
    if explained and _accounts_for_fitted(found, seed):  # few select runs may have zeros like each other's
        return None
    say(0.8, "looking for encoder zeros that differ by run")
    homing = _homing(set_up, found, joints, say)
    if np.median(np.bincount(homing.run)) < LEAST:
        return None
    kept, evidence, values = _differing(homing, found)
    if not kept:
        return None
    there = np.unique(homing.run)
    offsets = _offsets(homing, values, found)[there][:, kept]
    mean, spread = offsets.mean(axis=0), offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets))
    common = np.abs(mean) > student.ppf(0.975, len(offsets) - 1) * spread
    names, runs = tuple(joints[j] for j in kept), tuple(_runs(set_up)[r] for r in there)
    return Zeros(names, runs, offsets - np.where(common, mean, 0.0), evidence.gain, float(evidence.t))


def zeros_of(
    simulation: Simulation,
    values: np.ndarray,
    data: Measurements,
    sigma: np.ndarray,
    horizon: float,
    joints: Sequence[str],
) -> Zeros:
    """The zeros of encoders in other runs, by a model that is known.

    :param simulation: with sensor biases of the joints among its effects
    :param values: its parameters, which stay, (p,)
    :param data: recordings
    :param sigma: noise of the position columns, (m,)
    :param horizon: length of the windows in s
    :param joints: whose encoders they are
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
    most = max(LEAST, (TRAIN + SELECT) // len(names))
    chosen = np.sort(np.concatenate([_spread(np.flatnonzero(run == r), most) for r in range(len(names))]))
    windows, run = windows.take(chosen), run[chosen]
    problem = Problem(simulation, windows, [Scales()] * len(simulation.effects))
    homing = Homing(problem, run, len(names), _biases(simulation, joints))
    fit = homing.fit(homing.begin(values), homing.own.ravel())
    saved = 1 - float(np.median(fit.errors) / np.median(homing.score(homing.begin(values)).errors))
    return Zeros(tuple(joints), names, fit.values[homing.own], saved, np.nan)


def _spread(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the rows, evenly chosen."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]


def homed(set_up: SetUp, zeros: Zeros) -> SetUp:
    """The same with the zeros of single runs taken off the recordings to fit to and to select on."""
    train, select, fitted = (zeros.taken_off(d) for d in (set_up.train, set_up.select, set_up.fitted))
    return replace(set_up, train=train, select=select, fitted=fitted)


def settled(set_up: SetUp, zeros: Zeros, found: Found, say: Progress, seed: int) -> tuple[SetUp, Zeros, Found]:
    """Fit the zeros once more, beside the effects that were found with them taken off, and those effects with them.

    What was missing when the zeros were fitted first has led them astray a little.

    :param set_up: recordings with the zeros taken off
    :param zeros: that were
    :param found: by the search on them
    :param say: progress
    :param seed: of the resampling
    :return: recordings with the new zeros taken off, these, and what was found with its fit to them
    """
    homing, selector, model = _homing(set_up, found, zeros.joints, say), found.on.fine, found.selection.model
    fit = homing.fit(homing.begin(model.fit.values), _free(homing, found, range(len(zeros.joints))))
    further = replace(zeros, offsets=_offsets(homing, fit.values, found)[[_runs(set_up).index(r) for r in zeros.runs]])
    values = fit.values[: homing.common].copy()
    values[homing.bias] = np.where(_named(homing, found), values[homing.bias], model.fit.values[homing.bias])
    set_up = homed(set_up, further)
    on = (set_up.selectors if selector.simulation is set_up.fine else set_up.finer)(selector.horizon, say)
    assert on is not None  # it was there for the search
    on.fine.threshold = on.rough.threshold = selector.threshold
    model = on.fine.model(model.effects, on.fine.train.score(values), iterations=10)
    found = replace(found, on=on, selection=replace(found.selection, model=model), after=judged(on.fine, model, seed))
    return set_up, replace(zeros, offsets=zeros.offsets + further.offsets), found


def _accounts_for_fitted(found: Found, seed: int) -> bool:
    """Whether a model that accounts for the windows that it was judged on does so for those that it was fitted to."""
    if found.on.fine.select is None:
        return True  # they are the same
    train = found.on.fine.train
    return adequacy(train, train.score(found.selection.model.fit.values), seed).adequate


def _differing(homing: Homing, found: Found) -> tuple[list[int], Evidence, np.ndarray]:
    """The joints whose encoders clearly have another zero in each run, by elimination.

    :return: numbers of the joints; what their zeros gain together over none; the parameters with them
    """
    parts, blocks = folds(homing.windows, found.on.fine.horizon), homing.windows.block

    def fitted(kept: Sequence[int], begin: Fit) -> tuple[Fit, np.ndarray]:
        free = _free(homing, found, kept)
        values = begin.values.copy()
        values[np.setdiff1d(homing.own, free)] = 0.0
        fit = homing.fit(values, free, begin.starts)
        return fit, unseen_errors(homing, fit, free, parts)

    first = homing.score(homing.begin(found.selection.model.fit.values))
    kept = list(range(len(homing.bias)))
    begin, without = fitted([], first)
    fit, errors = fitted(kept, begin)
    while kept:
        trials = {j: fitted([k for k in kept if k != j], fit) for j in kept}
        evidence = {j: compare(trial[1], errors, blocks) for j, trial in trials.items()}
        limit = found.on.fine.limit(Model((), fit, errors))
        weak = [j for j in kept if not evidence[j].clear(*limit)]
        if not weak:
            break
        worst = min(weak, key=lambda j: evidence[j].t)
        kept, (fit, errors) = [k for k in kept if k != worst], trials[worst]
    together = compare(without, errors, blocks)
    # So many numbers fit a little of whatever lacks: far from the noise, too, all of t* is asked of them together.
    return kept if together.t > found.on.fine.threshold else [], together, fit.values


def _free(homing: Homing, found: Found, kept: Sequence[int]) -> np.ndarray:
    """Indices of what is fitted beside the zeros of some joints' encoders: the model, and the zero of all runs."""
    model = found.on.fine.free(found.selection.model.effects)
    return np.union1d(np.union1d(model, homing.bias), homing.own[:, list(kept)])


def _offsets(homing: Homing, values: np.ndarray, found: Found) -> np.ndarray:
    """What encoders show in each run beyond what the model says in any case, rad or m, (R, J); 0 where no window is."""
    own, there = values[homing.own], np.isin(np.arange(len(homing.own)), homing.run)
    more = np.where(_named(homing, found), own - own[there].mean(axis=0), own + values[homing.bias])
    return np.where(there[:, None], more, 0.0)


def _named(homing: Homing, found: Found) -> np.ndarray:
    """Which of the biases are in the model, (J,)."""
    there = found.on.fine.free(found.selection.model.effects)
    return np.isin(homing.bias, there)


def _runs(set_up: SetUp) -> tuple[str, ...]:
    return tuple(dict.fromkeys(e.run for e in set_up.fitted.episodes))


def _homing(set_up: SetUp, found: Found, joints: Sequence[str], say: Progress) -> Homing:
    """Windows and model that a search ended with, and the encoders of some joints; in the usual steps in time."""
    selector, runs = found.on.fine, _runs(set_up)
    if selector.simulation is not set_up.fine:  # zeros show in kinks no more than elsewhere
        selector = set_up.selectors(selector.horizon, say).fine
    episodes = [set_up.fitted.episodes[i] for i in selector.train.windows.episode]
    if selector.select is not None:
        episodes += [set_up.select.episodes[i] for i in selector.select.windows.episode]
    run = np.array([runs.index(episode.run) for episode in episodes])
    return Homing(selector.every_window(), run, len(runs), _biases(selector.simulation, joints))


def _biases(simulation: Simulation, joints: Sequence[str]) -> np.ndarray:
    """Indices of the parameters that are the encoders' zeros, (J,)."""
    places = {e.on: s.start for e, s in zip(simulation.effects, simulation.slices) if e.kind == "sensor_bias"}
    return np.array([places[joint] for joint in joints])
