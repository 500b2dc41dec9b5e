"""The figures of a report, each as one image that needs no other file."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sb3_rpto.effects import Effect
from sb3_rpto.effects.names import object_id
from sb3_rpto.sysid.problem.inverse_dynamics import REST, ForceResidual, summary
from sb3_rpto.sysid.problem.missing_force import missing_forces
from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.report.results import Results
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, predictions
from sb3_rpto.sysid.shooting.windows import cut

# Apart for readers with any colour vision, and in grey (Okabe & Ito 2008); lines and markers differ as well.
BEFORE, AFTER, WITHOUT, MEASURED = "#D55E00", "#0072B2", "#009E73", "#444444"
STYLE: Any = {
    "svg.fonttype": "path",
    "svg.hashsalt": "sb3-rpto",
    "text.parse_math": False,  # names are not formulas
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
#: Most windows to choose from, and joints in a figure.
WINDOWS, JOINTS = 100, 8
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


@dataclass(frozen=True)
class Picture:
    """An image with the words around it.

    :param title: what is seen
    :param image: data URI of an SVG
    :param caption: how to read it
    """

    title: str
    image: str
    caption: str


def require() -> None:
    """Fail early where matplotlib is absent.

    :raises ImportError: it names the extra to install
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "the figures of a report need matplotlib: pip install -e '.[tracing]' in the checkout"
        ) from error


def draw(rows: int, columns: int, paint: Callable[[np.ndarray], None], height: float = 2.5) -> str:
    """An SVG as a data URI, the same bytes for the same figure.

    :param paint: draws on axes of shape (rows, columns)
    :param height: of a row in inches
    :raises ImportError: see :func:`require`
    """
    require()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure = Figure(figsize=(9.5, height * rows + 0.3), layout="constrained")
        paint(figure.subplots(rows, columns, squeeze=False))
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", dpi=110, metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode()


# --- errors by horizon ----------------------------------------------------------------------------------------------


def horizon_label(error: HorizonError) -> str:
    """The horizon for people."""
    return error.horizon if isinstance(error.horizon, str) else f"{error.horizon:g} s"


