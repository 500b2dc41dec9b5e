"""One recorded run: read from a table, checked, repaired."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sb3_rpto.sysid.data import signal_quality
from sb3_rpto.sysid.data.columns import Columns, joint_of
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.findings import Finding, FindingKind

Table = Mapping[str, np.ndarray]
PARTS = ("train", "select", "test")
#: Degrees in a radian.
DEGREES = 180 / np.pi


class Noise(NamedTuple):
    """Standard deviations of the white noise of whole states, where they are known.

    :param qpos: of each position column in rad or m, (m,)
    :param qvel: of each velocity column in rad/s or m/s, (nv,)
    """

    qpos: np.ndarray
    qvel: np.ndarray


@dataclass(frozen=True, eq=False)
class Episode:
    """One uninterrupted recording. Columns of the arrays are named by the :class:`Measurements` that hold it.

    :param name: unique name; ``<run>/0``, ``<run>/1`` … where a run was split at gaps
    :param run: name of the run it belongs to; splits keep a run together
    :param time: increasing times in s, shape (T,)
    :param qpos: positions in rad or m, shape (T, nq)
    :param qvel: velocities in rad/s or m/s, shape (T, nv)
    :param ctrl: commands in the actuators' units, shape (T, nu)
    :param qfrc: measured generalised forces in N·m or N, shape (T, nf)
    :param enabled: False where an actuator was switched off, shape (T, nu)
    :param params: settings known for this run, ``object.parameter`` to SI value
    :param part: ``"train"``, ``"select"`` or ``"test"`` where the file says so
    :param usable: False where the state is not known, shape (T,); all True by default
    :param after_gap: whether it begins where samples are missing, so that the commands before it are not known
    :param placed: False where the positions are not known, shape (T,): predictions are not compared there, while none
        begins where ``usable`` is False; the latter by default
    :raises ValueError: ``usable`` or ``placed`` does not fit ``time``
    """

    name: str
    run: str
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    qfrc: np.ndarray
    enabled: np.ndarray
    params: Mapping[str, float] = field(default_factory=dict)
    part: str | None = None
    usable: np.ndarray = None  # type: ignore[assignment]
    after_gap: bool = False
    placed: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.usable is None:
            object.__setattr__(self, "usable", np.ones(len(self.time), dtype=bool))
        if self.placed is None:
            object.__setattr__(self, "placed", self.usable)
        for name, flags in (("usable", self.usable), ("placed", self.placed)):
            if flags.shape != (len(self.time),):
                raise ValueError(
                    f"{self.name}: {name} has shape {flags.shape}, time {self.time.shape}; cut both in the same way"
                )

    def __len__(self) -> int:
        return len(self.time)

    def part_of(self, samples: slice, after_gap: bool) -> "Episode":
        """A part of it by itself; copies.

        :param samples: which
        :param after_gap: as above
        """
        names = ("time", "qpos", "qvel", "ctrl", "qfrc", "enabled", "usable", "placed")
        arrays = {name: getattr(self, name)[samples].copy() for name in names}
        return replace(self, after_gap=after_gap, **arrays)


def _is_number(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return "_" not in str(value)  # Python reads 1_0 as 10


def runs_of(file: str, table: Table) -> dict[str | None, dict[str, np.ndarray]]:
    """Check the values of a table and part its rows by episode."""
    lengths = {name: np.shape(values) for name, values in table.items()}
    if len(set(lengths.values())) != 1 or len(lengths["time"]) != 1:
        raise ValueError(f"{file}: columns must all have one shape (T,), a value for each time; got {lengths}")
    if "episode" in table and lengths["time"] == (0,):
        raise ValueError(f"{file}: the table has no rows; give one row a sample")
    rows: dict[str, np.ndarray] = {}
    for name, values in table.items():
        if name in ("episode", "split"):
            rows[name] = np.asarray(values).astype(str)
            blank = np.flatnonzero(np.isin(rows[name], ("", "nan", "None", "<NA>", "NaT")))
            if len(blank):
                raise ValueError(f"{file}: column {name!r} is empty in row {blank[0]}; fill it in on every row")
            continue
        if np.ma.isMaskedArray(values):
            values = np.ma.filled(values.astype(np.float64), np.nan)
        if np.iscomplexobj(values):
            raise ValueError(f"{file}: column {name!r} holds complex numbers; give real ones")
        if np.asarray(values).dtype.kind in "mM":
            raise ValueError(f"{file}: column {name!r} holds dates or durations; give numbers, times in seconds")
        try:
            rows[name] = np.asarray(values).astype(np.float64)
        except (TypeError, ValueError):
            each = list(enumerate(np.asarray(values)))
            row, odd = next((pair for pair in each if not _is_number(pair[1])), each[0])
            odd = odd.item() if isinstance(odd, np.generic) else odd
            remedy = "give seconds since the start of the run" if name == "time" else "correct or remove it"
            if isinstance(odd, str) and _is_number(odd.replace(",", ".")):
                remedy = "write decimals with a point"
            raise ValueError(
                f"{file}: column {name!r} holds {odd!r}, which is no number, in row {row} (counted from 0 below the "
                f"header); {remedy}"
            ) from None
        bad = np.flatnonzero(~np.isfinite(rows[name]))
        if len(bad):
            raise ValueError(
                f"{file}: column {name!r} has {len(bad)} NaN or infinite value(s), first in row {bad[0]} "
                "(counted from 0 below the header); keep a row's command and interpolate the rest where one or a few "
                "in succession are missing, and drop the rows where many are: a gap is handled"
            )
    if "episode" not in rows:
        return {None: rows}
    names = dict.fromkeys(rows["episode"].tolist())
    return {name: {c: values[rows["episode"] == name] for c, values in rows.items()} for name in names}


def read_run(file: str, name: str, rows: dict[str, np.ndarray], columns: Columns) -> Episode:
    """Check one run and stack its columns; velocities without a column stay NaN until the gaps are known."""
    where = f"{file}, episode {name}"
    time = rows["time"]
    if len(time) < DATA.min_rows:
        raise ValueError(f"{where}: {len(time)} rows are too few; give at least {DATA.min_rows} or remove the episode")
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        raise ValueError(
            f"{where}: column 'time' does not increase at row {back[0] + 1} of the episode ({time[back[0]]:g} s, then "
            f"{time[back[0] + 1]:g} s); sort the rows, drop doubled ones, or give each run its own episode"
        )
    steps = np.diff(time)
    middle, mean = float(np.median(steps)), float(np.mean(steps))
    if np.mean(steps > DATA.gap * middle) > DATA.burst_share and mean > DATA.burst_ratio * middle:
        raise ValueError(
            f"{where}: the clock comes in bursts, of steps of {middle:.3g} s where the mean is {mean:.3g} s; give the "
            "times at which samples were taken, not those at which they arrived"
        )
    for column in (c for c in rows if c == "split" or c.startswith("param.")):
        if len(np.unique(rows[column])) > 1:
            raise ValueError(
                f"{where}: column {column!r} changes within the episode; it must be constant, make it two episodes"
            )
    part = str(rows["split"][0]) if "split" in rows else None
    if part is not None and part not in PARTS:
        raise ValueError(f"{where}: column 'split' holds {part!r}; use one of {', '.join(PARTS)}")

    def stack(prefix: str, names: tuple[str, ...], default: float) -> np.ndarray:
        blank = np.full(len(time), default)
        return np.stack([rows.get(f"{prefix}.{n}", blank) for n in names], 1) if names else np.empty((len(time), 0))

    enabled = stack("enabled", columns.ctrl, 1.0)
    if not np.isin(enabled, (0.0, 1.0)).all():
        actuator = columns.ctrl[int(np.flatnonzero(~np.isin(enabled, (0.0, 1.0)).all(0))[0])]
        raise ValueError(f"{where}: column 'enabled.{actuator}' holds more than 0 and 1; use 1 for on and 0 for off")
    return Episode(
        name=name,
        run=name,
        # From 0 where, as beside the seconds since 1970, a double has no room for the tolerances of a clock.
        time=time - time[0] if np.spacing(np.abs(time).max()) > DATA.finest_time else time,
        qpos=stack("qpos", columns.qpos, np.nan),
        qvel=stack("qvel", columns.qvel, np.nan),
        ctrl=stack("ctrl", columns.ctrl, 0.0),
        qfrc=stack("qfrc", columns.qfrc, np.nan),
        enabled=enabled.astype(bool),
        params={p: float(rows[f"param.{p}"][0]) for p in columns.params},
        part=part,
    )


def check_clocks(episodes: Sequence[Episode]) -> None:
    """Refuse runs whose clocks differ by so much that they can hardly have one unit.

    :raises ValueError: such a one, named
    """
    steps = [float(np.median(np.diff(e.time))) for e in episodes]
    usual = sorted(steps)[(len(steps) - 1) // 2] if steps else 0.0
    for episode, step in zip(episodes, steps):
        if not usual / DATA.clock_ratio < step < usual * DATA.clock_ratio:
            raise ValueError(
                f"{episode.name}: the median step of column 'time' is {step:g}, that of most episodes {usual:g}; give "
                "the times of all in seconds"
            )


def repair(run: Episode, columns: Columns, findings: list[Finding]) -> list[Episode]:
    """Split a run at its gaps, unwrap its angles, estimate what velocities it lacks; report each."""
    slices = signal_quality.split_at_gaps(run.time)
    if len(slices) > 1:
        longest = max(run.time[s.start] - run.time[s.start - 1] for s in slices[1:])
        message = (
            f"{len(slices) - 1} gap(s) in time, the longest {longest:.4g} s; split there into {len(slices)} episodes"
        )
        findings.append(Finding.of_run(FindingKind.GAP, run.name, "", message))
    pieces = []
    for i, rows in enumerate(slices):
        name = run.name if len(slices) == 1 else f"{run.name}/{i}"
        if rows.stop - rows.start < DATA.min_rows:
            message = f"{rows.stop - rows.start} row(s) between gaps are too few to use; set aside"
            findings.append(Finding.of_run(FindingKind.SHORT, name, "", message))
            continue
        pieces.append(replace(run.part_of(rows, after_gap=i > 0), name=name))
        _repair_channels(pieces[-1], columns, findings)
    return pieces


class _Reporter:
    """Findings about one episode."""

    def __init__(self, episode: Episode, findings: list[Finding]) -> None:
        self._name, self._findings = episode.name, findings

    def __call__(self, kind: FindingKind, message: str, column: str = "time") -> None:
        self._findings.append(Finding.of_run(kind, self._name, column, message))

    def slope(self, slope: float | None, column: str) -> None:
        """Of measured velocities against the positions' change, where it is not about 1."""
        low, high = DATA.slope
        if slope is None or low <= slope <= high:
            return
        kind, cause = FindingKind.VELOCITY_SLOPE, "check units and filters"
        if slope < 0:
            kind, cause = FindingKind.FLIPPED_VELOCITY, "its sign is flipped"
        elif any(low <= slope / factor <= high for factor in (DEGREES, 1 / DEGREES)):
            cause = "one of the two is in degrees, times are in minutes or speeds in rpm; give s, rad and rad/s"
        self(kind, f"slope against the position's change is {slope:.2f}, not 1: {cause}; kept as it is", column)


