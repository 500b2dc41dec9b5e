"""The force that a model lacks, drawn against what it may depend on: what an effect looks like."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sb3_rpto.effects import Effect
from sb3_rpto.effects.names import object_id
from sb3_rpto.sysid.problem.inverse_dynamics import REST, ForceResidual, summary
from sb3_rpto.sysid.problem.missing_force import missing_forces
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.figures import AFTER, BEFORE, WITHOUT, Picture, draw, kind_of_runs, largest, left_out

if TYPE_CHECKING:
    from sb3_rpto.sysid.report.report import Report

#: Most points of a scatter, and bins of its medians.
POINTS, BINS = 1200, 15

#: What an effect answers to, where its place alone does not say it.
CAUSES = {
    "spring": "position",
    "end_stop": "position",
    "torque_ripple": "position",
    "position_friction": "position",
    "load_friction": "load",
    "directional_load_friction": "load",
    "torque_offset": "time",
    "armature": "acceleration",
    "command_delay": "command rate",
    "actuator_lag": "command rate",
    "dc_motor": "velocity",
    "wind": "velocity",
    "fluid": "velocity",
}
BY_PLACE = {
    "joint": "velocity",
    "actuator": "command",
    "sensor": "position",
    "body": "position",
    "geom": "velocity",
    "world": "position",
}
#: Frictions whose level is shown: their sign is that of the motion.
LEVELS = ("position_friction", "load_friction", "directional_load_friction")


def cause_of(effect: Effect) -> str:
    """What an effect answers to: velocity, position, load, command, command rate, acceleration or time."""
    return CAUSES.get(effect.kind, BY_PLACE[effect.place])


def residual_of(report: Report, effect: Effect) -> Picture | None:
    """The force residual against the natural cause of an effect, at the joint that it moves most.

    Three panels: of the model before the correction, of the corrected model without this effect alone, and with it.
    """
    model = report.simulation.model
    dofs = descriptions.dofs_of(effect, model)
    if not dofs or not report.residuals_before:
        return None
    dof = max(dofs, key=lambda d: np.nan_to_num(report.force_before[d] - report.force_after[d], nan=-np.inf))
    cause, level = cause_of(effect), effect.kind in LEVELS
    actuator = object_id(model, "actuator", effect.on) if effect.place == "actuator" else None
    panels = [
        ("before the correction", report.residuals_before, BEFORE),
        ("corrected but for this effect", _without(report, effect), WITHOUT),
        ("after the correction", report.residuals_after, AFTER),
    ]
    unit = descriptions.force_unit(model, dof)

    def paint(axes: np.ndarray) -> None:
        bounds = [
            _residual(axis, found, model, dof, cause, colour, actuator, level)
            for axis, (_, found, colour) in zip(axes[0], panels)
        ]
        for axis, (name, found, _) in zip(axes[0], panels):
            axis.set_ylim(min(low for low, _ in bounds), max(high for _, high in bounds))
            axis.set_title(f"{name}: {descriptions.number(summary(found)[dof], 3)} {unit} RMS")

    sign = ", times the direction of motion (below zero it brakes)" if level else ""
    caption = (
        f"Each dot is one sample of the {kind_of_runs(report)} runs: the force that the motion needed and the model "
        f"does not know{sign}, {descriptions.means(report.data)}. The line joins medians: where it changes with "
        f"{cause}, something is missing; flat at zero, nothing is. On the left other effects are missing too, "
        "in the middle this one alone. For the eye only: decisions are made on predictions."
    )
    title = (
        f"{effect.label}: missing force of {descriptions.dof_name(model, dof)} against {cause}, RMS "
        f"{descriptions.number(report.force_before[dof], 3)} → {descriptions.number(report.force_after[dof], 3)} {unit}"
    )
    return Picture(title, draw(1, 3, paint), caption)


def _without(report: Report, effect: Effect) -> list[ForceResidual]:
    """Residuals of the corrected model without one of its effects."""
    values = report.values_after.copy()
    for known, part in zip(report.simulation.effects, report.simulation.slices):
        if known.label == effect.label:
            values[part] = report.simulation.null[part]
    return missing_forces(report.simulation, values, report.data)


def standard_residuals(report: Report) -> Picture | None:
    """The force residual of the final model against velocity, position, load, command and time, joint by joint."""
    model = report.simulation.model
    dofs = descriptions.scalar_dofs(model)
    if not dofs or not report.residuals_after:
        return None
    shown = [dofs[i] for i in largest(report.force_after[dofs])]
    causes = ["velocity", "position", "load", *(["command"] if model.nu else []), "time"]

    def paint(axes: np.ndarray) -> None:
        for row, dof in zip(axes, shown):
            for axis, cause in zip(row, causes):
                bounds = _residual(axis, report.residuals_after, model, dof, cause, AFTER, None, False)
                axis.set_ylim(*bounds)
                axis.set_title(f"{descriptions.dof_name(model, dof)}: against {cause}")

    caption = (
        f"Each dot is one sample of the {kind_of_runs(report)} runs: the force that the motion needed and the fitted "
        f"model does not know, {descriptions.means(report.data)}. The line joins medians: flat at zero where the model "
        "lacks nothing that depends on the axis below. Noise of differentiated positions, where there is some, spreads "
        "the dots. For the eye only."
    )
    caption += left_out(len(dofs), len(shown))
    return Picture(
        "Force that is still missing, against its possible causes", draw(len(shown), len(causes), paint), caption
    )


def _residual(
    axis: Any,
    residuals: Sequence[ForceResidual],
    model: Any,
    dof: int,
    cause: str,
    colour: str,
    actuator: int | None,
    level: bool,
) -> tuple[float, float]:
    """Scatter and binned medians; returns the range of forces to show."""
    x = np.concatenate([_cause(r, dof, cause, _actuator(model, dof, actuator)) for r in residuals])
    y = np.concatenate([r.force[:, dof] for r in residuals])
    speed = np.concatenate([r.qvel[:, dof] for r in residuals])
    if level or cause == "velocity":
        # At rest dry friction has no known sign.
        moving = np.abs(speed) > REST * np.quantile(np.abs(speed), 0.95)
        x, y = x[moving], (y * np.sign(speed) if level else y)[moving]
    if not len(x):
        return -1.0, 1.0
    some = np.linspace(0, len(x) - 1, min(POINTS, len(x))).astype(int)
    axis.axhline(0, color="black", linewidth=0.8)
    if not np.ptp(x):
        axis.text(0.5, 0.85, f"no {cause} here", ha="center", transform=axis.transAxes)
    axis.plot(x[some], y[some], ".", color=colour, markersize=2.5, alpha=0.35, rasterized=True)
    axis.plot(*binned_medians(x, y), "-o", color="black", markersize=3, linewidth=1.3, label="medians")
    low, high = np.quantile(x, [0.005, 0.995])
    margin = 0.02 * (high - low) or 1.0
    axis.set_xlim(low - margin, high + margin)
    axis.set_xlabel(f"{cause} [{_unit(model, dof, cause)}]")
    axis.set_ylabel(f"missing force{' × direction' if level else ''} [{descriptions.force_unit(model, dof)}]")
    below, above = np.quantile(y, [0.01, 0.99])
    margin = 0.15 * (above - below) + 1e-9
    return float(min(below, 0) - margin), float(max(above, 0) + margin)


def _actuator(model: Any, dof: int, given: int | None) -> int:
    """The actuator whose command is shown: the given one, one at the joint, or the first."""
    if given is not None:
        return given
    joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    at = np.flatnonzero(joints & (model.actuator_trnid[:, 0] == model.dof_jntid[dof]))
    return int(at[0]) if len(at) else 0


def _cause(r: ForceResidual, dof: int, cause: str, actuator: int) -> np.ndarray:
    if cause == "time":
        return r.time
    if cause in ("command", "command rate"):
        command = r.command[:, actuator]
        return command if cause == "command" else np.gradient(command, r.time)
    if cause == "acceleration":
        return np.gradient(r.qvel[:, dof], r.time)
    return {"position": r.qpos, "velocity": r.qvel, "load": r.load}[cause][:, dof]


def _unit(model: Any, dof: int, cause: str) -> str:
    unit = descriptions.dof_unit(model, dof)
    return {
        "time": "s",
        "position": unit,
        "velocity": f"{unit}/s",
        "acceleration": f"{unit}/s²",
        "load": descriptions.force_unit(model, dof),
        "command": "its unit",
        "command rate": "its unit/s",
    }[cause]


def binned_medians(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Medians of ``y`` in bins of equal width over the central 99 % of ``x``; bins with few samples are left out."""
    low, high = np.quantile(x, [0.005, 0.995])
    edges = np.linspace(low, high + 1e-12, BINS + 1)
    number = np.digitize(x, edges) - 1
    full = [b for b in range(BINS) if (number == b).sum() >= max(5, len(x) // (20 * BINS))]
    centre = (edges[:-1] + edges[1:]) / 2
    return centre[full], np.array([np.median(y[number == b]) for b in full])
