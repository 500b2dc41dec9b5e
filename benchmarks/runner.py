"""One runner for all studies: named jobs, each run once, side by side, with a small file for the result of each."""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib
import importlib.util
import io
import json
import os
import re
import shlex
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from tqdm import tqdm

from benchmarks.provenance import commit, machine, versions
from sb3_rpto.cores import cores
from sb3_rpto.files import plain, write_json, write_text

BACKENDS = ("joblib", "ray")
#: Address of a running Ray cluster; without it Ray starts on this machine alone.
RAY_ADDRESS = "RAY_ADDRESS"


#: A run: a dataclass that pickles and holds all that decides its result, its seed among it. It may have ``name``, see
#: :func:`name_of`, ``seconds``, its expected cost, for the time left, and ``to_json()``, what a kept result must agree
#: with; by default that is all its fields.
Job = Any
Item = TypeVar("Item")
Answer = TypeVar("Answer")
Row = dict[str, Any]
Result = dict[str, Any]


# --- jobs and their files -------------------------------------------------------------------------------------------


def run_jobs(
    function: Callable[[Any], Sequence[Row] | Result],
    jobs: Sequence[Job],
    folder: str | os.PathLike[str],
    workers: int | None = None,
    backend: str = "joblib",
    *,
    fresh: bool = False,
    current: Callable[[Any, Result], bool] = lambda job, result: True,
) -> list[Result]:
    """Run the jobs that have no result yet, in their order, and return the results of all.

    A result is kept while its job stays as it is. One that says that its run failed is made again, and so is a torn
    one. A failure is said and stops no other run. What is finished stays finished where the study is killed.

    :param function: of a module; returns the rows of a job, or a dictionary of what is kept, ``rows`` among it
    :param jobs: with names that differ
    :param folder: of the results, ``NAME.json`` each: job, rows, error, seconds, commit, versions, machine
    :param workers: runs side by side, of one thread each; None: one a core
    :param backend: ``"joblib"`` (this machine) or ``"ray"`` (the cluster that it joins, on which all machines see
        ``folder`` at the same path)
    :param fresh: run again what has a result
    :param current: whether a kept result of a job is still of it, beyond what the job says
    :raises ValueError: a setting out of range
    :raises ImportError: without joblib or Ray
    """
    workers, folder = check_workers(workers, backend), Path(folder).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    files = {name_of(job): _file(folder, job) for job in jobs}
    if len({*files.values()}) < len(jobs):
        raise ValueError("two jobs have the same name")
    pending = [job for job in jobs if fresh or (found := kept(job, folder)) is None or not current(job, found)]
    with started(backend, workers), _progress(pending) as done:
        work, lost = partial(_execute, function, folder), partial(_lost, folder)
        for result in spread(work, pending, workers, backend, lost):
            done(result)
    return [json.loads(file.read_text(encoding="utf-8")) for file in files.values()]


