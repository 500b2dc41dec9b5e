"""What of RPTO matters: a fractional factorial design over its choices, strictly matched in all else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_rpto.algorithms import RPTO
from sb3_rpto.baselines.registry import Method, two_worlds

#: The factors and their levels.
FACTORS: dict[str, tuple[str, ...]] = {
    "start": ("target", "source", "mix"),
    "updates": ("1", "5", "20"),
    "weighting": ("paper", "none"),
    "RPO": ("on", "off"),
    "fit every": ("250", "50"),
}


class WithoutRPO(RPTO):
    """RPTO whose actor learns from the critic's batches, as MBPO's does: D_source with ``real_ratio`` of D_target."""

    def sample_batches(self, count: int, batch_size: int) -> Iterator[tuple[ReplayBufferSamples, ReplayBufferSamples]]:
        """The critic's batches, for the actor too."""
        return ((batch, batch) for batch in self.critic_batches(count, batch_size))


#: Methods beside those of the registry.
ABLATED = {"rpto-without-rpo": Method(partial(two_worlds, WithoutRPO))}


@dataclass(frozen=True)
class Cell:
    """A combination of levels, and the method and settings that it means."""

    factors: Mapping[str, str]

    @property
    def label(self) -> str:
        """``mix-u5-paper-rpo-f50``."""
        start, updates, weighting, rpo, fits = (self.factors[name] for name in FACTORS)
        return f"{start}-u{updates}-{weighting}-{'rpo' if rpo == 'on' else 'plain'}-f{fits}"

    @property
    def method(self) -> str:
        """Of the registry or of :data:`ABLATED`."""
        return "rpto" if self.factors["RPO"] == "on" else "rpto-without-rpo"

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of the method; what is not here is the default preset's, but for the share of real data.

        That is MBPO's 5 %: with the preset's 50 % the actor would see states of the target without RPO, too.
        """
        return {
            "dynamics": "ensemble",
            "real_ratio": 0.05,
            "rollout_start": self.factors["start"],
            "gradient_steps": int(self.factors["updates"]),
            "weighting": None if self.factors["weighting"] == "none" else self.factors["weighting"],
            "model_train_freq": int(self.factors["fit every"]),
        }


def cells() -> list[Cell]:
    """24 of the 72 combinations.

    All eight combinations of the factors with two levels, each with three of the nine pairs of start and updates: a
    diagonal, moved on by the number of second levels. So each level of start, and each of updates, is tried once with
    each of the eight combinations. Pairs of start and updates come twice or three times, so these two are nearly, not
    quite, free of one another, and their interaction is not estimated.
    """
    starts, updates, *others = FACTORS.items()
    chosen = []
    for levels in product(*(range(len(names)) for _, names in others)):
        for i, start in enumerate(starts[1]):
            moved = updates[1][(i + sum(levels)) % len(updates[1])]
            rest = {name: names[level] for (name, names), level in zip(others, levels)}
            chosen.append(Cell({starts[0]: start, updates[0]: moved, **rest}))
    return chosen
