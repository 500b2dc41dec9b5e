"""Clocks whose stamps jitter while the samples do not: a logger that is late by a little, now and then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sb3_rpto.sysid.data import signal_quality
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.findings import Finding, FindingKind

#: A clock that jitters by less than this fraction of its interval is even.
SLIGHT = 0.005
#: Stamps may be off an even clock by so much of its interval, else they are another sample's.
WITHIN = 0.45
#: At even times the variance of the differences must be less by this share, where the joint moves fast.
SMOOTHER = 0.05
#: Order of the divided differences that tell smooth motion from noise.
ORDER = 4


def settle_clock(data: Measurements) -> tuple[Measurements, list[Finding]]:
    """Give the samples even times where the stamps jitter and the positions do not follow them.

    A sample that was taken late shows where the joint was then: fast motion is smooth on the stamps. A stamp that was
    written late shows nothing: it is smooth on an even clock.

    :param data: recordings; not changed
    :return: the recordings, and what was found
    """
    if data.exact:
        return data, []
    jittered = {i: even for i, e in enumerate(data.episodes) if (even := _even(e)) is not None}
    if not jittered:
        return data, []
    there = [data.episodes[i] for i in jittered]
    instead = [replace(data.episodes[i], time=time) for i, time in jittered.items()]
    ratios = [_roughness(instead, column) / _roughness(there, column) for column in range(len(data.columns.qpos))]
    if not np.exp(np.mean(np.log(ratios))) < 1 - SMOOTHER:
        return data, []
    message = (
        f"the stamps jitter and the samples do not: on an even clock the positions have {np.mean(ratios):.0%} of the "
        "noise variance that they have on the stamps, where they move fast; traced with even times"
    )
    episodes = [replace(e, time=jittered[i]) if i in jittered else e for i, e in enumerate(data.episodes)]
    kept = [finding for finding in data.findings if finding.kind != FindingKind.JITTER]
    findings = [Finding.of_run(FindingKind.EVEN_CLOCK, data.episodes[i].name, "time", message) for i in jittered]
    return replace(data, episodes=episodes, findings=kept), findings


def _even(episode: Episode) -> np.ndarray | None:
    """Times of an even clock near the stamps; None where they do not jitter, or no such clock is near."""
    time = episode.time
    if len(time) < 4 * ORDER or signal_quality.jitter(time) <= SLIGHT:
        return None
    steps = np.diff(time)
    ticks = np.append(0, np.cumsum(np.maximum(1, np.round(steps / np.median(steps)))))
    interval, begin = np.polyfit(ticks, time, 1)
    even = begin + interval * ticks
    return even if np.abs(even - time).max() < WITHIN * interval else None


def _roughness(episodes: list[Episode], column: int) -> float:
    """Mean square of the divided differences of a position in the faster half of the motion."""
    found, moved = [], []
    for e in episodes:
        position = e.qpos[:, column]
        found.append(signal_quality.divided_differences(e.time, position, ORDER))
        moved.append(np.ptp(np.lib.stride_tricks.sliding_window_view(position, ORDER + 1), axis=1))
    square, speed = np.concatenate(found) ** 2, np.concatenate(moved)
    fast = np.sort(square[speed >= np.median(speed)])
    return float(fast[: max(1, round(0.95 * len(fast)))].mean()) + 1e-300
