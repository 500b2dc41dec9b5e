"""A report as one HTML page that needs no other file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from sb3_rpto.effects import Declared
from sb3_rpto.effects.corrected_model_io import carried_by
from sb3_rpto.sysid.report import descriptions, figures, residual_plots
from sb3_rpto.sysid.report.figures import Picture, horizon_label
from sb3_rpto.version import __version__

if TYPE_CHECKING:
    from sb3_rpto.sysid.report.report import Report, Traced

#: Most effects with a figure of their own, and names of runs listed.
FIGURES, NAMES = 8, 20
#: The order of the table of candidates.
STATUSES = ("kept", "alike", "dropped", "not excited", "not needed")

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 60rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1.05rem; margin-bottom: .3rem; }
.verdict { border-left: .4rem solid #0072B2; background: #f2f6fa; padding: .6rem 1rem; }
.verdict b { font-size: 1.2rem; }
.equation { font-family: ui-monospace, monospace; font-size: .9rem; background: #f5f5f5; padding: .6rem; display: block;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .6rem 0; }
th, td { text-align: left; padding: .25rem .7rem .25rem 0; border-bottom: 1px solid #ddd; vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: 1.2rem 0; break-inside: avoid; } figure img { width: 100%; }
figcaption, .note { font-size: .9rem; color: #444; }
@media print { body { max-width: none; margin: 0; font-size: 10pt; } h2, h3 { break-after: avoid; }
  tr { break-inside: avoid; } .scroll { overflow: visible; } }
"""

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


def render(report: Report) -> str:
    """The whole report as the text of an HTML file: no scripts, no links to other files; the same for the same report.

    :raises ImportError: matplotlib is not installed
    """
    figures.require()
    sections = [
        ("Verdict", _verdict(report)),
        ("Model", _model(report)),
        ("Effects", _effects(report)),
        ("Error before and after", _errors(report)),
        ("Missing force", _forces(report)),
        ("Predictions", _picture(figures.trajectories(report)) or _note("No run is as long as a window.")),
        ("Candidates", _candidates(report)),
        ("Findings in the data", _findings(report)),
        ("Data and split", _data(report)),
        ("How this was obtained", _method(report)),
    ]
    body = "\n".join(f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>" for title, content in sections)
    title = f"What the model lacks: {report.verdict}"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>What the model lacks</h1>\n{body}\n"
        f'<p class="note">sb3_rpto {escape(__version__)}. The same numbers are in report.json, the corrected model in '
        "model.xml and effects.json.</p>\n</body>\n</html>\n"
    )


# --- sections -------------------------------------------------------------------------------------------------------


def _verdict(report: Report) -> str:
    means, caution = descriptions.verdict(report.verdict, searched=bool(report.candidates))
    before, after = report.adequacy_before, report.adequacy_after
    idle = sum(c.status == "not excited" for c in report.candidates)
    said = "<br>".join(escape(sentence) for sentence in (means, *descriptions.rest(after), caution))
    verdict = f"<b>{escape(report.verdict.capitalize())}.</b> {said}"
    apart = (
        "that were not fitted" if report.judged_apart else f"that were fitted, {descriptions.not_apart(report.runs)}"
    )
    ratios = [f"<b>{escape(str(a).removeprefix('R = '))}</b>" for a in (before, after)]
    lines = [
        f'<div class="verdict">{verdict}</div>',
        f"<p>Typical error over that of measurement noise alone (R, 1 where nothing is missing): {ratios[0]} before "
        f"and {ratios[1]} after the correction, on windows {apart}.</p>",
    ]
    if idle:
        lines.append(
            _note(f"{idle} of {len(report.candidates)} candidates could not have shown in these data; see below.")
        )
    return "\n".join(lines)


def _model(report: Report) -> str:
    lines = [
        f'<code class="equation">{escape(report.equation())}</code>',
        _note(
            "q, qd and qdd are positions, velocities and accelerations, M the inertia, c gravity and velocity terms, "
            "tau the actuators, u a command. In brackets: the object of the MJCF where a term acts."
        ),
    ]
    if not report.declared:
        return "\n".join([*lines, _note("No parameter was declared: the model was taken as it is.")])
    rows = []
    simulation = report.simulation
    given = {e.label: simulation.null[s] for e, s in zip(simulation.effects, simulation.slices) if e.known}
    for t in report.declared:
        rows_of = zip(t.effect.parameters, t.effect.values, given[t.label], t.units, t.interval.T)
        for parameter, value, old, unit, (low, high) in rows_of:
            name = t.label if isinstance(t.effect, Declared) else f"{t.label}: {parameter.name}"
            change = descriptions.percent(value / old - 1) if old else "–"
            rows.append(
                [
                    name,
                    descriptions.number(value),
                    descriptions.interval(low, high),
                    unit,
                    descriptions.number(old),
                    change,
                ]
            )
    header = ["declared or known", "fitted", "95 % interval", "unit", "as given", "change"]
    return "\n".join([*lines, _table(header, rows, numbers=(1, 2, 4, 5))])


