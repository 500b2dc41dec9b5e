"""Agents that saw normalised observations, in every command that takes one."""

from __future__ import annotations

import json
import shutil
from collections import deque
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from test_commands import JUDGED, SETTINGS, SOURCE, TARGET, interrupt_at, rows

from sb3_rpto import cli
from sb3_rpto.algorithms.normalisation import read_statistics
from sb3_rpto.commands.policies import NormalisedPolicy, load_policy
from sb3_rpto.evaluation.learning_curve import evaluate

EVERY = [
    pytest.param(m, marks=pytest.mark.slow if m in ("slbo", "trpo-warm", "sysid-retrain", "rto") else ())
    for m in SETTINGS
    if m != "sac"
]


def far() -> VecNormalize:
    """Statistics under which the agent sees all else than the cart-pole shows."""
    env = VecNormalize(make_vec_env(SOURCE))
    env.obs_rms.mean[:], env.obs_rms.var[:], env.obs_rms.count = 1.5, 0.04, 1e6
    env.ret_rms.var, env.ret_rms.count = np.float64(9.0), 1e6
    return env


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A zip, and the file of its statistics beside it."""
    folder, env = tmp_path_factory.mktemp("normalised"), far()
    settings = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 20, "device": "cpu", "seed": 0}
    SAC("MlpPolicy", env, **settings).learn(60).save(folder / "model.zip")
    env.save(str(folder / "vecnormalize.pkl"))
    return folder / "model.zip"


def transfer(agent: Path, out: Path, method: str, *options: str) -> int:
    given = ["transfer", str(agent), TARGET, "--method", method, "--out", str(out), "--device", "cpu"]
    return cli.main([*given, "--steps", "60", *JUDGED, *SETTINGS[method], *options])


def seen_rightly(agent: Path) -> float:
    """What the agent earns in the target, as the curves judge it."""
    env = far()
    target = VecNormalize(make_vec_env(TARGET, n_envs=2), training=False)
    target.obs_rms = env.obs_rms
    return evaluate(SAC.load(agent, device="cpu"), target, 2, 0)


@pytest.mark.parametrize("method", EVERY)
def test_it_is_transferred_by_every_method(
    method: str, agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert transfer(agent, tmp_path, method) == 0
    assert f"ZIP sees observations normalised by {agent.with_name('vecnormalize.pkl')}" in capsys.readouterr().err
    first = rows(tmp_path)[0]["return"]
    if method != "trpo-warm":  # a clone
        assert first == pytest.approx(seen_rightly(agent), rel=0.02)  # statistics move on a little
    statistics = read_statistics(tmp_path / "vecnormalize.pkl")
    np.testing.assert_allclose(statistics.obs_rms.mean, 1.5, atol=0.01)
    assert json.loads((tmp_path / "config.json").read_text())["vec_normalize"].endswith("vecnormalize.pkl")
    assert cli.main(["enjoy", str(tmp_path), "--episodes", "2", "--seed", "50000"]) == 0
    shown = capsys.readouterr()
    assert f"MODEL sees observations normalised by {tmp_path / 'vecnormalize.pkl'}" in shown.err


@pytest.mark.parametrize("method", ["rpo", "sac-warm", pytest.param("rpto", marks=pytest.mark.slow)])
def test_a_killed_transfer_of_it_goes_on_with_its_statistics(
    method: str, agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed, unbroken = tmp_path / "killed", tmp_path / "unbroken"
    with monkeypatch.context() as patch:
        interrupt_at(60, patch)
        assert transfer(agent, killed, method) == 130
    assert list((killed / "checkpoints").glob("*/vecnormalize.pkl"))
    assert transfer(agent, killed, method) == 0
    assert transfer(agent, unbroken, method) == 0
    counts = [read_statistics(out / "vecnormalize.pkl").obs_rms.count for out in (killed, unbroken)]
    if method != "sac-warm":  # bit for bit, as our checkpoints are
        assert rows(killed) == rows(unbroken)
        assert counts[0] == counts[1]
    assert min(counts) > 1e6


def test_statistics_are_named_or_denied(agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(agent, alone / "model.zip")
    named = str(agent.with_name("vecnormalize.pkl"))
    assert transfer(alone / "model.zip", tmp_path / "named", "zero-shot", "--vec-normalize", named) == 0
    assert rows(tmp_path / "named")[0]["return"] == pytest.approx(seen_rightly(agent), rel=0.02)
    capsys.readouterr()
    assert transfer(agent, tmp_path / "denied", "zero-shot", "--vec-normalize", "none") == 0
    assert rows(tmp_path / "denied")[0]["return"] != pytest.approx(seen_rightly(agent), rel=0.02)
    assert "normalised" not in capsys.readouterr().err
    for name, said in (("nothing.pkl", "--vec-normalize: there is no file"), (str(agent), "cannot be read")):
        assert transfer(agent, tmp_path / "out", "rpo", "--vec-normalize", name) == 2
        assert said in capsys.readouterr().err
    pendulum = tmp_path / "pendulum.pkl"
    VecNormalize(make_vec_env("Pendulum-v1")).save(str(pendulum))
    for method in ("rpo", "sac-warm"):
        assert transfer(agent, tmp_path / "out", method, "--vec-normalize", str(pendulum)) == 2
        assert "its statistics are not of env's observations" in capsys.readouterr().err
    assert cli.main(["enjoy", str(agent), TARGET, "--vec-normalize", str(pendulum)]) == 2
    assert "name the file that was saved with it" in capsys.readouterr().err


@pytest.mark.parametrize("method", ["zero-shot", "rpo"])
def test_an_agent_without_its_statistics_is_told_of(method: str, agent: Path, tmp_path: Path) -> None:
    """By what it earned in training."""
    (tmp_path / "alone").mkdir()
    sac = SAC.load(agent, device="cpu")
    sac.ep_info_buffer = deque([{"r": 180.0 + i, "l": 200, "t": 0.0} for i in range(20)], maxlen=100)
    sac.save(tmp_path / "alone" / "model.zip")
    with pytest.warns(UserWarning, match=r"in env, where its zip remembers 194.5.*--vec-normalize") as said:
        assert transfer(tmp_path / "alone" / "model.zip", tmp_path / "out", method) == 0
    assert len([warning for warning in said if "remembers" in str(warning.message)]) == 1


def test_another_agent_in_a_run_is_refused(agent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert transfer(agent, tmp_path, "zero-shot") == 0
    capsys.readouterr()
    assert transfer(agent, tmp_path, "zero-shot", "--vec-normalize", "none") == 2
    assert "holds a run with vec_normalize=" in capsys.readouterr().err


def test_a_policy_is_enjoyed_by_its_statistics(agent: Path, capsys: pytest.CaptureFixture[str]) -> None:
    statistics = agent.with_name("vecnormalize.pkl")
    policy = load_policy(agent, "MODEL", statistics)
    assert isinstance(policy, NormalisedPolicy)
    sac, env, returns = SAC.load(agent, device="cpu"), gym.make(TARGET), []
    for episode in range(2):
        observation, _ = env.reset(seed=3 if episode == 0 else None)
        total, over = 0.0, False
        while not over:
            action, _ = sac.predict(read_statistics(statistics).normalize_obs(observation), deterministic=True)
            np.testing.assert_array_equal(action, policy.predict(observation, deterministic=True)[0])
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    assert cli.main(["enjoy", str(agent), TARGET, "--episodes", "2", "--seed", "3"]) == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines()[:2] == [f"episode {i + 1}: return {r:.1f}" for i, r in enumerate(returns)]
    assert f"MODEL sees observations normalised by {statistics}" in shown.err
    assert cli.main(["enjoy", str(agent), TARGET, "--episodes", "1", "--vec-normalize", "none"]) == 0
    assert capsys.readouterr().err == ""
