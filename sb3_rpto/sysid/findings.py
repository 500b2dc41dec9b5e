"""What a reader of recordings or of a report must know beside it; ``python -m sb3_rpto.sysid.findings`` lists all."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np

#: A number in a message, not one that is part of a name.
_NUMBER = re.compile(r"(?<![\w.,'\"+-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])(?!\.\d)")


class Severity(StrEnum):
    """What a finding does to the result."""

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"

    @property
    def meaning(self) -> str:
        """In a sentence."""
        return {
            "note": "The result stands.",
            "warning": "The result stands with a restriction that the finding names.",
            "error": "The data, the model or the result is wrong in what the finding names.",
        }[self]


_NOTE, _WARNING, _ERROR = Severity


class FindingKind(StrEnum):
    """The kinds of findings.

    :ivar severity: what they do to the result
    :ivar condition: when a finding is made, and what is done then
    :ivar remedy: what a user does about it
    """

    severity: Severity
    condition: str
    remedy: str

    def __new__(cls, text: str, severity: Severity, condition: str, remedy: str) -> Self:
        """A member whose value is its text."""
        member = str.__new__(cls, text)
        member._value_ = text
        member.severity, member.condition, member.remedy = severity, condition, remedy
        return member

    # fmt: off
    GAP = ("gap", _NOTE,
        "A step in time exceeds five median steps, or a transition does not go on from the one before it. The run "
        "is split there; windows begin 0.2 s later, the longest delay of the library, or after a quarter of what "
        "follows.",
        "None is needed, unless the logger lost samples that you have.")
    SHORT = ("short", _NOTE,
        "Fewer than five rows lie between gaps, or an episode has fewer than two transitions. They are set aside.",
        "Record longer runs, or fill the gaps, where you need these rows.")
    JITTER = ("jitter", _NOTE,
        "More than 5 % of the steps in time are over 5 % off the median. The times are kept, unless `even clock` "
        "replaces them.",
        "Give the times at which the samples were taken where the logger, not the robot, was late.")
    EVEN_CLOCK = ("even clock", _NOTE,
        "The stamps jitter and the samples do not: where the joints move fast, positions are smoother on an even "
        "clock. A trace uses even times.",
        "Give the times at which the samples were taken if they were not even.")
    MISSING_ROWS = ("missing rows", _WARNING,
        "The clock is regular, and steps of 1.5 to 5 medians are among it. The command before is held there, which "
        "may make a right model wrong.",
        "Keep such rows with their commands, and interpolate the rest.")
    WRAPPED_ANGLE = ("wrapped angle", _NOTE,
        "An angle within one turn jumps by nearly a turn, or moves by whole turns otherwise than its velocity. It "
        "is unwrapped.",
        "None is needed.")
    FAST_ANGLE = ("fast angle", _ERROR,
        "More than 5 % of the steps of an angle within one turn are of about half a turn, and no velocity tells the"
        " turns. It is kept.",
        "Sample faster, or give `qvel`.")
    GLITCH = ("glitch", _NOTE,
        "One or two samples of an angle or a slide are far off the line between those around, by eight times the "
        "change of speed there and twice a fast step, and answer no command. They are interpolated and not "
        "compared; where they are more than 1 % of all they are kept.",
        "Look at the sensor; where many were kept, interpolate them or drop them with their commands.")
    JUMP = ("jump", _WARNING,
        "At most 2 % of an angle's or a slide's steps are single and over eight times as fast as all others: an "
        "encoder with another period than a turn, a slip, a reset within a run. They are kept.",
        "Unwrap the encoder at its own period, or split the run there.")
    HELD_SAMPLES = ("held samples", _WARNING,
        "All positions, or those of one joint, repeat the row before but in every n-th row. They are kept.",
        "Give the fresh rows alone, or interpolate the one joint between its fresh rows.")
    QUATERNION_NORM = ("quaternion norm", _NOTE,
        "A quaternion is more than 0.1 % (up to 5 %) longer or shorter than 1. It is divided by its norm, as "
        "smaller errors are.",
        "Check how the logger writes quaternions.")
    QUATERNION_SIGN = ("quaternion sign", _NOTE,
        "Neighbouring samples of a ball or free joint have opposite signs, which is one orientation. They are given"
        " one sign.",
        "None is needed.")
    OTHER_CONVENTION = ("other convention", _ERROR,
        "The angular velocity of a ball or free joint fits quaternions x, y, z, w, or the world's frame, and not "
        "MuJoCo's convention. It is kept.",
        "Give quaternions as w, x, y, z, and angular velocities in the body's frame.")
    MISSING_VELOCITY = ("missing velocity", _NOTE,
        "There is no `qvel` column, or no observation holds the velocity. It is estimated by a cubic Savitzky-Golay"
        " filter on the episode's own clock.",
        "None is needed; fits of hinges and slides use positions.")
    QUANTISED_VELOCITY = ("quantised velocity", _NOTE,
        "Fewer than half of the non-zero values of a velocity are distinct. It is kept.",
        "None is needed; leave the column out where it is too coarse.")
    FLIPPED_VELOCITY = ("flipped velocity", _ERROR,
        "The velocity's integral falls where the position rises; an angular velocity is compared with its "
        "quaternions' change. It is kept.",
        "Reverse the sign of the column that does not count as the model's axis does.")
    VELOCITY_SLOPE = ("velocity slope", _WARNING,
        "The slope of the velocity's integral against the position's change lies outside 0.8 to 1.25, also at the "
        "bound that noise leaves nearest to 1. It is kept.",
        "Check units and filters: s, rad or m, rad/s or m/s.")
    DUPLICATE = ("duplicate", _NOTE,
        "Two episodes hold identical samples. The first is kept.",
        "None is needed, unless one of them should be another run.")
    UNOBSERVED = ("unobserved", _NOTE,
        "No observation holds the position. It is integrated from the velocity where there is one, else kept, and "
        "not compared.",
        "Observe the coordinate where what acts on it matters.")
    CLIPPED = ("clipped", _NOTE,
        "Some observations do not hold the coordinate. No prediction begins at those samples; without a position "
        "they are not compared either.",
        "Observe the coordinate without a bound where these samples matter.")
    WRAPPER = ("wrapper", _NOTE,
        "An action wrapper is not gymnasium's. It is taken as part of the machine.",
        "Give the environment without the wrapper if it is no part of the machine.")
    SPLIT = ("split", _WARNING,
        "A part of the split is empty, there are few runs, or few windows to judge on. The split is made as well as"
        " it can be.",
        "Record more and longer runs, or set them apart by a `split` column.")
    SAMPLING = ("sampling", _NOTE,
        "The median step is no whole multiple of the model's timestep, 1 % off.",
        "Choose a timestep that divides the median step.")
    SLOW_SAMPLING = ("slow sampling", _WARNING,
        "The median step of a machine's recordings is over 20 ms. Faster effects leave no trace.",
        "Log faster, or give a simulator's own transitions by `Measurements.from_replay`.")
    LATE_RESPONSE = ("late response", _WARNING,
        "The motion follows a command or a measured force by more than two samples.",
        "Check that all channels were recorded at the same time; else a delay or lag in the actuator is the cause.")
    FLIPPED_SIGN = ("flipped sign", _ERROR,
        "In one run or in all, the motion needs the opposite of a command or a measured force. It is kept.",
        "Reverse the sign of that column; in all runs the cause may also be a large force that the model lacks.")
    STIFF_MODEL = ("stiff model", _NOTE,
        "The model is too stiff for the Runge-Kutta method at its timestep. It is integrated implicitly, less "
        "finely.",
        "Shorten the timestep.")
    CLIPPED_COMMAND = ("clipped command", _WARNING,
        "Commands lie outside the model's `ctrlrange`, which clips them; those of more than half of the samples are"
        " refused.",
        "Give commands in the units of the model's `ctrl`, or widen the range.")
    LARGE_ANGLE = ("large angle", _WARNING,
        "An angle spans many turns, and nothing explains the data.",
        "Give rad if the column is in degrees.")
    CONSTANT_COMMAND = ("constant command", _WARNING,
        "A command never changes, and nothing explains the data.",
        "Check that the column holds what the actuator was told.")
    LIMITED_FORCE = ("limited force", _WARNING,
        "A motor is asked for more than its `forcerange`, and nothing explains the data.",
        "Check that the range is that of the machine.")
    SOFT_FRICTION = ("soft friction", _WARNING,
        "Dry friction of the model gives way over more than 5 ms; or what was found leaves less if its dry friction"
        " gives way as MuJoCo's does by default; or such friction was looked for and found.",
        'Set `solreffriction="0.001 1" solimpfriction="0.99 0.99"`, in the model or in the robot that is simulated.')
    SOFT_TIE = ("soft tie", _WARNING,
        "An equality constraint of the model gives way over more than 5 ms.",
        "Set its `solref` and `solimp` to stiff ones where the machine's is rigid.")
    GRAVITY_COMPENSATION = ("gravity compensation", _WARNING,
        "The model's `gravcomp` carries the weight of bodies, and by MuJoCo's rule that of what is added to them. A"
        " payload has no weight there.",
        "Take `gravcomp` out of the model, and give the motors' whole output as commands.")
    OWN_STEP = ("own step", _WARNING,
        "`step()` of the environment that is traced gives other commands than its action, or adds forces. The MJCF "
        "alone is compared.",
        "Put into the MJCF what `step()` adds, or give the commands that it gives.")
    MOCAP_BODY = ("mocap body", _WARNING,
        "Something moving is tied to a mocap body, hangs on it or may touch it. It is taken to stand still.",
        "Give the body joints with columns where it moved.")
    AT_REST = ("at rest", _NOTE,
        "A position never changes, so that nothing tells how finely it is measured. It is not compared; where none "
        "changes, that is an error.",
        "Move the joint in the recordings where it matters.")
    CONTACTS = ("contacts", _NOTE,
        "Contacts come and go. Windows are shorter.",
        "None is needed; motion without contacts tells more.")
    NO_PLACE = ("no place", _NOTE,
        "A kind of effect was named among the candidates, and nothing in the model can have it. It is not looked "
        "for.",
        "Leave the kind out of `candidates`, or model the part that it acts on.")
    WHOLE_TURNS = ("whole turns", _NOTE,
        "A hinge lies more than half a turn outside its limits, off its spring's rest after unwrapping, or off its "
        "servo's command. Whole turns are taken off.",
        "None is needed.")
    OUTSIDE_LIMITS = ("outside limits", _WARNING,
        "A position is 0.1 rad or m beyond the limits of its joint all the same. It is kept.",
        "Check the encoder's zero, its sign and the limits in the model.")
    SIMULATED = ("simulated", _NOTE,
        "Steps of the model's own integrator, of its timestep, a half or a quarter of it, fit the recordings better"
        " than the continuous motion. They are traced in such steps.",
        "None is needed; pass `simulated=True` where you know it.")
    RUN_ZEROS = ("run zeros", _NOTE,
        "The zeros of encoders differ from run to run, and that explains much that effects do not. They are taken "
        "off the fitted runs; those of others are not known.",
        "Home the encoders before each run, or use `report.zeros_of(new)` for new recordings.")
    MISSED = ("missed", _WARNING,
        "A test run errs over five times what noise leaves, and the verdict is `complete` or `explained`. The "
        "verdict stays, as it is about the fitted runs.",
        "See how the named run differs: a moved sensor, another load, another motion.")
    FEW_WINDOWS = ("few windows", _WARNING,
        "The verdict is `complete` or `explained`, yet R is above 1.06 and the test runs err clearly more than "
        "noise leaves, over half a window or more. So few windows cannot deny the verdict.",
        "Record more.")
    VAGUE_NOISE = ("vague noise", _WARNING,
        "R of recordings with noise is below 0.9 at the upper end of its interval. What is missing may hide below "
        "what passes for noise.",
        "Sample faster, or hold commands for more samples.")
    STRAY_WINDOWS = ("stray windows", _WARNING,
        "The final model misses some windows by far more than others. They count little; the worst is named.",
        "Look at the run at that time for a stall, a touch or a lost sample.")
    UNDETERMINED = ("undetermined", _WARNING,
        "The data hardly tell a declared number, or one of a known effect. It is kept.",
        "Move so that it matters, or declare fewer numbers that act alike.")
    AT_ITS_BOUND = ("at its bound", _WARNING,
        "A fitted number, or a parameter of a named effect, ends at its bound. It is kept.",
        "Widen the bound (`name=low:high`), or look for what it makes up for.")
    UNSTABLE = ("unstable", _ERROR,
        "The declared or the corrected model becomes unstable in some windows. They count as missed.",
        "Give bounds to what you declare, or lower the timestep.")
    TIME_STEP = ("time step", _WARNING,
        "The model's time step errs by a part of what is left. Transitions, which pass for the model's own steps, "
        "are kept.",
        "Shorten the timestep, and raise `frame_skip` of an environment in proportion.")
    OWN_STEPS = ("own steps", _WARNING,
        "In its own steps in time the corrected simulator errs by more than the sensors do. The errors of the "
        "report are of finer steps.",
        'Set `integrator="RK4"` or a shorter timestep in `<option>` of the MJCF.')
    NO_NEARER = ("no nearer", _ERROR,
        "Under `unexplained` or `partly explained` what is listed predicts the test runs worse.",
        "Do not use the corrected simulator.")
    ENCODER_ZERO = ("encoder zero", _WARNING,
        "A constant torque is named where a position servo acts. Recordings of another sensor with another zero "
        "look like it, too.",
        "Check the zeros of the servo's encoder and of the recorded one.")
    TIED_SENSOR = ("tied sensor", _WARNING,
        "A sensor's gain or zero is named at a joint that an `<equality><joint>` ties. Its `polycoef` may be what "
        "is off.",
        "Check the tie.")
    BRIEF_DELAY = ("brief delay", _WARNING,
        "A named delay is less than 5 % of the time between two samples. A clock or the steps of another simulator "
        "may be that, too.",
        "Check the time stamps.")
    IDLE_START = ("idle start", _NOTE,
        "Runs of a simulator begin as if zeros had been commanded before, as an empty queue of commands does. What "
        "is late acts on zeros there.",
        "None is needed.")
    HELD_FORCES = ("held forces", _NOTE,
        "Friction, damping or drag of a joint that a simulator holds for a step of its environment, as a wrapper "
        "that writes `qfrc_applied` does, was looked for and found.",
        "None is needed, unless a machine made the recordings.")
    EARLY_RESPONSE = ("early response", _ERROR,
        "Nothing explains the recordings, and the model errs by less than half as much with all commands a row "
        "earlier.",
        "Shift the `ctrl` columns up a row, and trace again.")
    EXCHANGED = ("exchanged", _ERROR,
        "Nothing explains the recordings, and the model errs by less than half as much with the columns of two "
        "joints, of two actuators or of both exchanged.",
        "Exchange the columns, and trace again.")
    REVERSED = ("reversed", _ERROR,
        "Nothing explains the recordings, and the model errs by less than half as much with the sign of a joint "
        "reversed, alone or with its commands'.",
        "Let the columns count as the model's axis does, and trace again.")
    UNDECLARED_MASS = ("undeclared mass", _WARNING,
        "Nothing explains noisy recordings, and the model errs by less than half as much with another mass of a "
        "body that was not declared, its inertia in proportion.",
        "Declare the mass, and trace again.")
    UNDECLARED_INERTIA = ("undeclared inertia", _WARNING,
        "As `undeclared mass`, of an inertia alone.",
        "Declare the inertia, and trace again.")
    BEYOND_THE_LIBRARY = ("beyond the library", _WARNING,
        "Something is left unexplained, and the model has what no effect acts on: ball and free joints, mocap "
        "bodies, equality constraints, tendons, flexes, plugins, actuators at sites, slider-cranks, adhesion, "
        "muscles. Other hints beside it are withheld unless they leave no more than noise.",
        "Compare its numbers in the MJCF with the machine's, or model it by hinges, slides and motors.")
    # fmt: on


@dataclass(frozen=True)
class Finding:
    """Something about the data that a reader of the results must know.

    :param kind: what it is about, with its severity and remedy
    :param where: the episode and, where there is one, the column
    :param message: what was found and what was done about it, in plain language
    :param runs: names of the runs or episodes that it is about; none where it is about no single ones
    """

    kind: FindingKind
    where: str
    message: str
    runs: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.kind} in {self.where}: {self.message}"

    @classmethod
    def of_run(cls, kind: FindingKind, run: str, place: str, message: str) -> Self:
        """One about a single run.

        :param place: the column there; may be empty
        """
        return cls(kind, f"{run}, {place}" if place else run, message, (run,))

    @property
    def place(self) -> str:
        """Where it is, without the run."""
        return self.where.removeprefix(self.runs[0]).removeprefix(", ") if len(self.runs) == 1 else self.where


@dataclass(frozen=True)
class Hint(Finding):
    """What may be wrong instead where nothing explains recordings.

    :param bodies: that it concerns; None: all
    :param left: share of the error that is left with it; infinite where that was not tried
    """

    bodies: frozenset[int] | None = None
    left: float = np.inf


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names in a sentence, the first few where there are many."""
    shown, more = [*names[:most]], len(names) - most
    if more > 0:
        return f"{', '.join(shown)} and {more} more"
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


