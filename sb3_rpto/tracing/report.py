"""What a trace found: verdict, effects, errors before and after, and the corrected model."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_rpto.effects import Declared, Effect, Simulation
from sb3_rpto.tracing.adequacy import Adequacy
from sb3_rpto.tracing.checks import Finding
from sb3_rpto.tracing.evaluate import HorizonError
from sb3_rpto.tracing.measurements import Measurements
from sb3_rpto.tracing.residuals import ForceResidual

if TYPE_CHECKING:
    import gymnasium as gym


@dataclass(frozen=True)
class Traced:
    """An effect with its fitted parameters.

    :param effect: with the values found
    :param interval: 95 % intervals of the parameters by resampling blocks, (2, p)
    :param alike: effects that explain the data as well: together they are its equivalence class
    :param gain: share of the typical window error that it saves
    :param t: of that gain
    :param frequency: share of resampled data in which it is selected
    """

    effect: Effect
    interval: np.ndarray
    alike: list[str]
    gain: float
    t: float
    frequency: float

    @property
    def label(self) -> str:
        """Kind and place."""
        return self.effect.label

    def __str__(self) -> str:
        parts = []
        for p, value, (low, high) in zip(self.effect.parameters, self.effect.values, self.interval.T):
            name = "" if isinstance(self.effect, Declared) else f"{p.name} "
            parts.append(f"{name}{value:.4g} [{low:.4g}, {high:.4g}] {p.unit}".rstrip())
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
    """The outcome of :func:`sb3_rpto.tracing.trace.trace`.

    :param verdict: ``complete``, ``explained``, ``partly explained`` or ``unexplained``
    :param declared: fitted declared parameters
    :param effects: what the model lacks, with values; under ``partly explained`` and ``unexplained`` they lower the
        error and are no explanation
    :param candidates: what became of each candidate
    :param adequacy_before: of the declared model on select windows
    :param adequacy_after: of the corrected model
    :param before: errors on test runs of the fitted declared model, by horizon
    :param after: of the corrected model
    :param floor: of the corrected model on recordings of itself with the estimated noise; empty for exact data
    :param force_before: force residual of the declared model on test runs, N·m or N, (nv,)
    :param force_after: of the corrected model, (nv,)
    :param learnable: share of what is left that a small regressor predicts, (nv,)
    :param findings: all that was found and repaired in the data
    :param noise: of each position column, rad or m
    :param runs: names of the train, select and test runs
    :param threshold: t*
    :param horizon: length of the windows in s
    """

    verdict: str
    declared: list[Traced]
    effects: list[Traced]
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
    noise: dict[str, float]
    runs: dict[str, list[str]]
    threshold: float
    horizon: float
    seed: int
    source: Any
    simulation: Simulation
    values_before: np.ndarray
    values_after: np.ndarray
    data: Measurements
    sigma: np.ndarray

    @property
    def correction(self) -> list[Effect]:
        """Declared parameters and effects with the values found: what the corrected model needs."""
        return [t.effect for t in (*self.declared, *self.effects)]

    def apply(self, env: gym.Env) -> gym.Env:
        """A corrected copy of a gymnasium MuJoCo environment, for RPTO, SAC, anything; ``env`` stays as it is."""
        from sb3_rpto.envs.corrected import apply_effects

        return apply_effects(env, self.correction)

    def __str__(self) -> str:
        joints = self.before[0].joints if self.before else ()
        lines = [f"verdict: {self.verdict}", "", "model", f"  {self.equation()}"]
        lines += [f"  {t}" for t in self.declared]
        if self.effects:
            claim = "lacks" if self.verdict == "explained" else "is closer to the data with"
            lines += ["", f"it {claim}"]
            for t in self.effects:
                alike = f"; the data cannot tell it from {', '.join(t.alike)}" if t.alike else ""
                carried = "in the MJCF" if t.effect.native else "carried by the environment wrapper"
                lines.append(f"  {t}")
                lines.append(
                    f"    saves {t.gain:.0%} of the window error (t = {t.t:.1f}, selected in {t.frequency:.0%} of "
                    f"resamples){alike}; {carried}"
                )
        lines += ["", f"adequacy on select windows: before {self.adequacy_before}, after {self.adequacy_after}"]
        lines += ["", f"error on test runs, RMSE [95 % interval]: {', '.join(joints)}"]
        floors = {f.horizon: f for f in self.floor}
        for before, after in zip(self.before, self.after):
            at = before.horizon if isinstance(before.horizon, str) else f"{before.horizon:g} s"
            for j, joint in enumerate(joints):
                floor = floors.get(before.horizon)
                noise = f", noise floor {floor.rmse[j]:.4g}" if floor is not None else ""
                lines.append(
                    f"  {at:>9}  {joint:<12} {before.rmse[j]:.4g} [{before.low[j]:.4g}, {before.high[j]:.4g}] -> "
                    f"{after.rmse[j]:.4g} [{after.low[j]:.4g}, {after.high[j]:.4g}]{noise}"
                )
        force = [f"{a:.3g} -> {b:.3g}" for a, b in zip(self.force_before, self.force_after)]
        lines += [f"  force residual by inverse dynamics: {', '.join(force)}"]
        share = ", ".join(f"{s:.0%}" for s in self.learnable)
        lines += [f"  a small regressor predicts {share} of what is left of it"]
        idle = [c for c in self.candidates if c.status == "not excited"]
        if idle:
            lines += ["", "not excited by these data"] + [f"  {c.label}: {c.reason}" for c in idle]
        if self.findings:
            lines += ["", "findings"] + [f"  {f}" for f in self.findings]
        return "\n".join(lines)

    def equation(self) -> str:
        """The corrected model in a line."""
        terms = [t.effect.equation if not t.effect.on else f"[{t.effect.on}] {t.effect.equation}" for t in self.effects]
        return " + ".join(["M(q) qdd + c(q, qd) = tau + passive(q, qd)", *terms])

    def to_json(self) -> dict[str, Any]:
        """Everything but the recordings, for ``report.json``."""

        def errors(found: list[HorizonError]) -> list[dict[str, Any]]:
            return [
                {
                    "horizon": e.horizon,
                    "windows": e.windows,
                    "joints": {
                        name: {"rmse": e.rmse[j], "low": e.low[j], "high": e.high[j], "mae": e.mae[j]}
                        for j, name in enumerate(e.joints)
                    },
                }
                for e in found
            ]

        def traced(t: Traced) -> dict[str, Any]:
            return {
                "label": t.label,
                "parameters": {
                    p.name: {"value": v, "low": low, "high": high, "unit": p.unit}
                    for p, v, (low, high) in zip(t.effect.parameters, t.effect.values, t.interval.T)
                },
                "equation": t.effect.equation,
                "alike": t.alike,
                "gain": t.gain,
                "t": t.t,
                "frequency": t.frequency,
                "carried_by": "mjcf" if t.effect.native or isinstance(t.effect, Declared) else "wrapper",
            }

        return {
            "verdict": self.verdict,
            "declared": [traced(t) for t in self.declared],
            "effects": [traced(t) for t in self.effects],
            "candidates": [vars(c) for c in self.candidates],
            "adequacy_before": vars(self.adequacy_before),
            "adequacy_after": vars(self.adequacy_after),
            "before": errors(self.before),
            "after": errors(self.after),
            "floor": errors(self.floor),
            "force_before": self.force_before,
            "force_after": self.force_after,
            "learnable": self.learnable,
            "findings": [vars(f) for f in self.findings],
            "noise": self.noise,
            "runs": self.runs,
            "threshold": self.threshold,
            "horizon": self.horizon,
            "seed": self.seed,
        }

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write ``report.html``, ``report.json`` and the corrected model (``model.xml`` and ``effects.json``).

        :param folder: made if absent; files in it are replaced one by one, each whole
        :return: the folder
        """
        from sb3_rpto.effects.carry import save_corrected
        from sb3_rpto.tracing.html import render

        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        save_corrected(out, self.source, self.correction)
        write_atomically(out / "report.json", json.dumps(self.to_json(), indent=1, default=_plain, allow_nan=True))
        write_atomically(out / "report.html", render(self))
        return out


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def write_atomically(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