def _repair_channels(episode: Episode, columns: Columns, findings: list[Finding]) -> None:
    """Check and repair, in place, the channels of an episode that is not yet handed out."""
    tell = _Reporter(episode, findings)
    _check_samples(episode, columns, tell)
    _repair_orientations(episode, columns, tell)
    _repair_positions(episode, columns, tell)
    _complete_velocities(episode, columns, tell)


def _check_samples(episode: Episode, columns: Columns, tell: _Reporter) -> None:
    spread = signal_quality.jitter(episode.time)
    if spread > DATA.jitter:
        tell(
            FindingKind.JITTER,
            f"steps vary by {spread:.0%} around their median of {np.median(np.diff(episode.time)):.4g} s; kept as they "
            "are: where the logger, not the robot, was late, give the times at which the samples were taken",
        )
    elif late := signal_quality.count_missing_rows(episode.time):
        tell(
            FindingKind.MISSING_ROWS,
            f"{late} step(s) are longer than the others, and no gaps: the command of a row that is missing is not "
            "known, and the one before is held instead. Keep such rows with their commands, and interpolate the rest",
        )
    rows = signal_quality.rows_per_reading(episode.qpos)
    if rows is not None:
        tell(
            FindingKind.HELD_SAMPLES,
            f"positions are fresh in every {rows}. row alone, and repeated between: keep those rows, as held ones look "
            "like late sensors and commands",
            "qpos",
        )
        return
    for i, name in enumerate(columns.qpos):
        rows = signal_quality.rows_per_reading(episode.qpos[:, i : i + 1])
        if rows is not None:
            tell(
                FindingKind.HELD_SAMPLES,
                f"it is fresh in every {rows}. row alone, and repeated between: interpolate it between those rows, or "
                "keep them alone, as what is held looks like a late sensor",
                f"qpos.{name}",
            )


