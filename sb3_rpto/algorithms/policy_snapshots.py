"""Never worse than you came: policies to go back to."""

from __future__ import annotations

from collections import UserDict
from typing import Any, Literal

import numpy as np
import torch as th
from stable_baselines3.sac.policies import SACPolicy


class PolicySnapshots(UserDict[str, dict[str, Any]]):
    """Policies by name: actor, critics and temperature, on the CPU.

    There is "source" (as it came), "best" (highest return in the target), and where the loop is closed "simulator"
    (highest return in the fitted simulator) and "learner" (goes on learning while that one acts).
    """

    def __init__(self) -> None:
        super().__init__()
        #: return of "best" in the target
        self.best_mean_reward = -np.inf
        #: how it was measured: by recent training episodes, or by an evaluation (``callbacks.KeepBest``)
        self.best_by: Literal["training", "evaluation"] = "training"

    def take(self, name: str, policy: SACPolicy, temperature: th.Tensor) -> None:
        """Keep a policy.

        :param name: to keep it under
        :param policy: actor and critics
        :param temperature: SAC's entropy coefficient
        """
        state = {key: value.detach().cpu().clone() for key, value in policy.state_dict().items()}
        self[name] = {"policy": state, "temperature": float(temperature)}

    def put_back(self, name: str, policy: SACPolicy, log_ent_coef: th.Tensor | None) -> None:
        """Go back to a policy that was kept.

        :param name: of it
        :param policy: that gets its parameters
        :param log_ent_coef: the logarithm of SAC's entropy coefficient, where it is learned
        :raises ValueError: when there is no such policy yet
        """
        if name not in self:
            until = '; "simulator" is kept once a trace is complete or explained' if name == "simulator" else ""
            raise ValueError(f"no policy {name!r} to roll back to; there is {sorted(self) or 'none yet'}{until}")
        snapshot = self[name]
        self.pop("learner", None)  # what goes on learning is this one
        policy.load_state_dict(snapshot["policy"])
        if log_ent_coef is not None:
            log_ent_coef.data.fill_(float(np.log(snapshot["temperature"])))

    def is_best(self, mean_reward: float) -> bool:
        """Whether a policy earned more in the target than any before, which is noted."""
        if mean_reward <= self.best_mean_reward:
            return False
        self.best_mean_reward = mean_reward
        return True

    def forget_best(self) -> None:
        """Begin anew to look for the best policy, in the target and in the simulator that is fitted to it."""
        self.best_mean_reward = -np.inf
        for name in ("best", "simulator", "learner"):
            self.pop(name, None)
