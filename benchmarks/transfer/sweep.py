"""Move policies to targets by every method, many runs side by side: ``python -m benchmarks transfer``."""

from __future__ import annotations

import argparse
import copy
import importlib
import importlib.util
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import torch as th

from benchmarks.transfer.ablation import ABLATED
from benchmarks.transfer.plan import Job, Place, Suite, jobs, listing, variant_of
from benchmarks.transfer.sources import Reference, digest, reference, source_agent
from benchmarks.transfer.suites import SUITES
from sb3_rpto.baselines.registry import REGISTRY, Run
from sb3_rpto.cores import cores
from sb3_rpto.envs.tasks import env_id, make_shift
from sb3_rpto.evaluation.learning_curve import LearningCurve, MakeEnv
from sb3_rpto.evaluation.provenance import commit, constructor_arguments, machine, plain, versions
from sb3_rpto.files import write_json

NAME = "python -m benchmarks transfer"
BACKENDS = ("joblib", "ray")
#: Address of a running Ray cluster; without it Ray starts on this machine alone.
RAY_ADDRESS = "RAY_ADDRESS"

Result = dict[str, Any]
Item = TypeVar("Item")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Task:
    """A run and the files that it reads and writes."""

    job: Job
    agent: str
    data: str | None
    folder: str