def _repair_orientations(episode: Episode, columns: Columns, tell: _Reporter) -> None:
    """Unit quaternions of one sign, and their velocities compared with how they turn."""
    for joint, first in columns.quaternions():
        norms = np.linalg.norm(episode.qpos[:, first : first + 4], axis=1)
        off = float(np.nanmax(np.abs(norms - 1), initial=0.0))
        if off > DATA.quaternion_norm:
            raise ValueError(
                f"{episode.name}: qpos.{joint} holds no unit quaternion in its last four columns (norms from "
                f"{np.nanmin(norms):.3g} to {np.nanmax(norms):.3g}); give w, x, y, z in this order"
            )
        if off > DATA.quaternion_rounding:
            episode.qpos[:, first : first + 4] /= norms[:, None]
            if off > DATA.quaternion_finding:
                tell(FindingKind.QUATERNION_NORM, f"off 1 by up to {off:.2g}; divided by it", f"qpos.{joint}")
        flips = signal_quality.align_quaternions(episode.qpos[:, first : first + 4])
        if flips:
            tell(
                FindingKind.QUATERNION_SIGN,
                f"{flips} change(s) between q and -q, one orientation; aligned",
                f"qpos.{joint}",
            )
        turn = [i for i, name in enumerate(columns.qvel) if joint_of(name) == joint and name not in columns.missing]
        measured, oriented = episode.qvel[:, turn[-3:]], episode.qpos[:, first : first + 4]
        other = signal_quality.turning_convention(episode.time, oriented, measured) if turn else None
        if other is not None:
            message = f"the numbers fit {other}; kept as they are: give w, x, y, z, and velocities in the body's frame"
            tell(FindingKind.OTHER_CONVENTION, message, f"qpos.{joint}")
        elif turn:
            tell.slope(signal_quality.turning_slope(episode.time, oriented, measured), f"qvel.{joint}")


