"""Some hundred transitions of a simulator are soon over, and tell all the same what it lacks."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from simulated import PENDULUM, briefly, recorded
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_rpto import apply_effects
from sb3_rpto.effects import LIBRARY
from sb3_rpto.sysid import Measurements, trace

STEP = 0.02
MOTORS = ("actuator0", "actuator1")


def reacher() -> gym.Env:
    return gym.make("Reacher-v5", max_episode_steps=1_000)


def transitions(env: gym.Env, n: int) -> ReplayBuffer:
    """One episode of smoothed random actions."""
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    buffer = ReplayBuffer(n, env.observation_space, env.action_space, "cpu", handle_timeout_termination=False)
    action = np.zeros(2, np.float32)
    for _ in range(n):
        action = (0.5 * action + 0.5 * env.action_space.sample()).astype(np.float32)
        following, reward, terminated, _, _ = env.step(action)
        buffer.add(obs[None], following[None], action[None], np.array([reward]), np.array([terminated]), [{}])
        obs = following
    return buffer


@pytest.mark.slow
@pytest.mark.parametrize("late", [(), MOTORS], ids=["complete", "late-motors"])
def test_a_second_and_a_half_of_a_simulator_are_enough(late) -> None:
    """Late commands of all motors look like late sensors of all joints; fewer and exact is what acts."""
    env = reacher()
    target = apply_effects(env, [LIBRARY["command_delay"](motor, delay=STEP) for motor in late])
    data = Measurements.from_replay(transitions(target, 78), env)
    kinds = ["command_delay", "sensor_delay"]
    report = trace(env, data, ["body0.mass"], candidates=kinds, horizon=3 * STEP, threads=1, seed=0)
    assert report.verdict == ("explained" if late else "complete")
    assert [e.label for e in report.effects] == [f"command_delay({motor})" for motor in late]
    for found in report.effects:
        assert found.effect.values == pytest.approx([STEP], rel=1e-3)


@pytest.mark.slow
def test_test_runs_too_short_to_predict_are_told() -> None:
    whole = recorded()
    parts = ["train", "train", "train", "test"]
    episodes = [replace(e, part=part) for e, part in zip(whole.episodes, parts)]
    names = ("time", "qpos", "qvel", "ctrl", "qfrc", "enabled", "usable", "placed")
    arrays = {name: getattr(episodes[-1], name)[:8] for name in names}
    data = replace(whole, episodes=[*episodes[:-1], replace(episodes[-1], **arrays)])
    report = briefly(PENDULUM, data, ["hinge.damping"], ["torque_offset"])
    assert report.before == report.after == []
    (finding,) = [f for f in report.findings if f.where == "test runs"]
    assert "no error on unseen runs: the longest stretch of theirs has 35 ms" in finding.message