# --- the command ----------------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: without the program's name; default: those of the process
    :return: exit code: 1 where runs failed
    """
    parser = argparse.ArgumentParser(prog=NAME, description=__doc__)
    about = "; ".join(f"{suite.name}: {suite.about}" for suite in SUITES.values())
    parser.add_argument("--suite", choices=tuple(SUITES), default="quick", help=f"{about} (default: quick)")
    parser.add_argument("--out", metavar="DIR", help="folder of the suite's results (default: runs/transfer-SUITE)")
    parser.add_argument("--workers", metavar="N", type=int, help="runs side by side, one thread each (default: cores)")
    parser.add_argument("--backend", choices=BACKENDS, default="joblib", help="ray: on the cluster at $RAY_ADDRESS")
    parser.add_argument("--seeds", metavar="N", type=int, help="of each method (default: the suite's)")
    parser.add_argument("--only", metavar="REGEX", help="only runs whose name matches somewhere, e.g. 'CartPole.*rpto'")
    parser.add_argument("--list", action="store_true", help="print the runs and what they will cost, and stop")
    parsed = parser.parse_args(arguments)
    suite, workers = SUITES[parsed.suite], _workers(parsed.workers)
    if parsed.list:
        print(listing(jobs(suite, parsed.seeds, parsed.only), workers))
        return 0
    out = parsed.out or f"runs/transfer-{suite.name}"
    results = run(suite, out, workers, parsed.backend, parsed.seeds, parsed.only)
    failed = [result for result in results if result["error"]]
    for result in failed:
        print(f"{NAME}: {result['name']} failed: {result['error'].splitlines()[-1]}", file=sys.stderr)
    done = f"{len(results) - len(failed)} of {len(results)} runs are done"
    print(f"{done}; tables: python -m benchmarks transfer report {out}")
    return 1 if failed else 0


def _workers(given: int | None) -> int:
    if given is not None and given < 1:
        raise ValueError(f"workers is {given}; give 1 or more, or nothing for one a core")
    return given or cores()


# --- many runs ------------------------------------------------------------------------------------------------------


def run(
    suite: Suite,
    out: str | os.PathLike[str],
    workers: int | None = None,
    backend: str = "joblib",
    seeds: int | None = None,
    only: str | None = None,
) -> list[Result]:
    """Make the runs of a suite that have no result yet, and return the results of all.

    A result is kept while its run and its source agent stay as they are; a torn file, one of another run of that name
    and one that says that the run failed are made again. Source agents and oracles are made first.

    :param suite: which
    :param out: folder: ``manifest.json``, ``runs/NAME.json``, and ``sources/`` with agents and oracles
    :param workers: runs side by side; None: one a core
    :param backend: ``"joblib"`` (this machine) or ``"ray"`` (the cluster that it joins, on which all machines see
        ``out`` at the same path)
    :param seeds: of each variant; None: the suite's
    :param only: regular expression that a run's name must match somewhere
    :raises ValueError: nothing matches, a setting out of range, or a folder of another suite
    :raises ImportError: without joblib or Ray
    """
    listed, workers, folder = jobs(suite, seeds, only), _workers(workers), Path(out).resolve()
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}; choose one of {BACKENDS}")
    if importlib.util.find_spec(backend) is None:
        extra = "ray" if backend == "ray" else "experiments"
        raise ImportError(f"backend {backend!r} needs the package: pip install -e '.[{extra}]' in the checkout")
    known = _manifest(folder, suite)
    (folder / "runs").mkdir(parents=True, exist_ok=True)

    wanted = {(job.task, job.target) for job in listed}
    targets = [(place, target) for place in suite.places for target in place.targets if (place.task, target) in wanted]
    places = [place for place in suite.places if place.task in dict(wanted)]
    with _started(backend, workers):
        side_by_side = partial(spread, workers=workers, backend=backend)
        train = partial(_agent, folder=folder / "sources")
        agents = _prepared("source agent", side_by_side(train, places), len(places))
        measure = partial(_reference, agents=agents, folder=folder / "sources")
        measured = _prepared("oracle", side_by_side(measure, targets), len(targets))
        references = known.get("references", {}) | measured
        tasks = [Task(job, *agents[job.task], str(folder / "runs")) for job in listed]
        pending = [task for task in tasks if stored(task) is None]
        about = {**_about(suite, seeds), "references": references}
        about["planned"] = max(about["planned"], known.get("planned", 0))
        ran = {"versions": versions(), "commit": commit(), **machine()} if pending or not known else {}
        write_json(folder / "manifest.json", {**known, **about, **ran})
        say = _Progress([task.job for task in pending], workers)
        for result in side_by_side(work, pending, lost=killed):
            say(result)
    return [json.loads((folder / "runs" / f"{job.name}.json").read_text(encoding="utf-8")) for job in listed]


def _prepared(what: str, answers: Iterator[tuple[str, Answer]], count: int) -> dict[str, Answer]:
    """What is found at once or trained for minutes before the first run, with a line for each that is there."""
    print(f"[0/{count}] {what}s: found, or trained now and kept", file=sys.stderr, flush=True)
    ready = {}
    for name, answer in answers:
        ready[name] = answer
        print(f"[{len(ready)}/{count}] {what} of {name} is there", file=sys.stderr, flush=True)
    return ready


def _about(suite: Suite, seeds: int | None) -> dict[str, Any]:
    """What the report has to know of a suite."""
    variants = [variant_of(job.to_json()) for job in jobs(suite, 1)]
    return {
        "suite": suite.name,
        "about": suite.about,
        "labels": list(dict.fromkeys(variant.label for place in suite.places for variant in place.variants)),
        "variants": [variant for i, variant in enumerate(variants) if variant not in variants[:i]],
        "interactions": [list(pair) for pair in suite.interactions],
        "planned": len(jobs(suite, seeds)),
    }


def _manifest(folder: Path, suite: Suite) -> dict[str, Any]:
    """What an earlier call wrote.

    :raises ValueError: when that was another suite
    """
    try:
        known = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
    if known.get("suite") != suite.name:
        raise ValueError(f"{folder} holds the suite {known.get('suite')!r}; choose another folder for {suite.name!r}")
    return known


def spread(
    function: Callable[[Item], Answer],
    items: Iterable[Item],
    workers: int,
    backend: str,
    lost: Callable[[Item], Answer] | None = None,
) -> Iterator[Answer]:
    """Answers of a function, in the order in which they come; items are begun in theirs.

    :param function: of a module, and items that pickle
    :param workers: side by side; on a Ray cluster as many as it has CPUs
    :param backend: one of :data:`BACKENDS`
    :param lost: the answer for an item whose process the system ends, for want of memory, say; None: an error
    """
    items = list(items)
    if not items:
        return
    if backend == "ray":
        ray = _ray()
        remote = ray.remote(num_cpus=1)(lambda item: function(item))
        waiting = [remote.remote(item) for item in items]
        while waiting:
            done, waiting = ray.wait(waiting)
            yield from ray.get(done)
        return
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left = dict(enumerate(items))
    while left:
        try:
            for i, answer in _side_by_side(function, left, workers):
                del left[i]
                yield answer
        except TerminatedWorkerError:
            # It takes the others down with it. Items are begun in order: one of the first is to blame, and each is
            # tried again by itself.
            for i in list(left)[:workers]:
                try:
                    ((_, answer),) = _side_by_side(function, {i: left[i]}, 2)
                except TerminatedWorkerError:
                    if lost is None:
                        raise
                    answer = lost(left[i])
                del left[i]
                yield answer


def _side_by_side(
    function: Callable[[Item], Answer], items: dict[int, Item], workers: int
) -> Iterator[tuple[int, Answer]]:
    """The answers with their items' numbers, from other processes."""
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=min(workers, max(len(items), 2)), inner_max_num_threads=1):
        yield from Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs")(
            delayed(_numbered)(function, i, item) for i, item in list(items.items())
        )


def _numbered(function: Callable[[Item], Answer], i: int, item: Item) -> tuple[int, Answer]:
    return i, function(item)


@contextmanager
def _started(backend: str, workers: int) -> Iterator[None]:
    """Ray, where it is asked for and does not run yet: the cluster at :data:`RAY_ADDRESS`, else this machine alone."""
    if backend == "ray":
        ray = _ray()
        if not ray.is_initialized():
            here = {} if os.environ.get(RAY_ADDRESS) else {"num_cpus": workers, "include_dashboard": False}
            ray.init(log_to_driver=False, **here)
            try:
                yield
            finally:
                ray.shutdown()
            return
    yield


def _ray() -> Any:
    """The package, an extra."""
    return importlib.import_module("ray")