def _repair_positions(episode: Episode, columns: Columns, tell: _Reporter) -> None:
    """Unwrap angles, bridge what is no reading, and tell of steps that are no motion."""
    for i, name in enumerate(columns.qpos):
        # A turn means nothing to the coordinates of a ball or free joint.
        if name != joint_of(name):
            continue
        change = None
        if name in columns.qvel and name not in columns.missing:
            velocity = episode.qvel[:, columns.qvel.index(name)]
            change = np.diff(episode.time) * 0.5 * (velocity[1:] + velocity[:-1])
        episode.qpos[:, i], jumps, fast = signal_quality.unwrap(episode.qpos[:, i], change)
        if jumps:
            tell(FindingKind.WRAPPED_ANGLE, f"{jumps} jump(s) of about one turn; unwrapped", f"qpos.{name}")
        if fast:
            message = "many steps are of about half a turn, so whole turns may be lost: sample faster, or give qvel"
            tell(FindingKind.FAST_ANGLE, message, f"qpos.{name}")
        _bridge_glitches(episode, i, tell, f"qpos.{name}")
        leaps = np.abs(np.diff(episode.qpos[:, i])[signal_quality.jumps(episode.time, episode.qpos[:, i])])
        if len(leaps):
            most = f"{leaps.max():.3g}"
            sizes = most if np.ptp(leaps) < 0.05 * leaps.max() else f"{leaps.min():.3g} to {most}"
            message = (
                f"{len(leaps)} step(s) of {sizes} from a sample to the next, far faster than all others; kept: unwrap "
                "the encoder at its own period, or split the run where it was moved by hand or set anew"
            )
            tell(FindingKind.JUMP, message, f"qpos.{name}")


