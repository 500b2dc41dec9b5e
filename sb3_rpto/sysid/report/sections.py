"""What a report says, section by section: built once, and written as text or as a page by whoever shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from sb3_rpto.effects import Declared
from sb3_rpto.effects.corrected_model_io import carried_by
from sb3_rpto.sysid.report import figures
from sb3_rpto.sysid.report.descriptions import (
    dof_name,
    dof_unit,
    force_unit,
    interval,
    means,
    not_apart,
    number,
    percent,
    position_unit,
    rest,
    scalar_dofs,
    verdict,
    with_numbers,
)
from sb3_rpto.sysid.report.figures import Picture, horizon_label
from sb3_rpto.sysid.report.results import Results, Traced

#: Most effects with a figure of their own, and names of runs listed.
FIGURES, NAMES = 8, 20
#: The order of the table of candidates.
STATUSES = ("kept", "alike", "dropped", "not excited", "not needed")
CARRIED = {
    "mjcf": "in model.xml, which MuJoCo loads by itself",
    "wrapper": "in effects.json, put into the simulation by the environment wrapper: it is not in model.xml",
}

METHOD = (
    "Runs were parted into train, select and test as wholes; the test runs were predicted once, at the end.",
    "The declared parameters were fitted to short windows of the train runs, each simulated from its measured start "
    "under the recorded commands, with a robust cost in units of the measurement noise.",
    "R compares the error of select windows with what the noise alone would leave in them, their starts being fitted. "
    "Where R reaches one, the model is complete and nothing more was tried.",
    "Otherwise each candidate effect was screened: could these data show it, and does it look like another?",
    "Where the data are exact, or contacts come and go, one kind of effect at all its places was tried first, of "
    "exact data up to three together, and then nothing else where they accounted for them. Else all candidates that "
    "could show were fitted together. Of either, effects were dropped one by one: first those whose loss seems to "
    "cost least, judged on the select windows, until all that remained were needed.",
    "An effect is needed when its loss raises the log error of blocks of select windows clearly (t above the "
    "threshold) and by more than 3 %; far from the noise, where other missing effects spread the blocks, a t of 2 is "
    "enough and a tenth is needed. Where the typical window is met without it, the few that are missed speak for it by "
    "themselves. Like effects were then tried in its place: those that do as well form its class.",
    "The kept effects and the declared parameters were fitted once more to train and select runs; their intervals "
    "come from how the blocks of windows scatter.",
    "Errors, missing forces and the curves above are those of the test runs, where there are any.",
)


@dataclass(frozen=True)
class Table:
    """A table of text.

    :param header: names of the columns
    :param rows: cells
    :param numbers: indices of the columns that hold numbers
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Sequence[int] = ()


@dataclass(frozen=True)
class Section:
    """A part of a report; what it does not have is left empty.

    :param title: of the section
    :param paragraphs: sentences
    :param formula: an equation
    :param table: numbers
    :param figure: draws a picture, None where there is nothing to draw
    :param evidence: items that a reader looks at who doubts; folded on a page
    :param notes: how to read it; on a page alone
    :param level: 2, or 3 of a part of the section before it
    :param medium: where it is shown
    """

    title: str
    paragraphs: Sequence[str] = ()
    formula: str = ""
    table: Table | None = None
    figure: Callable[[], Picture | None] | None = None
    evidence: Sequence[str] = ()
    notes: Sequence[str] = ()
    level: int = 2
    medium: Literal["both", "text", "page"] = "both"


def sections_of(found: Results) -> list[Section]:
    """All that is to say about the outcome of a trace, in the order in which it is read."""
    return [
        _verdict(found),
        *_model(found),
        *_effects(found),
        *_encoder_offsets(found),
        _errors(found),
        *_forces(found),
        Section("Predictions", figure=partial(figures.trajectories, found), medium="page"),
        *_candidates(found),
        *_findings(found),
        *_data(found),
        _method(found),
    ]


def _verdict(found: Results) -> Section:
    says, caution = verdict(found.verdict, searched=bool(found.candidates))
    before, after = (str(a).removeprefix("R = ") for a in (found.adequacy_before, found.adequacy_after))
    apart = "on select windows" if found.judged_apart else f"on fitted windows, {not_apart(found.runs)}"
    ratio = (
        f"Adequacy R, the typical error over that of noise alone, {apart}; 1 where nothing is missing: before "
        f"{before}, after {after}."
    )
    idle = sum(c.status == "not excited" for c in found.candidates)
    note = f"{idle} of {len(found.candidates)} candidates could not have shown in these data; see below."
    paragraphs = [*(says, *rest(found.adequacy_after), caution), ratio]
    return Section(f"Verdict: {found.verdict}", paragraphs, notes=[note] if idle else [])


