"""From a robot's log to a policy that works on it: record, trace what the simulator lacks, go on in the corrected one.

    python examples/robot_log_to_policy.py
    python examples/robot_log_to_policy.py --seed 1 --agent rpto

The robot is an inverted double pendulum whose lower pole is longer than its simulator says, and which has something in
it that the simulator does not know at all; the seed draws what. It is simulated here too, in finer time steps, but all
that is learned of it comes from CSV files. What is in it is told at the end. Some ten minutes on two cores the first
time; the source policy is kept for the next.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.monitor import Monitor

from sb3_rpto import RPTO
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, Report, trace

TASK = "InvertedDoublePendulum-v5"
DECLARED = ["pole.length"]  # what the makers of the simulator are unsure of
SOLVED = 9_300  # return at which a policy counts as converged: 9,360 is the most there is
DECISION, SAMPLE, STEP = 0.05, 0.005, 0.001  # s between commands, between rows of the log, of the robot's simulation
LONGEST, AFTER = 2.0, 0.1  # s that an attempt is recorded, and that it falls on
NOISE = {"qpos": 1e-3, "qvel": 0.02}  # of the encoders, in m or rad, and m/s or rad/s
#: One of these is in the robot: kind, place, parameter, and the range that its value is drawn from.
SECRETS = (
    ("actuator_lag", "slide", "time_constant", (0.027, 0.035)),
    ("command_delay", "slide", "delay", (0.015, 0.022)),
    ("torque_offset", "hinge", "offset", (0.8, 1.2)),
)
STEPS_PER_UPDATE = 8  # that RPTO takes in a corrected simulator, as updates cost far more
COLUMNS = ["time", *(f"{what}.{joint}" for what in NOISE for joint in ("slider", "hinge", "hinge2")), "ctrl.slide"]


class Robot:
    """The machine; :meth:`truth` is read in the last line of :func:`main` alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        kind, place, parameter, bounds = SECRETS[seed % len(SECRETS)]
        (pole,) = declare(gym.make(TASK).unwrapped.model, DECLARED)
        unknown = LIBRARY[kind](place, **{parameter: rng.uniform(*bounds)})
        self._inside: list[Effect] = [pole.with_values(rng.uniform(1.08, 1.2) * pole.values), unknown]

    def env(self, dt: float = DECISION) -> gym.Env:
        """The robot as an environment that takes a command every ``dt`` seconds."""
        env = gym.make(TASK, frame_skip=round(dt / STEP))
        env.unwrapped.model.opt.timestep = STEP
        return apply_effects(env, self._inside)

    def truth(self) -> str:
        return "; ".join(map(str, self._inside))


def source_policy(folder: Path, steps: int) -> Path:
    """A SAC that balances in the simulator; trained once."""
    path = folder / f"source_{steps}.zip"
    if not path.exists():
        print("training a policy in the simulator (once)")
        model = SAC("MlpPolicy", gym.make(TASK), seed=0, device="cpu")
        learn(model, gym.make(TASK), steps, folder)
        model.save(path)
    return path


def learn(model: SAC, check: gym.Env, steps: int, folder: Path) -> SAC:
    """Learn until all is learned; the best policy. Evaluations in a simulator are free.

    :param check: as the model's environment
    """
    solved = StopTrainingOnRewardThreshold(SOLVED, verbose=0)
    every = {"eval_freq": min(steps, 1_000), "n_eval_episodes": 10, "verbose": 0}
    best = EvalCallback(Monitor(check), callback_on_new_best=solved, best_model_save_path=str(folder), **every)
    best.eval_env.seed(0)  # it decides when to stop
    model.learn(steps, callback=best)
    model.set_parameters(folder / "best_model.zip", device="cpu")
    return model


