"""Is what remains no more than noise? The adequacy ratio R."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom

from sb3_rpto.sysid.settings import DEFAULTS, AdequacySettings
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem

#: Verdicts that leave nothing to look for.
SETTLED = ("complete", "explained")


@dataclass(frozen=True)
class Adequacy:
    """Typical error of the windows over that of a true model with the noise of the data.

    :param ratio: of the medians
    :param low: 2.5 % quantile over resampled blocks, or of what noise alone does to so many windows if that is lower
    :param high: 97.5 % quantile, likewise
    :param strays: share of windows whose error noise does not explain
    :param chance: of as many of them by noise alone
    :param spread: whether several episodes have such windows
    :param settings: thresholds
    """

    ratio: float
    low: float
    high: float
    strays: float
    chance: float
    spread: bool = False
    settings: AdequacySettings = DEFAULTS.adequacy

    @property
    def adequate(self) -> bool:
        """Whether the ratio reaches down to one, within the tolerance of the noise estimate, with few stray windows."""
        return self.low <= 1 + self.settings.tolerance and self.chance > self.settings.chance

    @property
    def denied_by_strays(self) -> bool:
        """Whether the typical error is no more than noise, and single windows alone say that something is missing."""
        return self.low <= 1 + self.settings.tolerance and not self.adequate

    def __str__(self) -> str:
        return f"R = {self.ratio:.2f} [{self.low:.2f}, {self.high:.2f}]"


def count_strays_with(select: Adequacy, few: int, fitted: Adequacy, more: int) -> Adequacy:
    """The same, with the stray windows of a fit counted among those of a few that it was not made to.

    A robust fit gives up what it cannot reach: of few windows too few are of that to deny that it is all.

    :param select: of the ``few`` windows
    :param fitted: of the ``more`` windows
    """
    strays = round(select.strays * few) + round(fitted.strays * more)
    chance = float(binom.sf(strays - 1, few + more, select.settings.stray_share))
    return replace(select, strays=strays / (few + more), chance=min(select.chance, chance))


def adequacy(problem: Problem, fit: Fit, seed: int, settings: AdequacySettings = DEFAULTS.adequacy) -> Adequacy:
    """Compare the errors of a fit with those of noise alone.

    :param problem: windows that the parameters were not fitted to, with their starts fitted
    :param fit: those starts
    """
    noise = problem.noise_errors(fit, seed)
    typical = float(np.median(noise))
    rng = np.random.default_rng(seed)
    blocks = problem.windows.block
    names = np.unique(blocks)
    members = [np.flatnonzero(blocks == b) for b in names]
    medians = []
    for _ in range(settings.resamples):
        rows = np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))])
        medians.append(np.median(fit.errors[rows]))
    ratio = float(np.median(fit.errors)) / typical
    low, high = np.quantile(medians, [0.025, 0.975]) / typical
    # Two or three blocks, resampled, say next to nothing; noise in so few windows is known without them.
    noisy = np.median(rng.choice(noise.ravel(), (settings.resamples, len(fit.errors))), axis=1) / typical
    least, most = np.quantile(noisy, [0.025, 0.975])
    low, high = min(low, ratio / most), max(high, ratio / least)
    stray = fit.errors > settings.stray_factor * np.quantile(noise, 0.99)
    count = int(stray.sum()) if len(np.unique(blocks[stray])) > 1 else 0
    return Adequacy(
        ratio,
        float(low),
        float(high),
        float(stray.mean()),
        float(binom.sf(count - 1, len(stray), settings.stray_share)),
        len(np.unique(problem.windows.episode[stray])) > 1,
        settings,
    )


def judge(before: Adequacy, after: Adequacy, named: bool) -> str:
    """The verdict from adequacy before and after.

    ``complete``: nothing is missing. ``explained``: what is left with the named effects is no more than noise.
    ``partly explained``: they at least halve the excess log error (or, where the typical error is no more than noise,
    the share of windows that are). ``unexplained``: they do not.
    """
    if not named:
        return "complete" if before.adequate else "unexplained"
    if after.adequate:
        return "explained"
    if before.ratio <= 1 + before.settings.tolerance:  # only stray windows deny that it is complete
        halved = after.strays <= 0.5 * before.strays
    else:
        halved = np.log(max(after.ratio, 1.0)) <= 0.5 * np.log(before.ratio)
    return "partly explained" if halved else "unexplained"
