"""All robots of gymnasium, acting at random: is what is put into each found, and nothing where nothing is?"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_rpto.algorithms.closing import window
from sb3_rpto.effects import LIBRARY, Effect
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.experiments.closed_loop import moved, peak_force
from sb3_rpto.experiments.first_trace import judged
from sb3_rpto.files import write_text
from sb3_rpto.tracing import Measurements, trace
from sb3_rpto.tracing.contacts import contact_changes

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
#: follows, of the command, or of a step of the environment.
KINDS = {
    "coulomb_friction": (0.1, 0.0),
    "quadratic_drag": (0.1, 5.0),
    "torque_offset": (0.1, 0.0),
    "command_gain": (0.2, 0.0),
    "command_delay": (0.5, 0.0),
}
NOTHING = "nothing"


@dataclass(frozen=True)
class Job:
    """One trace.

    :param robot: of :data:`ROBOTS`
    :param kind: of :data:`KINDS`, or :data:`NOTHING`
    :param seed: of the declared numbers, of where the effect sits, and of the actions
    """

    robot: str
    kind: str
    seed: int = 0


def planted(job: Job) -> list[Effect]:
    """What distinguishes the target: the declared numbers, and an effect at a place that is drawn."""
    env: Any = gym.make(job.robot).unwrapped
    model, rng = env.model, np.random.default_rng([job.seed, *f"{job.robot} {job.kind}".encode()])
    effects: list[Effect] = moved(model, ROBOTS[job.robot], rng)
    if job.kind != NOTHING:
        motor = int(rng.integers(model.nu))
        size, speed = KINDS[job.kind]
        if LIBRARY[job.kind].place == "joint":
            effect = LIBRARY[job.kind](model.joint(int(model.actuator_trnid[motor, 0])).name)
            effect.bind(model)
            value = size * peak_force(model, effect) / (speed**2 or 1.0)
        else:
            effect = LIBRARY[job.kind](model.actuator(motor).name or f"actuator{motor}")
            effect.bind(model)
            value = size * env.dt if job.kind == "command_delay" else 1 - size
        effects.append(effect.with_values(np.array([value])))
    env.close()
    return effects


def run(job: Job, folder: Path) -> dict[str, Any]:
    """Act at random in the target, trace, and compare with the truth; finished ones are read again.

    :param job: which
    :param folder: for result files
    :return: as :func:`~sb3_rpto.experiments.first_trace.judged`, what was put in, and seconds
    """
    path = folder / f"{job.robot}_{job.kind}_{job.seed}.json"
    if not path.exists():
        effects, source = planted(job), gym.make(job.robot)
        target = Monitor(apply_effects(gym.make(job.robot), effects))
        sac = SAC(
            "MlpPolicy", target, buffer_size=TRANSITIONS, learning_starts=TRANSITIONS, seed=job.seed, device="cpu"
        )
        sac.learn(TRANSITIONS)  # collects, without an update
        assert sac.replay_buffer is not None
        data, base = Measurements.from_replay(sac.replay_buffer, source), cast(Any, source.unwrapped)
        horizon = (window(data, contact_changes(base.model, data)) - 1) * float(base.dt)
        began = time.perf_counter()
        report = trace(source, data, ROBOTS[job.robot], seed=job.seed, horizon=horizon, threads=1)
        what = "" if job.kind == NOTHING else effects[-1].label
        row = {**asdict(job), "what": what, **judged(effects, report), "seconds": time.perf_counter() - began}
        write_text(path, json.dumps(row, indent=1) + "\n")
    found: dict[str, Any] = json.loads(path.read_text())
    return found
