"""What a result is worth: the right class, values, the share of the error that it takes away; and shares of many."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.tracing.truth import UNIDENTIFIABLE, VECTORS, deviation, kind_of, twins

Result = dict[str, Any]

WITHIN = 0.25
"""Values count as found within this relative error."""
ENOUGH = 0.8
"""Share of the true structure's error reduction that counts as reached."""
WORTH = 0.1
"""Where the true structure takes away less than this share of the error, there is nothing to compare."""
MEASURES = {
    "right class": "each planted effect is named, or one that the data cannot tell from it, and nothing else",
    "planted named": "the same, but more may be named",
    "itself": "each planted effect is named itself, and nothing else",
    "values": f"planted effects are named themselves, with values within {WITHIN:.0%}",
    "intervals": "the 95 % intervals of planted effects that are named themselves all hold the planted values",
    "error reduction": f"at least {ENOUGH:.0%} of the error is taken away that the true structure, fitted, takes away",
    "says explained": "the verdict is explained",
    "nothing named": "no effect is named",
    "says complete": "the verdict is complete",
    "listed": "nothing is named, and the effect is listed as not excited or the model found complete",
    "not explained": "the verdict is not explained",
    "says so": "the verdict is unexplained or partly explained",
    "zeros": "zeros that differ are found, and each within a quarter of their spread, but for what all have in common",
}
_FOUND = ("right class", "planted named", "itself", "values", "intervals", "error reduction", "says explained")
APPLY = {
    "complete": ("nothing named", "says complete"),
    "single": _FOUND,
    "pair": _FOUND,
    "outside": ("not explained", "says so"),
    "not excited": ("nothing named", "listed"),
    "own classes": _FOUND,
    "run zeros": ("zeros", "right class", "says explained"),
}
"""Measures of each group; the first one decides whether a case passes."""


