"""RTO: the fit of phi to D_target, and whose rules of the task phi knows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cloudpickle
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.base import Dynamics, Transitions
from sb3_rpto.dynamics.weights import effective_sample_size
from sb3_rpto.envs.task_rules import task_rules

#: What is known of a task: entries of ``dynamics_kwargs`` and attributes of the dynamics.
RULES = ("reward_fn", "termination_fn")


def fit(dynamics: Dynamics, data: Transitions, weights: th.Tensor | None, logger: Logger) -> None:
    """Move phi towards D_target by the weighted loss, and log what comes of it."""
    if weights is not None:
        logger.record("rto/effective_samples", effective_sample_size(weights))
    for name, value in dynamics.fit(data, weights).items():
        logger.record(f"dynamics/{name}", value)


# --- rules of the task ------------------------------------------------------------------------------------------------


class RuleOfEnvironment:
    """Stands in a checkpoint for a rule that belongs to an environment which does not pickle.

    :param name: of the rule
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, *args: Any) -> Any:
        """Say what is missing.

        :raises RuntimeError: always
        """
        raise RuntimeError(f"{self.name} belongs to an environment; pass env= and target_env= to load()")


def adopt_rules(
    dynamics: Dynamics | None, config: dict[str, Any], given: Mapping[str, Any], target_env: VecEnv
) -> None:
    """Let phi know the target's rules: Hopper's healthy heights follow its body, say.

    Rules that the user passed stay, and so does a rule that the target does not tell.

    :param dynamics: P_phi
    :param config: what a checkpoint rebuilds it from
    :param given: the user's ``dynamics_kwargs``
    :param target_env: the target
    """
    rules = task_rules(target_env)
    for name in RULES:
        rule = getattr(rules, name)
        if rule is not None and name not in given and config[name] is not None:
            config[name] = rule
            setattr(dynamics, name, rule)


def bind_rules(dynamics: Dynamics | None, config: dict[str, Any], env: VecEnv) -> None:
    """Give a loaded model the rules that its checkpoint could not hold.

    :param config: what it was rebuilt from
    :param env: the world that they belong to
    """
    missing = [name for name in RULES if isinstance(config.get(name), RuleOfEnvironment)]
    rules = task_rules(env) if missing else None
    for name in missing:
        config[name] = getattr(rules, name) or config[name]
        setattr(dynamics, name, config[name])


def picklable(config: dict[str, Any] | None) -> dict[str, Any] | None:
    """A config of the dynamics without rules whose environment does not pickle; these are read again after loading."""
    if config is None:
        return None
    found = dict(config)
    for name in set(RULES) & set(config):
        try:
            cloudpickle.dumps(config[name])
        except Exception:  # whatever an environment's own pickling raises
            found[name] = RuleOfEnvironment(name)
    return found
