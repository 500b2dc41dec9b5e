"""What several seeds say together: interquartile means with bootstrap intervals."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import trim_mean

N_RESAMPLES = 2000


def iqm(values: np.ndarray) -> np.ndarray:
    """Interquartile mean along the last axis: the mean of the middle half (Agarwal et al. 2021)."""
    return trim_mean(values, 0.25, axis=-1)


def iqm_interval(values: np.ndarray, confidence: float = 0.95, seed: int = 0) -> tuple[float, float, float]:
    """IQM of one number per seed with its percentile bootstrap interval over seeds.

    :param values: (n_seeds,)
    :param confidence: coverage of the interval
    :param seed: of the resampling
    :return: (IQM, lower, upper)
    """
    values = np.asarray(values, dtype=float)
    draws = np.random.default_rng(seed).choice(values, size=(N_RESAMPLES, len(values)))
    lower, upper = np.quantile(iqm(draws), [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(iqm(values)), float(lower), float(upper)


def summarise(rows: pd.DataFrame, by: list[str], value: str = "return") -> pd.DataFrame:
    """One line per group: IQM over seeds, its interval, and the number of seeds.

    :param rows: long form, one line per run and evaluation
    :param by: columns that make a group, e.g. ["panel", "method", "steps"]
    :param value: the column to summarise
    :return: columns ``by``, iqm, low, high, seeds
    """
    lines = []
    for key, group in rows.groupby(by, sort=True, dropna=False):
        middle, low, high = iqm_interval(group[value].to_numpy())
        lines.append((*key, middle, low, high, len(group)))
    return pd.DataFrame(lines, columns=[*by, "iqm", "low", "high", "seeds"])
