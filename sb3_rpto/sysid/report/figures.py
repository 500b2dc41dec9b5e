"""The figures of a report, each as one image that needs no other file."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_rpto.sysid.report import descriptions
from sb3_rpto.sysid.shooting.prediction_errors import HorizonError, predictions
from sb3_rpto.sysid.shooting.windows import cut

if TYPE_CHECKING:
    from sb3_rpto.sysid.report.report import Report

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


def errors_by_horizon(report: Report) -> Picture | None:
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


def trajectories(report: Report) -> Picture | None:
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


def kind_of_runs(report: Report) -> str:
    """Which runs the figures show."""
    return "test" if report.runs["test"] else "fitted"
