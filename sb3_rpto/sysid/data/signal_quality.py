"""What can be wrong with one recorded run: pure functions on arrays, each of which repairs or reports one thing."""

from itertools import pairwise

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from sb3_rpto.sysid.data.settings import DATA

#: A turn in rad.
TURN = 2 * np.pi


def split_at_gaps(time: np.ndarray) -> list[slice]:
    """Cut a run where its clock jumps.

    :param time: increasing times in s, shape (T,)
    :return: adjoining slices that together cover all T samples, in order
    """
    if len(time) < 2:
        return [slice(0, len(time))]
    steps = np.diff(time)
    cuts = np.flatnonzero(steps > DATA.gap * np.median(steps)) + 1
    edges = [0, *cuts.tolist(), len(time)]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def jitter(time: np.ndarray) -> float:
    """Relative jitter of the clock: 95 % of the steps lie within this fraction of the median step around a tick of it.

    Rows that are missing are no jitter.

    :param time: increasing times in s, shape (T,) with T >= 2
    """
    steps = np.diff(time) / np.median(np.diff(time))
    ticks = np.where(steps <= DATA.gap, np.maximum(np.round(steps), 1), 1)
    return float(np.quantile(np.abs(steps - ticks), 0.95))


def divided_differences(time: np.ndarray, position: np.ndarray, order: int) -> np.ndarray:
    """Divided differences of a position, scaled to the variance of white noise, (T - order,).

    On any clock they vanish on polynomials of a degree below their order.

    :param time: increasing times in s, shape (T,)
    :param position: shape (T,)
    :param order: each is of ``order`` + 1 samples
    """
    t, q = (np.lib.stride_tricks.sliding_window_view(x, order + 1) for x in (time, position))
    gaps = t[:, :, None] - t[:, None, :]
    gaps = gaps / np.abs(gaps).max(axis=(1, 2), keepdims=True)
    weights = 1 / np.prod(np.where(np.eye(order + 1, dtype=bool), 1.0, gaps), axis=2)
    return np.asarray((weights * q).sum(1) / np.sqrt((weights**2).sum(1)))


def count_missing_rows(time: np.ndarray) -> int:
    """Number of steps over which, by the others, at least one sample is missing, gaps left out.

    :param time: increasing times in s, shape (T,) with T >= 2
    """
    steps = np.diff(time) / np.median(np.diff(time))
    return int(np.count_nonzero((steps > DATA.missing_row) & (steps <= DATA.gap)))


def unwrap(angle: np.ndarray, change: np.ndarray | None = None) -> tuple[np.ndarray, int, bool]:
    """Undo the wrapping of an angle to one turn.

    Only a signal that stays within one turn (and 1 % for rounding) is taken as wrapped, where it jumps by nearly a
    whole one (within a quarter turn). Where many steps are of about half a turn, its velocity says which way they went.

    :param angle: in rad, shape (T,)
    :param change: of the angle from each sample to the next by its measured velocity, shape (T - 1,); None without one
    :return: the continuous angle, shape (T,), the number of jumps removed, and whether the motion is too fast for the
        samples to tell them
    """
    steps = np.diff(angle)
    if np.ptp(angle) > 1.01 * TURN:
        return angle, 0, False
    jumps = np.where(np.abs(np.abs(steps) - TURN) < TURN / 4, np.sign(steps), 0.0)
    unsure = np.abs(np.abs(steps) - TURN / 2) < TURN / 4  # of about half a turn: either way is as near
    fast = float(np.mean(unsure)) > DATA.fast_angle
    if fast and change is not None:
        told = np.round((steps - change) / TURN)
        if (np.abs(steps - change - TURN * told)[unsure] < TURN / 8).all():
            jumps, fast = np.where(unsure, told, jumps), False
    count = int(np.count_nonzero(jumps))
    return angle - TURN * np.concatenate([[0.0], np.cumsum(jumps)]) if count else angle, count, fast


