"""The table of the benchmark, for readers and for programs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.runner import manifest, read_table, write_table
from benchmarks.tracing.design import GROUPS, HIGH, LOW, Case, fingerprint
from benchmarks.tracing.planting import SYSTEMS
from benchmarks.tracing.score import APPLY, MEASURES, Result, Row, score, share
from benchmarks.tracing.truth import TWINS
from sb3_rpto.files import write_json, write_text

MINUTES = 3.0
"""A set of a machine with one or two joints is to be traced within this time."""
REQUIRED: tuple[tuple[str, str, str, float | None, float], ...] = (
    ("complete models: nothing named", "complete", "nothing named", None, 0.95),
    ("single effects, 1 mrad: right class", "single", "right class", LOW, 0.90),
    ("single effects, 5 mrad: right class", "single", "right class", HIGH, 0.80),
    ("pairs: right class", "pair", "right class", None, 0.80),
    ("outside the library: never called explained", "outside", "not explained", None, 1.0),
)
"""What must hold: words, group, measure, noise (None: any), least share."""


def table(results: Sequence[Result], planned: int | None = None) -> str:
    """The benchmark's results in Markdown.

    :param results: as :func:`~benchmarks.tracing.run.flat` makes them
    :param planned: cases of the design; default: as many as there are results
    """
    rows = score(results)
    planned = len(rows) if planned is None else planned
    parts = ["# What the tracer finds", f"{len(rows)} of {planned} generated sets traced. Shares with 95 % intervals."]
    parts += ["## What must hold", _required(rows), "## All measures", *_groups(rows)]
    parts += ["## Single effects by kind", _kinds(rows), "## Time", _times(rows)]
    parts += ["## What fails", _failures(rows), "## How it is scored", _explained()]
    return "\n\n".join(parts) + "\n"


def _grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(header)
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (header, rule, *lines)
    )


def _required(rows: Sequence[Row]) -> str:
    lines = []
    for words, group, measure, noise, least in REQUIRED:
        part = [r for r in rows if r.case["group"] == group and noise in (None, r.case["noise"])]
        found = share(part, measure)
        met = "–" if not found.n else "yes" if found.value >= least else "no"
        lines.append([words, f"{least:.0%}", str(found), met])
    small = [r.seconds / 60 for r in rows if _joints(r) <= 2]
    if small:
        slowest, met = max(small), "yes" if max(small) < MINUTES else "no"
        lines.append(["1–2 joints: minutes, at most, in one thread", f"{MINUTES:g}", f"{slowest:.1f}", met])
    return _grid(["", "required", "measured", "met"], lines)


def _groups(rows: Sequence[Row]) -> list[str]:
    parts = []
    for group in GROUPS:
        part = [r for r in rows if r.case["group"] == group]
        if not part:
            continue
        noises = sorted({r.case["noise"] for r in part})
        header = [group, *(f"{1e3 * n:g} mrad" for n in noises)]
        lines = [[m, *(str(share([r for r in part if r.case["noise"] == n], m)) for n in noises)] for m in APPLY[group]]
        parts.append(_grid(header, lines))
    named = [n for r in rows for n in r.classes]
    if named:
        parts.append(f"A named effect stands for a class of {np.mean(named):.1f} effects on average (itself included).")
    return parts


def _kind(row: Row) -> str:
    return "+".join(kind for kind, _ in row.case["effects"])


def _kinds(rows: Sequence[Row]) -> str:
    single = [r for r in rows if r.case["group"] == "single"]
    lines = []
    for kind in dict.fromkeys(map(_kind, single)):
        part = [r for r in single if _kind(r) == kind]
        cells = [share([r for r in part if r.case["noise"] == n], "right class") for n in (LOW, HIGH)]
        others = [share(part, m) for m in ("itself", "values", "error reduction", "says explained")]
        lines.append([kind, *(f"{s.hits}/{s.n}" for s in (*cells, *others))])
    header = ["effect", "right, 1 mrad", "right, 5 mrad", "itself", "values", "error reduction", "says explained"]
    return _grid(header, lines) if lines else "None traced."


def _times(rows: Sequence[Row]) -> str:
    lines = []
    for joints in sorted({_joints(r) for r in rows}):
        seconds = [r.seconds for r in rows if _joints(r) == joints]
        cells = [np.median(seconds), np.quantile(seconds, 0.9), max(seconds)]
        lines.append([str(joints), str(len(seconds)), *(f"{s:.0f}" for s in cells)])
    return _grid(["joints", "sets", "median s", "90 % s", "longest s"], lines) + "\n\nEach in one thread."


def _joints(row: Row) -> int:
    system = SYSTEMS.get(row.case["system"])
    return len(system.links) if system else 4 if row.case["system"].startswith("Reacher") else 3


def _failures(rows: Sequence[Row]) -> str:
    lines = [[r.case["id"], r.why, _number(r.ratio_before), _number(r.ratio_after)] for r in rows if not r.passed]
    return _grid(["set", "why", "R before", "R after"], lines) if lines else "Nothing."


def _explained() -> str:
    measures = [f"- **{name}**: {words}" for name, words in MEASURES.items()]
    same = [f"- {system}: {', '.join(sorted(labels))}: {why}" for system, labels, why in TWINS]
    heading = (
        "Effects that no recording could tell apart count as one, beside those that the report itself calls alike:"
    )
    return "\n".join([*measures, "", heading, "", *same])


def write(
    out: str | os.PathLike[str], results: Sequence[Result], cases: Sequence[Case] = (), command: str | None = None
) -> str:
    """Write the table ``OUT.csv``, its manifest ``OUT.json`` and the report ``OUT.md``; return the report.

    :param out: without a suffix
    :param results: to score
    :param cases: of the design
    :param command: that made them; None: table and manifest are there
    """
    path, text = Path(out), table(results, len(cases) or None)
    if command is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        errors = sum(result["error"] is not None for result in results)
        seconds = round(sum(result["seconds"] for result in results), 1)
        counts = {"cases": len(cases), "done": len(results), "errors": errors, "seconds": seconds}
        made = manifest(command, results, design=fingerprint(cases), **counts)
        write_json(path.with_name(f"{path.name}.json"), made)
        rows = [{"id": result["case"]["id"], **result} for result in results]
        write_table(path.with_name(f"{path.name}.csv"), rows, digits=None)
    write_text(path.with_name(f"{path.name}.md"), text)
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Score a table of results anew, as ``python -m benchmarks tracing`` writes it.

    :param arguments: default: those of the process
    :return: exit code
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks tracing report", description=main.__doc__)
    parser.add_argument("table", metavar="TABLE", type=Path, help="CSV file; the report goes beside it")
    path = parser.parse_args(arguments).table
    print(write(path.with_suffix(""), read_table(path)))
    return 0


def _number(value: float | None, digits: int = 3) -> str:
    return "" if value is None else f"{value:.{digits}g}"
