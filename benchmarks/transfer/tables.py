"""The report and the figure of a suite, of a folder of runs or of a committed table.

python -m benchmarks transfer report runs/transfer_quick
python -m benchmarks transfer report benchmarks/results/transfer_quick.csv
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.runner import Result, last_line, read_table, write_table
from benchmarks.transfer import plots
from benchmarks.transfer.plan import variant_of
from benchmarks.transfer.statistics import (
    PLACE,
    SHARE,
    costs,
    curves,
    effects,
    firsts,
    improvements,
    overall,
    scored,
)
from sb3_rpto.files import write_json, write_text

SHARE_WORDS = f"{100 * SHARE:.0f} %"
NAME = "python -m benchmarks transfer report"
#: Where the oracle gains less than this share of its return over the source policy, scores are mostly noise.
SMALL_GAP = 0.05


@dataclass(frozen=True)
class Study:
    """What is known of a suite.

    :param manifest: of the suite
    :param results: of all runs
    :param rows: one line a run and evaluation: task, target, label, method, seed, steps, return, score, updates,
        source_steps, seconds, factors; model_error where a model was learned
    :param failed: name and last line of the error of each run that failed
    :param left_out: name of each run that is not of the suite as it is now, and why
    """

    manifest: dict[str, Any]
    results: list[Result]
    rows: pd.DataFrame
    failed: dict[str, str]
    left_out: dict[str, str]

    @property
    def labels(self) -> list[str]:
        """Methods that have results, in the suite's order."""
        return [label for label in self.manifest["labels"] if label in set(self.rows["label"])]

    @property
    def ours(self) -> list[str]:
        """Those that are RPTO; none in a factorial design, whose cells all are."""
        mine = set(self.rows.loc[(self.rows["method"] == "rpto") & (self.rows["factors"].map(len) == 0), "label"])
        return [label for label in self.labels if label in mine]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: without the program's name; default: those of the process
    :return: exit code
    """
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog=NAME, description=__doc__, formatter_class=form)
    parser.add_argument("where", metavar="DIR", help="of --runs of a suite, finished or not, or its table (.csv)")
    parser.add_argument("--out", metavar="PATH", help="without a suffix (default: table in DIR, or beside the table)")
    asked = parser.parse_args(arguments)
    print(write(asked.where, asked.out))
    return 0


def load(where: str | os.PathLike[str]) -> Study:
    """Read a suite's results; unfinished ones will do.

    :param where: folder of runs, or table of results with its manifest beside it
    :raises FileNotFoundError: no manifest
    :raises ValueError: no run is done, or a torn manifest
    """
    table = Path(where) if Path(where).suffix == ".csv" else None
    path = table.with_suffix(".json") if table else Path(where) / "manifest.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there; run 'python -m benchmarks transfer --runs {where}' first")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path} is torn ({error}); run 'python -m benchmarks transfer' again with that --runs"
        ) from error
    rows: list[dict[str, Any]] = []
    failed, left_out = dict[str, str](), dict[str, str]()
    results = read_table(table) if table else _results(Path(where) / "runs", failed)
    for result in results:
        job = result["job"]
        reference = manifest["references"].get(f"{job['task']}_{job['target']}", {})
        if result.get("error"):
            failed[result["name"]] = last_line(result["error"])
        elif result["source"]["sha256"] != reference.get("agent"):
            left_out[result["name"]] = "of another source agent"
        elif "variants" in manifest and variant_of(job) not in manifest["variants"]:  # earlier ones do not tell
            left_out[result["name"]] = "of other settings than the suite's"
        else:
            known = {name: job[name] for name in ("task", "target", "label", "method", "seed", "factors")}
            rows += [{**known, **row} for row in _whole(job, result["rows"])]
    if not rows:
        raise ValueError(f"{where}: no run is done; go on with 'python -m benchmarks transfer --runs {where}'")
    scores = scored(pd.DataFrame(rows), manifest["references"])
    return Study(manifest, results, scores, dict(sorted(failed.items())), left_out)


def _results(folder: Path, failed: dict[str, str]) -> list[Result]:
    """Those of a folder; torn files, which the next sweep makes again, are noted."""
    results = []
    for file in sorted(folder.glob("*.json")):
        try:
            result = json.loads(file.read_text(encoding="utf-8"))
            results.append({**result, "job": result["job"]})
        except (ValueError, TypeError, KeyError):
            failed[file.stem] = "torn file"
    return results


def _whole(job: Mapping[str, Any], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Zero-shot has one evaluation, which holds at all steps."""
    if job["method"] == "zero-shot":
        return [{**rows[0], "steps": steps} for steps in (0, *job["points"])]
    return list(rows)


