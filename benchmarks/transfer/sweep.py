"""Move policies to targets by every method: the runs of a suite, then its tables.

    python -m benchmarks transfer --suite quick          # 125 runs; --list prints them with what they will cost
    python -m benchmarks transfer report runs/transfer_quick

DIR of --runs holds manifest.json, runs/NAME.json, and sources/ with agents and oracles.
"""

from __future__ import annotations

import copy
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym

from benchmarks.provenance import constructor_arguments
from benchmarks.runner import Result, check_workers, chosen, parser_of, run_jobs, said, spread, started
from benchmarks.transfer import tables
from benchmarks.transfer.ablation import ABLATED
from benchmarks.transfer.plan import Job, Place, Suite, jobs, listing, variant_of
from benchmarks.transfer.shared_dynamics import fit_once
from benchmarks.transfer.sources import Reference, digest, reference, source_agent
from benchmarks.transfer.suites import SUITES
from sb3_rpto.baselines.registry import REGISTRY, Run
from sb3_rpto.envs.tasks import env_id, make_shift
from sb3_rpto.evaluation.learning_curve import LearningCurve, MakeEnv
from sb3_rpto.files import write_json

Answer = TypeVar("Answer")
#: By task, its source agent and transitions.
Agents = Mapping[str, tuple[str, str | None]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: its options; default: those of the process
    :return: exit code: 1 where runs failed
    """
    parser = parser_of("transfer", __doc__, "transfer_SUITE")
    about = "; ".join(f"{suite.name}: {suite.about}" for suite in SUITES.values())
    parser.add_argument("--suite", choices=tuple(SUITES), default="quick", help=f"{about} (default: quick)")
    parser.add_argument("--seeds", metavar="N", type=int, help="of each method (default: the suite's)")
    asked = parser.parse_args(arguments)
    suite = SUITES[asked.suite]
    if asked.list:
        listed = chosen(jobs(suite, asked.seeds), asked.only)
        print(listing(listed, check_workers(asked.workers, asked.backend)))
        return 0
    folder = Path(str(asked.runs).replace("SUITE", suite.name))
    out = asked.out or folder / "table"
    results = run(suite, folder, asked.workers, asked.backend, asked.seeds, asked.only, asked.fresh)
    if not all(result["error"] for result in results):
        tables.write(folder, out)
    return said(results, out)


def run(
    suite: Suite,
    folder: str | os.PathLike[str],
    workers: int | None = None,
    backend: str = "joblib",
    seeds: int | None = None,
    only: str | None = None,
    fresh: bool = False,
) -> list[Result]:
    """Make the runs of a suite that have no result yet, and return the results of all.

    A result is kept while its run and its source agent stay as they are. Source agents and oracles are made first.

    :param suite: which
    :param folder: its own; other parameters are as :func:`~benchmarks.runner.run_jobs` takes them
    :param seeds: of each variant; None: the suite's
    :param only: regular expression that a run's name must match somewhere
    :raises ValueError: nothing matches, a setting out of range, or a folder of another suite
    :raises ImportError: without joblib or Ray
    """
    workers, folder = check_workers(workers, backend), Path(folder).resolve()
    listed, known, sources = chosen(jobs(suite, seeds), only), _manifest(folder, suite), folder / "sources"
    wanted = {(job.task, job.target) for job in listed}
    targets = [(place, target) for place in suite.places for target in place.targets if (place.task, target) in wanted]
    places = [place for place in suite.places if place.task in dict(wanted)]
    with started(backend, workers):
        trained = spread(partial(_agent, folder=sources), places, workers, backend)
        agents = _prepared("source agent", trained, len(places))
        measured = spread(partial(_reference, agents=agents, folder=sources), targets, workers, backend)
        references = known.get("references", {}) | _prepared("oracle", measured, len(targets))
        planned = max(len(jobs(suite, seeds)), known.get("planned", 0))
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "manifest.json", {**_about(suite), "planned": planned, "references": references})

        def current(job: Job, result: Result) -> bool:
            return bool(result["source"]["sha256"] == digest(agents[job.task][0]))

        work = partial(transfer_once, agents=agents, folder=sources)
        return run_jobs(work, listed, folder / "runs", workers, backend, fresh=fresh, current=current)


def _prepared(what: str, answers: Iterator[tuple[str, Answer]], count: int) -> dict[str, Answer]:
    """What is found at once or trained for minutes before the first run, with a line for each that is there."""
    print(f"[0/{count}] {what}s: found, or trained now and kept", file=sys.stderr, flush=True)
    ready = {}
    for name, answer in answers:
        ready[name] = answer
        print(f"[{len(ready)}/{count}] {what} of {name} is there", file=sys.stderr, flush=True)
    return ready


def _about(suite: Suite) -> dict[str, Any]:
    """What the report has to know of a suite."""
    variants = [variant_of(job.to_json()) for job in jobs(suite, 1)]
    return {
        "suite": suite.name,
        "about": suite.about,
        "labels": list(dict.fromkeys(variant.label for place in suite.places for variant in place.variants)),
        "variants": [variant for i, variant in enumerate(variants) if variant not in variants[:i]],
        "interactions": [list(pair) for pair in suite.interactions],
    }


def _manifest(folder: Path, suite: Suite) -> dict[str, Any]:
    """What an earlier call wrote.

    :raises ValueError: when that was another suite
    """
    try:
        known: dict[str, Any] = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
    if known.get("suite") != suite.name:
        raise ValueError(f"{folder} holds the suite {known.get('suite')!r}; choose another folder for {suite.name!r}")
    return known


def worlds(task: str, target: str) -> tuple[MakeEnv, MakeEnv]:
    """What makes a source, and one of its targets."""
    return partial(gym.make, env_id(task)), partial(gym.make, env_id(task), shift=target)


def _agent(place: Place, folder: Path) -> tuple[str, tuple[str, str | None]]:
    make_source = partial(gym.make, env_id(place.task))
    return place.task, source_agent(place.agent, make_source, place.source_steps, folder, **place.source_settings)


def _reference(item: tuple[Place, str], agents: Agents, folder: Path) -> tuple[str, Reference]:
    place, target = item
    name, (agent, _) = f"{place.task}_{target}", agents[place.task]
    return name, reference(name, agent, *worlds(place.task, target), place.oracle_steps, folder)


def transfer_once(job: Job, agents: Agents, folder: Path) -> Result:
    """One run.

    :param job: which
    :param agents: of all tasks
    :param folder: where fits of networks to a source are kept
    :return: rows, algorithm and all its arguments, source agent, target's factors
    """
    known: dict[str, Any] = {}
    agent, data = agents[job.task]

    def read(model: Any) -> dict[str, float]:
        # A SAC that was loaded keeps the seed of its training; it was seeded anew.
        known.update(algorithm=type(model).__name__, arguments={**constructor_arguments(model), "seed": job.seed})
        dynamics = getattr(model, "dynamics", None)
        if dynamics is None or model.replay_buffer.target.size() < 2:
            return {}
        return {"model_error": float(dynamics.error(model.transitions("target")))}

    method = {**REGISTRY, **ABLATED}[job.method]
    make_source, make_target = worlds(job.task, job.target)
    curve = LearningCurve(make_target, job.points, job.episodes, job.seed, read, after_update=method.in_batches)
    settings = copy.deepcopy(dict(job.settings))  # SAC writes into its policy_kwargs
    given: dict[str, Any] = {"budget": job.points[-1], "seed": job.seed, "source_data": data, "kwargs": settings}
    before = partial(fit_once, folder=folder)
    method.run(Run(agent, make_source, make_target, **given, before_learning=before), curve)
    curve.env.close()
    return {
        **known,
        "source": {"agent": Path(agent).name, "sha256": digest(agent), "data": data is not None},
        "target": {"id": env_id(job.task), "shift": job.target, "factors": make_shift(job.task, job.target).factors},
        "rows": curve.rows,
    }