def kept(job: Job, folder: Path) -> Result | None:
    """The result of a job; None where there is none, or it is torn, failed or of another job of that name."""
    try:
        result = json.loads(_file(folder, job).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    fits = isinstance(result, dict) and result.get("error") is None and result.get("job") == described(job)
    return result if fits else None


def described(job: Job) -> Row:
    """What a kept result must agree with, in types of JSON."""
    to_json = getattr(job, "to_json", None)
    return dict(to_json() if to_json else plain(asdict(job)))


def name_of(job: Job) -> str:
    """Its ``name``, or its fields one after the other, of those that are true or false the name where it is true."""
    named: str | None = getattr(job, "name", None)
    words = {key: key if value is True else value for key, value in vars(job).items() if value is not False}
    return named or "_".join(f"{value:g}" if isinstance(value, float) else str(value) for value in words.values())


def chosen(jobs: Sequence[Item], only: str | None) -> list[Item]:
    """The jobs whose name a regular expression matches somewhere.

    :raises ValueError: no regular expression, or nothing matches
    """
    try:
        found = [job for job in jobs if re.search(only or "", name_of(job))]
    except re.error as error:
        raise ValueError(f"only is {only!r}, which is no regular expression: {error}") from error
    if not found:
        like = f"; names look like {name_of(jobs[0])!r}" if jobs else ""
        raise ValueError(f"no run matches {only!r}{like}")
    return found


def _file(folder: Path, job: Job) -> Path:
    return folder / f"{re.sub(r'[^A-Za-z0-9_.=^-]+', '-', name_of(job))}.json"


def _execute(function: Callable[[Job], Any], folder: Path, job: Job) -> Result:
    th.set_num_threads(1)
    began, made_by = time.perf_counter(), commit()  # now: a checkout may move on meanwhile
    answer, error = {}, None
    try:
        answer = function(job)
    except Exception:
        error = traceback.format_exc(limit=-3)
    found = answer if isinstance(answer, dict) else {"rows": answer}
    return _write(folder, job, found, error, round(time.perf_counter() - began, 2), made_by)


def _lost(folder: Path, job: Job) -> Result:
    return _write(folder, job, {}, "its process was ended by the system (for want of memory?)", 0.0, commit())


def _write(folder: Path, job: Job, found: Result, error: str | None, seconds: float, made_by: str | None) -> Result:
    result = {"name": name_of(job), "job": described(job), "rows": [], **found}
    result |= {"versions": versions(), "commit": made_by, **machine(), "seconds": seconds, "error": error}
    result = plain(result)
    write_json(_file(folder, job), result)
    return result


@contextlib.contextmanager
def _progress(pending: Sequence[Job]) -> Iterator[Callable[[Result], None]]:
    """A bar whose time left goes by what jobs were expected to cost, and a line for each that failed."""
    expected = {name_of(job): getattr(job, "seconds", 1.0) for job in pending}
    form = "{desc} {percentage:3.0f} %|{bar}| {elapsed}, {remaining} left{postfix}"
    with tqdm(total=sum(expected.values()), bar_format=form, disable=None if pending else True) as bar:
        bar.set_description_str(f"0/{len(pending)} runs")

        def done(result: Result) -> None:
            bar.update(expected.pop(result["name"]))
            bar.set_description_str(f"{len(pending) - len(expected)}/{len(pending)} runs")
            if result["error"]:
                bar.write(f"{result['name']} failed: {last_line(result['error'])}", file=sys.stderr)

        yield done


def last_line(error: str) -> str:
    """What went wrong, of a traceback."""
    return error.strip().splitlines()[-1]


# --- side by side ---------------------------------------------------------------------------------------------------


def check_workers(workers: int | None, backend: str) -> int:
    """How many runs go on side by side.

    :raises ValueError: less than one, or another backend
    :raises ImportError: without the backend's package
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers is {workers}; give 1 or more, or nothing for one a core")
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}; choose one of {BACKENDS}")
    if importlib.util.find_spec(backend) is None:
        extra = "ray" if backend == "ray" else "benchmarks"
        raise ImportError(f"backend {backend!r} needs the package: pip install -e '.[{extra}]' in the checkout")
    return workers or cores()


def spread(
    function: Callable[[Item], Answer],
    items: Iterable[Item],
    workers: int,
    backend: str = "joblib",
    lost: Callable[[Item], Answer] | None = None,
) -> Iterator[Answer]:
    """Answers of a function, in the order in which they come; items are begun in theirs.

    :param function: of a module, and items that pickle
    :param workers: side by side, 1: in this process; on a Ray cluster as many as it has CPUs
    :param backend: one of :data:`BACKENDS`
    :param lost: the answer for an item whose process the system ends, for want of memory, say; None: an error
    """
    left = dict(enumerate(items))
    if backend == "ray":
        yield from _on_ray(function, list(left.values()))
        return
    from joblib.externals.loky.process_executor import TerminatedWorkerError

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
    """The answers with their items' numbers, from other processes unless there is one worker."""
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=min(workers, max(len(items), 2)), inner_max_num_threads=1):
        yield from Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs")(
            delayed(_numbered)(function, i, item) for i, item in list(items.items())
        )


def _numbered(function: Callable[[Item], Answer], i: int, item: Item) -> tuple[int, Answer]:
    return i, function(item)


def _on_ray(function: Callable[[Item], Answer], items: Sequence[Item]) -> Iterator[Answer]:
    ray = importlib.import_module("ray")
    remote = ray.remote(num_cpus=1)(lambda item: function(item))
    waiting = [remote.remote(item) for item in items]
    while waiting:
        done, waiting = ray.wait(waiting)
        yield from ray.get(done)


@contextlib.contextmanager
def started(backend: str, workers: int) -> Iterator[None]:
    """Ray, where it is asked for and does not run yet: the cluster at :data:`RAY_ADDRESS`, else this machine alone."""
    ray = importlib.import_module("ray") if backend == "ray" else None
    if ray is None or ray.is_initialized():
        yield
        return
    here = {} if os.environ.get(RAY_ADDRESS) else {"num_cpus": workers, "include_dashboard": False}
    ray.init(log_to_driver=False, **here)
    try:
        yield
    finally:
        ray.shutdown()


# --- tables ---------------------------------------------------------------------------------------------------------


def rows_of(results: Iterable[Result]) -> list[Row]:
    """The rows of the runs that did not fail, each with its job and commit."""
    return [{**r["job"], **row, "commit": r["commit"]} for r in results if not r["error"] for row in r["rows"]]


def write_table(path: Path, rows: Sequence[Row], digits: int | None = 6) -> None:
    """Write rows as CSV, whole or not at all. What is no text is written as JSON, nothing as an empty cell.

    :param path: of the file
    :param rows: with any keys
    :param digits: of floating-point numbers; None: all
    """
    stream = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(row.get(name), digits) for name in columns] for row in rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, stream.getvalue())


def read_table(path: Path) -> list[Row]:
    """The rows that :func:`write_table` wrote, None where cells are empty."""
    csv.field_size_limit(sys.maxsize)
    with path.open(newline="", encoding="utf-8") as stream:
        return [{name: _value(cell) if cell else None for name, cell in row.items()} for row in csv.DictReader(stream)]