def write(where: str | os.PathLike[str], out: str | os.PathLike[str] | None = None) -> str:
    """Write the report ``OUT.md`` and the figure ``OUT.png``; of a folder, ``OUT.csv`` and ``OUT.json``, too.

    :param where: as :func:`load` takes it
    :param out: without a suffix; None: ``table`` in the folder, or beside the table under its name
    :return: the report in Markdown
    """
    study, path = load(where), Path(where)
    stem = Path(out) if out else path.with_suffix("") if path.suffix == ".csv" else path / "table"
    references = study.manifest["references"]
    lines = curves(study.rows)
    tables = {
        "curves": lines,
        "overall": overall(study.rows),
        "costs": costs(study.rows, references),
        "improvement": improvements(study.rows, study.ours),
        "first": firsts(lines),
    }
    if study.rows["factors"].map(len).any():
        tables["effects"] = effects(study.rows, study.manifest["interactions"])
    if path.suffix != ".csv":
        write_table(stem.with_name(f"{stem.name}.csv"), study.results, digits=None)
        commits = sorted({str(result["commit"]) for result in study.results})
        made = {name: study.results[0][name] for name in ("versions", "python", "machine")}
        write_json(stem.with_name(f"{stem.name}.json"), {**study.manifest, "commits": commits, **made})
    plots.learning_curves(lines, references, study.labels, study.ours, stem.with_name(f"{stem.name}.png"))
    text = markdown(study, tables, f"{stem.name}.png")
    write_text(stem.with_name(f"{stem.name}.md"), text)
    return text


def _runs(rows: pd.DataFrame) -> int:
    return len(rows[[*PLACE, "label", "seed"]].drop_duplicates())


# --- Markdown -------------------------------------------------------------------------------------------------------


def markdown(study: Study, tables: Mapping[str, pd.DataFrame], figure: str) -> str:
    """The report, for readers.

    :param study: of :func:`load`
    :param tables: those that :func:`write` makes
    :param figure: file of the learning curves
    """
    manifest, references = study.manifest, study.manifest["references"]
    done = _runs(study.rows)
    parts = [f"# Suite {manifest['suite']}: {manifest['about']}"]
    parts.append(
        f"{done} of {manifest['planned']} runs are done. Scores: 0 is the source policy as it is, 1 the oracle. "
        "IQM over seeds with 95 % bootstrap intervals, over several targets stratified by these."
    )
    if study.failed:
        parts.append("Failed: " + "; ".join(f"{name} ({why})" for name, why in study.failed.items()) + ".")
    if study.left_out:
        parts.append("Left out: " + "; ".join(f"{name} ({why})" for name, why in study.left_out.items()) + ".")
    parts += ["## References", _references(references)]
    if "effects" in tables:
        parts += ["## Factors", _effects(tables["effects"])]
    else:
        parts += ["## All targets together", _overall(study, tables)]
        for (task, target), part in tables["curves"].groupby(PLACE, sort=False):
            parts += [f"## {task} {target}", _place(study, tables, part, task, target)]
    parts += ["## How to read this", _explained(), f"![learning curves]({figure})"]
    return "\n\n".join(parts) + "\n"


def _references(references: Mapping[str, Mapping[str, Any]]) -> str:
    lines = []
    for name, known in references.items():
        gap = known["oracle"] - known["zero_shot"]
        small = gap < SMALL_GAP * abs(known["oracle"])
        words = "hardly any: scores are mostly noise" if small else f"{gap:.0f}"
        lines.append([name, f"{known['zero_shot']:.0f}", f"{known['oracle']:.0f}", f"{known['steps']:,}", words])
    return _grid(["task, target", "source policy", "oracle", "target steps of the oracle", "gap"], lines)


def _overall(study: Study, tables: Mapping[str, pd.DataFrame]) -> str:
    together, first, better = tables["overall"], tables["first"], tables["improvement"]
    points = sorted(set(together.loc[together["steps"] > 0, "steps"]))
    better = _at(better, "all", "all")
    header = ["method", "runs", *(f"score at {p:,}" for p in points), *(f"P({our} better)" for our in study.ours)]
    header += [f"first at {p:,}" for p in points]
    lines = []
    for label in study.labels:
        mine = together[together["label"] == label].set_index("steps")
        runs = study.rows.loc[study.rows["label"] == label, [*PLACE, "seed"]].drop_duplicates()
        cells = [label, str(len(runs))]
        cells += _scores(mine, points)
        cells += [_better(better, our, label) for our in study.ours]
        won = first[first["label"] == label].set_index("steps")
        cells += [f"{won.loc[p, 'first']} of {won.loc[p, 'places']}" if p in won.index else "–" for p in points]
        lines.append(cells)
    return _grid(header, lines)