def errors_by_horizon(report: Results) -> Picture | None:
    """Bars of the errors before and after, with the noise floor."""
    if not report.before:
        return None
    model = report.simulation.model
    joints = report.before[0].joints
    shown = largest(np.nan_to_num(report.before[0].rmse))
    floors = {f.horizon: f for f in report.floor}
    x = np.arange(len(report.before))
    columns = min(len(shown), 2)
    rows = -(-len(shown) // columns)
    both = np.array([[e.rmse for e in found] for found in (report.before, report.after)])[..., shown]
    logarithmic = bool(both.min() > 0 and both.max() > 20 * both.min())

    def paint(axes: np.ndarray) -> None:
        for axis in axes.flat[len(shown) :]:
            axis.set_visible(False)
        for axis, j in zip(axes.flat, shown):
            for found, label, colour, hatch, shift in (
                (report.before, "before", BEFORE, "", -0.2),
                (report.after, "after", AFTER, "//", 0.2),
            ):
                rmse, low, high = (np.array([getattr(e, n)[j] for e in found]) for n in ("rmse", "low", "high"))
                whiskers = np.maximum([rmse - low, high - rmse], 0)
                axis.bar(x + shift, rmse, 0.38, color=colour, alpha=0.8, label=label, hatch=hatch, edgecolor="white")
                axis.errorbar(x + shift, rmse, whiskers, fmt="none", ecolor="black", elinewidth=1, capsize=3)
            floor = [(i, floors[e.horizon].rmse[j]) for i, e in enumerate(report.before) if e.horizon in floors]
            for i, level in floor:
                name = "noise floor" if i == floor[0][0] else None
                axis.plot([i - 0.45, i + 0.45], [level, level], color="black", linestyle=":", linewidth=1.8, label=name)
            if logarithmic:
                axis.set_yscale("log")
                axis.set_ylim(bottom=0.5 * both.min())
                for ticks in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
                    ticks(_plain_ticks)
            axis.set_xticks(x, [horizon_label(e) for e in report.before])
            axis.set_xlabel("length of the prediction")
            unit = descriptions.position_unit(model, joints[j])
            axis.set_ylabel(f"RMSE [{unit}]" + (", log scale" if logarithmic else ""))
            at = _middle(report.before)
            fall = f"{report.before[at].rmse[j]:.3g} → {report.after[at].rmse[j]:.3g} {unit}"
            axis.set_title(f"{joints[j]}: at {horizon_label(report.before[at])} {fall}")
            axis.legend()

    caption = (
        "Each prediction starts from a measured state and follows the recorded commands; lower is better. Whiskers are "
        "95 % intervals by resampling blocks of windows, for whole runs the range of the runs. The dotted line is the "
        "error that a true model would still have, because starts and measurements are noisy."
    )
    caption += left_out(len(joints), len(shown))
    at = _middle(report.before)
    least = 1e-12  # exact data can be met exactly
    ratios = np.maximum(report.before[at].rmse, least) / np.maximum(report.after[at].rmse, least)
    factor = float(np.exp(np.mean(np.log(ratios))))
    if factor > 1.05:
        change = f"err {factor:.3g} times less after the correction"
    else:
        change = "err as much after the correction as before it" if factor > 0.95 else "err more after the correction"
    title = f"Predictions over {horizon_label(report.before[at])} {change}".replace("over whole run", "of whole runs")
    return Picture(title, draw(rows, columns, paint), caption)


def _plain_ticks(value: float, _: int) -> str:
    """Ticks at 1, 2 and 5 of each decade, without formulas."""
    lead = value / 10 ** np.floor(np.log10(value) + 1e-9)
    return f"{value:g}" if round(lead) in (1, 2, 5) else ""


def _middle(errors: Sequence[HorizonError]) -> int:
    return next((i for i, e in enumerate(errors) if e.horizon == 0.5), 0)


def largest(sizes: np.ndarray) -> list[int]:
    """Indices of the few joints that are worth a panel."""
    return sorted(np.argsort(-np.asarray(sizes))[:JOINTS].tolist())


def left_out(total: int, shown: int) -> str:
    """A sentence for a caption where not all joints are shown."""
    return f" The {shown} joints with the largest errors of {total} are shown." if shown < total else ""


# --- predicted and measured -----------------------------------------------------------------------------------------


def trajectories(report: Results) -> Picture | None:
    """Measured positions and predictions before and after: two typical windows and the worst."""
    simulation, data = report.simulation, report.data
    try:
        windows = cut(simulation.model, data, report.sigma, report.horizon, WINDOWS)
    except ValueError:  # no run is as long as a window
        return None
    predicted, off = {}, {}
    for name, values in (("before", report.values_before), ("after", report.values_after)):
        predicted[name], difference, usable = predictions(simulation, values, windows)
        square = np.where(usable[:, :, None], difference**2, 0).sum(1) / np.maximum(usable.sum(1), 1)[:, None]
        off[name] = np.sqrt(square)
    order = np.argsort((off["after"] / windows.sigma).max(axis=1))
    chosen = list(dict.fromkeys(int(order[round(at * (len(order) - 1))]) for at in (0.35, 0.65, 1.0)))
    names = [n for n in data.columns.qpos if n not in data.unobserved]
    shown = largest(off["before"].mean(0) / windows.sigma)
    step = float(simulation.model.opt.timestep)

    def paint(axes: np.ndarray) -> None:
        for row, j in zip(axes, shown):
            unit = descriptions.position_unit(simulation.model, names[j])
            for axis, w, what in zip(row, chosen, [*["typical"] * (len(chosen) - 1), "worst"]):
                use = windows.usable[w]
                t, measured = windows.at[w][use] * step, windows.measured[w][use, j]
                axis.plot(t, measured, ".", color=MEASURED, markersize=3, label="measured", rasterized=True)
                for name, colour, line in (("before", BEFORE, "--"), ("after", AFTER, "-")):
                    axis.plot(t, predicted[name][w][use, j], line, color=colour, linewidth=1.4, label=name)
                span = np.ptp(measured) + 1e-6
                low, high = axis.get_ylim()
                axis.set_ylim(max(low, measured.min() - 2 * span), min(high, measured.max() + 2 * span))
                error = f"{off['before'][w, j]:.2g} → {off['after'][w, j]:.2g} {unit}"
                axis.set_title(f"{names[j]}, {what}: {error}", fontsize=8.5)
                axis.set_ylabel(f"position [{unit}]" if unit else "coordinate")
                axis.set_xlabel("time in the window [s]")
        axes[0, 0].legend()

    caption = (
        f"Windows of {report.horizon:g} s of the {kind_of_runs(report)} runs: dots are measured, the dashed line is "
        "the fitted model before the correction, the solid line after it. Two windows of typical error after the "
        "correction, and the worst one. Above each: RMSE before → after."
    )
    caption += left_out(len(names), len(shown))
    title = "Predicted and measured motion in typical windows and in the worst"
    return Picture(title, draw(len(shown), len(chosen), paint, 2.2), caption)


def kind_of_runs(report: Results) -> str:
    """Which runs the figures show."""
    return "test" if report.runs["test"] else "fitted"


# --- missing force ---------------------------------------------------------------------------------------------------


def cause_of(effect: Effect) -> str:
    """What an effect answers to: velocity, position, load, command, command rate, acceleration or time."""
    return CAUSES.get(effect.kind, BY_PLACE[effect.place])


def residual_of(report: Results, effect: Effect) -> Picture | None:
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
        ("corrected but for this effect", residuals_without(report, effect), WITHOUT),
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


def residuals_without(report: Results, effect: Effect) -> list[ForceResidual]:
    """Residuals of the corrected model without one of its effects."""
    values = report.values_after.copy()
    for known, part in zip(report.simulation.effects, report.simulation.slices):
        if known.label == effect.label:
            values[part] = report.simulation.null[part]
    return missing_forces(report.simulation, values, report.data)


def standard_residuals(report: Results) -> Picture | None:
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