def _effects(report: Report) -> str:
    lines = []
    if report.zeros is not None:
        text = "The zeros of these encoders differ from run to run; they are taken off the fitted runs."
        lines += [f"<p>{text}</p>", _table(["encoder", "spread, rad or m", "in each run"], report.zeros.rows(), (1,))]
    if not report.effects:
        return "\n".join([*lines, _note("No effect was needed or could be named.")])
    if report.verdict != "explained":
        lines.append("<p>These bring the model closer to the data. They are <b>not</b> claimed as the explanation.</p>")
    for t in report.effects:
        lines += [
            f"<h3>{escape(t.label)}</h3>",
            f'<code class="equation">{escape(descriptions.with_numbers(t.effect))}</code>',
        ]
        rows = []
        for p, value, unit, (low, high) in zip(t.effect.parameters, t.effect.values, t.units, t.interval.T):
            rows.append([p.name, descriptions.number(value), descriptions.interval(low, high), unit])
        lines += [_table(["parameter", "value", "95 % interval", "unit"], rows, numbers=(1, 2)), _evidence(report, t)]
    return "\n".join(lines)


def _evidence(report: Report, t: Traced) -> str:
    where = (
        "in model.xml, which MuJoCo loads by itself"
        if carried_by(t.effect) == "mjcf"
        else "in effects.json, put into the simulation by the environment wrapper: it is not in model.xml"
    )
    alike = f"the data cannot tell it from {', '.join(t.alike)}" if t.alike else "no other candidate does as well"
    items = (
        ("Class", "; ".join([alike, *map(str, t.stand_ins)])),
        (
            "Evidence",
            f"saves {descriptions.percent(t.gain)} of the window error, t = {descriptions.number(t.t, 3)} where "
            f"{descriptions.number(report.threshold, 3)} is needed",
        ),
        ("Stability", f"clear in {descriptions.percent(t.frequency)} of resampled sets of blocks"),
        ("Carried", where),
    )
    return "<ul>" + "".join(f"<li>{escape(name)}: {escape(text)}</li>" for name, text in items) + "</ul>"


def _errors(report: Report) -> str:
    model = report.simulation.model
    floors = {f.horizon: f for f in report.floor}
    rows = []
    for before, after in zip(report.before, report.after):
        floor = floors.get(before.horizon)
        for j, joint in enumerate(before.joints):
            cells = [horizon_label(before), joint, descriptions.position_unit(model, joint)]
            for e in (before, after):
                cells += [descriptions.number(e.rmse[j]), descriptions.interval(e.low[j], e.high[j], 3)]
            noise = "–" if floor is None else descriptions.number(floor.rmse[j])
            rows.append([*cells, noise, str(before.windows)])
    header = ["horizon", "joint", "unit", "RMSE before", "95 % interval", "RMSE after", "95 % interval", "noise floor"]
    header += ["predictions"]
    table = _table(header, rows, numbers=tuple(range(3, len(header))))
    note = "Errors of positions. Of whole runs the interval is the range of the runs, and no floor is computed."
    if not report.runs["test"]:
        note = "There are no test runs: these errors are those of the runs that were fitted. " + note
    if report.data.exact:
        note += " The data are exact, so there is no noise floor."
    return "\n".join([_picture(figures.errors_by_horizon(report)), table, _note(note)])