def _place(study: Study, tables: Mapping[str, pd.DataFrame], part: pd.DataFrame, task: str, target: str) -> str:
    better, spent = (_at(tables[name], task, target) for name in ("improvement", "costs"))
    points = sorted(set(part.loc[part["steps"] > 0, "steps"]))
    header = ["method", "runs", *(f"score at {p:,}" for p in points), f"return at {points[-1]:,}"]
    header += [*(f"P({our} better)" for our in study.ours), f"target steps to {SHARE_WORDS}", "updates / step"]
    header += ["source steps / step", "ms / step", "model error"]
    lines = []
    for label in (known for known in study.labels if known in set(part["label"])):
        mine = part[part["label"] == label].set_index("steps")
        cost = spent[spent["label"] == label].iloc[0]
        cells = [label, str(cost["runs"]), *_scores(mine, points)]
        cells.append(_interval(mine.loc[points[-1]], "return", 0) if points[-1] in mine.index else "–")
        cells += [_better(better, our, label) for our in study.ours]
        cells += [_censored(cost), f"{cost['updates']:.3g}", f"{cost['source_steps']:.3g}"]
        error = f"{cost['model_error']:.2g}" if math.isfinite(cost["model_error"]) else "–"
        lines.append([*cells, f"{1_000 * cost['seconds']:.3g}", error])
    won = _at_first(tables["first"], f"{task} {target}")
    return _grid(header, lines) + f"\n\nFirst: {won}."


def _at(table: pd.DataFrame, task: str, target: str) -> pd.DataFrame:
    return table[(table["task"] == task) & (table["target"] == target)]


def _at_first(table: pd.DataFrame, place: str) -> str:
    won = table[[place in where.split(", ") for where in table["where"]]]
    return "; ".join(f"at {steps:,} {', '.join(part['label'])}" for steps, part in won.groupby("steps"))


def _better(table: pd.DataFrame, our: str, other: str) -> str:
    """At the last evaluation."""
    found = table[(table["ours"] == our) & (table["other"] == other) & (table["steps"] == table["steps"].max())]
    if not len(found):
        return "–"
    line = found.iloc[0]
    return f"{line['probability']:.2f}" + ("" if line["runs"] == 2 * line["places"] else _bounds(line, "low", "high"))


def _censored(cost: pd.Series) -> str:
    found = f"{cost['steps_to']:,.0f}" if math.isfinite(cost["steps_to"]) else f"> {cost['budget']:,}"
    return f"{found} ({cost['reached']}/{cost['runs']})"


def _by_number(level: str) -> list[int | str]:
    """Sorts texts with numbers in them: 5 before 20."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", level)]


def _effects(table: pd.DataFrame) -> str:
    last = table[table["steps"] == table["steps"].max()]
    tasks = sorted(set(last["task"]) - {"all"})
    grids = []
    for factor, part in last.groupby("factor", sort=False):
        lines = []
        for level in sorted(set(part["level"]), key=_by_number):
            mine = part[part["level"] == level].set_index("task")
            cells = _scores(mine, (*tasks, "all"))
            lines.append([level, str(mine.loc["all", "runs"]) if "all" in mine.index else "–", *cells])
        grids.append(_grid([str(factor), "runs", *(f"score, {task}" for task in (*tasks, "all"))], lines))
    return "\n\n".join([f"At {last['steps'].iloc[0]:,} target steps, over all cells with that level.", *grids])


def _explained() -> str:
    words = {
        "runs": "that are done; unequal numbers are of an unfinished suite, or of methods with more seeds. "
        "Of one run a target no interval is told.",
        "P(A better)": "a run of A ends with a higher return than one of the line's method; ties count half.",
        f"target steps to {SHARE_WORDS}": "median over runs of the first evaluation with at least that share of the "
        "oracle's return, and how many runs had one. Censored at the budget: > means that half of the runs did not get "
        "there. It need not last.",
        "updates, source steps, ms": "of each target step, training alone: no evaluations, no phi_0, no cloning.",
        "model error": "one-step error on all target transitions at the end, 1 = as large as a typical step's change; "
        "median over runs.",
        "first": "the largest IQM of the return. It says nothing of whether the intervals overlap.",
    }
    return "\n".join(f"- **{name}**: {text}" for name, text in words.items())


def _scores(lines: pd.DataFrame, keys: Sequence[Any]) -> list[str]:
    return [_interval(lines.loc[key], "score") if key in lines.index else "–" for key in keys]


def _interval(line: pd.Series, name: str, digits: int = 2) -> str:
    """A value with its interval; of one run a target without, as that tells nothing of how runs differ."""
    if not math.isfinite(line[name]):
        return "–"
    alone = line["runs"] == line.get("places", 1)
    return f"{line[name]:,.{digits}f}" + ("" if alone else _bounds(line, f"{name}_low", f"{name}_high", digits))


def _bounds(line: pd.Series, low: str, high: str, digits: int = 2) -> str:
    return f" [{line[low]:,.{digits}f}, {line[high]:,.{digits}f}]"


def _grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(header)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, rule, *lines))
