"""How often the tracer is right, on generated sets whose truth is known: ``python -m benchmarks tracing``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.tracing.design import SCALES, Case, design
from benchmarks.tracing.run import run, selected, stored
from benchmarks.tracing.score import score
from benchmarks.tracing.table import table, write

__all__ = ["Case", "add_arguments", "design", "main", "run", "run_benchmark", "score", "table"]

NAME = "python -m benchmarks tracing"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of :func:`run_benchmark`."""
    parser.add_argument("--out", metavar="DIR", help="folder for the table; results go to DIR/cases")
    parser.add_argument("--scale", choices=SCALES, default="quick", help="22 or 215 sets (default: quick)")
    parser.add_argument("--workers", metavar="N", type=int, help="processes, of one thread each (default: one a core)")
    parser.add_argument("--only", metavar="REGEX", help="only sets whose id matches somewhere, e.g. '^single-.*1mrad'")
    parser.add_argument("--fresh", action="store_true", help="trace again what has a result already")
    parser.add_argument("--list", action="store_true", help="print the ids and stop")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: without the program's name; default: those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog=NAME, description=__doc__)
    add_arguments(parser)
    parsed = parser.parse_args(arguments)
    if parsed.list:
        print("\n".join(case.id for case in selected(parsed.scale, parsed.only)))
        return 0
    if parsed.out is None:
        parser.error("--out DIR says where the table goes")
    return run_benchmark(parsed.out, parsed.scale, parsed.workers, not parsed.fresh, parsed.only)


def run_benchmark(out: str, scale: str, workers: int | None, resume: bool, only: str | None = None) -> int:
    """Trace what has no result yet, then write and print the table of all that has one, of earlier calls too.

    :param out: folder for ``table.md``, ``summary.csv``, ``cases.csv``, ``manifest.json`` and ``cases/``
    :param scale: ``"quick"`` or ``"full"``
    :param workers: processes; None: one a core
    :param resume: False: trace again what has a result already
    :param only: regular expression that the id of a case to trace must match somewhere
    :return: exit code, 0: a table that shows failures is a result
    :raises ValueError: nothing matches, or a setting out of range
    """
    run(out, scale, workers, only, resume)
    asked, folder = {case.id for case in selected(scale, only)}, Path(out) / "cases"
    found = {case.id: result for case in design(scale) if (result := stored(folder, case)) is not None}
    cases = [case for case in design(scale) if case.id in asked or case.id in found]
    command = f"{NAME} --scale {scale}" + (f" --only '{only}'" if only else "")
    print(write(out, list(found.values()), cases, command))
    return 0