def _model(found: Results) -> list[Section]:
    note = (
        "q, qd and qdd are positions, velocities and accelerations, M the inertia, c gravity and velocity terms, tau "
        "the actuators, u a command. In brackets: the object of the MJCF where a term acts."
    )
    none = "No parameter was declared: the model was taken as it is."
    sections = [Section("Model", formula=found.equation(), notes=[note] if found.declared else [note, none])]
    simulation = found.simulation
    given = {e.label: simulation.null[s] for e, s in zip(simulation.effects, simulation.slices) if e.known}
    for title, is_number in (("Declared parameters, fitted", True), ("Known effects, fitted", False)):
        rows = []
        for t in found.declared:
            unknown = np.full(len(t.units), np.nan)
            if isinstance(t.effect, Declared) == is_number:
                for (label, name, *cells), value, old in zip(_values(t), t.effect.values, given.get(t.label, unknown)):
                    change = percent(value / old - 1) if old else "–"
                    rows.append([f"{label} {name}".rstrip(), *cells, number(old), change])
        header = ["parameter", "value", "95 % interval", "unit", "as given", "change"]
        table = Table(header, rows, numbers=(1, 2, 4, 5))
        if rows:
            sections.append(Section(title, table=table))
    return sections


def _values(t: Traced) -> list[list[str]]:
    """A row for each parameter: place, name, value, interval, unit."""
    is_number = isinstance(t.effect, Declared)
    return [
        [t.label, "" if is_number else p.name, number(value), interval(low, high), unit]
        for p, value, unit, low, high in t.parameters()
    ]


def _effects(found: Results) -> list[Section]:
    if not found.effects:
        return [Section("Effects", ["No effect was needed or could be named."], medium="page")]
    explained = found.verdict == "explained"
    title = "Effects that it lacks" if explained else "Effects that lower the error and do not explain the data"
    header = ["effect", "parameter", "value", "95 % interval", "unit"]
    rows = [row for t in found.effects for row in _values(t)]
    return [
        Section(title, table=Table(header, rows, numbers=(2, 3))),
        *(
            Section(t.label, formula=with_numbers(t.effect), evidence=_evidence(found, t), level=3)
            for t in found.effects
        ),
    ]


def _evidence(found: Results, t: Traced) -> list[str]:
    alike = f"the data cannot tell it from {', '.join(t.alike)}" if t.alike else "no other candidate does as well"
    return [
        f"saves {percent(t.gain)} of the window error (t = {number(t.t, 3)}, needed "
        f"{number(found.threshold, 3)}), clear in {percent(t.frequency)} of resampled sets of blocks",
        f"carried {CARRIED[carried_by(t.effect)]}",
        alike,
        *map(str, t.stand_ins),
    ]


def _encoder_offsets(found: Results) -> list[Section]:
    if found.zeros is None:
        return []
    text = "The zeros of these encoders differ from run to run; they are taken off the fitted runs."
    table = Table(["encoder", "spread, rad or m", "in each run"], found.zeros.rows(), numbers=(1,))
    return [Section("Encoder zeros that differ by run", [text], table=table)]


def _errors(found: Results) -> Section:
    model = found.simulation.model
    floors = {f.horizon: f for f in found.floor}
    rows = []
    for before, after in zip(found.before, found.after):
        floor = floors.get(before.horizon)
        for j, joint in enumerate(before.joints):
            cells = [horizon_label(before), joint, position_unit(model, joint)]
            for e in (before, after):
                cells += [number(e.rmse[j]), interval(e.low[j], e.high[j], 3)]
            rows.append([*cells, "–" if floor is None else number(floor.rmse[j]), str(before.windows)])
    header = ["horizon", "joint", "unit", "before", "95 % interval", "after", "95 % interval", "noise floor", "n"]
    tested = found.runs["test"]
    notes = [
        "Root mean squared errors of n predictions of positions. Of whole runs the interval is the range of the runs, "
        "and no floor is computed."
    ]
    if found.data.exact:
        notes.append("The data are exact, so there is no noise floor.")
    return Section(
        f"Error before and after, on {'test' if tested else 'fitted'} runs: RMSE",
        [] if tested else ["There are no test runs: these errors are those of the runs that were fitted."],
        table=Table(header, rows, numbers=range(3, len(header))),
        figure=partial(figures.errors_by_horizon, found),
        notes=notes,
    )


