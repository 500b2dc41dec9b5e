"""The tables and the figure of a suite, written beside its manifest: ``python -m benchmarks transfer report``."""

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

from benchmarks.transfer import plots
from benchmarks.transfer.plan import variant_of
from sb3_rpto.evaluation.statistics import (
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

    :param manifest: of the folder
    :param rows: one line a run and evaluation: task, target, label, method, seed, steps, return, score, updates,
        source_steps, seconds, factors; model_error where a model was learned
    :param failed: name and last line of the error of each run that failed
    :param left_out: name of each run that is not of the suite as it is now, and why
    :param commits: of the runs
    """

    manifest: dict[str, Any]
    rows: pd.DataFrame
    failed: dict[str, str]
    left_out: dict[str, str]
    commits: list[str]

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
    parser = argparse.ArgumentParser(prog=NAME, description=__doc__)
    parser.add_argument("folder", metavar="DIR", help="folder of a suite, as 'python -m benchmarks transfer' fills it")
    print(write(parser.parse_args(arguments).folder))
    return 0


def load(folder: str | os.PathLike[str]) -> Study:
    """Read a suite's results; unfinished ones will do.

    :raises FileNotFoundError: no manifest
    :raises ValueError: no run is done, or a torn manifest
    """
    path = Path(folder) / "manifest.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} has no manifest.json; run 'python -m benchmarks transfer --out {folder}' first"
        )
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path} is torn ({error}); run 'python -m benchmarks transfer' again with that --out"
        ) from error
    rows: list[dict[str, Any]] = []
    failed, left_out, commits = dict[str, str](), dict[str, str](), set[str]()
    variants = manifest.get("variants")  # folders of earlier versions do not tell
    for file in sorted((Path(folder) / "runs").glob("*.json")):
        try:
            result = json.loads(file.read_text(encoding="utf-8"))
            job = result["job"]
        except (ValueError, TypeError, KeyError):  # torn: the next sweep makes it again
            failed[file.stem] = "torn file"
            continue
        reference = manifest["references"].get(f"{job['task']}_{job['target']}", {})
        if result["error"]:
            failed[result["name"]] = result["error"].strip().splitlines()[-1]
        elif result["source"]["sha256"] != reference.get("agent"):
            left_out[result["name"]] = "of another source agent"
        elif variants is not None and variant_of(job) not in variants:
            left_out[result["name"]] = "of other settings than the suite's"
        else:
            commits.add(str(result["commit"]))
            known = {name: job[name] for name in ("task", "target", "label", "method", "seed", "factors")}
            rows += [{**known, **row} for row in _whole(job, result["rows"])]
    if not rows:
        raise ValueError(f"{folder}: no run is done; go on with 'python -m benchmarks transfer --out {folder}'")
    return Study(manifest, scored(pd.DataFrame(rows), manifest["references"]), failed, left_out, sorted(commits))


def _whole(job: Mapping[str, Any], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Zero-shot has one evaluation, which holds at all steps."""
    if job["method"] == "zero-shot":
        return [{**rows[0], "steps": steps} for steps in (0, *job["points"])]
    return list(rows)


def write(folder: str | os.PathLike[str]) -> str:
    """Write ``report.md``, ``report.json``, the tables as CSV and the figure ``curves.png`` beside the manifest.

    :return: the report in Markdown
    """
    study, out = load(folder), Path(folder)
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
    for name, table in tables.items():
        write_text(out / f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
    counted = {"runs": _runs(study.rows), "failed": study.failed, "left_out": study.left_out, "commits": study.commits}
    everything = {"manifest": study.manifest, **counted, **{n: t.to_dict("records") for n, t in tables.items()}}
    write_json(out / "report.json", everything)
    plots.learning_curves(lines, references, study.labels, study.ours, out / "curves.png")
    text = markdown(study, tables)
    write_text(out / "report.md", text)
    return text


def _runs(rows: pd.DataFrame) -> int:
    return len(rows[[*PLACE, "label", "seed"]].drop_duplicates())


# --- Markdown -------------------------------------------------------------------------------------------------------


def markdown(study: Study, tables: Mapping[str, pd.DataFrame]) -> str:
    """The report, for readers.

    :param study: of :func:`load`
    :param tables: those that :func:`write` makes
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
    parts += ["## How to read this", _explained(), "![learning curves](curves.png)"]
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