def _forces(report: Report) -> str:
    model = report.simulation.model
    if not report.residuals_after:
        return _note("Not known: the runs are short, or an equality constraint transmits what no motion tells.")
    rows = []
    for d in descriptions.scalar_dofs(model):
        sizes = [descriptions.number(f[d], 3) for f in (report.force_before, report.force_after)]
        share = descriptions.percent(report.learnable[d])
        rows.append([descriptions.dof_name(model, d), descriptions.force_unit(model, d), *sizes, share])
    header = ["joint", "unit", "RMS before", "RMS after", "learnable share of the rest"]
    lines = [
        _table(header, rows, numbers=(2, 3, 4)),
        _note(
            f"The force that the motion needed and the model does not know, {descriptions.means(report.data)}, away "
            "from rest. Noise of differentiated positions, where there is some, is part of it. The learnable share is "
            "what a small regressor predicts on unseen stretches: what a learned correction could still take away; "
            "none is given where nothing but rounding is left."
        ),
    ]
    shown = [residual_plots.residual_of(report, t.effect) for t in report.effects[:FIGURES]]
    if len(report.effects) > FIGURES:
        lines.append(_note(f"The first {FIGURES} of {len(report.effects)} effects are drawn."))
    if report.verdict != "explained":
        shown.append(residual_plots.standard_residuals(report))
    lines += map(_picture, shown)
    return "\n".join(lines)


def _candidates(report: Report) -> str:
    order = sorted(report.candidates, key=lambda c: (STATUSES.index(c.status), -c.sensitivity))
    screened = any(c.status != "not needed" for c in order)
    rows = []
    for c in order:
        sensitivity = descriptions.number(c.sensitivity, 3) if screened else "–"
        rows.append([c.label, c.status, c.reason, sensitivity, ", ".join(c.alike)])
    counts = ", ".join(
        f"{sum(c.status == s for c in order)} {s}" for s in STATUSES if any(c.status == s for c in order)
    )
    note = (
        "Sensitivity: by how many units of noise an effect of plausible small size moves all predictions together, "
        "beyond what the declared parameters can take up. Looks like: effects with the same influence at that size."
    )
    header = ["candidate", "status", "reason", "sensitivity", "looks like"]
    lead = f"<p>{escape(counts)}.</p>" if counts else _note("There were no candidates.")
    return "\n".join([lead, _table(header, rows, numbers=(3,)), _note(note)])


def _findings(report: Report) -> str:
    if not report.findings:
        return _note("Nothing was repaired or set aside.")
    return _table(["what", "where", "what was done"], [[f.kind, f.where, f.message] for f in report.findings])


def _data(report: Report) -> str:
    data = report.data
    rows = [[part, str(len(names)), _names(names)] for part, names in report.runs.items()]
    lines = [_table(["part", "runs", "names"], rows, numbers=(1,))]
    if data.unobserved:
        lines.append(_note(f"Not measured, so not compared: {', '.join(data.unobserved)}."))
    model = report.simulation.model
    levels = [
        [name, descriptions.number(value, 3), descriptions.position_unit(model, name)]
        for name, value in report.noise.items()
    ]
    if data.noise is not None:
        levels += [
            [f"{name}, velocity", descriptions.number(value, 3), f"{descriptions.dof_unit(model, dof)}/s"]
            for dof, (name, value) in enumerate(zip(data.columns.qvel, data.noise.qvel))
        ]
    lines.append(_table(["column", "noise, standard deviation", "unit"], levels, numbers=(1,)))
    if data.exact:
        lines.append(_note("The samples come from a simulator: the noise is a token, small share of the motion."))
    return "\n".join(lines)


def _names(names: Sequence[str]) -> str:
    rest = len(names) - NAMES
    return ", ".join(names[:NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _method(report: Report) -> str:
    steps = "".join(f"<li>{escape(step)}</li>" for step in METHOD)
    settings = (
        f"Windows of {report.horizon:g} s; threshold t* = {report.threshold:.3g}; seed {report.seed}; time step "
        f"{report.simulation.model.opt.timestep:g} s. The same data and seed give the same report."
    )
    return f"<ol>{steps}</ol>\n{_note(settings)}"


# --- pieces ---------------------------------------------------------------------------------------------------------


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table of text; ``numbers`` are the columns set to the right."""
    if not rows:
        return ""

    def line(cells: Sequence[str], tag: str) -> str:
        right = [' class="n"' if i in numbers else "" for i in range(len(cells))]
        return f"<tr>{''.join(f'<{tag}{at}>{escape(cell)}</{tag}>' for cell, at in zip(cells, right))}</tr>"

    body = "\n".join(line(row, "td") for row in rows)
    return f'<div class="scroll"><table>\n<thead>{line(header, "th")}</thead>\n<tbody>\n{body}\n</tbody></table></div>'


def _picture(picture: Picture | None) -> str:
    if picture is None:
        return ""
    title = escape(picture.title)
    image = f'<img src="{picture.image}" alt="{title}">'
    return f"<figure><h3>{title}</h3>\n{image}\n<figcaption>{escape(picture.caption)}</figcaption></figure>"
