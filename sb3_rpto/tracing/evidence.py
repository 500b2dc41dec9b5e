"""Is one model better than another on windows that neither was fitted to? Evidence from independent blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from sb3_rpto.tracing.windows import Windows

#: Effects must lower the typical window error by this share to stay.
GAIN = 0.03
#: Errors below this many units of noise are none: exact data are met to rounding, where any ratio may be large.
NOTHING = 0.5
#: The t of fewer blocks counts as what is as unlikely among so many: two or three may agree by chance.
BLOCKS = 6
#: Most folds of a cross-validation.
FOLDS = 6


@dataclass(frozen=True)
class Evidence:
    """What a model gains over another on the select windows.

    :param gain: share of the typical window error saved, 1 - exp(-mean log ratio)
    :param t: mean log error ratio of the blocks over its standard error; among less than :data:`BLOCKS` that which has
        the same level of significance among so many
    :param blocks: the log ratio of each block, (b,)
    """

    gain: float
    t: float
    blocks: np.ndarray

    def clear(self, threshold: float, gain: float = GAIN) -> bool:
        """Whether the gain is more than chance and more than a trifle."""
        return self.t > threshold and self.gain > gain

    def frequency(self, limit: tuple[float, float], rng: np.random.Generator, resamples: int = 200) -> float:
        """Share of resampled sets of blocks in which the gain is clear by a limit of t and gain."""
        n = len(self.blocks)
        found = [_evidence(self.blocks[rng.integers(n, size=n)]).clear(*limit) for _ in range(resamples)]
        return float(np.mean(found))


def compare(without: np.ndarray, with_: np.ndarray, blocks: np.ndarray) -> Evidence:
    """Evidence for the model with an effect against the one without.

    :param without: errors of the windows, (W,)
    :param with_: errors of the same windows, (W,)
    :param blocks: number of the block of each window, (W,)
    """
    ratio = np.log(np.maximum(without, NOTHING)) - np.log(np.maximum(with_, NOTHING))
    return _evidence(np.array([ratio[blocks == b].mean() for b in np.unique(blocks)]))


def _evidence(blocks: np.ndarray) -> Evidence:
    mean = float(blocks.mean())
    if len(blocks) < 2:
        return Evidence(1 - float(np.exp(-mean)), 0.0, blocks)
    error = float(blocks.std(ddof=1)) / np.sqrt(len(blocks))
    # Few blocks may agree by chance: their spread counts as at least a percent.
    error = max(error, 0.01 / np.sqrt(len(blocks)))
    return Evidence(1 - float(np.exp(-mean)), _among_many(mean / error, len(blocks)), blocks)


def _among_many(t: float, count: int) -> float:
    """The t that is as unlikely by chance among :data:`BLOCKS` blocks as this is among fewer."""
    if count >= BLOCKS:
        return t
    # By the upper tail, which keeps its digits where 1 - p has none left.
    return float(np.copysign(student.isf(student.sf(abs(t), count - 1), BLOCKS - 1), t))


def folds(windows: Windows, horizon: float, count: int = FOLDS) -> list[tuple[np.ndarray, np.ndarray]]:
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
