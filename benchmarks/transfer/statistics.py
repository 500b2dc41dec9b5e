"""The tables of a suite: scores, curves, costs, who is first, and what the factors of a design do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from sb3_rpto.evaluation.statistics import improvement, iqm_interval, stratified_interval

PLACE = ["task", "target"]
#: Share of the oracle's return that counts as having arrived.
SHARE = 0.9


def scored(rows: pd.DataFrame, references: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Rows with ``score``: 0 is the source policy as it is, 1 the oracle; NaN where the oracle is no better.

    :param rows: columns task, target, label, seed, steps, return, …
    :param references: of each ``<task>_<target>``, by their names ``zero_shot`` and ``oracle``
    """
    of = [references.get(f"{task}_{target}", {}) for task, target in zip(rows["task"], rows["target"])]
    low, high = (np.array([r.get(name, np.nan) for r in of], dtype=float) for name in ("zero_shot", "oracle"))
    span = np.where(high > low, high - low, np.nan)
    return rows.assign(score=(rows["return"].to_numpy() - low) / span)


def curves(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each task, target, method and evaluation: IQM and interval of return and of score.

    :param rows: of :func:`scored`
    :return: columns task, target, label, steps, runs, return, return_low, return_high, score, score_low, score_high
    """
    lines = []
    for key, part in rows.groupby([*PLACE, "label", "steps"], sort=False):
        line: dict[str, Any] = dict(zip((*PLACE, "label", "steps"), key)) | {"runs": len(part)}
        for name in ("return", "score"):
            line |= dict(zip((name, f"{name}_low", f"{name}_high"), iqm_interval(part[name].to_numpy())))
        lines.append(line)
    return pd.DataFrame(lines)


def overall(rows: pd.DataFrame, by: Sequence[str] = ("label",)) -> pd.DataFrame:
    """A line for each method and evaluation over all tasks and targets: IQM of scores, stratified interval.

    :param rows: of :func:`scored`; those without a score do not count
    :param by: other columns than the method's label
    :return: columns ``by``, steps, runs, places, score, score_low, score_high
    """
    lines = []
    for key, part in rows.dropna(subset=["score"]).groupby([*by, "steps"], sort=False):
        strata = [place["score"].to_numpy() for _, place in part.groupby(PLACE)]
        line: dict[str, Any] = dict(zip((*by, "steps"), key)) | {"runs": len(part), "places": len(strata)}
        lines.append(line | dict(zip(("score", "score_low", "score_high"), stratified_interval(strata))))
    return pd.DataFrame(lines, columns=[*by, "steps", "runs", "places", "score", "score_low", "score_high"])


def improvements(rows: pd.DataFrame, ours: Sequence[str]) -> pd.DataFrame:
    """Probability that each of our methods beats each other one: at each number of steps on each target, and over all.

    :param rows: columns task, target, label, seed, steps, return
    :param ours: labels
    :return: columns task, target, steps, ours, other, runs (of both), places, probability, low, high; task and target
        are "all" for the last evaluations on all targets together, steps then the largest budget
    """
    later = rows[rows["steps"] > 0]
    budget = later.groupby(PLACE)["steps"].transform("max")
    groups: list[tuple[tuple[Any, ...], pd.DataFrame]] = list(later.groupby([*PLACE, "steps"], sort=False))
    groups.append((("all", "all", later["steps"].max()), later[later["steps"] == budget]))
    lines = []
    for key, part in groups:
        of = {place: one["return"].to_numpy() for place, one in part.groupby(["label", *PLACE], sort=False)}
        for our, other in product(ours, dict.fromkeys(label for label, *_ in of)):
            pairs = [
                (of[(our, *place)], of[(other, *place)])
                for label, *place in of
                if label == our and (other, *place) in of
            ]
            if pairs and our != other:
                counts = {"runs": sum(len(x) + len(y) for x, y in pairs), "places": len(pairs)}
                line = dict(zip((*PLACE, "steps"), key)) | {"ours": our, "other": other} | counts
                lines.append(line | dict(zip(("probability", "low", "high"), improvement(pairs))))
    found = ("ours", "other", "runs", "places", "probability", "low", "high")
    return pd.DataFrame(lines, columns=[*PLACE, "steps", *found])


def costs(rows: pd.DataFrame, references: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """What each method spent for each target step, and how many it took to :data:`SHARE` of the oracle's return.

    :param rows: columns task, target, label, seed, steps, return, updates, source_steps, seconds; model_error where a
        model was learned
    :param references: as :func:`scored` takes them
    :return: columns task, target, label, runs, budget, updates, source_steps, seconds (the last three for each target
        step, from the first one on), model_error (median at the end; NaN without a model), reached (runs that did),
        steps_to (median of the first evaluations that did; infinite where half did not)
    """
    lines = []
    for (task, target, label), part in rows.groupby([*PLACE, "label"], sort=False):
        budget = int(part["steps"].max())
        last = part[part["steps"] == budget]
        line: dict[str, Any] = {"task": task, "target": target, "label": label, "runs": part["seed"].nunique()}
        line |= {"budget": budget}
        begun = part[part["steps"] == 0]  # of updates and seconds nothing
        for name in ("updates", "source_steps", "seconds"):
            line[name] = float(last[name].mean() - begun[name].mean()) / max(budget, 1)
        line["model_error"] = float(last["model_error"].median()) if "model_error" in last else np.nan
        best = references.get(f"{task}_{target}", {}).get("oracle", np.nan)
        reached = [steps_to(one, enough(best)) for _, one in part.groupby("seed")]
        line |= {"reached": int(np.isfinite(reached).sum())}
        lines.append(line | {"steps_to": float(np.quantile(reached, 0.5, method="higher"))})
    return pd.DataFrame(lines)


def enough(best: float) -> float:
    """Of an oracle's return what leaves out no more than a share of 1 - :data:`SHARE`, also where it is negative."""
    return best - (1 - SHARE) * abs(best)


def steps_to(curve: pd.DataFrame, threshold: float) -> float:
    """Steps of the first evaluation with at least this return; infinite where there is none: censored at the budget.

    :param curve: columns steps, return of one run
    :param threshold: a return
    """
    reached = curve.loc[curve["return"] >= threshold, "steps"]
    return float(reached.min()) if len(reached) else np.inf


def firsts(lines: pd.DataFrame) -> pd.DataFrame:
    """On how many targets the IQM of each method's return is the largest, at each number of steps; ties count for all.

    :param lines: of :func:`curves`
    :return: columns label, steps, first, places, where (targets, parted by commas)
    """
    later = lines[lines["steps"] > 0]
    best = later.groupby([*PLACE, "steps"])["return"].transform("max")
    won = later.assign(won=np.isclose(later["return"], best, rtol=1e-9, atol=0.0))
    out = []
    for (label, steps), part in won.groupby(["label", "steps"], sort=False):
        names = [f"{task} {target}" for task, target in part.loc[part["won"], PLACE].itertuples(index=False)]
        line = {"label": label, "steps": steps, "first": len(names), "places": len(part)}
        out.append(line | {"where": ", ".join(names)})
    return pd.DataFrame(out, columns=["label", "steps", "first", "places", "where"])


def effects(rows: pd.DataFrame, interactions: Sequence[Sequence[str]] = ()) -> pd.DataFrame:
    """Of a factorial design: IQM of scores over all runs with a level of a factor, or with a pair of levels.

    :param rows: of :func:`scored`, with a column ``factors`` (level of each)
    :param interactions: pairs of factors
    :return: columns factor, level, task ("all" for all), steps, runs, places, score, score_low, score_high
    """
    names = list(dict.fromkeys(name for levels in rows["factors"] for name in levels))
    parts = []
    later = rows[rows["steps"] > 0]
    for group in [*((name,) for name in names), *interactions]:
        levels = [", ".join(known[name] for name in group) for known in later["factors"]]
        of = later.assign(factor=" x ".join(group), level=levels)
        parts.append(overall(of, ("factor", "level", "task")))
        parts.append(overall(of, ("factor", "level")).assign(task="all"))
    return pd.concat(parts, ignore_index=True)