def _forces(found: Results) -> list[Section]:
    model = found.simulation.model
    title = "Missing force"
    if not found.residuals_after:
        none = "Not known: the runs are short, or an equality constraint transmits what no motion tells."
        return [Section(title, [none], medium="page")]
    rows = []
    for d in scalar_dofs(model):
        sizes = [number(f[d], 3) for f in (found.force_before, found.force_after)]
        rows.append([dof_name(model, d), force_unit(model, d), *sizes, percent(found.learnable[d])])
    header = ["joint", "unit", "RMS before", "RMS after", "learnable share of the rest"]
    note = (
        f"The force that the motion needed and the model does not know, {means(found.data)}, away from rest. Noise of "
        "differentiated positions, where there is some, is part of it. The learnable share is what a small regressor "
        "predicts on unseen stretches: what a learned correction could still take away; none is given where nothing "
        "but rounding is left."
    )
    table = Table(header, rows, numbers=(2, 3, 4))
    title += f" {means(found.data)}"
    sections = [Section(title, table=table, notes=[note], medium="both" if rows else "page")]
    drawn = [partial(figures.residual_of, found, t.effect) for t in found.effects[:FIGURES]]
    if found.verdict != "explained":
        drawn.append(partial(figures.standard_residuals, found))
    sections += [Section("", figure=figure, level=3, medium="page") for figure in drawn]
    if len(found.effects) > FIGURES:
        few = f"The first {FIGURES} of {len(found.effects)} effects are drawn."
        sections.append(Section("", notes=[few], level=3, medium="page"))
    return sections


def _candidates(found: Results) -> list[Section]:
    order = sorted(found.candidates, key=lambda c: (STATUSES.index(c.status), -c.sensitivity))
    screened = any(c.status != "not needed" for c in order)
    rows = [
        [c.label, c.status, c.reason, number(c.sensitivity, 3) if screened else "–", ", ".join(c.alike)] for c in order
    ]
    counts = {status: sum(c.status == status for c in order) for status in STATUSES}
    lead = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    note = (
        "Sensitivity: by how many units of noise an effect of plausible small size moves all predictions together, "
        "beyond what the declared parameters can take up. Looks like: effects with the same influence at that size."
    )
    header = ["candidate", "status", "reason", "sensitivity", "looks like"]
    idle = Table(["candidate", "reason"], [[c.label, c.reason] for c in found.candidates if c.status == "not excited"])
    told = [Section("Not excited by these data", table=idle, medium="text")] if idle.rows else []
    lead = f"{lead}." if lead else "There were no candidates."
    return [
        *told,
        Section("Candidates", [lead], table=Table(header, rows, numbers=(3,)), notes=[note], medium="page"),
    ]


def _findings(found: Results) -> list[Section]:
    if not found.findings:
        return [Section("Findings in the data", ["Nothing was repaired or set aside."], medium="page")]
    rows = [[f.kind, f.kind.severity, f.where, f.message, f.kind.remedy] for f in found.findings]
    header = ["what", "severity", "where", "what was done", "what to do"]
    return [
        Section("Findings", [str(f) for f in found.findings], medium="text"),
        Section("Findings in the data", table=Table(header, rows), medium="page"),
    ]


def _data(found: Results) -> list[Section]:
    data, model = found.data, found.simulation.model
    rows = [[part, str(len(names)), _names(names)] for part, names in found.runs.items()]
    notes = [f"Not measured, so not compared: {', '.join(data.unobserved)}."] if data.unobserved else []
    levels = [[name, number(value, 3), position_unit(model, name)] for name, value in found.noise.items()]
    if data.noise is not None:
        levels += [
            [f"{name}, velocity", number(value, 3), f"{dof_unit(model, dof)}/s"]
            for dof, (name, value) in enumerate(zip(data.columns.qvel, data.noise.qvel))
        ]
    exact = ["The samples come from a simulator: the noise is a token, small share of the motion."] * data.exact
    noise = Table(["column", "noise, standard deviation", "unit"], levels, numbers=(1,))
    split = Table(["part", "runs", "names"], rows, numbers=(1,))
    return [
        Section("Data and split", table=split, notes=notes, medium="page"),
        Section("", table=noise, notes=exact, level=3, medium="page"),
    ]


def _names(names: Sequence[str]) -> str:
    more = len(names) - NAMES
    return ", ".join(names[:NAMES]) + (f" and {more} more" if more > 0 else "")


def _method(found: Results) -> Section:
    settings = (
        f"Windows of {found.horizon:g} s; threshold t* = {found.threshold:.3g}; seed {found.seed}; time step "
        f"{found.simulation.model.opt.timestep:g} s. The same data and seed give the same report."
    )
    return Section("How this was obtained", evidence=METHOD, notes=[settings], medium="page")
