"""What 200 transitions of a target say about what its simulator lacks: traces of targets whose truth is known.

    python -m benchmarks tracing targets --tasks cheetah --targets 0 1 2 3 4 5
    python -m benchmarks tracing targets --tasks hopper --targets 0 --noise 0.001
    python -m benchmarks tracing targets --tasks double-pendulum --targets 0 1 2 --sensors 0.001 0.005
    python -m benchmarks tracing targets --tasks hopper --targets 0 1 --nothing-declared

The targets are those of benchmarks/closed_loop, by number, so that ones can be taken that nothing was tuned on.
The source's policy acts in each for 200 steps, as at the beginning of a transfer; no policy learns. With --noise it is
ten runs of at most 100 steps, of which a log shows positions alone, with that noise, at about 100 Hz. With --sensors it
is the 200 steps, observed with that noise, which the trace is told. With --nothing-declared the trace is not told which
numbers may differ either.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from benchmarks.closed_loop.study import (
    SHIFTS,
    TASKS,
    make_source,
    make_target,
    noisy,
    sensor_noise,
    shifted,
    source_agent,
)
from benchmarks.runner import Row, Study
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop, horizon_of
from sb3_rpto.effects import LIBRARY, Declared, Effect
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.data.columns import columns_of

#: Target transitions before a closed loop's first trace.
FIRST = ClosedLoop.settings.first_trace
#: A noisy log: runs, steps of the policy in each, and the longest time between two samples in s.
RUNS, STEPS, SAMPLED = 10, 100, 0.01
#: A shift of the declared numbers, and a cause outside of the library: gusts of so many N on the first coordinate,
#: a sine of so many Hz, whose phase nobody records.
GUSTS, FORCE, FREQUENCY = "gusts", 20.0, 1.0
CAUSES = (*SHIFTS, GUSTS)
#: What shows that a number is another, where nobody declared it.
SHOWN_AS = {"length": "link_length", "mass": "mass_scale", "friction": "geom_friction"}


@dataclass(frozen=True)
class Job:
    """One trace.

    :param task: of :data:`benchmarks.closed_loop.study.TASKS`
    :param shift: of :data:`CAUSES`
    :param target: number that the target is drawn from
    :param seed: of the target's starts and the policy's noise
    :param noise: standard deviation of a log's positions in rad or m, velocities not measured; 0: transitions
    :param sensors: that of the positions which transitions show, and ten times as many rad/s or m/s of the speeds,
        which the trace is told; 0: exact transitions
    :param declared: whether the trace is told which numbers may differ
    """

    task: str
    shift: str
    target: int
    seed: int = 0
    noise: float = 0.0
    sensors: float = 0.0
    declared: bool = True

    @property
    def name(self) -> str:
        """Of its result."""
        how = f"_{self.noise:g}" if self.noise else f"_sensors_{self.sensors:g}" if self.sensors else ""
        how += "" if self.declared else "_nothing-declared"
        return f"{self.task}_{self.shift}_{self.target}_{self.seed}{how}"

    @property
    def planted(self) -> str:
        """The study's shift that is in the target, gusts apart."""
        return "declared" if self.shift == GUSTS else self.shift


class Gusts(gym.Wrapper):
    """A force that changes with time alone, with a phase of its own in each episode.

    :param env: whom it pushes
    :param seed: of the phases
    :param dof: which coordinate
    :param force: its amplitude in N or N·m
    """

    def __init__(self, env: gym.Env, seed: int, dof: int = 0, force: float = FORCE) -> None:
        super().__init__(env)
        self._rng, self._dof, self._force = np.random.default_rng(seed), dof, force

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode at another time of the storm."""
        self._phase = self._rng.uniform(0, 2 * np.pi)
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Blow, and step."""
        robot: Any = self.unwrapped
        phase = 2 * np.pi * FREQUENCY * robot.data.time + self._phase
        robot.data.qfrc_applied[self._dof] = self._force * np.sin(phase)
        return self.env.step(action)


def run(job: Job, folder: Path) -> list[Row]:
    """Let the source's policy act in the target, trace, and compare with the truth.

    :param job: which
    :param folder: for source agents where none are found
    :return: verdict, R before and after, what was named, what was there, largest relative error of the declared
        numbers, seconds
    """
    source = make_source(job.task)
    data = noisy_log(job, folder) if job.noise else first_transitions(job, folder)
    horizon = None if job.noise else horizon_of(data, source)
    began, names = time.perf_counter(), TASKS[job.task].declared if job.declared else ()
    report = trace(source, data, names, seed=job.seed, horizon=horizon, threads=1)
    effects = shifted(job.task, job.planted, job.target)
    if not job.declared:
        effects = [as_effect(e) if isinstance(e, Declared) else e for e in effects]
    return [{**judged(effects, report), "seconds": round(time.perf_counter() - began, 1)}]


def first_transitions(job: Job, folder: Path) -> Measurements:
    """As many target transitions as a transfer takes before its first trace, by the source's stochastic policy."""
    agent, _ = source_agent(job.task, folder)
    settings: dict[str, Any] = {"buffer_size": FIRST, "learning_starts": 0, "gradient_steps": 0, "seed": job.seed}
    target: gym.Env = make_target(job.task, job.planted, job.target)
    if job.shift == GUSTS:
        target = Gusts(target, job.seed)
    noise = sensor_noise(job.task, target, job.sensors) if job.sensors else None
    if noise is not None:
        target = noisy(target, noise, job.seed)
    target = Monitor(target)
    sac = SAC.load(agent, env=target, device="cpu", **settings)
    sac.learn(FIRST)  # collects, without an update
    assert sac.replay_buffer is not None
    return Measurements.from_replay(sac.replay_buffer, make_source(job.task), noise=noise)


