"""What closing the loop is worth: policies moved to shifted targets, with and without effects that nobody declared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium import spaces

from benchmarks.runner import Result, Row, rows_of
from benchmarks.transfer import sources
from benchmarks.transfer.shared_dynamics import fit_once
from benchmarks.transfer.statistics import enough, steps_to
from sb3_rpto.baselines.domain_randomization import randomised_agent
from sb3_rpto.baselines.transfer import transfer
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.effects import LIBRARY, Declared, Effect, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.evaluation.statistics import stratified_interval
from sb3_rpto.files import write_json

SHIFTS = ("declared", "undeclared", "none")
#: Two fixed targets for each task and shift.
TARGETS = (0, 1)
EPISODES = 10


@dataclass(frozen=True)
class Task:
    """A source, what its user declares, and what its user does not know.

    :param env_id: of gymnasium
    :param declared: names of numbers that are shifted by up to 20 % and declared
    :param lacks: kind of effect, value as a share of its place's peak (or in its units), and objects it sits on
    :param source_steps: of SAC's training in the source, where no agent is found
    """

    env_id: str
    declared: tuple[str, ...]
    lacks: tuple[str, float, tuple[str, ...]]
    source_steps: int


TASKS = {
    "double-pendulum": Task(
        "InvertedDoublePendulum-v5",
        ("pole.length", "pole2.length", "cart.mass"),
        ("coulomb_friction", 0.04, ("slider",)),
        40_000,
    ),
    "hopper": Task(
        "Hopper-v5",
        ("torso.length", "thigh.length", "leg.length", "foot.length", "torso.mass", "foot_geom.friction"),
        ("command_delay", 0.008, ("actuator0", "actuator1", "actuator2")),
        300_000,
    ),
    "cheetah": Task(
        "HalfCheetah-v5",
        ("torso.length", "?thigh.length", "?shin.length", "?foot.length", "torso.mass", "floor.friction"),
        ("coulomb_friction", 0.12, ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")),
        300_000,
    ),
    "walker": Task(
        "Walker2d-v5",
        ("torso.length", "thigh*.length", "leg*.length", "torso.mass", "foot*geom.friction"),
        (
            "coulomb_friction",
            0.1,
            ("thigh_joint", "leg_joint", "foot_joint", "thigh_left_joint", "leg_left_joint", "foot_left_joint"),
        ),
        300_000,
    ),
}
#: Which observations are speeds; what comes after them are forces of constraints, which are shown without noise.
SPEEDS = {"double-pendulum": slice(5, 8), "hopper": slice(5, 11), "cheetah": slice(8, 17), "walker": slice(8, 17)}
SHORT, LONG = (250, 500, 1_000, 2_000), (250, 500, 1_000, 2_000, 5_000, 10_000, 20_000)
ORACLE_STEPS = 100_000
#: Declared numbers are off by at most this share, which a randomised source is told.
SPREAD = 0.2
PHYSICAL = {"dynamics": "physical"}
METHODS: dict[str, tuple[str, tuple[int, ...], dict[str, Any]]] = {
    "zero-shot": ("zero-shot", (), {}),
    "SAC-warm": ("sac-warm", LONG, {"gradient_steps": 1}),
    "RPTO-ensemble": ("rpto", SHORT, {"dynamics": "ensemble"}),
    "RPTO-physical, open loop": ("rpto", SHORT, PHYSICAL),
    # The closed loop without its library: what learning on in a fitted, incomplete simulator is worth.
    "RPTO-physical, declared alone": ("rpto", SHORT, {**PHYSICAL, "close_loop": True, "effects": []}),
    "RPTO-physical, closed loop": ("rpto", SHORT, {**PHYSICAL, "close_loop": True}),
    # Told of no number that may differ: the trace has to find these, too.
    "RPTO-physical, nothing declared": ("rpto", SHORT, {**PHYSICAL, "close_loop": True, "declared": []}),
    # Before its first target step it is what domain randomisation makes of the source's policy.
    "randomised, SAC-warm": ("sac-warm", SHORT, {"gradient_steps": 1}),
}
#: SAC, fine-tuned long in the target, seed 0: the best of its evaluations says what could be reached.
ORACLE = "oracle"
ORACLE_POINTS = tuple(range(ORACLE_STEPS // 10, ORACLE_STEPS + 1, ORACLE_STEPS // 10))


@dataclass(frozen=True)
class Job:
    """One run.

    :param sensors: standard deviation of the noise with which the target's positions are observed, in rad or m, and ten
        times as many rad/s or m/s of the speeds; a closed loop is told
    :param budget: at most so many target steps, but for the oracle; None: the study's
    :param episodes: of an evaluation
    """

    task: str
    shift: str
    target: int
    method: str
    seed: int
    sensors: float = 0.0
    budget: int | None = None
    episodes: int = EPISODES

    @property
    def name(self) -> str:
        """Of its result."""
        place = (self.task, self.shift, self.target, self.method, self.seed)
        told = (*place, f"sensors-{self.sensors:g}") if self.sensors else place
        return "_".join(map(str, told)).replace(" ", "-").replace(",", "")

    @property
    def points(self) -> tuple[int, ...]:
        """Target steps at which the policy is evaluated, beside 0."""
        if self.method == ORACLE:
            return ORACLE_POINTS
        points = METHODS[self.method][1]
        within = tuple(p for p in points if self.budget is None or p <= self.budget)
        return within or ((self.budget,) if points and self.budget else ())

    def to_json(self) -> Row:
        """What a kept result must agree with: one of a larger budget will do, see :func:`long_enough`."""
        return {name: value for name, value in asdict(self).items() if name not in ("budget", "episodes")}


def long_enough(job: Job, result: Result) -> bool:
    """Whether a result is not of a smaller budget than its job now has."""
    return bool(result["rows"][-1]["steps"] >= max(job.points, default=0))


def jobs(
    tasks: Sequence[str], shifts: Sequence[str], targets: Sequence[int], seeds: Sequence[int], **settings: Any
) -> list[Job]:
    """All runs but the oracles, seed by seed, so that an unfinished study is a fair sample.

    :param settings: further ones of :class:`Job`
    :raises ValueError: an unknown task or shift
    """
    for name, given, known in (("tasks", tasks, tuple(TASKS)), ("shifts", shifts, SHIFTS)):
        unknown = set(given) - set(known)
        if unknown:
            raise ValueError(f"{name}: {sorted(unknown)} do not exist; choose from {known}")
    places = product(seeds, tasks, shifts, targets, METHODS)
    return [Job(task, shift, target, method, seed, **settings) for seed, task, shift, target, method in places]


def shifted(task: str, shift: str, target: int) -> list[Effect]:
    """What distinguishes a target from its source, drawn from its number."""
    made = TASKS[task]
    if shift == "none":
        return []
    env = gym.make(made.env_id)
    model = env.unwrapped.model  # type: ignore[attr-defined]
    rng = np.random.default_rng([target, *made.env_id.encode()])
    effects: list[Effect] = moved(model, made.declared, rng)
    kind, size, places = made.lacks
    if shift == "undeclared":
        for place in places:
            effect = LIBRARY[kind](place)
            effect.bind(model)
            value = size * peak_force(model, effect.index) if effect.place == "joint" else size
            effects.append(effect.with_values(np.array([value])))
    env.close()
    return effects


def moved(model: Any, declared: Sequence[str], rng: np.random.Generator) -> list[Effect]:
    """Declared numbers, each off by a random share of at most :data:`SPREAD`."""
    return [d.with_values(d.values * rng.uniform(1 - SPREAD, 1 + SPREAD, 1)) for d in declare(model, declared)]


def peak_force(model: Any, joint: int) -> float:
    """Largest force that the motor of a joint gives, N·m or N."""
    motors = np.flatnonzero(model.actuator_trnid[:, 0] == joint)
    return float(np.abs(model.actuator_gear[motors[0], 0] * model.actuator_ctrlrange[motors[0]]).max())


def make_source(task: str) -> gym.Env:
    """The source of a task."""
    return gym.make(TASKS[task].env_id)


def true_numbers(task: str, shift: str, target: int) -> dict[str, float]:
    """What the declared numbers are in a target, by their names; where nothing differs, what they are in the source."""
    model = make_source(task).unwrapped.model  # type: ignore[attr-defined]
    numbers = [*declare(model, TASKS[task].declared), *shifted(task, shift, target)]
    return {e.label: float(e.values[0]) for e in numbers if isinstance(e, Declared)}


def make_target(task: str, shift: str, target: int, sensors: float = 0.0, seed: int = 0) -> gym.Env:
    """A target of a task, observed with noise as of :class:`Job` that follows from a seed."""
    source = make_source(task)
    effects = shifted(task, shift, target)
    made = apply_effects(source, effects) if effects else source
    return noisy(made, sensor_noise(task, made, sensors), seed) if sensors else made


def sensor_noise(task: str, env: gym.Env, sensors: float) -> np.ndarray:
    """Standard deviation of each observation's noise, (d,), from that of positions."""
    assert env.observation_space.shape is not None
    speeds, noise = SPEEDS[task], np.full(env.observation_space.shape, sensors)
    noise[speeds] *= 10
    noise[speeds.stop :] = 0
    return noise


