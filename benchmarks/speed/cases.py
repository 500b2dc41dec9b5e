"""What is timed: each case builds its variants once and returns what they do."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from gymnasium import spaces
from mujoco.batch import Batch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure

from benchmarks.speed.plain import PlainEnsemble, PlainRPTO
from benchmarks.speed.timing import Variants
from benchmarks.tracing.planting.systems import SYSTEMS
from sb3_rpto.algorithms import RPO, RPTO
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.dynamics.matmul_precision import fast_products
from sb3_rpto.effects import Simulation, declare
from sb3_rpto.effects.corrected_model_io import correct
from sb3_rpto.effects.friction import AsymmetricDamping
from sb3_rpto.effects.simulation import Drive

#: Observation and action dimensions of HalfCheetah, SAC's batch and hidden layers, the ensemble's hidden layers.
OBSERVATION, ACTION, BATCH, HIDDEN, WIDE = 17, 6, 256, (256, 256), (400, 400, 400, 400)
LENGTHS = ("torso.length", "bthigh.length", "bshin.length", "bfoot.length", "fthigh.length", "fshin.length")

Shapes = Counter[tuple[int, int, int, int]]


@dataclass(frozen=True)
class Case:
    """One comparison.

    :param name: what is timed
    :param unit: of the reported milliseconds
    :param count: units in one run of a variant
    :param variants: what takes turns, the fast one by the name "ours"
    :param plain: the one that "ours" is measured against
    :param floor: matrix products that it cannot do without; empty where they are not the cost
    """

    name: str
    unit: str
    count: int
    variants: Variants
    plain: str
    floor: Shapes = field(default_factory=Counter)


class Stage(gym.Env):
    """Spaces, and nothing that happens in them."""

    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(self, observation: int = OBSERVATION, action: int = ACTION) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (observation,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (action,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Always at zero."""
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Stay there."""
        return np.zeros(self.observation_space.shape), 0.0, False, False, {}


def random_rows(n: int, observation: int, action: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Transitions of no system, as a replay buffer takes them."""
    rng = np.random.default_rng(seed)
    return {
        "observations": rng.normal(size=(n, observation)),
        "next_observations": rng.normal(size=(n, observation)),
        "actions": rng.uniform(-1, 1, (n, action)).astype(np.float32),
        "rewards": rng.normal(size=n).astype(np.float32),
        "dones": np.zeros(n, dtype=np.float32),
    }


def update(device: str, count: int, observation: int = OBSERVATION, batch: int = BATCH, rows: int = 20_000) -> Case:
    """SAC's update against SB3's own."""
    sac, rpo = (make(device, observation, batch, rows) for make in (sac_with_data, rpo_with_data))
    variants = {"SB3": partial(sac.train, count, batch), "ours": partial(rpo.train, count, batch)}
    return Case("SAC update", "ms/update", count, variants, "SB3", sac_products(observation, batch, count))


def sac_with_data(device: str, observation: int, batch: int, rows: int) -> SAC:
    """SB3's, with a full replay buffer."""
    sac = SAC("MlpPolicy", Stage(observation), seed=0, device=device, buffer_size=rows, batch_size=batch)
    memory = sac.replay_buffer
    assert memory is not None
    for name, values in random_rows(rows, observation, ACTION).items():
        getattr(memory, name)[:, 0] = values
    memory.full = True
    return _ready(sac)


def rpo_with_data(device: str, observation: int, batch: int, rows: int) -> RPO:
    """Ours, with a full source side and at most 5,000 transitions of the target."""
    target = Stage(observation)
    rpo = RPO("MlpPolicy", Stage(observation), target_env=target, seed=0, device=device, buffer_size=rows)
    rpo.replay_buffer.append("source", **random_rows(rows, observation, ACTION))
    rpo.replay_buffer.append("target", **random_rows(min(rows, 5_000), observation, ACTION, 1))
    return _ready(rpo)


def _ready(model: Any) -> Any:
    model.set_logger(configure(None, []))
    model._current_progress_remaining = 1.0
    return model


def sac_products(observation: int, batch: int, updates: int) -> Shapes:
    """The matrix products that one SAC update cannot do without, times ``updates``."""
    actor = [observation, *HIDDEN, 2 * ACTION]
    critic = [observation + ACTION, *HIDDEN, 1]
    shapes: Shapes = Counter()
    for _ in range(2):  # a ~ pi(s), a' ~ pi(s')
        _forward(shapes, actor, batch, updates)
    _backward(shapes, actor, batch, updates, weights=True, inputs=False)
    for _ in range(2):  # twin critics
        for _ in range(3):  # Q'(s', a'), Q(s, a), Q(s, pi(s))
            _forward(shapes, critic, batch, updates)
        _backward(shapes, critic, batch, updates, weights=True, inputs=False)
        _backward(shapes, critic, batch, updates, weights=False, inputs=True)
    return shapes


