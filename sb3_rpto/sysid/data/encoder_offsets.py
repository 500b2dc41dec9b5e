"""Encoder offsets of single runs, as of encoders homed anew where friction lets the machine rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind


@dataclass(frozen=True)
class EncoderOffsets:
    """Zeros of encoders in single runs.

    :param joints: whose encoders they are, J of them
    :param runs: names, R of them
    :param offsets: what the encoder shows in a run beyond the true position, rad or m, (R, J); where the mean of all
        runs is beyond chance, beyond that: it is a bias of the sensor, as any other that all runs have
    :param gain: share of the typical window error that they save, where they were found by a trace on windows that they
        were not fitted to
    :param t: of that gain; NaN where a known model found them
    """

    joints: tuple[str, ...]
    runs: tuple[str, ...]
    offsets: np.ndarray
    gain: float
    t: float

    def rows(self) -> list[list[str]]:
        """A row for each joint: its name, how far its zeros scatter, and those of single runs."""
        spread = self.offsets.std(axis=0, ddof=min(1, len(self.runs) - 1))
        each = (", ".join(f"{run} {x:+.3g}" for run, x in zip(self.runs, column)) for column in self.offsets.T)
        return [[joint, f"{s:.3g}", runs] for joint, s, runs in zip(self.joints, spread, each)]

    def finding(self) -> Finding:
        """For the report."""
        each = "; ".join(f"{joint} by {spread} ({runs})" for joint, spread, runs in self.rows())
        message = (
            f"differ: {each}, in rad or m. That saves {self.gain:.0%} of the window error (t = {self.t:.1f}). Such are "
            "encoders that are zeroed anew where friction holds the machine, or that slip. They are taken off the "
            "fitted runs; those of other runs are not known, and predictions err by that much more there. Home the "
            "machine at a stop or a mark"
        )
        return Finding(FindingKind.RUN_ZEROS, "fitted runs, encoders", message)

    def to_json(self) -> dict[str, Any]:
        """Offsets by joint and run, and the evidence for them."""
        each = {joint: dict(zip(self.runs, column)) for joint, column in zip(self.joints, self.offsets.T.tolist())}
        return {"offsets": each, "gain": self.gain, "t": self.t}

    def taken_off(self, data: Measurements) -> Measurements:
        """The recordings as encoders with one zero would have shown them; runs of other names as they are."""
        columns = [data.columns.qpos.index(name) for name in self.joints]
        episodes = []
        for episode in data.episodes:
            if episode.run in self.runs:
                qpos = episode.qpos.copy()
                qpos[:, columns] -= self.offsets[self.runs.index(episode.run)]
                episode = replace(episode, qpos=qpos)
            episodes.append(episode)
        return replace(data, episodes=episodes)
