"""Does a policy see observations on the scale of those that it has learned from?"""

from __future__ import annotations

import copy
import pathlib
import pickle
import warnings
from typing import Any, Literal, TypeAlias

import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize

#: A zip's last observation is the one before it, rather than what statistics make of it, where it is so much nearer.
NEARER = 3.0
#: Nor does an environment leave its observations' bounds by more than this share of their range.
BEYOND = 0.1
#: How statistics are told to from_source() and to the commands.
PASS = "vec_normalize=FILE (--vec-normalize FILE), what VecNormalize.save() wrote"
#: How errors call statistics that nobody has passed.
BESIDE = "the statistics beside source_model"

Statistics: TypeAlias = VecNormalize | str | pathlib.Path | Literal[False] | None


def normalises(env: VecNormalize | None) -> bool:
    """Whether an environment, of which this is the VecNormalize, changes observations."""
    return env is not None and env.norm_obs


def check_normalisation(
    had: bool,
    given: VecNormalize | None,
    what: str,
    learned: VecNormalize | None = None,
    *,
    remedy: str = "pass env in one with those statistics",
) -> bool:
    """Warn where a policy will see observations on another scale than those it has learned from; whether that is so.

    :param had: whether these were normalised
    :param given: of the environment that the policy is to act in
    :param what: to call the policy
    :param learned: of the environment that it has learned in, where that is known
    :param remedy: where statistics are missing
    """
    has, other = normalises(given), "the policy will see others"
    if had and not has:
        said = f"observations normalised by VecNormalize, and env is in none: {other}; {remedy}"
    elif has and not had:
        said = (
            f"raw observations, and env normalises them by VecNormalize: {other}; pass env without it, or with "
            "norm_obs=False"
        )
    elif has and learned is not None and given is not None and not alike(learned, given):
        said = f"observations normalised by other statistics than env's: {other}; {remedy}"
    else:
        return False
    warnings.warn(f"{what} saw {said}", stacklevel=4)
    return True


