"""How often the tracer is right: generated sets whose truth is known are traced and scored.

python -m benchmarks tracing --scale quick                  # 22 sets; --list prints them
python -m benchmarks tracing --scale full --only '^pair-' --out benchmarks/results/tracing
python -m benchmarks tracing report benchmarks/results/tracing.csv
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import Result as Kept
from benchmarks.runner import chosen, kept, parser_of, run_jobs, said
from benchmarks.tracing.design import SCALES, Case, design
from benchmarks.tracing.score import Result
from benchmarks.tracing.table import write
from benchmarks.tracing.truth import Set, make
from sb3_rpto.effects import Effect
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, horizon_errors
from sb3_rpto.sysid.shooting.windows import cut

HORIZON = 0.5
"""Predictions of this length in s are compared, on test runs."""
WINDOWS = 96
"""Most windows that the true structure is fitted to."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Trace what has no result yet, then write and print the table of all that has one, of earlier calls too.

    :param arguments: without the study's name; default: those of the process
    :return: exit code, 1 where traces raised an error
    """
    parser = parser_of("tracing", __doc__, "tracing")
    parser.add_argument("--scale", choices=SCALES, default="quick", help="22 or 215 sets (default: quick)")
    asked = parser.parse_args(arguments)
    listed = chosen(design(asked.scale), asked.only)
    if asked.list:
        print(*(case.id for case in listed), sep="\n")
        return 0
    results = run(asked.runs, listed, asked.workers, asked.backend, asked.fresh)
    of_now = {result["name"]: result for result in results}
    found = [of_now.get(case.id) or kept(case, asked.runs / "runs") for case in design(asked.scale)]
    cases = [case for case, one in zip(design(asked.scale), found) if one]
    command = f"python -m benchmarks tracing --scale {asked.scale}" + f" --only '{asked.only}'" * bool(asked.only)
    out = asked.out or asked.runs / "table"
    print(write(out, [flat(result) for result in found if result], cases, command))
    return said(results, out)


def run(
    folder: str | os.PathLike[str],
    cases: Sequence[Case],
    workers: int | None = None,
    backend: str = "joblib",
    fresh: bool = False,
) -> list[Kept]:
    """Trace the cases that have no result yet, and return the results of all in their order.

    :param folder: of the study; other parameters are as :func:`~benchmarks.runner.run_jobs` takes them
    :param cases: of a design
    """
    # In mixed order an unfinished run is a fair sample, and its time left an honest guess.
    mixed = random.Random(0).sample(cases, len(cases))
    results = run_jobs(examined, mixed, Path(folder) / "runs", workers, backend, fresh=fresh)
    of = {result["name"]: result for result in results}
    return [of[case.id] for case in cases]


def examined(case: Case) -> list[dict[str, Any]]:
    """The job of a case."""
    return [examine(case)]


def flat(result: Kept) -> Result:
    """What is scored of a kept result."""
    (row,) = result["rows"] or [{}]
    return {"case": result["job"], **{name: result[name] for name in ("commit", "error", "seconds")}, **row}


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
