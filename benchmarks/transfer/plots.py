"""The paper's figure: learning curves with bands, a panel for each task and target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def learning_curves(
    lines: pd.DataFrame,
    references: Mapping[str, Mapping[str, float]],
    labels: Sequence[str],
    ours: Sequence[str],
    path: Path,
) -> Figure:
    """Draw IQMs of the return with their 95 % bands against target steps; a row of panels for each task.

    :param lines: of :func:`sb3_rpto.evaluation.statistics.curves`
    :param references: of each ``<task>_<target>``: ``zero_shot`` (dotted) and ``oracle`` (dashed)
    :param labels: methods, in the order of the legend
    :param ours: those that are drawn in front, thick and in black, red and blue
    :param path: of the picture; its suffix says the format
    :return: what was drawn
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(lines["task"]))
    targets = {task: list(dict.fromkeys(lines.loc[lines["task"] == task, "target"])) for task in tasks}
    columns = max(map(len, targets.values()))
    figure = Figure(figsize=(4.2 * columns + 2.2, 3.0 * len(tasks)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(tasks), columns, squeeze=False)
    others = [label for label in labels if label not in ours]
    colours = dict(zip(others, colormaps["tab20"](np.arange(len(others)) % 20)))
    dashed = others[20:]  # the palette begins anew
    colours |= dict(zip(ours, ("black", "crimson", "royalblue", "darkorange") * (len(ours) // 4 + 1)))
    for row, task in zip(axes, tasks):
        for axis, target in zip(row, targets[task]):
            here = lines[(lines["task"] == task) & (lines["target"] == target)]
            for label in labels:
                curve = here[here["label"] == label].sort_values("steps")
                front = label in ours
                style = {"color": colours[label], "zorder": 3 if front else 2}
                form = {"linewidth": 2.2 if front else 1.0, "linestyle": "--" if label in dashed else "-"}
                axis.plot(curve["steps"], curve["return"], label=label, **form, **style)
                band = (curve["steps"], curve["return_low"], curve["return_high"])
                axis.fill_between(*band, alpha=0.18 if front else 0.07, linewidth=0, **style)
            known = references.get(f"{task}_{target}", {})
            for name, words, dashes in (("oracle", "oracle", "--"), ("zero_shot", "source policy", ":")):
                if name in known:
                    axis.axhline(known[name], color="grey", linestyle=dashes, linewidth=1, label=words)
            axis.set(title=f"{task}, {target}", xlabel="target steps", ylabel="return")
        for axis in row[len(targets[task]) :]:
            axis.set_visible(False)
    handles: dict[str, Any] = {}
    for axis in figure.axes:
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels())))
    figure.legend(list(handles.values()), list(handles), loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)
    return figure
