"""The report of a trace: its text, its page, its JSON, and the corrected model."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects import Declared
from sb3_rpto.effects.corrected_model_io import carried_by, check_free, corrected_files, write_files
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.files import json_text, plain
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.hypotheses.encoder_offsets import offsets_of
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.rendering import html_of, text_of
from sb3_rpto.sysid.report.results import Results, Traced
from sb3_rpto.sysid.report.sections import sections_of
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError
from sb3_rpto.version import __version__

#: Of ``report.json``.
FORMAT = 1


@dataclass(frozen=True, eq=False)
class Report(Results):
    """The outcome of :func:`sb3_rpto.sysid.trace.trace`: print it, save it, or apply it to an environment."""

    def apply(self, env: gym.Env) -> gym.Env:
        """A corrected copy of a gymnasium MuJoCo environment, for RPTO, SAC, anything; ``env`` stays as it is.

        Effects come on top of those that it has: one that was corrected already is corrected twice.
        """
        return apply_effects(env, self.correction)

    def zeros_of(self, data: Measurements) -> EncoderOffsets:
        """The zeros of other runs' encoders by the corrected model: ``report.zeros_of(new).taken_off(new)`` is homed.

        :param data: recordings of the machine, columns in the order of those traced
        :raises ValueError: no encoder has a zero that differs by run; a run has no episode as long as a window
        """
        if self.zeros is None:
            raise ValueError("no encoder's zero was found to differ by run; predict the runs as they are")
        # A joint that was at rest in the recordings says as little here.
        data = replace(data, unobserved=tuple(dict.fromkeys((*data.unobserved, *self.data.unobserved))))
        return offsets_of(self.simulation, self.values_after, data, self.sigma, self.horizon, self.zeros.joints)

    def __str__(self) -> str:
        return text_of(sections_of(self))

    def html(self) -> str:
        """One page without scripts or links to other files; the same for the same report.

        :raises ImportError: matplotlib is not installed
        """
        return html_of(f"What the model lacks: {self.verdict}", sections_of(self))

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
                    for p, v, unit, low, high in t.parameters()
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
        out = Path(folder)
        # Rendered before anything is written: what fails there leaves the folder as it was.
        page, data = self.html(), json_text(self.to_json())
        files = {"report.json": f"{data}\n".encode(), "report.html": page.encode()}
        try:
            check_free(out, self.file)
            files = {**corrected_files(out, self.source, self.correction), **files}
        finally:
            # After a long trace, a file that is missing must not lose what was found.
            if not isinstance(self.source, mujoco.MjModel):
                write_files(out, files)
        return out
