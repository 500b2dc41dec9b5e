"""What a trace found: verdict, effects, errors before and after, and the corrected model."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sb3_rpto.effects import Declared, Effect, Simulation
from sb3_rpto.effects.corrected_model_io import carried_by, check_free, corrected_files, write_files
from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.files import json_text, plain
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding
from sb3_rpto.sysid.hypotheses.encoder_offsets import Zeros, zeros_of
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.selection.adequacy import Adequacy
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError
from sb3_rpto.version import __version__

if TYPE_CHECKING:
    import gymnasium as gym

#: Of ``report.json``.
FORMAT = 1
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

    def __str__(self) -> str:
        parts = []
        for p, value, unit, (low, high) in zip(self.effect.parameters, self.effect.values, self.units, self.interval.T):
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
class Report:
    """The outcome of :func:`sb3_rpto.sysid.trace.trace`.

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
    zeros: Zeros | None
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

    def apply(self, env: gym.Env) -> gym.Env:
        """A corrected copy of a gymnasium MuJoCo environment, for RPTO, SAC, anything; ``env`` stays as it is.

        Effects come on top of those that it has: one that was corrected already is corrected twice.
        """
        from sb3_rpto.envs.corrected import apply_effects

        return apply_effects(env, self.correction)

    def zeros_of(self, data: Measurements) -> Zeros:
        """The zeros of other runs' encoders by the corrected model: ``report.zeros_of(new).taken_off(new)`` is homed.

        :param data: recordings of the machine, columns in the order of those traced
        :raises ValueError: no encoder has a zero that differs by run; a run has no episode as long as a window
        """
        if self.zeros is None:
            raise ValueError("no encoder's zero was found to differ by run; predict the runs as they are")
        # A joint that was at rest in the recordings says as little here.
        data = replace(data, unobserved=tuple(dict.fromkeys((*data.unobserved, *self.data.unobserved))))
        return zeros_of(self.simulation, self.values_after, data, self.sigma, self.horizon, self.zeros.joints)

    def __str__(self) -> str:
        means, _ = descriptions.verdict(self.verdict, searched=bool(self.candidates))
        said = [f"  {sentence}" for sentence in (means, *descriptions.rest(self.adequacy_after))]
        lines = [f"verdict: {self.verdict}", *said, "", "model", f"  {self.equation()}"]
        for what, is_number in (("declared parameters", True), ("known effects", False)):
            given = [t for t in self.declared if isinstance(t.effect, Declared) == is_number]
            if given:
                lines += ["", f"{what}, fitted [95 % interval]", *descriptions.aligned(self._values(given))]
        if self.effects:
            claim = "it lacks" if self.verdict == "explained" else "closer to the data with, but not explained by"
            lines += ["", claim, *descriptions.aligned(self._values(self.effects)), *self._evidence()]
        if self.zeros is not None:
            lines += [
                "",
                "encoder zeros that differ by run, rad or m: spread, and each",
                *descriptions.aligned(self.zeros.rows()),
            ]
        apart = "on select windows" if self.judged_apart else f"on fitted windows, {descriptions.not_apart(self.runs)}"
        lines += ["", f"adequacy R: error over that of noise alone, {apart}; 1 where nothing is missing"]
        lines += [f"  before {self.adequacy_before}, after {self.adequacy_after}"]
        tested = "test runs" if self.runs["test"] else "the fitted runs, as there are no test runs"
        lines += ["", f"error on {tested}: RMSE [95 % interval, of whole runs their range]"]
        lines += descriptions.aligned(self._errors())
        if self.residuals_before and descriptions.scalar_dofs(self.simulation.model):
            by = descriptions.means(self.data)
            lines += ["", f"missing force {by}, RMS; share of the rest that a small regressor predicts"]
            lines += descriptions.aligned(self._forces())
        idle = [[c.label, c.reason] for c in self.candidates if c.status == "not excited"]
        if idle:
            lines += ["", "not excited by these data", *descriptions.aligned(idle)]
        if self.findings:
            lines += ["", "findings", *(f"  {f}" for f in self.findings)]
        return "\n".join(lines)

    def _values(self, found: list[Traced]) -> list[list[str]]:
        """A row for each parameter: place, name, value, interval, unit."""
        rows = []
        for t in found:
            label = t.label
            for p, value, unit, (low, high) in zip(t.effect.parameters, t.effect.values, t.units, t.interval.T):
                name = "" if isinstance(t.effect, Declared) else p.name
                rows.append([label, name, descriptions.number(value), descriptions.interval(low, high), unit])
                label = ""
        return rows

    def _evidence(self) -> list[str]:
        lines = []
        for t in self.effects:
            where = "in model.xml" if carried_by(t.effect) == "mjcf" else "in effects.json, by the environment wrapper"
            lines.append(
                f"  {t.label}: saves {descriptions.percent(t.gain)} of the window error (t = {t.t:.1f}, needed "
                f"{self.threshold:.1f}), clear in {descriptions.percent(t.frequency)} of resamples; carried {where}"
            )
            if t.alike:
                lines.append(f"    the data cannot tell it from {', '.join(t.alike)}")
            lines += [f"      {one}" for one in t.stand_ins]
        return lines

    def _errors(self) -> list[list[str]]:
        """A row for each horizon and joint."""
        floors = {f.horizon: f for f in self.floor}
        rows = [["", "", "", "before", "", "after", "", "noise floor"]]
        for before, after in zip(self.before, self.after):
            at = before.horizon if isinstance(before.horizon, str) else f"{before.horizon:g} s"
            for j, joint in enumerate(before.joints):
                cells = [at if j == 0 else "", joint, descriptions.position_unit(self.simulation.model, joint)]
                for e in (before, after):
                    cells += [descriptions.number(e.rmse[j]), descriptions.interval(e.low[j], e.high[j], 3)]
                floor = floors.get(before.horizon)
                rows.append([*cells, "" if floor is None else descriptions.number(floor.rmse[j])])
        return rows

    def _forces(self) -> list[list[str]]:
        """A row for each hinge and slide."""
        model = self.simulation.model
        rows = [["", "", "before", "after", "learnable"]]
        for d in descriptions.scalar_dofs(model):
            sizes = [descriptions.number(f[d], 3) for f in (self.force_before, self.force_after)]
            unit = descriptions.force_unit(model, d)
            rows.append([descriptions.dof_name(model, d), unit, *sizes, descriptions.percent(self.learnable[d])])
        return rows

    def equation(self) -> str:
        """The corrected model in a line, with the values found, those of known effects among them."""
        return descriptions.equation([effect for effect in self.correction if not isinstance(effect, Declared)])

    def to_json(self) -> dict[str, Any]:
        """Everything but the recordings, for ``report.json``, in Python's own types; None for what is not finite."""

        model = self.simulation.model

        def errors(found: list[HorizonError]) -> list[dict[str, Any]]:
            return [
                {
                    "horizon": e.horizon,
                    "windows": e.windows,
                    "joints": {
                        name: {
                            "rmse": e.rmse[j],
                            "low": e.low[j],
                            "high": e.high[j],
                            "mae": e.mae[j],
                            "unit": descriptions.position_unit(model, name),
                        }
                        for j, name in enumerate(e.joints)
                    },
                }
                for e in found
            ]

        def traced(t: Traced) -> dict[str, Any]:
            evidence = {} if isinstance(t.effect, Declared) else {"gain": t.gain, "t": t.t, "frequency": t.frequency}
            return {
                "label": t.label,
                "parameters": {
                    p.name: {"value": v, "low": low, "high": high, "unit": unit}
                    for p, v, unit, (low, high) in zip(t.effect.parameters, t.effect.values, t.units, t.interval.T)
                },
                "equation": t.effect.equation,
                "alike": t.alike,
                "instead": [
                    {"label": one.effect.label, "parameters": one.effect.to_json()["values"], "others": one.others}
                    for one in t.stand_ins
                ],
                **evidence,
                "carried_by": carried_by(t.effect),
            }

        def forces(values: np.ndarray) -> dict[str, float]:
            return {descriptions.dof_name(model, d): values[d] for d in descriptions.scalar_dofs(model)}

        found = {
            "format": FORMAT,
            "version": __version__,
            "verdict": self.verdict,
            "equation": self.equation(),
            "declared": [traced(t) for t in self.declared],
            "effects": [traced(t) for t in self.effects],
            "correlation": self.correlation,
            "candidates": [vars(c) for c in self.candidates],
            "adequacy_before": vars(self.adequacy_before),
            "adequacy_after": vars(self.adequacy_after),
            "before": errors(self.before),
            "after": errors(self.after),
            "floor": errors(self.floor),
            "force_before": forces(self.force_before),
            "force_after": forces(self.force_after),
            "learnable": forces(self.learnable),
            "findings": [
                {"kind": f.kind, "where": f.where, "message": f.message, "runs": [*f.runs]} for f in self.findings
            ],
            "zeros": self.zeros and self.zeros.to_json(),
            "noise": self.noise,
            "runs": self.runs,
            "judged_apart": self.judged_apart,
            "threshold": self.threshold,
            "horizon": self.horizon,
            "seed": self.seed,
        }
        strict: dict[str, Any] = plain(found)
        return strict

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write ``report.html``, ``report.json`` and the corrected model (``model.xml`` and ``effects.json``).

        :param folder: made if absent; files in it are replaced together, once all are written
        :return: the folder
        :raises ImportError: matplotlib is not installed; nothing is written then
        :raises ValueError: the model came as an ``MjModel``, whose MJCF nothing tells; nothing is written then. Where
            the model cannot be written for another reason, the report is: where ``folder`` is the nominal model's, say
        """
        from sb3_rpto.sysid.report.html import render

        out = Path(folder)
        # Rendered before anything is written: what fails there leaves the folder as it was.
        page, data = render(self), json_text(self.to_json())
        files = {"report.json": f"{data}\n".encode(), "report.html": page.encode()}
        try:
            check_free(out, self.file)
            files = {**corrected_files(out, self.source, self.correction), **files}
        finally:
            # After a long trace, a file that is missing must not lose what was found.
            if not isinstance(self.source, mujoco.MjModel):
                write_files(out, files)
        return out
