"""Never worse than you came: policies to go back to."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from sb3_rpto.algorithms.update import RelativeUpdate


class PolicySnapshots(RelativeUpdate):
    """Keeps the policy that came from the source and the best one seen in the target."""

    #: by name: "source" (as it came), "best" (highest return in the target), "simulator" (in the fitted simulator),
    #: "learner" (goes on learning while that one acts)
    snapshots: dict[str, dict[str, Any]]
    best_mean_reward: float
    #: what ``best_mean_reward`` is: the mean of recent training episodes, or an evaluation (``callbacks.KeepBest``)
    best_by: Literal["training", "evaluation"] = "training"

    def keep_if_best(self, mean_reward: float) -> bool:
        """Keep the current policy as "best" if it earned more than any before.

        :param mean_reward: its return in the target, however it was measured
        :return: whether it was kept
        """
        if mean_reward <= self.best_mean_reward:
            return False
        self.best_mean_reward = mean_reward
        self.take_snapshot("best")
        return True

    def forget_best(self) -> None:
        """Begin anew to look for the best policy, in the target and in the simulator that is fitted to it."""
        self.best_mean_reward = -np.inf
        self.snapshots.pop("best", None)
        self.snapshots.pop("simulator", None)
        self.snapshots.pop("learner", None)

    def rollback(self, to: str = "best") -> None:
        """Go back to a policy that was kept; a VecNormalize keeps the statistics that it has now.

        :param to: "best" (in the target), "source" (as it came) or, where a trace accounts for the target,
            "simulator" (the best in the fitted one); restores actor, critics and temperature
        :raises ValueError: when there is no such policy yet
        """
        if to not in self.snapshots:
            until = '; "simulator" is kept once a trace is complete or explained' if to == "simulator" else ""
            raise ValueError(
                f"no policy {to!r} to roll back to; there is {sorted(self.snapshots) or 'none yet'}{until}"
            )
        snapshot = self.snapshots[to]
        self.snapshots.pop("learner", None)  # what goes on learning is this one
        self.policy.load_state_dict(snapshot["policy"])
        if self.log_ent_coef is not None:
            self.log_ent_coef.data.fill_(float(np.log(snapshot["temperature"])))

    def take_snapshot(self, name: str) -> None:
        """Keep actor, critics and temperature under ``name``, on the CPU."""
        state = {key: value.detach().cpu().clone() for key, value in self.policy.state_dict().items()}
        self.snapshots[name] = {"policy": state, "temperature": float(self.temperature())}
