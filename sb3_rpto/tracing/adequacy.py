"""Is what remains no more than noise? The adequacy ratio R."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_rpto.tracing.identify import Fit, Problem

#: R may exceed one by so much: the noise is estimated, too.
TOLERANCE = 0.06
#: Level of the upper quantile that is watched beside the median: saturation is rare and hides in medians.
UPPER = 0.9
RESAMPLES = 400


@dataclass(frozen=True)
class Adequacy:
    """Typical error of the windows over that of a true model with the estimated noise.

    :param ratio: of the medians
    :param low: 2.5 % quantile over resampled blocks
    :param high: 97.5 % quantile
    :param upper: the same ratio of the 90 % quantiles
    :param upper_low: its 2.5 % quantile
    """

    ratio: float
    low: float
    high: float
    upper: float
    upper_low: float

    @property
    def adequate(self) -> bool:
        """Whether both ratios reach down to one, within the tolerance of the noise estimate."""
        return self.low <= 1 + TOLERANCE and self.upper_low <= 1 + 2 * TOLERANCE

    def __str__(self) -> str:
        return f"R = {self.ratio:.2f} [{self.low:.2f}, {self.high:.2f}]"


def adequacy(problem: Problem, fit: Fit, seed: int) -> Adequacy:
    """Compare the errors of a fit with those of noise alone.

    :param problem: windows that the parameters were not fitted to, with their starts fitted
    :param fit: those starts
    """
    noise = problem.noise_errors(fit, seed)
    typical, rare = float(np.median(noise)), float(np.quantile(noise, UPPER))
    rng = np.random.default_rng(seed)
    blocks = problem.windows.block
    names = np.unique(blocks)
    members = [np.flatnonzero(blocks == b) for b in names]
    medians, uppers = [], []
    for _ in range(RESAMPLES):
        rows = np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))])
        medians.append(np.median(fit.errors[rows]))
        uppers.append(np.quantile(fit.errors[rows], UPPER))
    low, high = np.quantile(medians, [0.025, 0.975]) / typical
    return Adequacy(
        float(np.median(fit.errors)) / typical,
        float(low),
        float(high),
        float(np.quantile(fit.errors, UPPER)) / rare,
        float(np.quantile(uppers, 0.025)) / rare,
    )