def grouped(findings: Iterable[Finding]) -> list[Finding]:
    """Findings that say the same of several runs or places as one, in their order.

    Of several runs numbers may differ: a message then tells the least and the largest of each.

    :param findings: such as were grouped before are left as they are
    """
    of_runs: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        said = _NUMBER.sub("#", finding.message) if len(finding.runs) == 1 else finding.message
        of_runs.setdefault((finding.kind, finding.place, said), []).append(finding)
    of_places: dict[tuple[FindingKind, str, tuple[str, ...]], list[tuple[str, Finding]]] = {}
    for alike in of_runs.values():
        first = alike[0]
        message = _ranges([finding.message for finding in alike])
        runs = tuple(dict.fromkeys(run for finding in alike for run in finding.runs))
        of_places.setdefault((first.kind, message, runs), []).append((first.place, first))
    found = []
    for (kind, message, runs), places in of_places.items():
        first = places[0][1]
        if len(places) == 1 and runs == first.runs:
            found.append(first)
            continue
        where = listed([place for place, _ in places if place])
        if len(runs) == 1:
            where = f"{runs[0]}, {where}"
        elif len(first.runs) == 1:
            where = f"{where} of {listed(runs)}" if where else listed(runs)
        found.append(Finding(kind, where, message, runs))
    return found