def noisy_log(job: Job, folder: Path) -> Measurements:
    """Runs of the source's stochastic policy in the target, as a robot's log shows them: positions, with noise."""
    agent = SAC.load(source_agent(job.task, folder)[0], device="cpu")
    env: gym.Env = make_target(job.task, job.planted, job.target)
    if job.shift == GUSTS:
        env = Gusts(env, job.seed)
    robot: Any = env.unwrapped
    columns, rng = columns_of(robot.model), np.random.default_rng(job.seed)
    skip, step = robot.frame_skip, robot.model.opt.timestep
    stride = max(n for n in range(1, skip + 1) if skip % n == 0 and (n == 1 or n * step <= SAMPLED))
    tables = {}
    agent.set_random_seed(job.seed)
    for run in range(RUNS):
        observation, _ = env.reset(seed=RUNS * job.seed + run)
        positions, commands = list[np.ndarray](), list[np.ndarray]()
        ended = False
        while len(positions) < STEPS * skip // stride and not ended:
            command, _ = agent.predict(observation, deterministic=False)
            robot.frame_skip = stride
            for _ in range(skip // stride):
                positions.append(robot.data.qpos.copy())
                commands.append(command)
                observation, _, ended, _, _ = env.step(command)
            robot.frame_skip = skip
        shown = np.array(positions) + job.noise * rng.standard_normal((len(positions), robot.model.nq))
        table = {"time": stride * step * np.arange(len(shown))}
        table |= {f"qpos.{name}": shown[:, i] for i, name in enumerate(columns.qpos)}
        table |= {f"ctrl.{name}": np.array(commands)[:, i] for i, name in enumerate(columns.ctrl)}
        tables[f"run{run}"] = table
    env.close()
    return Measurements.from_tables(tables)


def as_effect(number: Declared) -> Effect:
    """The effect that shows that a number of the simulator is another, with its size."""
    owner, _, parameter = number.label.rpartition(".")
    (value,) = number.values
    change = value - number.nominal if parameter == "friction" else value / number.nominal - 1
    return LIBRARY[SHOWN_AS[parameter]](owner).with_values(np.array([change]))


def judged(effects: Sequence[Effect], report: Report) -> dict[str, Any]:
    """What a report says, beside what is true; ``alike`` counts effects in place of a like one that is there.

    :param effects: what was put into the target
    """
    truth = {e.label: float(e.values[0]) for e in effects}
    there = {e.label for e in effects if not isinstance(e, Declared)}
    named = {traced.effect.label for traced in report.effects}
    values = {t.effect.label: float(t.effect.values[0]) for t in report.declared}
    nominal = {d.label: float(d.parameters[0].null) for d in (t.effect for t in report.declared)}
    off = {label: abs(value / truth.get(label, nominal[label]) - 1) for label, value in values.items()}
    true = nominal | truth
    shown = [(true[t.label], t.interval[:, 0]) for t in (*report.declared, *report.effects) if t.label in true]
    held = [low <= value <= high for value, (low, high) in shown if low <= high]
    return {
        "verdict": report.verdict,
        "R_before": report.adequacy_before.ratio,
        "R_after": report.adequacy_after.ratio,
        "there": len(there),
        "named": len(named),
        "right": len(named & there),
        "alike": sum(t.effect.label not in there and bool({*t.alike} & (there - named)) for t in report.effects),
        "named_effects": "; ".join(sorted(named)),
        "declared_error_median": float(np.median(list(off.values()))) if off else None,
        "true_effects_off": "; ".join(
            f"{t.effect.values[0] / truth[t.effect.label] - 1:+.4f}" for t in report.effects if t.effect.label in there
        ),
        "intervals": len(held),
        "hold_the_truth": int(sum(held)),
        "declared_error_max": float(max(off.values())) if off else None,
        "declared_worst": max(off, key=lambda label: off[label], default=None),
    }


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--shifts", nargs="+", default=list(SHIFTS), choices=CAUSES)
    parser.add_argument("--targets", nargs="+", type=int, default=list(range(6)))
    parser.add_argument("--noise", type=float, default=0.0, help="of a log's positions in rad or m (default: exact)")
    parser.add_argument("--sensors", nargs="+", type=float, default=[0.0], help="noise of observed positions")
    parser.add_argument("--nothing-declared", action="store_true", help="tell the trace of no number that may differ")


def _jobs(asked: argparse.Namespace) -> list[Job]:
    """Target by target, so that an unfinished table is a fair sample."""
    places, told = product(asked.targets, asked.sensors, asked.tasks, asked.shifts), not asked.nothing_declared
    return [Job(task, shift, i, i if noisy else 0, asked.noise, noisy, told) for i, noisy, task, shift in places]


def _prepare(asked: argparse.Namespace) -> None:
    for task in asked.tasks:
        source_agent(task, asked.runs)


def summary(rows: Sequence[Row]) -> str:
    """What was found in each target."""
    table = pd.DataFrame(rows).sort_values(["task", "sensors", "shift", "target"])
    return table.drop(columns=["seed", "declared_worst", "commit"]).to_string(index=False)


main = Study("tracing targets", "trace_targets", __doc__, _jobs, run, summary, _options, _prepare).main