class _Progress:
    """A line for each run that is done, with the time left by what runs were expected to cost and do."""

    def __init__(self, pending: Sequence[Job], workers: int) -> None:
        self.expected = {job.name: job.seconds for job in pending}
        self.count, self.workers = len(pending), workers
        self.spent = self.foreseen = 0.0

    def __call__(self, result: Result) -> None:
        self.foreseen += self.expected.pop(result["name"])
        self.spent += result["seconds"]
        left = sum(self.expected.values()) * self.spent / max(self.foreseen, 1e-9) / self.workers
        outcome = result["error"].splitlines()[-1] if result["error"] else f"{result['rows'][-1]['return']:.0f}"
        print(
            f"[{self.count - len(self.expected)}/{self.count}, {left / 60:.0f} min left] {result['name']}: {outcome}, "
            f"{result['seconds']:.0f} s",
            file=sys.stderr,
            flush=True,
        )


# --- one run --------------------------------------------------------------------------------------------------------


def worlds(task: str, target: str) -> tuple[MakeEnv, MakeEnv]:
    """What makes a source, and one of its targets."""
    return partial(gym.make, env_id(task)), partial(gym.make, env_id(task), shift=target)


def _agent(place: Place, folder: Path) -> tuple[str, tuple[str, str | None]]:
    make_source = partial(gym.make, env_id(place.task))
    return place.task, source_agent(place.agent, make_source, place.source_steps, folder, **place.source_settings)


def _reference(
    item: tuple[Place, str], agents: dict[str, tuple[str, str | None]], folder: Path
) -> tuple[str, Reference]:
    place, target = item
    name = f"{place.task}_{target}"
    agent, _ = agents[place.task]
    return name, reference(name, agent, *worlds(place.task, target), place.oracle_steps, folder)


def stored(task: Task) -> Result | None:
    """The result of a run; None where there is none, it is torn, failed, or of other settings or another agent."""
    try:
        result = json.loads((Path(task.folder) / f"{task.job.name}.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    if not isinstance(result, dict) or result.get("error") is not None or result.get("job") != task.job.to_json():
        return None
    return result if result.get("source", {}).get("sha256") == digest(task.agent) else None


def work(task: Task) -> Result:
    """Make a run and write its result, whatever comes of it.

    :return: name, job, algorithm and all its arguments, source agent, target's factors, versions, commit, machine,
        seconds of the whole run (phi_0 and evaluations included), error, and the rows of
        :func:`~sb3_rpto.baselines.transfer.transfer`
    """
    th.set_num_threads(1)
    began, made_by = time.perf_counter(), commit()
    arguments: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    error = None
    try:
        rows = learning_curve(task, arguments)
    except Exception:
        error = traceback.format_exc(limit=-3)
    return _write(task, arguments, rows, error, round(time.perf_counter() - began, 2), made_by)


def killed(task: Task) -> Result:
    """The result of a run whose process the system ended."""
    error = "its process was ended by the system (for want of memory?)"
    return _write(task, {}, [], error, 0.0, commit())


def _write(
    task: Task, arguments: dict[str, Any], rows: list[dict[str, Any]], error: str | None, seconds: float, made_by: Any
) -> Result:
    job = task.job
    result = {
        "name": job.name,
        "job": job.to_json(),
        **arguments,
        "source": {"agent": Path(task.agent).name, "sha256": digest(task.agent), "data": task.data is not None},
        "target": {"id": env_id(job.task), "shift": job.target, "factors": make_shift(job.task, job.target).factors},
        "versions": versions(),
        "commit": made_by,
        **machine(),
        "seconds": seconds,
        "error": error,
        "rows": rows,
    }
    result = plain(result)
    write_json(Path(task.folder) / f"{job.name}.json", result)
    return result


def learning_curve(task: Task, arguments: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The rows of a run.

    :param task: the run
    :param arguments: is filled with ``algorithm`` and ``arguments`` of the last model that was evaluated
    """
    job, known = task.job, {} if arguments is None else arguments

    def read(model: Any) -> dict[str, float]:
        # A SAC that was loaded keeps the seed of its training; it was seeded anew.
        known.update(algorithm=type(model).__name__, arguments={**constructor_arguments(model), "seed": job.seed})
        dynamics = getattr(model, "dynamics", None)
        if dynamics is None or model.replay_buffer.target.size() < 2:
            return {}
        return {"model_error": float(dynamics.error(model.transitions("target")))}

    make_source, make_target = worlds(job.task, job.target)
    method = {**REGISTRY, **ABLATED}[job.method]
    curve = LearningCurve(make_target, job.points, job.episodes, job.seed, read, after_update=method.in_batches)
    settings = copy.deepcopy(dict(job.settings))  # SAC writes into its policy_kwargs
    models = Path(task.folder).with_name("sources")
    given = Run(task.agent, make_source, make_target, job.points[-1], job.seed, 1, task.data, settings, models=models)
    method.run(given, curve)
    curve.env.close()
    return curve.rows