def _bridge_glitches(episode: Episode, column: int, tell: _Reporter, where: str) -> None:
    """Interpolate samples of a position that are no readings, so that no velocity is made of them; none is compared.

    What may be motion is kept: many such samples, and those that may answer to a command, with all beside them.
    """
    position = episode.qpos[:, column]
    wrong = signal_quality.glitches(episode.time, position)
    if not wrong.any():
        return
    answering = signal_quality.after_commands(episode.time, episode.ctrl)
    for together in np.split(np.flatnonzero(wrong), np.flatnonzero(np.diff(np.flatnonzero(wrong)) > 1) + 1):
        wrong[together] = not answering[together].any()
    if not wrong.any():
        return
    first, few = int(np.argmax(wrong)), wrong.mean() <= DATA.glitch_share
    message = (
        f"{wrong.sum()} sample(s) far from those before and after, the first {position[first]:.4g} at "
        f"{episode.time[first]:.4g} s; "
    )
    message += (
        "interpolated, and no prediction begins there or is compared"
        if few
        else "kept, as they are many: where they are no readings, interpolate them, or drop them with their commands"
    )
    tell(FindingKind.GLITCH, message, where)
    if not few:
        return
    position[wrong] = np.interp(episode.time[wrong], episode.time[~wrong], position[~wrong])
    for known in (episode.usable, episode.placed):
        known[wrong] = False


def _complete_velocities(episode: Episode, columns: Columns, tell: _Reporter) -> None:
    """Estimate those that were not measured; look at the others' steps and slopes."""
    turning = {joint: episode.qpos[:, first : first + 4] for joint, first in columns.quaternions()}
    for i, name in enumerate(columns.qvel):
        velocity = episode.qvel[:, i]
        position = episode.qpos[:, columns.qpos.index(name)] if columns.slides(name) else None
        if name in columns.missing:
            if position is not None:
                episode.qvel[:, i] = signal_quality.smoothed_velocity(episode.time, position)
            else:
                rates = signal_quality.angular_velocity(episode.time, turning[joint_of(name)])
                episode.qvel[:, i] = rates[:, int(name[-1]) % 3]  # .0 to .2 of a ball joint, .3 to .5 of a free one
            tell(
                FindingKind.MISSING_VELOCITY,
                "not measured; estimated from the position by a cubic Savitzky-Golay filter",
                f"qvel.{name}",
            )
            continue
        step = signal_quality.quantum(velocity)
        if step is not None:
            levels = len(np.unique(velocity))
            tell(
                FindingKind.QUANTISED_VELOCITY,
                f"{levels} distinct values in {len(velocity)} samples, smallest step {step:.4g}",
                f"qvel.{name}",
            )
        if position is not None:
            tell.slope(signal_quality.velocity_slope(episode.time, position, velocity), f"qvel.{name}")