def noisy(env: gym.Env, noise: np.ndarray, seed: int) -> gym.Env:
    """The environment behind sensors with white noise of this standard deviation, (d,)."""
    rng = np.random.default_rng(seed)
    return gym.wrappers.TransformObservation(
        env, lambda observation: observation + noise * rng.standard_normal(noise.shape), env.observation_space
    )


@cache
def source_agent(task: str, folder: Path) -> tuple[str, str | None]:
    """The source's SAC and its transitions, see :func:`benchmarks.transfer.sources.source_agent`; one for a folder.

    :raises ValueError: the folder's runs are of another agent, with whose curves these would be pooled
    """
    made = TASKS[task]
    agent, data = sources.source_agent(made.env_id, partial(make_source, task), made.source_steps, folder)
    kept, found = folder / f"agent_{task}.json", {"sha256": sources.digest(agent)}
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(kept, found)
    elif json.loads(kept.read_text(encoding="utf-8")) != found:
        raise ValueError(
            f"the runs in {folder} are of another source agent than {agent}; give another folder, or by "
            f"{sources.FOLDER_VARIABLE} the agent that they had"
        )
    return agent, data


def run(job: Job, folder: Path) -> list[Row]:
    """One run.

    :param job: which
    :param folder: of source agents and fits that runs share
    """
    agent, data = source_agent(job.task, folder)
    before: dict[str, float] = {}
    if job.method.startswith("randomised"):
        agent, before = _randomised(job, agent, folder)
    target = partial(make_target, job.task, job.shift, job.target, job.sensors, job.seed)
    method, _, settings = ("sac-warm", (), {}) if job.method == ORACLE else METHODS[job.method]
    kwargs: dict[str, Any] = dict(settings)
    if method == "rpto":
        kwargs["source_data"] = data
        if kwargs["dynamics"] == "physical":
            kwargs.setdefault("declared", list(TASKS[job.task].declared))
        if job.sensors and "close_loop" in kwargs:
            noise = sensor_noise(job.task, make_source(job.task), job.sensors)
            kwargs["dynamics_kwargs"] = {"observation_noise": noise.tolist()}
    truth = true_numbers(job.task, job.shift, job.target)
    rows = transfer(
        method,
        agent,
        partial(make_source, job.task),
        target,
        max(job.points, default=0),
        every=job.points,
        seed=job.seed,
        n_episodes=job.episodes,
        read=partial(_read, job.task, truth),
        before_learning=partial(fit_once, folder=folder),
        **kwargs,
    )
    rows = [{**row, **{name: row[name] + spent for name, spent in before.items()}} for row in rows]
    return [{**row, "method": job.method} for row in rows]  # not that of the registry


