"""From recordings to what is found in them, searched again where that tells that they are of another kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from sb3_rpto.effects import LIBRARY, Declared, Effect
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.encoder_offsets import Zeros, homed, settled, zeros_by_run
from sb3_rpto.sysid.problem.data_origin import may_be_exact, met_exactly, origin
from sb3_rpto.sysid.problem.prepare import Progress, SetUp
from sb3_rpto.sysid.report.diagnostics import DRY, WORSE, creeping
from sb3_rpto.sysid.selection.adequacy import SETTLED, TOLERANCE, adequacy, judge
from sb3_rpto.sysid.selection.pipeline import Found
from sb3_rpto.sysid.selection.stepwise_selection import Selection
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS

#: Dry friction that may give way is looked for where it leaves less than this share of the error, and forces that are
#: held are taken where they do, or explain.
SOFTER = 0.5
#: Kinds that brake a joint in every substep and have a held form.
TWINS = ("coulomb_friction", "soft_friction", "viscous_friction", "asymmetric_damping", "quadratic_drag")
SOFT = Finding(
    FindingKind.SOFT_FRICTION,
    "fitted runs",
    "dry friction gives way near rest, as MuJoCo's frictionloss alone does and a machine's hardly",
)
HELD = Finding(
    FindingKind.HELD_FORCES,
    "fitted runs",
    "forces stay what they are at the beginning of a step of the environment until its end, as where a wrapper writes "
    "them, and no machine's do",
)
UNLIKE = Finding(
    FindingKind.SPLIT,
    "fitted runs",
    "the runs set apart to select on do not show what is missing in the others: blocks of all of them take turns",
)


class Prepared(Protocol):
    """Reads recordings for a search."""

    def __call__(self, data: Measurements, simulated: bool, kinds: Sequence[str] | None, soft: bool = False) -> SetUp:
        """Recordings, whether they are of a simulator's own steps, and the kinds of effects to look for.

        :param soft: whether declared dry friction gives way near rest, see :func:`~sb3_rpto.effects.library.given`
        """


@dataclass(frozen=True)
class Searched:
    """What a search ended with.

    :param set_up: the recordings, as they were read at last
    :param found: what was found in them
    :param first: the same before zeros of single runs were taken off
    :param zeros: encoder zeros that differ by run; None where none do
    :param verdict: see :func:`sb3_rpto.sysid.selection.adequacy.judge`
    """

    set_up: SetUp
    found: Found
    first: Found
    zeros: Zeros | None
    verdict: str


def conclude(
    prepared: Prepared,
    search: Callable[[SetUp], Found],
    data: Measurements,
    declared: Sequence[str],
    kinds: Sequence[str] | None,
    simulated: bool,
    threads: int,
    seed: int,
    say: Progress,
) -> Searched:
    """Search, and once more where what was found tells that the recordings are of another kind than they looked.

    :param prepared: reads recordings as of a kind
    :param search: in what was read
    :param data: recordings
    :param declared: names of the parameters that are fitted
    :param kinds: of effects to look for; None: all that are offered
    :param simulated: whether ``data`` are known to be of the model's own steps in time
    :param threads: that simulate
    :param seed: of the resampling
    :param say: progress
    """

    def read(data: Measurements, simulated: bool) -> tuple[SetUp, Found]:
        def searched(kinds: Sequence[str] | None, soft: bool = False) -> tuple[SetUp, Found]:
            set_up = prepared(data, simulated, kinds, soft)
            found = search(set_up)
            if found.substeps is None and hidden(found, seed):
                set_up = set_up.with_all_to_fit()
                set_up.findings.append(UNLIKE)
                found = search(set_up)
            return set_up, found

        set_up, found = searched(kinds)
        if found.substeps is not None:  # they are read in those steps before anything else is tried
            return set_up, found
        if not _explains(found) and _creeps(found):
            other, then = searched(_softer(kinds), soft=True)
            if _explains(then) or then.after.ratio < found.after.ratio:
                set_up, found = other, then
                set_up.findings.append(SOFT)
        if kinds is None and not _explains(found) and found.on.fine.train.windows.drive.hold > 1:
            other, then = searched(_held_beside(found))
            if _explains(then) or then.after.ratio < SOFTER * found.after.ratio:
                set_up, found = other, then
                if any(effect.held for effect in _named(found)):
                    set_up.findings.append(HELD)
        return set_up, found

    set_up, found = read(data, simulated)
    if found.substeps is not None:
        finer = replace(data, substeps=found.substeps)
        other, then = read(finer, True)
        if _explains(then) or not _explains(found):
            data, simulated, set_up, found = finer, True, other, then
            step = 1e3 * set_up.nominal.opt.timestep / data.substeps
            message = (
                f"from the model's integrator in steps of {step:g} ms, as a simulator's are: it meets them better than "
                "the continuous motion does"
            )
            set_up.findings.append(Finding(FindingKind.SIMULATED, "fitted runs", message))
    again = _of_own_steps(set_up, found, declared, threads)
    if again is not None:
        simulated = True
        set_up, found = read(data, simulated)
        set_up.findings.append(again)
    if may_be_exact(data) and (not _explains(found) or _is_exact(set_up, found, declared, threads)):
        exact, then = read(replace(data, exact=True), simulated)
        if _explains(then):
            set_up, found = exact, then
            message = "from the model's own steps in time, without noise, as shows with what was found: searched again"
            set_up.findings.append(Finding(FindingKind.SIMULATED, "fitted runs", message))
    first = found
    zeros = zeros_by_run(set_up, found, _explains(found), say, seed)
    if zeros is not None:
        without = homed(set_up, zeros)
        without, refined, then = settled(without, zeros, search(without), say, seed)
        zeros = refined if then.after.adequate or then.after.ratio < found.after.ratio else None
    if zeros is not None:
        set_up, found = without, then
        set_up.findings.append(zeros.finding())
    verdict = judge(first.before, found.after, bool(found.selection.model.effects) or zeros is not None)
    if verdict == "unexplained" and not found.after.ratio < first.before.ratio:
        found = replace(found, selection=Selection(found.base), after=found.before)  # it is no hint either
    return Searched(set_up, found, first, zeros, verdict)


def hidden(found: Found, seed: int) -> bool:
    """Whether runs set apart to judge on pass what fails on those fitted to: they cannot tell what is missing there."""
    select, values = found.on.fine.select, found.selection.model.fit.values
    if select is None or found.after.adequate:
        return False
    return adequacy(select, select.score(values, iterations=START_STEPS), seed).adequate


def _explains(found: Found) -> bool:
    return judge(found.before, found.after, bool(found.selection.model.effects)) in SETTLED


def _creeps(found: Found) -> bool:
    """Whether dry friction that was found leaves what it would not if it gave way at rest."""
    model = found.selection.model
    share = creeping(found.on.fine.every_window(), model.fit.values, model.effects)[1]
    return share < SOFTER or (share < 1 - WORSE and share * found.after.low <= 1 + TOLERANCE)


def _named(found: Found) -> list[Effect]:
    return [found.on.fine.simulation.effects[i] for i in found.selection.model.effects]


def _held_beside(found: Found) -> list[str]:
    """Kinds of forces that are held, and those that were found, but for what would be the same if it were held."""
    there = {effect.kind for effect in _named(found)} - {*TWINS}
    return [kind for kind, effect in LIBRARY.items() if effect.held or kind in there]


def _softer(kinds: Sequence[str] | None) -> list[str]:
    """The same kinds of effects, with friction that gives way in the place of the dry ones."""
    kinds = kinds if kinds is not None else [name for name, kind in LIBRARY.items() if kind.offered]
    others = [kind for kind in kinds if kind not in DRY]
    return [*others, "soft_friction"] if len(others) < len(kinds) else others


def _is_exact(set_up: SetUp, found: Found, declared: Sequence[str], threads: int) -> bool:
    """Whether recordings without noise were taken for noisy ones, which wrong numbers may explain, too."""
    return met_exactly(set_up.nominal, set_up.fitted, declared, set_up.length, threads, _known_and_found(found))


def _known_and_found(found: Found) -> list[Effect]:
    """The effects that are no candidates any more, as they were fitted."""
    simulation, values = found.on.fine.simulation, found.selection.model.fit.values
    known = [i for i, e in enumerate(simulation.effects) if e.known and not isinstance(e, Declared)]
    kept = (*known, *found.selection.model.effects)
    there = [simulation.effects[i].with_values(values[simulation.slices[i]]) for i in kept]
    return [effect for effect in there if not effect.does_nothing]  # as known ones may, after the fit


def _of_own_steps(set_up: SetUp, found: Found, declared: Sequence[str], threads: int) -> Finding | None:
    """Whether recordings that were taken for a machine's turn out to be the model's own, now that something is found.

    What is missing errs as much in one kind of steps as in another; with it in the model they can be told apart.
    """
    if _explains(found) or not found.selection.model.effects:
        return None
    kind = origin(
        set_up.nominal, set_up.fitted, declared, set_up.sigma, set_up.length, threads, _known_and_found(found)
    )
    if kind == "machine":
        return None
    message = "from the model's own steps in time, as shows with what was found first; searched again in such steps"
    return Finding(FindingKind.SIMULATED, "fitted runs", message)
