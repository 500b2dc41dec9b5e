"""Does a policy see observations on the scale of those that it has learned from?"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


def normalises(env: VecNormalize | None) -> bool:
    """Whether an environment, of which this is the VecNormalize, changes observations."""
    return env is not None and env.norm_obs


def check_normalisation(had: bool, given: VecNormalize | None, what: str, learned: VecNormalize | None = None) -> None:
    """Warn where a policy will see observations on another scale than those it has learned from.

    :param had: whether these were normalised
    :param given: of the environment that the policy is to act in
    :param what: to call the policy
    :param learned: of the environment that it has learned in, where that is known
    """
    has, other = normalises(given), "the policy will see others; pass env"
    if had and not has:
        said = f"observations normalised by VecNormalize, and env is in none: {other} in one with those statistics"
    elif has and not had:
        said = f"raw observations, and env normalises them by VecNormalize: {other} without it, or with norm_obs=False"
    elif has and learned is not None and given is not None and not _alike(learned, given):
        said = f"observations normalised by other statistics than env's: {other} in a VecNormalize with those"
    else:
        return
    warnings.warn(f"{what} saw {said}", stacklevel=4)


def rescaled(
    seen: Any, original: Any, before: VecNormalize | None, after: VecNormalize | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """An observation as another VecNormalize shows it, and its original where there is one.

    :param seen: as ``before`` showed it
    :param original: of it, where ``before`` is one
    """
    raw = np.asarray(seen if before is None else original)
    return (raw, None) if after is None else (np.asarray(after.normalize_obs(raw)), raw)


def _alike(own: VecNormalize, given: VecNormalize) -> bool:
    """Whether the statistics of two are about the same."""
    ours, theirs = own.obs_rms, given.obs_rms
    assert isinstance(ours, RunningMeanStd)  # observations are flat Boxes, never a Dict
    assert isinstance(theirs, RunningMeanStd)
    offset = np.abs(ours.mean - theirs.mean) / np.sqrt(ours.var + 1e-8)
    ratio = (theirs.var + 1e-8) / (ours.var + 1e-8)
    return bool((offset < 1).all() and (np.abs(np.log(ratio)) < np.log(4)).all())