def rescaled(
    seen: Any, original: Any, before: VecNormalize | None, after: VecNormalize | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """An observation as another VecNormalize shows it, and its original where there is one.

    :param seen: as ``before`` showed it
    :param original: of it, where ``before`` is one
    """
    raw = np.asarray(seen if before is None else original)
    return (raw, None) if after is None else (np.asarray(after.normalize_obs(raw)), raw)


def alike(own: VecNormalize, given: VecNormalize) -> bool:
    """Whether the statistics of two are about the same."""
    ours, theirs = own.obs_rms, given.obs_rms
    assert isinstance(ours, RunningMeanStd)  # observations are flat Boxes, never a Dict
    assert isinstance(theirs, RunningMeanStd)
    if ours.mean.shape != theirs.mean.shape:
        return False
    offset = np.abs(ours.mean - theirs.mean) / np.sqrt(ours.var + 1e-8)
    ratio = (theirs.var + 1e-8) / (ours.var + 1e-8)
    return bool((offset < 1).all() and (np.abs(np.log(ratio)) < np.log(4)).all())


# --- statistics in files ----------------------------------------------------------------------------------------------


def statistics_of(path: str | pathlib.Path) -> pathlib.Path | None:
    """The statistics of VecNormalize that the zoo or SB3's callbacks left with a zip; None where there are none.

    :param path: of the zip
    """
    path = pathlib.Path(path)
    prefix, _, steps = path.stem.removesuffix("_steps").rpartition("_")
    # The zoo's, those of SB3's CheckpointCallback, and those that docs/checkpoints.md saves.
    own = ("vecnormalize.pkl", f"{prefix}_vecnormalize_{steps}_steps.pkl", "statistics.pkl")
    zoo = (file for file in path.parent.glob("*/vecnormalize.pkl") if file.with_name("args.yml").is_file())
    found = (*(path.with_name(name) for name in own), *zoo)
    return next((file for file in found if file.is_file()), None)


def read_statistics(given: VecNormalize | str | pathlib.Path, argument: str = "vec_normalize") -> VecNormalize:
    """The statistics and settings of a VecNormalize, in one that is around no environment.

    :param given: it, untouched, or the file that its ``save()`` wrote (a pickle, as SB3's zips are)
    :param argument: what the user passed it as
    :raises FileNotFoundError: there is no such file
    :raises TypeError: for what is neither
    :raises ValueError: for a file that holds something else
    """
    if isinstance(given, VecNormalize):
        found = object.__new__(VecNormalize)
        around = ("venv", "class_attributes", "returns")  # what SB3 leaves out of its pickles
        found.__setstate__({name: copy.deepcopy(x) for name, x in vars(given).items() if name not in around})
        return found
    if not isinstance(given, str | pathlib.Path):
        raise TypeError(f"{argument} must be a VecNormalize, or the path that its save() wrote, not {given!r}")
    try:
        with open(given, "rb") as file:
            found = pickle.load(file)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{argument}: there is no file {str(given)!r}; check the path") from error
    except Exception as error:  # whatever a pickle of something else raises
        raise ValueError(
            f"{argument} {str(given)!r} cannot be read ({error}); pass what VecNormalize.save() wrote"
        ) from error
    if not isinstance(found, VecNormalize):
        raise ValueError(
            f"{argument} {str(given)!r} holds a {type(found).__name__}; pass what VecNormalize.save() wrote"
        )
    return found


def in_statistics(env: GymEnv, given: VecNormalize | str | pathlib.Path, argument: str = "vec_normalize") -> VecEnv:
    """``env`` in a VecNormalize with given statistics and settings; they go on from there where they are in training.

    :param env: an environment or a VecEnv that normalises nothing
    :param given: as of :func:`read_statistics`
    :param argument: likewise
    :raises ValueError: statistics of other observations
    """
    found, venv = read_statistics(given, argument), SAC._wrap_env(env, verbose=0)
    try:
        found.set_venv(venv)
    except (AssertionError, ValueError) as error:
        raise ValueError(f"{argument}: its statistics are not of env's observations: {error}") from error
    return found


# --- a source model ---------------------------------------------------------------------------------------------------


def saw_normalised(sac: SAC, statistics: VecNormalize | None = None) -> bool | None:
    """Whether a model from a zip has learned from normalised observations; None where the zip does not tell.

    SB3 keeps the last observation there as the policy saw it, and the last original one: of raw observations that is
    the one before.

    :param sac: the model
    :param statistics: which lie beside its zip; it saw what these show, unless the zip tells otherwise
    """
    seen, original = sac._last_obs, sac._last_original_obs
    known = isinstance(seen, np.ndarray) and isinstance(original, np.ndarray) and seen.shape == original.shape
    by_default = None if statistics is None else normalises(statistics)
    if not known:
        return by_default
    assert isinstance(seen, np.ndarray)
    assert isinstance(original, np.ndarray)
    if original.dtype == np.float64:  # VecNormalize shows float32, whatever it is shown
        return seen.dtype == np.float32
    space = sac.observation_space
    if isinstance(space, spaces.Box) and _far_outside(seen, space) and not _far_outside(original, space):
        return True
    if statistics is not None and normalises(statistics):
        off, step = (float(np.abs(x - seen).mean()) for x in (np.asarray(statistics.normalize_obs(original)), original))
        return off <= NEARER * step
    return by_default


def _far_outside(observations: np.ndarray, space: spaces.Box) -> bool:
    """Whether some lie where no raw ones can: farther beyond their bounds than careless bounds are wrong."""
    room = BEYOND * (space.high.astype(float) - space.low)  # infinite where a bound is
    return bool(((observations < space.low - room) | (observations > space.high + room)).any())


def statistics_beside(sac: SAC, path: str | pathlib.Path) -> pathlib.Path | None:
    """The file beside a model's zip that holds the statistics by which it saw observations; None where it saw raw ones.

    :param sac: the model
    :param path: of its zip
    """
    file = statistics_of(path)
    if file is None:
        return None
    statistics = read_statistics(file, BESIDE)
    of_another = statistics.observation_space.shape != sac.observation_space.shape
    return None if of_another or not saw_normalised(sac, statistics) else file


def has_learned_here(sac: SAC) -> bool:
    """Whether a model's own environment is the one that it has learned in; a zip does not hold it."""
    return sac.get_env() is not None and sac._last_obs is not None


def as_learned(
    sac: SAC, source_model: Any, env: GymEnv, given: Statistics, unpickle: bool = True
) -> tuple[GymEnv, VecNormalize | None]:
    """The source as the policy has seen it, and the statistics by which it has, where these are known.

    :param sac: the source model
    :param source_model: it, or the path of its zip, beside which its statistics may lie
    :param env: the source
    :param given: the statistics; False: there are none; None: those beside the zip
    :param unpickle: whether these may be read, as the zip's own pickles were
    :raises ValueError: ``env`` is in another VecNormalize already
    """
    around = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
    if given is False:
        return env, None
    if given is not None:
        statistics = read_statistics(given)
        if around is None:
            return in_statistics(env, given), statistics
        if given is not around and not (around.norm_obs and statistics.norm_obs and alike(statistics, around)):
            raise ValueError(
                "env is in a VecNormalize with other statistics than those of vec_normalize; leave one of them out"
            )
        return env, statistics
    if not unpickle and (unread := statistics_of(source_model)) is not None:
        warnings.warn(
            "statistics by which source_model may have seen observations normalised by VecNormalize lie beside it, "
            f"{str(unread)!r}: that is a pickle, which weights_only=True leaves unread; pass vec_normalize= if you "
            "trust it, or vec_normalize=False",
            stacklevel=3,
        )
        return env, None
    file = None if isinstance(source_model, SAC) else statistics_beside(sac, source_model)
    if file is None:
        return env, None
    statistics = read_statistics(file, BESIDE)
    if around is not None:
        return env, statistics
    warnings.warn(
        f"source_model saw observations normalised by VecNormalize, so env is put into one with the statistics beside "
        f"it, {str(file)!r}; pass vec_normalize={str(file)!r} to say so, or vec_normalize=False where it saw raw ones",
        stacklevel=3,
    )
    return in_statistics(env, statistics, BESIDE), statistics


def check_source_model(sac: SAC, statistics: VecNormalize | None, env: VecNormalize | None) -> bool:
    """Warn where the source model has seen other observations than it will.

    :param sac: the source model
    :param statistics: by which it saw observations, where :func:`as_learned` knows them
    :param env: the source's VecNormalize
    :return: whether the matter is settled, one way or the other; else what the policy earns may tell
    """
    remedy = f"pass {PASS}, or env in one with those statistics"
    if has_learned_here(sac):
        learned = sac.get_vec_normalize_env()
        check_normalisation(normalises(learned), env, "source_model", learned, remedy=remedy)
        return True
    had = saw_normalised(sac, statistics)
    if had is not False and statistics is None and env is not None and env.norm_obs and _is_fresh(env):
        warnings.warn(
            "source_model saw observations that were raw or normalised by other statistics, and env's VecNormalize has "
            f"none yet: the policy will see others; {remedy}, or env without one",
            stacklevel=3,
        )
        return True
    if had is None:
        return False
    return check_normalisation(had, env, "source_model", statistics, remedy=remedy) or not had


def _is_fresh(env: VecNormalize) -> bool:
    """Whether its statistics are those of a reset at most."""
    assert isinstance(env.obs_rms, RunningMeanStd)  # observations are flat Boxes, never a Dict
    return float(env.obs_rms.count) < env.num_envs + 0.5


# --- the target -------------------------------------------------------------------------------------------------------


def sharing(target: VecEnv, source: VecEnv | None) -> VecEnv:
    """The target without a VecNormalize of its own, as users wrap both worlds: it will share the source's statistics.

    Whoever holds that one, to evaluate in say, sees by the source's statistics, too.

    :param target: with all its wrappers
    :param source: None before it is known
    :raises ValueError: a target that is normalised beside a source that is not
    """
    own = unwrap_vec_normalize(target)
    if own is None:
        return target
    statistics = None if source is None else unwrap_vec_normalize(source)
    if source is not None and statistics is None:
        raise ValueError(
            "target_env is in VecNormalize and env is not, but a policy sees both worlds alike; wrap env (the source), "
            "with the statistics that the policy has learned by: the target shares them"
        )
    warnings.warn(
        "target_env is in a VecNormalize of its own: the target shares the statistics and settings of env's instead, "
        "which the source alone changes",
        stacklevel=4,
    )
    if statistics is not None:
        share(own, statistics)
    return _without(target, own)


def share(own: VecNormalize, statistics: VecNormalize) -> None:
    """Let one see by the running statistics and settings of another, which it never changes."""
    own.training = False
    for name in ("norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon"):
        setattr(own, name, getattr(statistics, name))
    if statistics.norm_obs:
        own.obs_rms = statistics.obs_rms
    own.ret_rms = statistics.ret_rms


def share_normalisation(venv: VecEnv, source: VecEnv | None) -> VecEnv:
    """Wrap ``venv`` so that it is normalised by the source's running statistics, which it never updates."""
    statistics = unwrap_vec_normalize(source) if source is not None else None
    if statistics is None:
        return venv
    shared = VecNormalize(venv, training=False, norm_obs=statistics.norm_obs)
    share(shared, statistics)
    return shared


def _without(venv: VecEnv, own: VecNormalize) -> VecEnv:
    """A VecEnv with the same wrappers but for one."""
    if venv is own:
        return own.venv
    assert isinstance(venv, VecEnvWrapper)  # it is one that holds another
    twin = object.__new__(type(venv))
    vars(twin).update(vars(venv))
    twin.venv = _without(venv.venv, own)
    return twin
