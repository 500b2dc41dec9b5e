"""The policy of any zip of ours or SB3's, whichever algorithm saved it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_rpto.algorithms import zips
from sb3_rpto.algorithms.slbo import SLBO


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


def load_policy(path: str | Path, argument: str) -> Policy:
    """Build the policy alone: no environment, buffers or model of the source are needed.

    :param path: of the zip
    :param argument: what the user passed it as
    :raises ValueError: for a file that is no model of SB3's
    """
    zips.look_into(path, argument)
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


def check_raw(path: str | Path, instead: str) -> None:
    """Refuse an agent that saw normalised observations, as far as the files beside its zip tell.

    :param path: of the zip
    :param instead: what to use for such an agent
    :raises ValueError: naming the statistics
    """
    statistics = statistics_of(path)
    if statistics is not None:
        raise ValueError(
            f"ZIP {str(path)!r} saw observations normalised by {statistics}, which this command cannot: use {instead}"
        )


def statistics_of(path: str | Path) -> Path | None:
    """The statistics of VecNormalize that the zoo or SB3's callbacks left with a zip; None where there are none.

    :param path: of the zip
    """
    path = Path(path)
    prefix, _, steps = path.stem.removesuffix("_steps").rpartition("_")
    # The zoo's, those of SB3's CheckpointCallback, and those that docs/checkpoints.md saves.
    own = ("vecnormalize.pkl", f"{prefix}_vecnormalize_{steps}_steps.pkl", "statistics.pkl")
    zoo = (file for file in path.parent.glob("*/vecnormalize.pkl") if file.with_name("args.yml").is_file())
    found = (*(path.with_name(name) for name in own), *zoo)
    return next((file for file in found if file.is_file()), None)