@dataclass(frozen=True)
class Row:
    """A case, scored.

    :param case: as it was stored
    :param verdict: ``"error"`` where the tracer raised one
    :param planted: labels
    :param named: labels
    :param classes: number of effects in each named one's class, itself included
    :param deviation: worst relative error of the planted effects' values; infinite where one is not named, None where
        it is named by another of its class, or its values cannot be found
    :param reduction: error taken away as a share of what the true structure takes away; None where that is next to
        nothing, or there is none
    :param measures: whether each measure of the group holds; None where it does not apply
    :param why: reason of a failure, or empty
    """

    case: dict[str, Any]
    verdict: str
    planted: tuple[str, ...]
    named: tuple[str, ...]
    classes: tuple[int, ...]
    deviation: float | None
    reduction: float | None
    measures: dict[str, bool | None]
    why: str
    ratio_before: float | None = None
    ratio_after: float | None = None
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the first measure of the group holds."""
        return bool(self.measures[APPLY[self.case["group"]][0]])


@dataclass(frozen=True)
class Share:
    """How often a measure holds, with its 95 % Wilson interval."""

    hits: int
    n: int
    low: float = field(init=False)
    high: float = field(init=False)

    def __post_init__(self) -> None:
        low, high = wilson(self.hits, self.n)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @property
    def value(self) -> float:
        """The share, NaN of nothing."""
        return self.hits / self.n if self.n else math.nan

    def __str__(self) -> str:
        if not self.n:
            return "–"
        return f"{self.hits}/{self.n} = {self.value:.0%} [{self.low:.0%}, {self.high:.0%}]"


def wilson(hits: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    r"""Wilson's (1927) interval of a share.

    :math:`\left(p + z^2/2n \pm z \sqrt{p (1 - p)/n + z^2/4n^2}\right) / (1 + z^2/n)`

    :param hits: how often it holds
    :param n: of how many; 0 gives the whole of [0, 1]
    :param z: quantile of the normal distribution; default: 95 %
    """
    if not n:
        return 0.0, 1.0
    p, middle = hits / n, z * z / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + middle / (2 * n))
    return max(0.0, (p + middle - half) / (1 + 2 * middle)), min(1.0, (p + middle + half) / (1 + 2 * middle))


def score(results: Iterable[Result]) -> list[Row]:
    """Score each result, see :func:`judge`."""
    return [judge(result) for result in results]


def judge(result: Result) -> Row:
    """Score a result; where the tracer raised an error, all measures that could hold fail.

    :param result: as :func:`~benchmarks.tracing.run.flat` makes it
    """
    case = result["case"]
    measures = APPLY[case["group"]]
    if result["error"] is not None:
        last = result["error"].strip().splitlines()[-1]
        planted = tuple(kind for kind, _ in case["effects"])
        failed: dict[str, bool | None] = dict.fromkeys(measures, False)
        return Row(case, "error", planted, (), (), None, None, failed, last, seconds=result["seconds"])
    named = {e["label"]: e for e in result["effects"]}
    planted = tuple(result["planted"])
    found = _assign(case["system"], planted, named)
    missed = [label for label in planted if label not in found]
    extra = [label for label in named if label not in found.values()]
    off, share = _deviation(result, named, found), _reduction(result)
    status = [result["candidates"].get(label) for label in planted]
    verdict = result["verdict"]
    holds: dict[str, bool | None] = {
        "right class": not missed and not extra,
        "planted named": not missed,
        "itself": set(planted) == set(named),
        "values": None if off is None else off <= WITHIN,
        "intervals": _held(result, named, found),
        "error reduction": None if share is None else share >= ENOUGH,
        "says explained": verdict == "explained",
        "nothing named": not named,
        "says complete": verdict == "complete",
        "listed": not named and (verdict == "complete" or status == ["not excited"] * len(status)),
        "not explained": verdict != "explained",
        "says so": verdict in ("unexplained", "partly explained"),
        "zeros": _zeros(result),
    }
    return Row(
        case,
        verdict,
        planted,
        tuple(named),
        tuple(1 + len(e["alike"]) for e in named.values()),
        off,
        share,
        {name: holds[name] for name in measures},
        "" if holds[measures[0]] else _why(case, verdict, missed, extra),
        result["ratio_before"],
        result["ratio_after"],
        result["seconds"],
    )


def _assign(system: str, planted: Sequence[str], named: dict[str, Any]) -> dict[str, str]:
    """To each planted label the named one that stands for it, each for one only; as many, and as literally, as can be.

    One stands for another if it is the same, its twin, or lists it in its class.
    """
    best: dict[str, str] = {}
    for names in itertools.permutations([*named, *[None] * len(planted)], len(planted)):
        pairs = {p: n for p, n in zip(planted, names) if n is not None and _same(system, p, named[n])}
        if _merit(pairs) > _merit(best):
            best = pairs
    return best


def _merit(pairs: dict[str, str]) -> tuple[int, int]:
    return len(pairs), sum(p == n for p, n in pairs.items())


def _same(system: str, label: str, effect: dict[str, Any]) -> bool:
    return label in effect["alike"] or twins(system, label, effect["label"])


def _deviation(result: Result, named: dict[str, Any], found: dict[str, str]) -> float | None:
    planted = {label: values for label, values in result["planted"].items() if values is not None}
    if any(label not in found for label in planted):
        return math.inf
    worst = []
    for label, true in planted.items():
        kind = kind_of(label)
        if found[label] != label or (result["case"]["system"], kind) in UNIDENTIFIABLE:
            return None
        fitted = {name: p["value"] for name, p in named[label]["parameters"].items()}
        worst.append(deviation(kind, true, fitted))
    return max(worst, default=None)


def _held(result: Result, named: dict[str, Any], found: dict[str, str]) -> bool | None:
    """Whether all intervals that are known hold the planted value; None where there is none to compare with one.

    Effects whose values are told only together (a phase, a direction) are left out.
    """
    held = []
    for label, values in result["planted"].items():
        kind = kind_of(label)
        apart = kind not in VECTORS and (result["case"]["system"], kind) not in UNIDENTIFIABLE
        if values is None or found.get(label) != label or not apart:
            continue
        for name, p in named[label]["parameters"].items():
            if name in values and math.isfinite(p["low"]) and math.isfinite(p["high"]):
                held.append(p["low"] <= values[name] <= p["high"])
    return all(held) if held else None


def _reduction(result: Result) -> float | None:
    """(before - after) / (before - true), of errors in units of the noise floor, root mean square over joints."""
    errors = result["errors"]
    if any(errors[name] is None for name in ("before", "after", "true", "floor")):
        return None
    joints = list(errors["floor"])
    before, after, true = (
        float(np.sqrt(np.mean([(errors[name][j] / errors["floor"][j]) ** 2 for j in joints])))
        for name in ("before", "after", "true")
    )
    return (before - after) / (before - true) if before - true > WORTH * before else None


def _zeros(result: Result) -> bool:
    """Whether zeros of single runs are told from each other as well as :data:`MEASURES` says."""
    found = (result.get("zeros") or {}).get("offsets", {})
    off = []
    for joint, each in found.items():
        true = np.array([result["true_zeros"][joint][int(run)] for run in each])
        wrong = np.array(list(each.values())) - true
        off.append(float(np.abs(wrong - wrong.mean()).max() / true.std()))
    return bool(off) and max(off) <= WITHIN


def _why(case: dict[str, Any], verdict: str, missed: Sequence[str], extra: Sequence[str]) -> str:
    if case["group"] == "outside":
        return f"called {verdict}" + (f" by {', '.join(extra)}" if extra else "")
    parts = [f"missed {', '.join(missed)}"] if missed and case["group"] != "not excited" else []
    parts += [f"named {', '.join(extra)}"] if extra else []
    if case["group"] == "not excited" and not extra:
        parts.append("named what it could not see")
    return "; ".join([*parts, verdict])


def share(rows: Iterable[Row], measure: str) -> Share:
    """How often a measure holds among the rows that it applies to."""
    held = [h for row in rows if (h := row.measures.get(measure)) is not None]
    return Share(sum(held), len(held))
