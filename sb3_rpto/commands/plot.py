"""``sb3-rpto plot``: learning curves of result files."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_rpto.commands.terminal import say

if TYPE_CHECKING:
    import pandas as pd

SUFFIXES = (".png", ".pdf", ".svg")
#: Beside its settings, what makes a run another method's.
BEGUN_WITH = ("source", "episodes")

DESCRIPTION = """\
Draw learning curves of result files: one panel a target, one line a method, the
interquartile mean over seeds with its 95 % bootstrap interval.
"""

EXAMPLE = """\
example:
  sb3-rpto plot runs/hopper-* --out hopper.png
"""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "plot",
        help="draw learning curves of result files",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("results", metavar="RESULT", nargs="+", type=Path, help="result files, or folders with some")
    parser.add_argument("--out", metavar="FIGURE", required=True, type=Path, help=f"one of {', '.join(SUFFIXES)}")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Read, summarise, draw."""
    if parsed.out.suffix not in SUFFIXES:
        raise ValueError(f"--out {parsed.out}: a figure is {', '.join(SUFFIXES)}")
    try:
        import pandas as pd
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(
            f"plot needs matplotlib and pandas ({error}): pip install -e '.[experiments]' in the checkout"
        ) from error
    from sb3_rpto.files import write_atomically

    rows = pd.DataFrame(read_rows(parsed.results))
    panels = sorted(rows["target"].unique())
    figure = Figure(figsize=(5.0 * len(panels), 3.8), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
        draw(axes, rows[rows["target"] == panel], panel)
    form = parsed.out.suffix.removeprefix(".")
    write_atomically(parsed.out, lambda file: figure.savefig(file, dpi=150), suffix=form)
    say(f"{len(rows):,} evaluations of {len(panels)} target(s); written: {parsed.out}")
    return 0


def read_rows(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The rows of all result files, with their target.

    :param paths: result files, or folders that are searched for some
    :raises ValueError: for a file that is no result, and for folders without any
    """
    rows: list[dict[str, Any]] = []
    seen: set[Path] = set()
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"RESULT: there is nothing at {str(path)!r}; check the path")
        files = sorted(path.rglob("*.json")) if path.is_dir() else [path]
        for file in (f for f in files if f.resolve() not in seen):
            seen.add(file.resolve())
            if path.is_dir() and file.name == "config.json" and not file.with_name("result.json").exists():
                print(f"sb3-rpto: left out, not finished: {file.parent}", file=sys.stderr)
            found = _result(file)
            if found is None and not path.is_dir():
                raise ValueError(f"RESULT {file} is no result file of sb3-rpto")
            rows += found or []
    if not rows:
        raise ValueError(f"RESULT: there are no result files in {', '.join(map(str, paths))}")
    return _once(_labelled(rows))


def _labelled(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with what settings of one method at one target differ in added to its name: they are other methods."""
    places: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        known = places.setdefault((row["target"], row["method"]), [])
        if row["settings"] not in known:
            known.append(row["settings"])
    found = []
    for row in rows:
        own, others = row["settings"], places[row["target"], row["method"]]
        names = sorted({name for other in others for name in {*own, *other} if own.get(name) != other.get(name)})
        label = " ".join([row["method"], *(f"{name}={own.get(name, 'default')}" for name in names)])
        found.append({**row, "method": label})
    return _told_apart(found)


def _told_apart(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with the source agent in the name of a method of which one seed has runs from several."""
    runs: dict[tuple[str, str, int], set[str]] = {}
    for row in rows:
        runs.setdefault((row["target"], row["method"], row["seed"]), set()).add(row["agent"])
    several = {(target, method) for (target, method, _), agents in runs.items() if len(agents) > 1}
    apart = [(row["target"], row["method"]) in several for row in rows]
    return [{**row, "method": f"{row['method']} agent={row['agent']}"} if a else row for row, a in zip(rows, apart)]


def _once(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows without those of runs that are there already: a seed counts once."""
    first: dict[tuple[str, str, int], str] = {}
    for row in rows:
        first.setdefault((row["target"], row["method"], row["seed"]), row["run"])
    kept = [row for row in rows if first[row["target"], row["method"], row["seed"]] == row["run"]]
    for run in sorted({row["run"] for row in rows} - {row["run"] for row in kept}):
        print(f"sb3-rpto: left out, the same seed of the same method is there: {run}", file=sys.stderr)
    return kept


def _result(file: Path) -> list[dict[str, Any]] | None:
    """The rows of a result of ``sb3-rpto transfer`` or ``train``, or of a benchmark; None for another file."""
    from sb3_rpto.envs.tasks import env_id

    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content.get("config", {}).get("command") == "adapt":
            print(f"sb3-rpto: left out, learned from a log, so that there is no curve: {file}", file=sys.stderr)
            return None
        if "job" in content:  # of the benchmark: a method with its settings has a label
            shift = content.get("target", content["job"]).get("shift", content["job"].get("target"))
            shifted = env_id(content["job"]["task"], shift)  # as of ``transfer``
            of_run = {"method": content["job"]["label"], "target": shifted, "seed": content["job"]["seed"]}
            known = {name: content["job"].get(name) for name in ("settings", "episodes")}
            known["source"] = env_id(content["job"]["task"])
            agent = content.get("source", {}).get("sha256")
        else:
            of_run = {name: content["config"][name] for name in ("method", "target", "seed")}
            known, agent = content["config"], content["config"].get("source_model_sha256")
        of_run["settings"] = _chosen(known)
        if content.get("error"):
            print(f"sb3-rpto: left out, failed: {file}", file=sys.stderr)
        of_run["run"] = str(file)
        of_run["agent"] = str(agent)[:8]
        return [{**of_run, "steps": row["steps"], "return": row["return"]} for row in content["rows"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        if file.name == "result.json":
            print(f"sb3-rpto: left out, no result of ours or torn: {file}", file=sys.stderr)
        return None


def _chosen(config: dict[str, Any]) -> dict[str, Any]:
    """The settings of a run but a buffer as long as the run, which the command made so, and what it began with."""
    settings = config.get("settings") or {}
    chosen = {n: value for n, value in settings.items() if n != "buffer_size" or value != config.get("steps")}
    return chosen | {name: config[name] for name in BEGUN_WITH if config.get(name) is not None}


def draw(axes: Any, rows: pd.DataFrame, title: str) -> None:
    """One panel.

    :param axes: of matplotlib
    :param rows: columns method, run, seed, steps, return
    :param title: of the panel
    """
    from sb3_rpto.evaluation.statistics import summarise

    for method, own in rows.groupby("method", sort=True):
        lines = summarise(_at_same_steps(own), ["steps"])
        seeds = own["seed"].nunique()
        label = f"{method} ({seeds})"
        if len(lines) == 1:  # zero-shot
            axes.axhline(lines["iqm"].iloc[0], color="grey", linestyle="--", label=label)
            continue
        (line,) = axes.plot(lines["steps"], lines["iqm"], marker=".", label=label)
        if seeds > 1:
            axes.fill_between(lines["steps"], lines["low"], lines["high"], color=line.get_color(), alpha=0.2, lw=0)
    axes.set(title=title, xlabel="steps", ylabel="return")
    axes.grid(alpha=0.3)
    axes.legend(title="method (seeds)", fontsize="small")


def _at_same_steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Runs at all steps at which one of them was evaluated, on a straight line between evaluations of their own.

    Where a run has ended, the others would draw a jump: there the line ends.
    """
    import numpy as np
    import pandas as pd

    runs = [run.sort_values("steps") for _, run in rows.groupby("run")]
    first, last = (choose(run["steps"].iloc[at] for run in runs) for choose, at in ((max, 0), (min, -1)))
    steps = np.array(sorted({step for step in rows["steps"] if first <= step <= last}))
    return pd.concat(
        [
            pd.DataFrame(
                {"seed": run["seed"].iloc[0], "steps": steps, "return": np.interp(steps, run["steps"], run["return"])}
            )
            for run in runs
        ]
    )