def _randomised(job: Job, agent: str, folder: Path) -> tuple[str, dict[str, float]]:
    """The policy of randomised sources that all targets of a task and a seed share, and what it cost."""
    path, declared = folder / f"randomised_{job.task}_{job.seed}.zip", TASKS[job.task].declared
    cost = randomised_agent(agent, partial(make_source, job.task), declared, SPREAD, job.seed, path)
    return str(path), cost


@cache
def uncorrected(task: str) -> PhysicalDynamics:
    """The source's simulator as it is."""
    env = make_source(task)
    assert isinstance(env.observation_space, spaces.Box)
    assert isinstance(env.action_space, spaces.Box)
    return PhysicalDynamics(env.observation_space, env.action_space, threads=1, **physical_config(env))


def _read(task: str, truth: dict[str, float], model: Any) -> dict[str, Any]:
    """One-step errors on D_target of the uncorrected simulator and the model, phi's error, what was traced so far."""
    dynamics = getattr(model, "dynamics", None)
    if dynamics is None:
        return {}
    row: dict[str, Any] = {}
    if model.replay_buffer.target.size() > 1:
        data = model.transitions("target")
        row |= {"source_error": uncorrected(task).error(data), "model_error": dynamics.error(data)}
    known = dynamics.describe()
    off = [abs(known[name] / value - 1) for name, value in truth.items() if name in known]
    if off:
        row["parameter_error"] = float(np.median(off))
    if model.loop.found:
        last = model.loop.found[-1]
        row["verdict"] = last["verdict"]
        declared = {e.label for e in dynamics.effects() if isinstance(e, Declared)}
        row["named"] = "; ".join(sorted(set(dynamics.names) - declared))
    return row


