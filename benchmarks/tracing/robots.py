"""Nine robots of gymnasium, seven effects, none, and gusts: what do 300 transitions of random actions say?

    python -m benchmarks tracing robots
    python -m benchmarks tracing robots --robots Ant-v5 Reacher-v5 --kinds nothing coulomb_friction

Lengths, masses or dampings are declared and off by up to a fifth; of the effect, at a joint or actuator that is drawn,
nobody is told, and gusts on a joint are no effect of the library. No robot has a policy: it acts at random.
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

from benchmarks.closed_loop.study import moved, peak_force
from benchmarks.runner import Row, Study
from benchmarks.tracing.targets import GUSTS, Gusts, judged
from sb3_rpto.algorithms.closed_loop.controller import horizon_of
from sb3_rpto.effects import LIBRARY, Effect
from sb3_rpto.effects.names import object_names
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace

#: What is declared of each; all of it is off by up to a fifth.
ROBOTS = {
    "Ant-v5": ("*.length",),
    "HalfCheetah-v5": ("*.length",),
    "Hopper-v5": ("*.mass",),
    "InvertedDoublePendulum-v5": ("*.length",),
    "InvertedPendulum-v5": ("pole.length", "pole.mass"),
    "Pusher-v5": ("r_*.damping",),
    "Reacher-v5": ("*.length",),
    "Swimmer-v5": ("*.length",),
    "Walker2d-v5": ("*.mass",),
}
#: Transitions of uniformly random actions.
TRANSITIONS = 300
#: What is put in: sizes are shares of the largest force of the joint's motor, at the speed in rad/s or m/s that
#: follows, of the command that is added to it, of a step of the environment, or of the ground's time constant.
KINDS = {
    "coulomb_friction": (0.1, 0.0),
    "soft_friction": (0.1, 0.0),
    "quadratic_drag": (0.1, 5.0),
    "torque_offset": (0.1, 0.0),
    "command_gain": (0.8, 0.0),
    "command_delay": (0.5, 0.0),
    "contact_softness": (0.5, 0.0),
}
#: What no effect of the library is has an amplitude of such a share.
NOTHING, PUSHED = "nothing", 0.1
CAUSES = (NOTHING, *KINDS, GUSTS)


@dataclass(frozen=True)
class Job:
    """One trace.

    :param robot: of :data:`ROBOTS`
    :param kind: of :data:`CAUSES`
    :param seed: of the declared numbers, of where the effect sits, and of the actions
    """

    robot: str
    kind: str
    seed: int = 0


def fits(job: Job) -> bool:
    """Whether the robot has a place for what is put in: not all of them touch a ground."""
    if job.kind not in KINDS or LIBRARY[job.kind].place != "geom":
        return True
    robot: Any = gym.make(job.robot).unwrapped
    return bool(LIBRARY[job.kind].places(robot.model))


def make_target(job: Job) -> tuple[gym.Env, list[Effect]]:
    """The target, and what is in it beside gusts: the declared numbers, and an effect at a place that is drawn."""
    env = gym.make(job.robot)
    robot: Any = env.unwrapped
    model, rng = robot.model, np.random.default_rng([job.seed, *f"{job.robot} {job.kind}".encode()])
    effects: list[Effect] = moved(model, ROBOTS[job.robot], rng)
    motor = int(rng.integers(model.nu))
    joint = int(model.actuator_trnid[motor, 0])
    if job.kind in KINDS:
        size, speed = KINDS[job.kind]
        if LIBRARY[job.kind].place == "joint":
            effect = LIBRARY[job.kind](model.joint(joint).name)
            value = size * peak_force(model, joint) / (speed**2 or 1.0)
        elif LIBRARY[job.kind].place == "geom":
            effect, value = LIBRARY[job.kind](LIBRARY[job.kind].places(model)[0]), size
        else:
            effect = LIBRARY[job.kind](object_names(model, "actuator")[motor])
            value = size * robot.dt if job.kind == "command_delay" else size
        effect.bind(model)
        effects.append(effect.with_values(np.array([value, *effect.values[1:]])))
    target: gym.Env = apply_effects(env, effects)
    if job.kind == GUSTS:
        target = Gusts(target, job.seed, int(model.jnt_dofadr[joint]), PUSHED * peak_force(model, joint))
    return target, effects


def run(job: Job, folder: Path) -> list[Row]:
    """Act at random in the target, trace, and compare with the truth.

    :param job: which
    :param folder: not needed
    :return: as :func:`~benchmarks.tracing.targets.judged`, what was put in, and seconds
    """
    (target, effects), source = make_target(job), gym.make(job.robot)
    settings: dict[str, Any] = {"buffer_size": TRANSITIONS, "learning_starts": TRANSITIONS, "seed": job.seed}
    sac = SAC("MlpPolicy", Monitor(target), device="cpu", **settings)
    sac.learn(TRANSITIONS)  # collects, without an update
    assert sac.replay_buffer is not None
    data = Measurements.from_replay(sac.replay_buffer, source)
    horizon = horizon_of(data, source)
    began = time.perf_counter()
    report = trace(source, data, ROBOTS[job.robot], seed=job.seed, horizon=horizon, threads=1)
    what = effects[-1].label if job.kind in KINDS else ""
    return [{"what": what, **judged(effects, report), "seconds": round(time.perf_counter() - began, 1)}]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--kinds", nargs="+", default=list(CAUSES), choices=CAUSES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])


def _jobs(asked: argparse.Namespace) -> list[Job]:
    """Kind by kind, so that an unfinished table is a fair sample."""
    listed = [Job(robot, kind, seed) for seed, kind, robot in product(asked.seeds, asked.kinds, asked.robots)]
    return [job for job in listed if fits(job)]


def summary(rows: Sequence[Row]) -> str:
    """What was found in each robot."""
    shown = ["robot", "what", "verdict", "named_effects", "true_effects_off", "R_before", "R_after", "seconds"]
    return pd.DataFrame(rows)[shown].to_string(index=False)


main = Study("tracing robots", "trace_robots", __doc__, _jobs, run, summary, _options).main
