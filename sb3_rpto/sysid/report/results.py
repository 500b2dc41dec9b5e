"""What a trace hands over: verdict, effects, errors before and after, and what they were found with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_rpto.effects import Declared, Effect, Parameter, Simulation
from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.selection.adequacy import Adequacy
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError

#: Width of a normal distribution's 95 % interval, in standard deviations.
WIDTH = 3.92


@dataclass(frozen=True)
class StandIn:
    """An effect of the class of one that was named, as it would be in its place.

    :param effect: with the values that it would have
    :param units: of its parameters
    :param others: parameters of declared numbers and other named effects that lie outside their intervals then, and
        read otherwise
    """

    effect: Effect
    units: tuple[str, ...]
    others: dict[str, float]

    def __str__(self) -> str:
        own = zip(self.effect.parameters, self.effect.values, self.units)
        said = ", ".join(f"{p.name} {descriptions.number(value)} {unit}".rstrip() for p, value, unit in own)
        then = ", ".join(f"{name} {descriptions.number(value)}" for name, value in self.others.items())
        return f"{self.effect.label} instead: {said}{f', and then {then}' if then else ''}"


@dataclass(frozen=True)
class Traced:
    """An effect with its fitted parameters.

    :param effect: with the values found
    :param units: of its parameters where it sits
    :param interval: 95 % intervals of the parameters from how blocks scatter, (2, p)
    :param alike: effects that explain the data as well: together they are its equivalence class
    :param gain: share of the typical window error that it saves
    :param t: of that gain
    :param frequency: share of resampled sets of blocks in which that evidence is clear
    :param stand_ins: those of ``alike`` that do as well in the final fit, where all else is explained
    """

    effect: Effect
    units: tuple[str, ...]
    interval: np.ndarray
    alike: list[str]
    gain: float
    t: float
    frequency: float
    stand_ins: list[StandIn] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Kind and place."""
        return self.effect.label

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations that the intervals are worth, (p,); infinite where an interval is unknown."""
        low, high = self.interval
        return np.nan_to_num((high - low) / WIDTH, nan=np.inf)

    def parameters(self) -> Iterator[tuple[Parameter, float, str, float, float]]:
        """Each parameter with its value, unit, and the ends of its interval."""
        yield from zip(self.effect.parameters, self.effect.values, self.units, *self.interval)

    def __str__(self) -> str:
        parts = []
        for p, value, unit, low, high in self.parameters():
            name = "" if isinstance(self.effect, Declared) else f"{p.name} "
            parts.append(f"{name}{value:.4g} {descriptions.interval(low, high)} {unit}".rstrip())
        return f"{self.label} = {', '.join(parts)}"


@dataclass(frozen=True)
class Candidate:
    """What became of one candidate.

    :param label: kind and place
    :param status: ``kept``, ``alike``, ``dropped``, ``not excited`` or ``not needed``
    :param reason: in plain language
    :param sensitivity: influence of a plausible size on all residuals, in units of noise
    :param alike: candidates whose influence is the same
    """

    label: str
    status: str
    reason: str
    sensitivity: float
    alike: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Results:
    """What :func:`sb3_rpto.sysid.trace.trace` found, as numbers.

    :param verdict: ``complete``, ``explained``, ``partly explained`` or ``unexplained``
    :param declared: fitted declared parameters, and the effects that were known beforehand, fitted
    :param effects: what the model lacks, with values; under ``partly explained`` and ``unexplained`` they lower the
        error and are no explanation
    :param correlation: of the parameters of ``declared``, then ``effects``, (p, p): how their errors go together
    :param candidates: what became of each candidate
    :param adequacy_before: of the declared model on select windows
    :param adequacy_after: of the corrected model
    :param before: errors on test runs of the fitted declared model, by horizon
    :param after: of the corrected model
    :param floor: of the corrected model on recordings of itself with the noise of the data; empty for exact data
    :param force_before: force residual of the declared model on test runs, N·m or N, (nv,)
    :param force_after: of the corrected model, (nv,)
    :param learnable: share of what is left that a small regressor predicts, (nv,); NaN where only rounding is left
    :param residuals_before: the force residuals themselves, an item for each run that is long enough
    :param residuals_after: of the corrected model
    :param findings: all that was found and repaired in the data, what several runs have in common once
    :param zeros: encoder zeros that differ by run; None where none clearly do
    :param noise: of each position column, rad or m
    :param runs: names of the train, select and test runs
    :param judged_apart: whether adequacy is that on select runs; else on the training runs, which were fitted
    :param threshold: t*
    :param horizon: length of the windows in s
    :param seed: of the trace
    :param source: the model as it was given
    :param file: the MJCF file that it came from, if any
    :param simulation: the model with all effects, those of no strength among them
    :param values_before: its parameters with the declared model fitted, (p,)
    :param values_after: with the corrected one, (p,)
    :param data: the test runs, or the fitted ones where there are none
    :param sigma: noise of each position column, rad or m, (m,)
    """

    verdict: str
    declared: list[Traced]
    effects: list[Traced]
    correlation: np.ndarray
    candidates: list[Candidate]
    adequacy_before: Adequacy
    adequacy_after: Adequacy
    before: list[HorizonError]
    after: list[HorizonError]
    floor: list[HorizonError]
    force_before: np.ndarray
    force_after: np.ndarray
    learnable: np.ndarray
    residuals_before: list[ForceResidual]
    residuals_after: list[ForceResidual]
    findings: list[Finding]
    zeros: EncoderOffsets | None
    noise: dict[str, float]
    runs: dict[str, list[str]]
    judged_apart: bool
    threshold: float
    horizon: float
    seed: int
    source: Any
    file: Path | None
    simulation: Simulation
    values_before: np.ndarray
    values_after: np.ndarray
    data: Measurements
    sigma: np.ndarray

    def __getstate__(self) -> dict[str, Any]:
        spec = self.source[0] if isinstance(self.source, tuple) else None
        # A specification does not pickle; its text does, with the numbers that the model had.
        return {**vars(self), "source": self.source if spec is None else PlainModel.of(*self.source)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        source = state["source"]
        if isinstance(source, PlainModel):
            source = mujoco.MjSpec.from_string(source.text, assets=source.assets), source.compile()
        vars(self).update({**state, "source": source})

    @property
    def correction(self) -> list[Effect]:
        """Declared parameters and effects with the values found: what the corrected model needs.

        A known effect that turned out to do nothing is left out.
        """
        found = [t.effect for t in (*self.declared, *self.effects)]
        return [effect for effect in found if isinstance(effect, Declared) or not effect.does_nothing]

    @property
    def covariance(self) -> np.ndarray:
        """Of the parameters of ``declared``, then ``effects``, (p, p), for draws of phi around what was found.

        Where an interval is unknown the variance is infinite, and the rest of its row zero.
        """
        spread = np.concatenate([*(t.deviation for t in (*self.declared, *self.effects)), np.zeros(0)])
        known = np.isfinite(spread)
        finite = np.where(known, spread, 0.0)
        return self.correlation * np.outer(finite, finite) + np.diag(np.where(known, 0.0, np.inf))

    def equation(self) -> str:
        """The corrected model in a line, with the values found, those of known effects among them."""
        return descriptions.equation([effect for effect in self.correction if not isinstance(effect, Declared)])