def record(robot: Robot, policy: SAC, folder: Path, attempts: int, seed: int) -> None:
    """Let the policy try, with its exploration, and leave one CSV file for each attempt, as a robot's logger would."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("attempt*.csv"):
        old.unlink()
    env, rng = robot.env(SAMPLE), np.random.default_rng(seed)
    state = env.unwrapped.data
    policy.set_random_seed(seed)
    for attempt in range(attempts):
        observation, _ = env.reset(seed=1_000 * seed + attempt)
        rows, end = [], round(LONGEST / SAMPLE)
        while len(rows) <= end:
            if len(rows) % round(DECISION / SAMPLE) == 0:
                command, _ = policy.predict(observation)
            shown = [getattr(state, what) + size * rng.standard_normal(3) for what, size in NOISE.items()]
            rows.append([len(rows) * SAMPLE, *np.concatenate(shown), *command])
            observation, _, fallen, _, _ = env.step(command)
            if fallen:
                end = min(end, len(rows) + round(AFTER / SAMPLE))
        with (folder / f"attempt{attempt:02d}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows([[f"{value:.6f}" for value in row] for row in rows])


def by_sac(source: Path, report: Report, steps: int, folder: Path, seed: int) -> SAC:
    """The source policy goes on by plain SAC in the corrected simulator."""
    model = SAC.load(source, env=report.apply(gym.make(TASK)), device="cpu")
    model.set_random_seed(seed)
    model.learning_starts = 0
    return learn(model, report.apply(gym.make(TASK)), steps, folder)


def by_rpto(source: Path, data: Measurements, kinds: list[str] | None, steps: int, seed: int) -> tuple[RPTO, Report]:
    """The log in place of a target: RPTO traces it, and learns in the simulator (alone, if that explains the log)."""
    model = RPTO.from_source(
        source,
        gym.make(TASK),
        target_data=data,
        dynamics="physical",
        declared=DECLARED,
        close_loop=True,
        effects=kinds or "all",
        seed=seed,
        device="cpu",
    )
    model.learn(STEPS_PER_UPDATE * steps)
    return model, model.loop.reports[0]


def returns(policy: SAC, robot: Robot, episodes: int) -> str:
    """What the policy earns on the robot, from the same starts for all."""
    env, found = robot.env(), []
    for episode in range(episodes):
        observation, _ = env.reset(seed=500 + episode)
        found.append(0.0)
        over = False
        while not over:
            observation, reward, fallen, timeout, _ = env.step(policy.predict(observation, deterministic=True)[0])
            found[-1] += float(reward)
            over = fallen or timeout
    return f"{np.mean(found):6,.0f}  (median {np.median(found):,.0f}, worst {min(found):,.0f}, best {max(found):,.0f})"


def progress(share: float, what: str) -> None:
    print(f"\r[{share:4.0%}] {what:<60}", end="", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="another seed is another robot")
    parser.add_argument(
        "--agent", choices=("sac", "rpto"), default="sac", help="what goes on in the corrected simulator"
    )
    parser.add_argument("--attempts", type=int, default=16, help="recorded on the robot")
    parser.add_argument(
        "--steps",
        type=int,
        default=8_000,
        help="of learning in the corrected simulator, at most; RPTO takes eight times as many for as many updates",
    )
    parser.add_argument("--source-steps", type=int, default=40_000, help="of learning before, at most")
    parser.add_argument("--episodes", type=int, default=10, help="of an evaluation on the robot")
    parser.add_argument("--out", type=Path, default=Path("runs/robot_log_to_policy"))
    parser.add_argument("--quick", action="store_true", help="see it run in seconds; the policy learns nothing")
    arguments = parser.parse_args()
    out, seed, kinds = arguments.out, arguments.seed, None
    if arguments.quick:
        arguments.steps = arguments.source_steps = 200
        arguments.attempts, arguments.episodes = 8, 2
        kinds = ["actuator_lag", "torque_offset"]
    out.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)  # more are no quicker for networks of this size
    source = source_policy(out, arguments.source_steps)
    robot, policy = Robot(seed), SAC.load(source, device="cpu")
    before = returns(policy, robot, arguments.episodes)
    print(f"the policy on the robot: {before}")

    record(robot, policy, out / "log", arguments.attempts, seed)
    data = Measurements.from_csv(out / "log" / "attempt*.csv")
    seconds = sum(episode.time[-1] for episode in data.episodes)
    print(f"recorded: {len(data.episodes)} attempts, {seconds:.0f} s, in {out / 'log'}")

    # From here on: the log, the simulator, the policy. That is all that you have of a robot, too.
    began = time.perf_counter()
    if arguments.agent == "sac":
        report = trace(gym.make(TASK), data, DECLARED, seed=seed, candidates=kinds, progress=progress)
        print(f"\rtraced in {time.perf_counter() - began:.0f} s{'':60}", file=sys.stderr)
        learned = by_sac(source, report, arguments.steps, out, seed)
    else:
        learned, report = by_rpto(source, data, kinds, arguments.steps, seed)
    print(f"{report}\n")
    report.save(out)
    learned.save(out / f"{arguments.agent}.zip")
    print(f"written: {out}/report.html, report.json, model.xml, effects.json, {arguments.agent}.zip")
    seconds = time.perf_counter() - began
    print(f"traced and learned by {arguments.agent.upper()} in {seconds:.0f} s; no step on the robot\n")

    print(f"return on the robot, {arguments.episodes} episodes each, the same starts")
    print(f"  policy of the simulator            {before}")
    print(f"  policy of the corrected simulator  {returns(learned, robot, arguments.episodes)}")
    print(f"in the robot: {robot.truth()}")
    print(f"found:        {'; '.join(map(str, [*report.declared, *report.effects]))}")


if __name__ == "__main__":
    main()
