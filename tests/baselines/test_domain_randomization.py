"""Domain randomisation as a baseline: what is drawn, how a policy is made of it, and what it cost."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import SAC

from benchmarks.closed_loop import study as study
from sb3_rpto.baselines import domain_randomization
from sb3_rpto.baselines.domain_randomization import RandomisedEnv, randomised_agent
from sb3_rpto.effects import declare

TASK, NAMES = "InvertedPendulum-v5", ("pole.length", "cart.mass")


def numbers(env: gym.Env) -> np.ndarray:
    return np.concatenate([e.values for e in declare(env.unwrapped.model, NAMES)])  # type: ignore[attr-defined]


def drawn(env: RandomisedEnv, seed: int | None = None) -> np.ndarray:
    env.reset(seed=seed)
    return numbers(env)


def test_each_episode_is_another_machine_within_the_spread() -> None:
    nominal, env = numbers(gym.make(TASK)), RandomisedEnv(gym.make(TASK), NAMES, 0.2)
    found = np.array([drawn(env, 0), *(drawn(env) for _ in range(60))])
    factors = found / nominal
    assert (np.abs(factors - 1) <= 0.2).all()
    assert len(np.unique(factors.round(9), axis=0)) == 61
    assert (factors.min(axis=0) < 0.83).all()  # one of 61 is, but for one time in thousands
    assert (factors.max(axis=0) > 1.17).all()
    assert abs(np.corrcoef(factors.T)[0, 1]) < 0.5
    np.testing.assert_array_equal(drawn(env, 0), found[0])
    np.testing.assert_array_equal(drawn(RandomisedEnv(gym.make(TASK), NAMES, 0.2), 1), drawn(env, 1))


def test_without_a_spread_it_is_the_source_bit_for_bit() -> None:
    envs = gym.make(TASK), RandomisedEnv(gym.make(TASK), NAMES, 0.0)
    first, second = ([env.reset(seed=3)[0], env.step(np.array([0.7], np.float32))[0]] for env in envs)
    np.testing.assert_array_equal(first, second)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain_randomization, "UPDATES", 12)
    monkeypatch.setattr(domain_randomization, "FILL", 160)
    monkeypatch.setattr(domain_randomization, "CHECKS", 3)
    monkeypatch.setattr(domain_randomization, "EPISODES", 2)


def source(folder: Path) -> str:
    path = folder / "source.zip"
    SAC("MlpPolicy", gym.make(TASK), seed=0, device="cpu", buffer_size=1_000, batch_size=32).save(path)
    return str(path)


def test_a_policy_is_made_once_and_its_cost_is_kept(short: None, tmp_path: Path) -> None:
    path = tmp_path / "new" / "agent.zip"
    make = partial(randomised_agent, source(tmp_path), partial(gym.make, TASK), NAMES, 0.2, 0, path)
    cost = make()
    assert (cost["updates"], cost["source_steps"]) == (12, 160 + 12 * 8)
    made = SAC.load(path, device="cpu")
    assert 0 < made._n_updates <= 12
    written = path.read_bytes()
    assert make() == cost
    assert path.read_bytes() == written
    assert {p.name for p in path.parent.iterdir()} == {"agent.zip", "agent.json"}


def test_the_study_counts_what_the_policy_cost_before_its_first_target_step(
    short: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = source(tmp_path)
    task = study.Task(TASK, NAMES, ("coulomb_friction", 0.1, ("slider",)), 100)
    monkeypatch.setitem(study.TASKS, "pendulum", task)
    monkeypatch.setattr(study, "source_agent", lambda task, folder: (agent, None))
    job = study.Job("pendulum", "declared", 0, "randomised, SAC-warm", 0, budget=20, episodes=1)
    rows = pd.DataFrame(study.run(job, tmp_path))
    assert rows["steps"].tolist() == [0, 20]
    assert rows["source_steps"].tolist() == [256, 256]
    assert rows["updates"].iloc[0] == 12
    assert rows["updates"].iloc[1] - 12 in (19, 20)
    assert (rows["seconds"] > 0).all()