def glitches(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Samples, one or two in succession, that are no readings of the joint: far off the line between those around.

    What moves would have to come back at once, and is as fast before or after it: a bounce is. Far is eight times the
    change of speed across the samples and of its 90 % quantile, and twice a fast or typical step.

    :param time: increasing times in s, shape (T,)
    :param position: in rad or m, shape (T,)
    :return: whether each sample is one, (T,)
    """
    speed, wrong = np.diff(position) / np.diff(time), np.zeros(len(position), dtype=bool)
    steps, step = np.abs(np.diff(position)), float(np.median(np.diff(time)))
    if len(time) < DATA.slope_span or not steps.any():
        return wrong
    far = 2 * max(float(np.quantile(steps, 0.9)), float(np.median(steps[steps > 0])))
    for rows in (1, 2):
        change = np.abs(speed[rows + 2 :] - speed[: -rows - 2]) * step / 2
        first, last = np.arange(1, len(time) - rows - 2), np.arange(rows + 2, len(time) - 1)  # those around
        share = [(time[first + r] - time[first]) / (time[last] - time[first]) for r in range(1, rows + 1)]
        off = [position[first + r + 1] - (1 - x) * position[first] - x * position[last] for r, x in enumerate(share)]
        off += [position[first + 1] - position[first], position[last - 1] - position[last]]  # and far from either
        least = np.min(np.abs(off), axis=0) * np.all(np.sign(off) == np.sign(off[0]), axis=0)
        for k in first[(least > DATA.jump * np.maximum(change, np.quantile(change, 0.9))) & (least > far)]:
            wrong[k + 1 : k + 1 + rows] = True
    return wrong


def after_commands(time: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Samples at which a joint may go and come back at once, as a command has done so, (T,).

    Twice it changed by more than twice the 90 % quantile of its changes, in the last tenth of a second or two samples,
    whichever is longer.

    :param time: increasing times in s, shape (T,)
    :param commands: shape (T, nu)
    """
    changes = np.abs(np.diff(commands, axis=0))
    unusual = np.flatnonzero((changes > 2 * np.quantile(changes, 0.9, axis=0)).any(axis=1))
    found = np.zeros(len(time), dtype=int)
    for k in unusual:  # between samples k and k + 1, which may have been recorded after it was sent
        found[k : max(k + 4, int(np.searchsorted(time, time[k + 1] + DATA.command_answer, "right")))] += 1
    return found > 1


def jumps(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Steps of a position that are no motion: few, single, and much larger than all others of their time, (T - 1,).

    :param time: increasing times in s, shape (T,)
    :param position: in rad or m, shape (T,)
    :return: whether each step is one
    """
    steps = np.diff(time)
    speed = np.abs(np.diff(position)) / np.maximum(steps, np.median(steps))  # a row may be stamped late
    falling = np.sort(speed)[::-1]
    most = max(1, int(DATA.jump_share * len(speed)))
    larger, smaller = falling[:most], falling[1 : most + 1]
    if len(smaller) < most or not (moving := smaller > 0).any():
        return np.zeros(len(speed), dtype=bool)
    apart = np.where(moving, larger / np.where(moving, smaller, 1.0), 0.0)
    found = speed > smaller[int(np.argmax(apart))]
    single = not (found[1:] & found[:-1]).any()
    return found if apart.max() > DATA.jump and single else np.zeros_like(found)


def align_quaternions(quaternions: np.ndarray) -> int:
    """Give neighbouring samples the sign that makes them near: q and -q are one orientation, differences are not.

    :param quaternions: (T, 4), changed in place
    :return: number of changes of sign undone
    """
    opposite = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions[1:] *= np.where(np.cumsum(opposite) % 2, -1.0, 1.0)[:, None]
    return int(opposite.sum())


def smoothed_velocity(time: np.ndarray, position: np.ndarray, window: int = DATA.filter_rows) -> np.ndarray:
    """Differentiate a position on the run's own clock with a cubic Savitzky-Golay filter.

    Position and time are both differentiated by sample number, and dq/dt = (dq/di) / (dt/di): so a jittered clock
    counts with its true times and nothing is resampled.

    :param time: increasing times in s, shape (T,) with T >= 5
    :param position: in rad or m, shape (T,) or (T, n)
    :param window: odd number of samples, >= 5; cut to the length of the run
    :return: velocity in rad/s or m/s, shape as ``position``
    """
    window = min(window, len(time) - (len(time) + 1) % 2)
    by_sample = savgol_filter(position, window, 3, deriv=1, axis=0)
    return (by_sample.T / savgol_filter(time, window, 3, deriv=1)).T


def angular_velocity(time: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Angular velocity in the body's frame by the same filter: twice the vector part of q* dq/dt.

    :param time: increasing times in s, shape (T,) with T >= 5
    :param quaternions: unit ones, w first, neighbours of near sign, shape (T, 4)
    :return: in rad/s, shape (T, 3)
    """
    rate = smoothed_velocity(time, quaternions)
    w, v = quaternions[:, :1], quaternions[:, 1:]
    return np.asarray(2 * (w * rate[:, 1:] - rate[:, :1] * v - np.cross(v, rate[:, 1:])))


def turning_convention(time: np.ndarray, quaternions: np.ndarray, velocity: np.ndarray) -> str | None:
    """What speaks for another convention than MuJoCo's: a measured angular velocity that fits that one, not this.

    :param time: increasing times in s, shape (T,) with T >= 5
    :param quaternions: unit ones, as they were given, shape (T, 4)
    :param velocity: measured angular velocity in rad/s, shape (T, 3)
    :return: the convention in words; None where w first and the body's frame fit, or nothing does
    """
    conjugate = np.array([1.0, -1.0, -1.0, -1.0])  # turns the other way, and swaps the frames
    scalar_last = np.roll(quaternions, 1, axis=1)
    readings = {
        "": angular_velocity(time, quaternions),
        "angular velocities in the world's frame": -angular_velocity(time, quaternions * conjugate),
        "quaternions x, y, z, w": angular_velocity(time, scalar_last),
        "quaternions x, y, z, w and angular velocities in the world's frame": -angular_velocity(
            time, scalar_last * conjugate
        ),
    }
    size = float(np.linalg.norm(velocity))
    errors = {said: float(np.linalg.norm(reading - velocity)) for said, reading in readings.items()}
    best = min(errors, key=lambda said: errors[said])
    clear = errors[best] < DATA.convention * min(size, errors[""])
    return best if best and clear else None


def quantum(velocity: np.ndarray) -> float | None:
    """Smallest step of a coarsely quantised signal, None when the signal is not quantised.

    Quantised means: fewer than half of the samples away from zero are distinct (zeros alone are a machine at rest).

    :param velocity: shape (T,)
    """
    moving = velocity[velocity != 0]
    levels = np.unique(velocity)
    if len(moving) < 20 or len(levels) < 3 or 2 * len(np.unique(moving)) >= len(moving):
        return None
    return _least_step(levels) or None


def rounding(position: np.ndarray) -> float | None:
    """Step that a position is rounded to, 0 where it is not; None of one that never changes, which tells nothing.

    :param position: shape (T,)
    """
    levels = np.unique(position)
    if len(levels) < 2:
        return None
    if 2 * len(levels) >= len(position):
        return 0.0
    return _least_step(levels)


def _least_step(levels: np.ndarray) -> float:
    """Between neighbours of some levels, of which those are one that differ by float's rounding; 0 where all do."""
    steps = np.diff(levels)
    least = max(1e-9 * np.ptp(levels), 1e-12 * np.abs(levels).max())
    return float(min(steps[steps > least], default=0.0))


def rows_per_reading(positions: np.ndarray) -> int | None:
    """Rows per fresh reading, where all positions are repeated between readings, (n, m); None where they are not.

    A coarse encoder repeats itself too, but changes by one step, and when the motion says so.
    """
    steps = np.diff(positions, axis=0)
    fresh = np.flatnonzero(np.any(steps != 0, axis=1))
    if len(fresh) < DATA.held_readings:
        return None
    gaps = np.diff(fresh)
    usual = int(np.median(gaps))
    low, high = np.quantile(gaps, (0.1, 0.9))
    moved = max(len(np.unique(np.abs(steps[fresh, i]).round(12))) for i in range(positions.shape[1]))
    return usual if usual >= 2 and low >= 2 and high <= 1.5 * usual and moved > DATA.held_changes else None


def velocity_slope(time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float | None:
    """Slope of a measured velocity against the position's change: of all that the noise leaves open, the nearest to 1.

    The velocity's integral over 16 samples is compared with the position's change over them, where both are
    large against their noise. The least-squares slope on a noisy quantity is too small, and that of the inverse
    regression too large: the true one lies between them (Frisch 1934).

    :param time: increasing times in s, shape (T,)
    :param position: shape (T,)
    :param velocity: shape (T,)
    :return: 1 for consistent channels, negative for a flipped sign; None where the joint hardly moved against its
        noise, or where the two have less than a quarter of their variance in common
    """
    # Third differences remove the motion and scale white noise by sqrt(1 + 9 + 9 + 1).
    noise = float(np.std(np.diff(position, 3))) / np.sqrt(20)
    if np.ptp(position) <= 50 * noise or np.ptp(position) < 1e-9:
        return None
    span = min(DATA.slope_span, len(time) // 2)
    integral = cumulative_trapezoid(velocity, time, initial=0)
    return _slope(*(x[span:] - x[:-span] for x in (position, integral)))


def turning_slope(time: np.ndarray, quaternions: np.ndarray, velocity: np.ndarray) -> float | None:
    """As :func:`velocity_slope`, of a measured angular velocity against the quaternions' change.

    :param time: increasing times in s, shape (T,) with T >= 5
    :param quaternions: unit ones, w first, neighbours of near sign, shape (T, 4)
    :param velocity: in rad/s, shape (T, 3)
    """
    if np.sum(np.diff(velocity, axis=0) ** 2) > np.sum(velocity[1:] ** 2):
        return None  # so few samples a swing do not tell how far it turned
    orientation = Rotation.from_quat(np.roll(quaternions, -1, axis=1))  # scipy has w last
    moved = (orientation[:-1].inv() * orientation[1:]).as_rotvec()
    said = 0.5 * np.diff(time)[:, None] * (velocity[1:] + velocity[:-1])
    span = min(DATA.slope_span, len(time) // 2)
    sums = (np.cumsum(np.concatenate([np.zeros((1, 3)), x]), axis=0) for x in (moved, said))
    return _slope(*((x[span:] - x[:-span]).ravel() for x in sums))


def _slope(moved: np.ndarray, said: np.ndarray) -> float | None:
    square, product = moved @ moved, moved @ said
    if product**2 <= 0.25 * square * (said @ said):
        return None
    low, high = sorted((product / square, (said @ said) / product))
    return float(np.clip(1.0, low, high))
