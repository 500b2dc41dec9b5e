"""Close the loop with measured data: find the residual, trace it to an effect the model lacks, add it, report both."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np

from sb3_rpto.effects import Effect
from sb3_rpto.ranges import SEED, THREADS, check, whole
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.hypotheses.alternatives import try_alternatives
from sb3_rpto.sysid.problem.problem import Assumptions, Inputs, Progress, prepare
from sb3_rpto.sysid.report.build_report import build_report, predict
from sb3_rpto.sysid.report.report import Report
from sb3_rpto.sysid.selection.confidence_intervals import refit
from sb3_rpto.sysid.selection.search import search
from sb3_rpto.sysid.settings import DEFAULTS, Settings


def trace(
    model: Any,
    data: Measurements,
    declared: Sequence[str] = (),
    *,
    known: Sequence[Effect] = (),
    seed: int = 0,
    candidates: Sequence[str] | None = None,
    horizon: float | None = None,
    calibrate: int = 0,
    threads: int = 0,
    simulated: bool = False,
    progress: Progress | None = None,
    settings: Settings = DEFAULTS,
) -> Report:
    """Find out which effect a model lacks to explain measured data.

    The declared parameters are fitted first. Where the errors of the fitted model on unseen windows exceed those that
    the measurement noise alone would leave, all effects of the library are fitted together and eliminated backwards;
    what remains is tested for stability and for likeness with other effects, fitted again and judged on test runs that
    nothing else has seen. The result is the same for the same seed.

    :param model: MJCF path, MJCF text, ``MjSpec``, ``MjModel`` or gymnasium MuJoCo environment
    :param data: recordings
    :param declared: parameters of the model that may be fitted, as :func:`sb3_rpto.effects.declare` takes them
    :param known: effects that the machine is known to have and the model lacks, with their values so far, e.g. those
        that an earlier trace found (``load_corrected(folder).effects``): they are fitted with the declared numbers, and
        nothing asks whether they are needed
    :param seed: of the split, the starts and the resampling
    :param candidates: kinds of effects to look for; default: all that are registered and offered
    :param horizon: length of the windows in s; default: 0.5, or 0.8 where there are less than 15 s of data, shorter
        for short episodes, 0.1 where contacts come and go, and twice that to go on with where what was found leaves
        errors far above the noise
    :param calibrate: recalibrate the threshold of selection on so many sets simulated from the fitted declared model
    :param threads: that simulate; 0: one for each core
    :param simulated: whether the recordings are of the model's own simulator, in its own steps in time; False: that is
        found out where it matters, at the latest when something is left unexplained, which takes a second search
    :param progress: called with the share done and what is being done
    :param settings: every threshold of the method
    :return: the verdict, the effects, errors before and after, and the corrected model
    :raises ValueError: data and model do not fit together, the data are too few, or an argument is out of range
    :raises TypeError: ``declared`` or ``candidates`` is a string, not a list of them; data that were not read
    """
    _check_arguments(data, seed, candidates, horizon, calibrate, threads)
    say = _never_back(progress)
    inputs = Inputs(model, data, declared, known, seed, candidates, horizon, calibrate, threads, say, settings)
    problem = prepare(inputs, Assumptions(simulated=simulated))
    result = search(problem)
    problem, result = try_alternatives(problem, result)
    verdict, result = result.verdict, result.without_useless_effects()
    fit = refit(problem, result)
    predictions = predict(problem, fit)
    return build_report(problem, result, verdict, fit, predictions)


def _never_back(progress: Progress | None) -> Progress:
    """Progress that never goes back: steps that come again keep the share that was reached."""
    reached = 0.0

    def say(share: float, what: str) -> None:
        nonlocal reached
        reached = max(reached, share)
        if progress is not None:
            progress(reached, what)

    return say


def _check_arguments(
    data: Measurements, seed: int, candidates: Sequence[str] | None, horizon: Any, calibrate: int, threads: int
) -> None:
    """Refuse what would fail after minutes."""
    if not isinstance(data, Measurements):
        raise TypeError(
            f"data must be Measurements, not {type(data).__name__}; read files by Measurements.from_csv(...)"
        )
    if isinstance(candidates, str):
        raise TypeError(f"candidates must be a list of kinds, not the string {candidates!r}; write [{candidates!r}]")
    number = isinstance(horizon, Real) and not isinstance(horizon, bool)
    if horizon is not None and not (number and 0 < horizon < np.inf):
        raise ValueError(f"horizon is {horizon!r}; give a time in s above 0, or None")
    check({"seed": SEED, "calibrate": whole(0), "threads": THREADS}, locals())