def oracles(rows: pd.DataFrame) -> dict[tuple[str, str, int], float]:
    """The best return of each oracle: (task, shift, target) -> return."""
    best = rows[rows["method"] == ORACLE].groupby(["task", "shift", "target"])["return"].max()
    return {(str(task), str(shift), int(target)): float(value) for (task, shift, target), value in best.items()}


def collected(folder: Path, sensors: float = 0.0) -> pd.DataFrame:
    """All rows of all finished runs whose targets were observed with this noise, see :class:`Job`; and oracles."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    rows = [row for row in rows_of(results) if row["sensors"] == sensors or row["method"] == ORACLE]
    return pd.DataFrame(rows)


def summary(rows: pd.DataFrame, oracles: dict[tuple[str, str, int], float]) -> pd.DataFrame:
    """A line for each task, shift, method and number of target steps, over targets and seeds.

    :param rows: of :func:`collected`; oracles are left out
    :param oracles: return of the oracle of each (task, shift, target)
    :return: IQM of the return with its 95 % interval, for which each target's runs are resampled for themselves, mean
        share of the oracle's, runs, updates and source steps per target step, seconds, median errors of the source, the
        model and its parameters, verdicts
    """
    best = pd.Series([oracles.get(key, np.nan) for key in zip(rows.task, rows["shift"], rows.target)], rows.index)
    rows = rows.assign(share=rows["return"] / best)[rows["method"] != ORACLE]
    lines = []
    for key, part in rows.groupby(["task", "shift", "method", "steps"], sort=False):
        middle, low, high = stratified_interval([of["return"].to_numpy() for _, of in part.groupby("target")])
        steps = max(int(key[3]), 1)
        line = dict(zip(("task", "shift", "method", "steps"), key))
        line |= {"runs": len(part), "iqm": middle, "low": low, "high": high, "share": part["share"].mean()}
        line |= {f"{n}_per_step": part[n].mean() / steps for n in ("updates", "source_steps")}
        line["seconds"] = part["seconds"].mean()
        for name in ("source_error", "model_error", "parameter_error"):
            line[name] = part[name].median() if name in part else np.nan
        verdicts = part["verdict"].dropna() if "verdict" in part else pd.Series(dtype=str)
        line["verdicts"] = ", ".join(f"{n}× {v}" for v, n in verdicts.value_counts().items())
        lines.append(line)
    return pd.DataFrame(lines)


def steps_to_oracle(rows: pd.DataFrame, oracles: dict[tuple[str, str, int], float]) -> pd.DataFrame:
    """First evaluation at which each run was at 90 % of its oracle: quartiles over runs, and how many were.

    Targets without an oracle are left out.
    """
    rows = rows[[place in oracles for place in zip(rows.task, rows["shift"], rows.target)]]
    rows, lines = rows[rows["method"] != ORACLE], []
    for (task, shift, method), part in rows.groupby(["task", "shift", "method"], sort=False):
        reached = []
        for (target, _), one in part.groupby(["target", "seed"]):
            reached.append(steps_to(one, enough(oracles[task, shift, target])))
        q = np.quantile(np.array(reached), [0.25, 0.5, 0.75], method="higher")  # half of the runs: not yet
        line = {"task": task, "shift": shift, "method": method, "runs": len(reached)}
        lines.append(line | dict(zip(("q25", "median", "q75"), q)) | {"reached": int(np.isfinite(reached).sum())})
    return pd.DataFrame(lines, columns=["task", "shift", "method", "runs", "q25", "median", "q75", "reached"])


def fingerprint() -> str:
    """SHA-256 of the targets' numbers, so that two tables can be told to be of the same ones."""
    drawn = {
        f"{task}/{shift}/{i}": [(e.label, e.values.round(12).tolist()) for e in shifted(task, shift, i)]
        for task in TASKS
        for shift in SHIFTS
        for i in TARGETS
    }
    return hashlib.sha256(json.dumps(drawn, sort_keys=True).encode()).hexdigest()
