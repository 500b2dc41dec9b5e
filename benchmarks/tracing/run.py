"""Generate and trace sets on several cores, one result file each; what is done stays done."""

from __future__ import annotations

import json
import os
import random
import re
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracing.design import Case, design
from benchmarks.tracing.truth import Set, make
from sb3_rpto.cores import cores
from sb3_rpto.effects import Effect
from sb3_rpto.evaluation import provenance
from sb3_rpto.files import write_json
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors
from sb3_rpto.sysid.shooting.windows import cut
from sb3_rpto.version import __version__

HORIZON = 0.5
"""Predictions of this length in s are compared, on test runs."""
WINDOWS = 96
"""Most windows that the true structure is fitted to."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Result = dict[str, Any]


def selected(scale: str, only: str | None = None) -> list[Case]:
    """The cases of a scale whose id matches a regular expression anywhere.

    :raises ValueError: another scale, no regular expression, or nothing matches
    """
    try:
        cases = [case for case in design(scale) if re.search(only or "", case.id)]
    except re.error as error:
        raise ValueError(f"only is {only!r}, which is no regular expression: {error}") from error
    if not cases:
        raise ValueError(f"no case of the {scale} design matches {only!r}; ids look like {design(scale)[0].id!r}")
    return cases


def run(
    out: str | os.PathLike[str],
    scale: str = "quick",
    workers: int | None = None,
    only: str | None = None,
    resume: bool = True,
) -> list[Result]:
    """Trace the cases that have no result yet, each in one thread, and return all results.

    A result is kept while its case stays as it is, also where the tracer raised an error; a torn file, or one of
    another case, is made again.

    :param out: folder; results are written to ``cases/ID.json`` in it
    :param scale: as :func:`~benchmarks.tracing.design.design` takes it
    :param workers: processes; default: one a core
    :param only: regular expression that a case's id must match somewhere
    :param resume: False: trace all again
    :return: the results of the cases, in their order
    :raises ValueError: nothing matches, or a setting out of range
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers is {workers}; give 1 or more, or nothing for one a core")
    cases = selected(scale, only)
    folder = Path(out) / "cases"
    folder.mkdir(parents=True, exist_ok=True)
    pending = [case for case in cases if not resume or stored(folder, case) is None]
    # In mixed order an unfinished run is a fair sample, and its time left an honest guess.
    random.Random(0).shuffle(pending)
    made_by, count = provenance.commit(), min(workers or cores(), max(1, len(pending)))
    say = _Progress(len(pending))
    if count == 1:
        for case in pending:
            say(work(case, folder, made_by))
    else:
        with _environment(dict.fromkeys(_ONE_THREAD, "1")):
            pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"))
            try:
                for done in as_completed([pool.submit(work, case, folder, made_by) for case in pending]):
                    say(done.result())
            finally:
                pool.shutdown(cancel_futures=True)
    return [result for case in cases if (result := stored(folder, case)) is not None]


def stored(folder: Path, case: Case) -> Result | None:
    """The result of a case; None where there is none, it is torn, or it belongs to another case of the same id."""
    try:
        result = json.loads((folder / f"{case.id}.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return result if isinstance(result, dict) and result.get("case") == case.to_json() else None


def work(case: Case, folder: Path, commit: str | None) -> Result:
    """Trace a case and write its result, whatever comes of it."""
    result: Result = {"case": case.to_json(), "version": __version__, "commit": commit, "error": None}
    start = time.process_time()
    try:
        result |= examine(case)
    except Exception:
        result["error"] = traceback.format_exc(limit=-3)
        result["seconds"] = time.process_time() - start
    write_json(folder / f"{case.id}.json", result)
    return result


def examine(case: Case, episodes: int | None = None, duration: float | None = None) -> Result:
    """Generate a set, trace it, and fit the true structure beside it.

    :param case: which
    :param episodes: how many, if not as many as the design has
    :param duration: of an episode in s, likewise
    :return: verdict, effects, candidates' fates, adequacy, errors by joint, the trace's seconds of processor time
    """
    sizes = {name: value for name, value in (("episodes", episodes), ("duration", duration)) if value is not None}
    made: Set = make(case, **sizes)  # type: ignore[arg-type]
    start = time.process_time()
    report = trace(made.model, made.measurements, made.declared, seed=case.seed, threads=1)
    seconds = time.process_time() - start
    found = report.to_json()
    errors = {name: _at_horizon(getattr(report, name)) for name in ("before", "after", "floor")}
    true = true_structure(report, made.measurements, made.effects)
    values = {e.label: {p.name: float(v) for p, v in zip(e.parameters, e.values)} for e in made.effects}
    return {
        "planted": {label: values.get(label) for label in made.planted},
        "verdict": report.verdict,
        "effects": found["effects"],
        "declared": found["declared"],
        "candidates": {c.label: c.status for c in report.candidates},
        "ratio_before": report.adequacy_before.ratio,
        "ratio_after": report.adequacy_after.ratio,
        "zeros": found["zeros"],
        "true_zeros": made.zeros,
        "noise": found["noise"],
        "threshold": report.threshold,
        "errors": errors | {"true": _at_horizon(true)},
        "seconds": seconds,
    }


def true_structure(report: Report, data: Measurements, effects: Sequence[Effect]) -> list[HorizonError]:
    """Errors on test runs of the model with exactly the effects that are in the machine, fitted by the tracer.

    The fit begins at their true values and is made on the runs that the tracer fitted its own result to.

    :return: as :func:`~sb3_rpto.sysid.shooting.prediction_errors.horizon_errors`; empty where there is no such model
    """
    simulation = report.simulation
    labels = [e.label for e in simulation.effects]
    if not effects or not all(e.label in labels for e in effects):
        return []
    train, select, _ = data.split(report.seed)
    fitted = replace(data, episodes=train.episodes + select.episodes)
    windows = cut(simulation.model, fitted, report.sigma, report.horizon, WINDOWS)
    scales = typical(simulation, force_residuals(simulation, simulation.null, fitted)).scales(simulation.effects)
    problem = Problem(simulation, windows, scales)
    values, free = report.values_before.copy(), problem.known.copy()
    for effect in effects:
        place = simulation.slices[labels.index(effect.label)]
        values[place], free[place] = effect.values, True
    values = np.clip(values, problem.lower, problem.upper)
    fit = problem.fit(values, np.flatnonzero(free), iterations=20)
    return horizon_errors(simulation, fit.values, report.data, report.sigma, report.seed)


def _at_horizon(errors: Sequence[HorizonError]) -> dict[str, float] | None:
    """RMSE of each joint at :data:`HORIZON`."""
    for e in errors:
        if e.horizon == HORIZON:
            return dict(zip(e.joints, map(float, e.rmse)))
    return None


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Environment variables for the processes that start meanwhile."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class _Progress:
    """A line for each case that is done, with the time left."""

    def __init__(self, count: int) -> None:
        self.count, self.done, self.start = count, 0, time.perf_counter()

    def __call__(self, result: Result) -> None:
        self.done += 1
        left = (time.perf_counter() - self.start) / self.done * (self.count - self.done)
        outcome = "error" if result["error"] else result["verdict"]
        print(
            f"[{self.done}/{self.count}, {left / 60:.0f} min left] {result['case']['id']}: {outcome}, "
            f"{result['seconds']:.0f} s",
            file=sys.stderr,
            flush=True,
        )