def _ranges(messages: Sequence[str]) -> str:
    """Messages that differ in numbers alone as one."""
    columns = zip(*(_NUMBER.findall(message) for message in messages))
    ends = iter([(min(column, key=float), max(column, key=float)) for column in columns])

    def between(number: re.Match[str]) -> str:
        low, high = next(ends)
        return low if float(low) == float(high) else f"{low} to {high}"

    return _NUMBER.sub(between, messages[0]) if len(messages) > 1 else messages[0]


def page() -> str:
    """The documentation of all kinds, in Markdown: ``docs/findings.md``."""
    lines = [
        "# Findings",
        "",
        "A finding is something about the data, the model or the result that a reader must know.",
        "`data.findings` holds those of [data](measurements.md), `report.findings` those of a [trace](tracing.md) "
        "and of its data.",
        "Each has `kind`, `where`, `message` and `runs`; `kind.severity` and `kind.remedy` are those below.",
        "What several runs have in common is said once: with the runs' names, and with the range of each number.",
        "",
        *(f"- **{severity}**: {severity.meaning}" for severity in Severity),
        "",
        "| kind | severity | found when, and what is done | remedy |",
        "|---|---|---|---|",
        *(f"| `{kind}` | {kind.severity} | {kind.condition} | {kind.remedy} |" for kind in FindingKind),
        "",
        "This page is written by `python -m sb3_rpto.sysid.findings`.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(page())