def ensemble_training(device: str, steps: int, members: int = 7, rows: int = 5_000) -> Case:
    """The ensemble's gradient steps against a loop over its members."""
    data = _transitions(rows, device)
    models = {cls: _ensemble(cls, device, members) for cls in (EnsembleDynamics, PlainEnsemble)}
    trained = {cls: model._prepare(data, None)[0] for cls, model in models.items()}
    variants = {
        name: partial(_train, models[cls], trained[cls], steps)
        for name, cls in (("loop over members", PlainEnsemble), ("ours", EnsembleDynamics))
    }
    shapes: Shapes = Counter()
    sizes = [OBSERVATION + ACTION, *WIDE, 2 * (OBSERVATION + 1)]
    n = len(trained[EnsembleDynamics].inputs)
    batch = round(n / math.ceil(n / BATCH))  # an epoch's are alike
    _forward(shapes, sizes, batch, steps, members)
    _backward(shapes, sizes, batch, steps, weights=True, inputs=False, n=members)
    return Case("ensemble training", "ms/step", steps, variants, "loop over members", shapes)


def rollouts(device: str, branches: int) -> Case:
    """One-step branches against asking all elites and taking one answer a row."""
    data = _transitions(branches, device)
    models = {cls: _ensemble(cls, device) for cls in (EnsembleDynamics, PlainEnsemble)}
    for model in models.values():
        model._prepare(_transitions(1_000, device), None)
    variants = {
        name: partial(models[cls].step, data.observations, data.actions)
        for name, cls in (("all, then gather", PlainEnsemble), ("ours", EnsembleDynamics))
    }
    shapes: Shapes = Counter()
    _forward(shapes, [OBSERVATION + ACTION, *WIDE, 2 * (OBSERVATION + 1)], branches // 5, 1, 5)
    return Case(f"{branches:,} rollouts", "ms", 1, variants, "all, then gather", shapes)


def whole_loop(device: str, target_steps: int, fit_steps: int) -> Case:
    """``RPTO.learn()`` on HalfCheetah against the same loop with SB3's update and the plain ensemble.

    :param target_steps: in one run of a variant, with one fit of the model
    :param fit_steps: gradient steps of that fit
    """
    source = gym.make("HalfCheetah-v5")
    agent = SAC("MlpPolicy", source, seed=0, device=device, learning_starts=0, buffer_size=25_000)
    agent.learn(1)
    memory = agent.replay_buffer
    assert memory is not None
    memory.reset()
    obs, _ = source.reset(seed=0)
    source.action_space.seed(0)
    for _ in range(25_000):  # what phi_0 is fitted to; fewer would be filled up in the source
        action = source.action_space.sample()
        following, reward, *_ = source.step(action)
        memory.add(obs[None], following[None], action[None], np.array([reward]), np.array([False]), [{}])
        obs = following

    def learn(cls: type[RPTO]) -> Callable[[], Any]:
        model = cls.from_source(
            agent,
            gym.make("HalfCheetah-v5"),
            target_env=gym.make("HalfCheetah-v5", reset_noise_scale=0.11),
            source_data=memory,
            seed=0,
            device=device,
            model_train_freq=target_steps,
        )
        ensemble = model.dynamics
        assert isinstance(ensemble, EnsembleDynamics)
        ensemble.fit, fit = partial(_briefly, ensemble.fit), ensemble.fit  # type: ignore[method-assign]
        model.learn(1)  # fits phi_0, which is not timed
        ensemble.fit = fit  # type: ignore[method-assign]
        ensemble.patience, ensemble.max_steps = fit_steps, fit_steps
        return lambda: model.learn(target_steps, reset_num_timesteps=False)

    variants = {"plain": learn(PlainRPTO), "ours": learn(RPTO)}
    return Case("RPTO.learn()", "ms/target step", target_steps, variants, "plain")


def _briefly(fit: Callable[..., Any], data: Transitions, weights: Any = None, max_steps: int | None = None) -> Any:
    return fit(data, weights, 20)


def columns(transitions: int) -> Case:
    """Finite-difference columns of the physical fit, all in one batch on all threads, against a model for each, on one.

    Variants return the positions after a step of the policy, (columns · transitions, nq).
    """
    env = gym.make("HalfCheetah-v5")
    model, skip = env.unwrapped.model, env.unwrapped.frame_skip  # type: ignore[attr-defined]
    spec = mujoco.MjSpec.from_file(env.unwrapped.fullpath)  # type: ignore[attr-defined]
    effects = declare(model, LENGTHS)
    simulation = Simulation(model, effects, th.get_num_threads())
    rng = np.random.default_rng(0)
    qpos = model.qpos0 + rng.normal(0, 0.1, (transitions, model.nq))
    qvel = rng.normal(0, 1, (transitions, model.nv))
    commands = np.repeat(rng.uniform(-1, 1, (transitions, 1, model.nu)), skip, axis=1)
    null = simulation.null
    values = np.concatenate([null[None], null + 1e-3 * np.diag(null)])

    def batched() -> np.ndarray:
        k = len(values)
        drive = Drive(np.tile(commands, (k, 1, 1)), 0)
        every = np.repeat(values, transitions, axis=0)
        return simulation.rollout(every, np.tile(qpos, (k, 1)), np.tile(qvel, (k, 1)), drive)[0][:, -1]

    def one_by_one() -> np.ndarray:
        ends = []
        for value in values:
            compiled = correct(
                spec.compile(), [e.with_values(value[s]) for e, s in zip(simulation.effects, simulation.slices)]
            )
            data = mujoco.MjData(compiled)
            for q, v, ctrl in zip(qpos, qvel, commands):
                data.qpos, data.qvel, data.ctrl = q, v, ctrl[0]
                mujoco.mj_step(compiled, data, nstep=skip)
                ends.append(data.qpos.copy())
        return np.array(ends)

    variants = {"a compilation a column": one_by_one, "ours": batched}
    return Case("columns of the fit", "ms", 1, variants, "a compilation a column")


def substeps(windows: int, steps: int) -> Case:
    """Simulations of the tracer in which an effect acts in every substep, against a batch of the model as it is."""
    model = mujoco.MjModel.from_xml_string(SYSTEMS["double_pendulum"].xml)
    model.dof_frictionloss[:] = 0.05
    effect = AsymmetricDamping("shoulder", forward=0.02, backward=0.05)
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(0, 0.5, (windows, model.nq)), rng.normal(0, 2, (windows, model.nv))
    commands = np.repeat(rng.uniform(-1, 1, (windows, 1, model.nu)), steps, axis=1)
    threads = th.get_num_threads()
    simulation, batch = Simulation(model, [effect], threads), Batch(model, windows, threads)
    q, v, ctrl, force = (batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qfrc_applied"))

    def ours() -> np.ndarray:
        return simulation.rollout(np.tile(effect.values, (windows, 1)), qpos, qvel, Drive(commands))[0]

    def plain() -> np.ndarray:
        out = np.empty((windows, steps + 1, model.nq))
        batch.reset()
        q[:], v[:], out[:, 0] = qpos, qvel, qpos
        forward, backward = effect.values
        for k in range(steps):
            ctrl[:] = commands[:, k]
            force[:, 0] = -forward * np.maximum(v[:, 0], 0) - backward * np.minimum(v[:, 0], 0)
            batch.step()
            out[:, k + 1] = q
        return out

    return Case("steps of the tracer", "ms", 1, {"MuJoCo's batch": plain, "ours": ours}, "MuJoCo's batch")


def _ensemble(cls: type[EnsembleDynamics], device: str, members: int = 7) -> EnsembleDynamics:
    stage = Stage()
    rule: Any = lambda o, a, n: th.zeros(len(o), dtype=th.bool, device=o.device)  # noqa: E731
    kwargs = {"termination_fn": rule, "n_members": members, "n_elites": min(5, members)}
    return cls(stage.observation_space, stage.action_space, **kwargs).to(device)


def _train(model: EnsembleDynamics, examples: Any, steps: int) -> None:
    """A fit's gradient steps, as it makes them."""
    with nullcontext() if isinstance(model, PlainEnsemble) else fast_products(model.device):
        model._train_epoch(examples, steps)


def _transitions(n: int, device: str) -> Transitions:
    rows = {k: th.as_tensor(v, device=device).float() for k, v in random_rows(n, OBSERVATION, ACTION).items()}
    rows["terminations"] = rows.pop("dones")
    return Transitions(**rows)


def _forward(shapes: Shapes, sizes: Sequence[int], batch: int, times: int, n: int = 1) -> None:
    for n_in, n_out in pairwise(sizes):
        shapes[n, batch, n_in, n_out] += times


def _backward(
    shapes: Shapes, sizes: Sequence[int], batch: int, times: int, *, weights: bool, inputs: bool, n: int = 1
) -> None:
    """Gradients of the weights and of the hidden activations; of the network's input only where asked for."""
    for layer, (n_in, n_out) in enumerate(pairwise(sizes)):
        if weights:
            shapes[n, n_in, batch, n_out] += times
        if layer or inputs:
            shapes[n, batch, n_out, n_in] += times
