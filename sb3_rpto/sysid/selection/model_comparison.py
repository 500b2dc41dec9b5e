"""Is one model better than another on windows that neither was fitted to? Evidence from independent blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from sb3_rpto.fitting.gauss_newton import add_step, bounded_step
from sb3_rpto.sysid.settings import DEFAULTS, ComparisonSettings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem
from sb3_rpto.sysid.shooting.windows import Windows


@dataclass(frozen=True)
class Evidence:
    """What a model gains over another on the select windows.

    :param gain: share of the typical window error saved, 1 - exp(-mean log ratio)
    :param t: mean log error ratio of the blocks over its standard error, see :func:`significance`; of the
        missed windows alone where that is larger and they are few
    :param blocks: the log ratio of each block, (b,)
    :param missed: that of its windows which the other model misses, NaN where it misses none, (b,)
    :param settings: thresholds
    """

    gain: float
    t: float
    blocks: np.ndarray
    missed: np.ndarray
    settings: ComparisonSettings = DEFAULTS.comparison

    def clear(self, threshold: float, gain: float | None = None) -> bool:
        """Whether the gain is more than chance and more than a trifle, or than ``gain``."""
        return self.t > threshold and self.gain > (self.settings.least_gain if gain is None else gain)

    def frequency(self, limit: tuple[float, float], rng: np.random.Generator, resamples: int = 200) -> float:
        """Share of resampled sets of blocks in which the gain is clear by a limit of t and gain."""
        draws = [rng.integers(len(self.blocks), size=len(self.blocks)) for _ in range(resamples)]
        return float(
            np.mean([evidence_of(self.blocks[rows], self.missed[rows], self.settings).clear(*limit) for rows in draws])
        )


def compare(
    without: np.ndarray,
    with_: np.ndarray,
    blocks: np.ndarray,
    rare: bool = False,
    settings: ComparisonSettings = DEFAULTS.comparison,
) -> Evidence:
    """Evidence for the model with an effect against the one without.

    :param without: errors of the windows, (W,)
    :param with_: errors of the same windows, (W,)
    :param blocks: number of the block of each window, (W,)
    :param rare: whether it may come from few windows, where the typical one is met without the effect
    """
    floor, limit = settings.error_floor, settings.missed
    ratio = np.log(np.maximum(without, floor)) - np.log(np.maximum(with_, floor))
    missed = without > limit if rare and np.median(without) <= limit else np.zeros(len(without), dtype=bool)

    def mean(rows: np.ndarray) -> float:
        return float(ratio[rows].mean()) if rows.any() else np.nan

    members = [blocks == b for b in np.unique(blocks)]
    return evidence_of(np.array([mean(m) for m in members]), np.array([mean(m & missed) for m in members]), settings)


def evidence_of(blocks: np.ndarray, missed: np.ndarray, settings: ComparisonSettings = DEFAULTS.comparison) -> Evidence:
    """Evidence from log ratios, as :class:`Evidence` has them.

    An effect that acts in a share p of n blocks never has a t above sqrt(n p / (1 - p)), however much it saves there:
    where the others go without it, those few are what speaks for it.
    """
    t, few = significance(blocks, settings.blocks), missed[~np.isnan(missed)]
    if len(few) >= settings.rare_blocks and _gain(few) > settings.rare_gain:
        t = max(t, significance(few, settings.blocks))
    return Evidence(_gain(blocks), t, blocks, missed, settings)


def several_missed(errors: np.ndarray, blocks: np.ndarray, settings: ComparisonSettings) -> bool:
    """Whether windows of several blocks are missed: fewer could not speak for an effect."""
    return len(np.unique(blocks[errors > settings.missed])) >= settings.rare_blocks


def significance(blocks: np.ndarray, reference: int) -> float:
    """Mean over standard error; among less than ``reference`` blocks what is as unlikely by chance among so many."""
    if len(blocks) < 2:
        return 0.0
    # Few blocks may agree by chance: their spread counts as at least a percent.
    error = max(float(blocks.std(ddof=1)), 0.01) / np.sqrt(len(blocks))
    return _among_many(float(blocks.mean()) / error, len(blocks), reference)


def _gain(blocks: np.ndarray) -> float:
    return 1 - float(np.exp(-blocks.mean()))


def _among_many(t: float, count: int, reference: int) -> float:
    """The t that is as unlikely by chance among ``reference`` blocks as this is among fewer."""
    if count >= reference:
        return t
    # By the upper tail, which keeps its digits where 1 - p has none left.
    return float(np.copysign(student.isf(student.sf(abs(t), count - 1), reference - 1), t))


def folds(
    windows: Windows, horizon: float, count: int = DEFAULTS.comparison.folds
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Part windows into folds by whole blocks: indices to fit and to judge on, with a window's gap between them.

    :param windows: which may overlap
    :param horizon: length of a window in s
    :param count: most folds
    """
    names = np.unique(windows.block)
    turn = np.searchsorted(names, windows.block) % min(count, len(names))
    same = windows.episode[:, None] == windows.episode
    beside = same & (np.abs(windows.time[:, None] - windows.time) < 2 * horizon - 1e-6)
    parts = []
    for k in range(turn.max() + 1):
        chosen = turn == k
        others = ~chosen & ~beside[:, chosen].any(axis=1)
        # Where the gap leaves nothing, the data are too short for one.
        parts.append((np.flatnonzero(others if others.any() else ~chosen), np.flatnonzero(chosen)))
    return parts


def unseen_errors(
    problem: Problem, fit: Fit, free: np.ndarray, folds: Sequence[tuple[np.ndarray, np.ndarray]], prior: float
) -> np.ndarray:
    """Errors of all windows, each by parameters that were fitted without it, (W,).

    Each fold's parameters are one Gauss-Newton step away from the fit to all windows, taken with the windows of the
    fold and beside it left out.

    :param problem: windows
    :param fit: to all of them
    :param free: indices of the parameters that were fitted, (f,)
    :param folds: windows to fit and to judge on, see :func:`folds`
    :param prior: see :class:`~sb3_rpto.sysid.settings.ComparisonSettings`
    """
    rows = np.tile(fit.values, (len(problem.windows), 1))
    if len(free):
        linear = problem.linear(fit, free)
        low, high = ((b[free] - fit.values[free]) / problem.size[free] for b in (problem.lower, problem.upper))
        for others, judged in folds:
            normal, gradient = linear.normal[others].sum(0), linear.gradient[others].sum(0)
            normal = normal + np.diag(1e-3 * np.diag(normal) + prior)
            step = bounded_step(normal, gradient, low, high) * problem.size[free]
            begin, lower, upper = (x[free] for x in (fit.values, problem.lower, problem.upper))
            rows[np.ix_(judged, free)] = add_step(begin, step, lower, upper)
    return problem.score(rows, fit.starts, iterations=1).errors
