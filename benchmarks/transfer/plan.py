"""What a suite of transfers is, and the order of its runs."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variant:
    """A method with its settings, as a line of the tables.

    :param label: its name there
    :param method: of the registry, or of :data:`~benchmarks.transfer.ablation.ABLATED`
    :param settings: arguments of the method
    :param seeds: how many
    :param seconds: expected of a run on one core, from the start of phi_0's fit to the last evaluation
    :param factors: level of each factor of a factorial design
    """

    label: str
    method: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seeds: int = 3
    seconds: float = 60.0
    factors: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Place:
    """A source, its targets, and what is compared there.

    :param task: one of :data:`~sb3_rpto.envs.tasks.TASKS`
    :param targets: names of its shifts
    :param variants: what is compared
    :param points: target steps at which policies are evaluated, beside 0; the last is the budget
    :param agent: name of the source agent's files, see :func:`~benchmarks.transfer.sources.source_agent`
    :param source_steps: of its training, where none is found
    :param source_settings: arguments of SAC in that training
    :param oracle_steps: target steps of the oracle
    """

    task: str
    targets: tuple[str, ...]
    variants: tuple[Variant, ...]
    points: tuple[int, ...]
    agent: str
    source_steps: int
    source_settings: Mapping[str, Any] = field(default_factory=dict)
    oracle_steps: int = 100_000


@dataclass(frozen=True)
class Suite:
    """A benchmark.

    :param name: of the command line
    :param about: in a line
    :param places: where
    :param episodes: of an evaluation
    :param interactions: pairs of factors whose levels are shown together
    """

    name: str
    about: str
    places: tuple[Place, ...]
    episodes: int = 10
    interactions: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Job:
    """One run; all that decides its result, but for the source agent."""

    task: str
    target: str
    label: str
    seed: int
    method: str
    settings: Mapping[str, Any]
    points: tuple[int, ...]
    episodes: int
    seconds: float
    factors: Mapping[str, str]

    @property
    def name(self) -> str:
        """Of its result file."""
        return f"{self.task}_{self.target}_{self.label}_{self.seed}"

    def to_json(self) -> dict[str, Any]:
        """What a result must agree with to be this run's, as JSON gives it back; the expected cost is no part of it."""
        values = asdict(self)
        del values["seconds"]
        return json.loads(json.dumps(values))


def variant_of(job: Mapping[str, Any]) -> dict[str, Any]:
    """What all runs of a line of the tables agree in, of a job as :meth:`Job.to_json` gives it."""
    return {name: value for name, value in job.items() if name not in ("target", "seed")}


def jobs(suite: Suite, seeds: int | None = None) -> list[Job]:
    """All runs, in an order in which an unfinished suite is a fair sample.

    A block is one seed of all variants on one target. Blocks follow one another seed by seed, within a seed target by
    target, tasks and variants in mixed order; so any two variants have, on each target, as many runs (give or take
    one, and as far as both have as many seeds), and any two tasks as many blocks.

    :param suite: which
    :param seeds: how many of each variant; None: the suite's numbers
    :raises ValueError: less than one seed
    """
    if seeds is not None and seeds < 1:
        raise ValueError(f"seeds is {seeds}; give 1 or more, or nothing for the suite's numbers")
    rng, listed = random.Random(0), []
    most = seeds or max(variant.seeds for place in suite.places for variant in place.variants)
    for seed in range(most):
        for turn in range(max(len(place.targets) for place in suite.places)):
            for place in _mixed([p for p in suite.places if turn < len(p.targets)], rng):
                due = [variant for variant in place.variants if seed < (seeds or variant.seeds)]
                listed += [_job(suite, place, place.targets[turn], variant, seed) for variant in _mixed(due, rng)]
    return listed


def _mixed(items: Sequence[Any], rng: random.Random) -> list[Any]:
    return rng.sample(items, len(items))


def _job(suite: Suite, place: Place, target: str, variant: Variant, seed: int) -> Job:
    values = {name: getattr(variant, name) for name in ("label", "method", "settings", "seconds", "factors")}
    return Job(place.task, target, seed=seed, points=place.points, episodes=suite.episodes, **values)


def listing(listed: Sequence[Job], workers: int) -> str:
    """Names and expected minutes of runs, in their order, and of all together."""
    minutes = sum(job.seconds for job in listed) / 60
    lines = [f"{job.name}  {job.seconds / 60:.1f} min" for job in listed]
    together = (
        f"{len(listed)} runs, about {minutes / 60:.1f} core hours: {minutes / workers:.0f} min on {workers} cores"
    )
    return "\n".join([*lines, f"{together}, without source agents and oracles"])
