"""What an Optuna search varies: constructor arguments of the algorithms, by the parts that an algorithm has."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.pdml import PDML
from sb3_rpto.baselines.ptp import PTP
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.zoo.settings import ALGORITHMS

if TYPE_CHECKING:
    import optuna

#: What of a sample is an argument of the dynamics' backend.
OF_DYNAMICS = frozenset({"max_steps"})


def suggest(cls: type[TransferAlgorithm], trial: optuna.Trial) -> dict[str, Any]:
    """Draw a point of the search space.

    :param cls: the algorithm
    :param trial: draws it
    :return: by the names of the study's parameters, see :func:`convert`
    """
    params: dict[str, Any] = {}
    if cls is not SLBO:  # whose policy is TRPO's
        params["learning_rate"] = trial.suggest_float("learning_rate", 3e-5, 1e-3, log=True)
        params["gradient_steps"] = trial.suggest_int("gradient_steps", 1, 40, log=True)
        params["real_ratio"] = trial.suggest_categorical("real_ratio", [0.0, 0.05, 0.2, 0.5])
    if not cls.updates_dynamics:
        params["source_steps"] = trial.suggest_int("source_steps", 5, 50, log=True)
        return params
    if cls is SLBO:
        params["iterations"] = trial.suggest_int("iterations", 5, 20)
        params["policy_updates"] = trial.suggest_int("policy_updates", 5, 40, log=True)
        return params
    params["model_train_freq"] = trial.suggest_categorical("model_train_freq", [25, 50, 100, 250, 500])
    params["max_steps"] = trial.suggest_int("max_steps", 10, 1_000, log=True)
    if not issubclass(cls, MBPO):
        params["weighting"] = trial.suggest_categorical("weighting", ["paper", "centred", "value_aware", "none"])
        params["weight_floor"] = trial.suggest_categorical("weight_floor", [0.1, 0.5, 1.0, 2.0])
        params["rollout_start"] = trial.suggest_categorical("rollout_start", ["target", "source", "mix"])
    if issubclass(cls, PTP):
        params["n_candidates"] = trial.suggest_int("n_candidates", 2, 6)
        params["horizon"] = trial.suggest_int("horizon", 1, 8)
    if issubclass(cls, PDML):
        params["block_steps"] = trial.suggest_categorical("block_steps", [50, 100, 250])
        params["newest_share"] = trial.suggest_categorical("newest_share", [0.02, 0.1, 0.3])
    return params


def convert(params: dict[str, Any]) -> dict[str, Any]:
    """Constructor arguments of the algorithm from the parameters of a study."""
    kwargs = {name: value for name, value in params.items() if name not in OF_DYNAMICS}
    if kwargs.get("weighting") == "none":  # a study's categories are kept as text
        kwargs["weighting"] = None
    of_dynamics = {name: params[name] for name in sorted(OF_DYNAMICS & params.keys())}
    return {**kwargs, **({"dynamics_kwargs": of_dynamics} if of_dynamics else {})}


def _sample(
    cls: type[TransferAlgorithm], trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """What the zoo calls; it passes more than we need."""
    return convert(suggest(cls, trial))


#: In the form of ``rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER``; of those that have a policy to judge.
SAMPLERS: dict[str, Callable[..., dict[str, Any]]] = {
    name: partial(_sample, cls) for name, cls in ALGORITHMS.items() if cls.updates_policy
}
