"""One run: a method moves a source policy to a target; its learning curve comes back as rows."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.baselines.registry import REGISTRY, Run
from sb3_rpto.evaluation.learning_curve import LearningCurve, MakeEnv

METHODS = tuple(REGISTRY)


def transfer(
    method: str,
    source_model: str,
    make_source: MakeEnv,
    make_target: MakeEnv,
    budget: int,
    *,
    every: int | Collection[int],
    seed: int = 0,
    n_episodes: int = 10,
    n_source_envs: int = 1,
    source_data: str | None = None,
    read: Callable[[Any], dict[str, Any]] | None = None,
    before_learning: Callable[[TransferAlgorithm], None] = lambda model: None,
    **kwargs: Any,
) -> list[dict[str, Any]]:
    """Run one method once.

    :param method: one of :data:`METHODS`
    :param source_model: zip of the SAC that was trained in the source
    :param make_source: makes the source environment
    :param make_target: makes the target
    :param budget: target steps
    :param every: target steps between evaluations, or the steps at which they are made
    :param seed: of the run
    :param n_episodes: episodes of an evaluation
    :param n_source_envs: source environments that step side by side
    :param source_data: transitions of the source, for the methods that use some (phi_0, cloning, mixed batches)
    :param read: further values of a row
    :param before_learning: is given an algorithm of ours as it was constructed
    :param kwargs: arguments of the method: of its constructor, or see :mod:`~sb3_rpto.baselines.registry`
    :return: one row an evaluation: method, seed, steps, return, updates, source_steps, seconds
    """
    if method not in METHODS:
        raise ValueError(f"method={method!r} does not exist; choose one of {METHODS}")
    chosen = REGISTRY[method]
    curve = LearningCurve(make_target, every, n_episodes, seed, read, after_update=chosen.in_batches)
    worlds = make_source, make_target
    given = Run(
        source_model, *worlds, budget, seed, n_source_envs, source_data, kwargs, before_learning=before_learning
    )
    chosen.run(given, curve)
    curve.env.close()
    return [{"method": method, "seed": seed, **row} for row in curve.rows]
