"""The policy of any zip of ours or SB3's, whichever algorithm saved it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rpto.algorithms import model_zip
from sb3_rpto.algorithms.normalisation import in_statistics, read_statistics, statistics_beside
from sb3_rpto.algorithms.warm_start import load_sac
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.commands import options
from sb3_rpto.files import write_atomically

#: The file that commands leave beside a zip, as the zoo does.
STATISTICS = "vecnormalize.pkl"


class Policy(Protocol):
    """What acts: a policy or an algorithm of SB3."""

    @property
    def observation_space(self) -> spaces.Space:
        """What it sees."""
        ...

    @property
    def action_space(self) -> spaces.Space:
        """What it does."""
        ...

    def predict(self, observation: Any, state: Any = None, *, deterministic: bool = False) -> tuple[np.ndarray, Any]:
        """The action for an observation, and the state of a recurrent policy after it."""
        ...


class NormalisedPolicy:
    """A policy that sees observations by the statistics of a VecNormalize.

    :param policy: that acts
    :param statistics: by which it has learned
    """

    def __init__(self, policy: Policy, statistics: VecNormalize) -> None:
        self.policy, self.statistics = policy, statistics
        self.observation_space, self.action_space = policy.observation_space, policy.action_space

    def predict(self, observation: Any, state: Any = None, *, deterministic: bool = False) -> tuple[np.ndarray, Any]:
        """The action for a raw observation; see :class:`Policy`."""
        raw = observation if isinstance(observation, dict) else np.asarray(observation)
        return self.policy.predict(self.statistics.normalize_obs(raw), state, deterministic=deterministic)


def load_policy(path: str | Path, argument: str, statistics: str | Path | None = None) -> Policy:
    """Build the policy alone: no environment, buffers or model of the source are needed.

    :param path: of the zip
    :param argument: what the user passed it as
    :param statistics: file of those by which it sees observations; None: it sees raw ones
    :raises ValueError: for a file that is no model of SB3's, or holds no statistics of its observations
    """
    policy = _load(path, argument)
    if statistics is None:
        return policy
    found = read_statistics(statistics, options.STATISTICS)
    if found.observation_space.shape != policy.observation_space.shape:
        raise ValueError(
            f"{options.STATISTICS} {str(statistics)!r} is of observations {found.observation_space}, {argument} has "
            f"{policy.observation_space}; name the file that was saved with it"
        )
    return NormalisedPolicy(policy, found)


def _load(path: str | Path, argument: str) -> Policy:
    model_zip.look_into(path, argument)
    constant = {"lr_schedule": lambda _: 0.0, "learning_rate": 0.0}
    data, parameters, _ = load_from_zip_file(path, device="cpu", custom_objects=constant)
    assert data is not None  # it was looked into
    if "trpo.policy" in parameters:  # SLBO acts by TRPO's policy, beside which it keeps SAC's
        return SLBO.load(path, device="cpu")
    kwargs = dict(data.get("policy_kwargs", {}))
    if data.get("use_sde"):  # PPO and A2C hand it over beside the others
        kwargs["use_sde"] = True
    policy = data["policy_class"](data["observation_space"], data["action_space"], lambda _: 0.0, **kwargs)
    policy.load_state_dict(parameters["policy"])
    policy.set_training_mode(False)
    return policy


def statistics_named(given: str | None) -> str | Literal[False] | None:
    """What the option says: a file, False for 'none', or None where nothing is said.

    :raises FileNotFoundError: there is no such file
    :raises ValueError: it holds no statistics
    """
    if given is None:
        return None
    if given.lower() == "none":
        return False
    options.check_file(given, options.STATISTICS)
    read_statistics(given, options.STATISTICS)
    return given


def statistics_of_source(path: str, given: str | None) -> str | Literal[False] | None:
    """The statistics by which a source agent saw observations: those named, else those beside its zip.

    :param path: of the zip of a SAC
    :param given: what the option says
    :return: False: 'none' was said; None: there are none
    """
    named = statistics_named(given)
    if named is not None:
        return named
    found = statistics_beside(load_sac(path, "cpu"), path)
    return None if found is None else str(found)


def say_statistics(argument: str, statistics: str | Path | Literal[False] | None) -> None:
    """Say by what an agent sees, where it is not what the world shows."""
    if statistics:
        print(f"sb3-rpto: {argument} sees observations normalised by {statistics}", file=sys.stderr)


def save_statistics(folder: Path, model: Any) -> None:
    """Leave the statistics by which a model sees observations in a folder, where it does, for its zip.

    :param folder: in which the zip is
    :param model: of SB3's or ours
    """
    normaliser = model.get_vec_normalize_env()
    if normaliser is not None:
        write_atomically(folder / STATISTICS, lambda file: normaliser.save(str(file)), suffix="pkl")


def in_saved(env: GymEnv, folder: Path) -> GymEnv:
    """``env`` in the statistics that :func:`save_statistics` left in a folder, where there are some."""
    file = folder / STATISTICS
    return in_statistics(env, file, str(file)) if file.is_file() else env