def _cell(value: Any, digits: int | None) -> str:
    value = plain(value)
    if value is None:
        return ""
    if isinstance(value, float) and digits is not None:
        return f"{value:.{digits}g}"
    if isinstance(value, str) and isinstance(_value(value), str) and value:
        return value
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))  # a text, too, that would be read otherwise


def _value(cell: str) -> Any:
    try:
        return json.loads(cell, parse_constant=str)
    except ValueError:
        return cell


def manifest(command: str, results: Iterable[Result] = (), **settings: Any) -> Row:
    """What made a table.

    :param command: that makes it anew
    :param results: of its runs
    :param settings: what else is to be told
    """
    commits = sorted({str(result["commit"]) for result in results}) or [str(commit())]
    return {"command": command, **settings, "commits": commits, "versions": versions(), **machine()}


# --- commands -------------------------------------------------------------------------------------------------------


def parser_of(name: str, about: str | None, runs: str) -> argparse.ArgumentParser:
    """A parser with the options that all studies have.

    :param name: of the study on the command line
    :param about: docstring of its module
    :param runs: name of its folder
    """
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks {name}", description=about, formatter_class=form)
    common = parser.add_argument_group("options of all studies")
    common.add_argument("--workers", metavar="N", type=int, help="runs side by side, one thread each (default: cores)")
    common.add_argument("--backend", choices=BACKENDS, default="joblib", help="ray: on the cluster at $RAY_ADDRESS")
    common.add_argument("--only", metavar="REGEX", help="only runs whose name matches somewhere")
    common.add_argument("--list", action="store_true", help="print the names of the runs and stop")
    common.add_argument("--fresh", action="store_true", help="run again what has a result")
    common.add_argument(
        "--runs",
        metavar="DIR",
        type=Path,
        default=Path("runs") / runs,
        help="where finished runs, agents and oracles are kept (default: %(default)s)",
    )
    common.add_argument(
        "--out", metavar="PATH", type=Path, help="of the table, without a suffix (default: table in the folder of runs)"
    )
    return parser


@dataclass(frozen=True)
class Study:
    """A study whose runs make the rows of one table.

    :param name: on the command line, after ``python -m benchmarks``
    :param folder: of its runs, and name of its committed table
    :param about: docstring of its module
    :param jobs: all runs that were asked for
    :param run: rows of a run, by its job and the folder of agents, or a dictionary with them; what is ``found`` there
        is told in the manifest; a function of a module
    :param summary: what is printed of the table
    :param options: adds the study's own
    :param prepare: makes what the runs share, by the options
    :param keeps: whether finished runs are kept; quick ones may be made anew by each call
    :param digits: of the table's numbers
    """

    name: str
    folder: str
    about: str | None
    jobs: Callable[[argparse.Namespace], Sequence[Any]]
    run: Callable[[Any, Path], Sequence[Row] | Result]
    summary: Callable[[Sequence[Row]], str]
    options: Callable[[argparse.ArgumentParser], object] = lambda parser: None
    prepare: Callable[[argparse.Namespace], object] = lambda asked: None
    keeps: bool = True
    digits: int | None = 6

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command: what has no result yet, then the table of what was asked for.

        :param arguments: without the names of study and part; default: those of the process
        :return: exit code, 1 where runs failed
        """
        parser = parser_of(self.name, self.about, self.folder)
        self.options(parser)
        asked = parser.parse_args(arguments)
        listed = chosen(self.jobs(asked), asked.only)
        if asked.list:
            print(*map(name_of, listed), sep="\n")
            return 0
        asked.runs.mkdir(parents=True, exist_ok=True)
        self.prepare(asked)
        function = partial(_run_in, self.run, asked.runs)
        how: dict[str, Any] = {"workers": asked.workers, "backend": asked.backend}
        how["fresh"] = asked.fresh or not self.keeps
        results = run_jobs(function, listed, asked.runs / "runs", **how)
        rows, out = rows_of(results), asked.out or asked.runs / "table"
        if rows:
            write_table(out.with_name(f"{out.name}.csv"), rows, self.digits)
            words = shlex.join(sys.argv[1:] if arguments is None else arguments)
            command = f"python -m benchmarks {self.name} {words}".strip()
            found = {result["name"]: result["found"] for result in results if "found" in result}
            made = manifest(command, results) | ({"found": found} if found else {})
            write_json(out.with_name(f"{out.name}.json"), made)
            print(self.summary(rows))
        return said(results, out)


def _run_in(run: Callable[[Any, Path], Any], folder: Path, job: Any) -> Any:
    return run(job, folder)


def said(results: Sequence[Result], out: Path) -> int:
    """Print how many runs are done and where the table is; exit code 1 where some failed."""
    failed = [result for result in results if result["error"]]
    print(f"{len(results) - len(failed)} of {len(results)} runs are done; table: {out}.csv")
    return 1 if failed else 0
