"""What several seeds say together: interquartile means, intervals, and how often one method beats another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import trim_mean

#: Draws of a bootstrap, and what its intervals cover.
N_RESAMPLES, CONFIDENCE = 2000, 0.95


def iqm(values: np.ndarray) -> np.ndarray:
    """Interquartile mean along the last axis: the mean of the middle half (Agarwal et al. 2021)."""
    return trim_mean(values, 0.25, axis=-1)


def iqm_interval(values: np.ndarray) -> tuple[float, float, float]:
    """IQM of one number per seed with its percentile bootstrap interval of 95 % over seeds.

    :param values: (n_seeds,)
    :return: (IQM, lower, upper)
    """
    return stratified_interval([values])


def stratified_interval(strata: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """IQM of all runs with its stratified percentile bootstrap interval: each stratum is resampled for itself.

    :param strata: one number per seed for each task and target, (n_seeds,) each
    :return: (IQM, lower, upper)
    """
    rng = np.random.default_rng(0)
    strata = [np.asarray(values, dtype=float) for values in strata]
    draws = np.concatenate([rng.choice(values, size=(N_RESAMPLES, len(values))) for values in strata], axis=1)
    return float(iqm(np.concatenate(strata))), *_percentiles(iqm(draws))


def improvement(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, float]:
    """Probability that a run of the first method beats one of the second, with its stratified bootstrap interval.

    P(X > Y) + P(X = Y) / 2 over all pairs of runs on a task and target, averaged over these (Agarwal et al. 2021).

    :param pairs: one number per seed of each method, for each task and target
    :return: (probability, lower, upper)
    """
    rng = np.random.default_rng(0)
    pairs = [(np.asarray(x, dtype=float), np.asarray(y, dtype=float)) for x, y in pairs]
    drawn = [
        _beats(rng.choice(x, size=(N_RESAMPLES, len(x))), rng.choice(y, size=(N_RESAMPLES, len(y)))) for x, y in pairs
    ]
    value = float(np.mean([_beats(x, y) for x, y in pairs]))
    return value, *_percentiles(np.mean(drawn, axis=0))


def _beats(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Share of pairs of the last axes in which ``x`` is larger; ties count half."""
    difference = x[..., :, None] - y[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-2, -1))


def _percentiles(draws: np.ndarray) -> tuple[float, float]:
    lower, upper = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(lower), float(upper)


def summarise(rows: pd.DataFrame, by: list[str], value: str = "return") -> pd.DataFrame:
    """One line per group: IQM over seeds, its interval, and the number of seeds.

    :param rows: long form, one line per run and evaluation, with the run's seed
    :param by: columns that make a group, e.g. ["panel", "method", "steps"]
    :param value: the column to summarise
    :return: columns ``by``, iqm, low, high, seeds
    """
    lines = []
    for key, group in rows.groupby(by, sort=True, dropna=False):
        middle, low, high = iqm_interval(group[value].to_numpy())
        lines.append((*key, middle, low, high, group["seed"].nunique()))
    return pd.DataFrame(lines, columns=[*by, "iqm", "low", "high", "seeds"])
