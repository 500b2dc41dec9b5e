"""What the first trace of a transfer finds in its few target transitions, on targets whose truth is known."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_rpto.algorithms.closing import FIRST, WINDOW
from sb3_rpto.effects import Declared
from sb3_rpto.experiments.closed_loop import TASKS, make_source, make_target, shifted, source_agent
from sb3_rpto.tracing import Measurements, Report, trace
from sb3_rpto.tracing.report import write_atomically


@dataclass(frozen=True)
class Job:
    """One trace.

    :param task: of :data:`sb3_rpto.experiments.closed_loop.TASKS`
    :param shift: of :data:`sb3_rpto.experiments.closed_loop.SHIFTS`
    :param target: number that the target is drawn from
    :param seed: of the target's starts and the policy's noise
    """

    task: str
    shift: str
    target: int
    seed: int = 0


def run(job: Job, folder: Path) -> dict[str, Any]:
    """Let the source's policy act in the target, trace, and compare with the truth; finished ones are read again.

    :param job: which
    :param folder: for result files, and source agents where none are found
    :return: verdict, R before and after, what was named, what was there, largest relative error of the declared
        numbers, seconds
    """
    path = folder / f"trace_{job.task}_{job.shift}_{job.target}_{job.seed}.json"
    if not path.exists():
        data = first_transitions(job, folder)
        began = time.perf_counter()
        report = trace(
            make_source(job.task),
            data,
            TASKS[job.task].declared,
            seed=job.seed,
            horizon=(WINDOW - 1) * float(make_source(job.task).unwrapped.dt),  # type: ignore[attr-defined]
            threads=1,
        )
        row = {**asdict(job), **judged(job, report), "seconds": round(time.perf_counter() - began, 1)}
        write_atomically(path, json.dumps(row, indent=1) + "\n")
    return dict(json.loads(path.read_text()))


def first_transitions(job: Job, folder: Path) -> Measurements:
    """As many target transitions as a transfer takes before its first trace, by the source's stochastic policy."""
    agent, _ = source_agent(job.task, folder)
    settings: dict[str, Any] = {"buffer_size": FIRST, "learning_starts": 0, "gradient_steps": 0, "seed": job.seed}
    target = Monitor(make_target(job.task, job.shift, job.target))
    sac = SAC.load(agent, env=target, device="cpu", **settings)
    sac.learn(FIRST)  # collects, without an update
    assert sac.replay_buffer is not None
    return Measurements.from_replay(sac.replay_buffer, target)


def judged(job: Job, report: Report) -> dict[str, Any]:
    """What a report says, beside what is true."""
    truth = {e.label: float(e.values[0]) for e in shifted(job.task, job.shift, job.target)}
    there = {e.label for e in shifted(job.task, job.shift, job.target) if not isinstance(e, Declared)}
    named = {traced.effect.label for traced in report.effects}
    values = {t.effect.label: float(t.effect.values[0]) for t in report.declared}
    nominal = {d.label: float(d.parameters[0].null) for d in (t.effect for t in report.declared)}
    off = {label: abs(value / truth.get(label, nominal[label]) - 1) for label, value in values.items()}
    return {
        "verdict": report.verdict,
        "R_before": report.adequacy_before.ratio,
        "R_after": report.adequacy_after.ratio,
        "there": len(there),
        "named": len(named),
        "right": len(named & there),
        "named_effects": "; ".join(sorted(named)),
        "declared_error_median": float(np.median(list(off.values()))),
        "declared_error_max": float(max(off.values())),
        "declared_worst": max(off, key=lambda label: off[label]),
    }
