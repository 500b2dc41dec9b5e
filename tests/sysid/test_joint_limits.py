"""Stops of joints that a target has elsewhere, in the states of a simulator."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_rpto.effects import LIBRARY
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, Report, trace


def traced(
    env_id: str,
    declared: list[str],
    steps: int,
    wrap: Any = lambda env: env,
    kinds: list[str] | None = None,
    **ranges: Any,
) -> Report:
    """What random transitions of an environment tell whose joints have other ranges."""
    source, target = gym.make(env_id), gym.make(env_id)
    for joint, limits in ranges.items():
        target.unwrapped.model.joint(joint).range[:] = limits  # type: ignore[attr-defined]
    target = Monitor(wrap(target))
    agent = SAC("MlpPolicy", target, buffer_size=steps, learning_starts=steps, seed=0, device="cpu").learn(steps)
    assert agent.replay_buffer is not None
    return trace(source, Measurements.from_replay(agent.replay_buffer, source), declared, candidates=kinds, threads=1)


@pytest.mark.slow
def test_stops_that_few_windows_reach_are_found() -> None:
    report = traced("Reacher-v5", ["body0.length", "body1.length"], 300, joint1=(-1.5, 1.6))
    assert report.verdict == "explained"
    assert [effect.label for effect in report.effects] == ["end_stop(joint1)"]
    assert report.effects[0].effect.values == pytest.approx([1.5, -1.4], abs=1e-4)
    # The corrected environment stops where the target does.
    target, corrected = gym.make("Reacher-v5"), report.apply(gym.make("Reacher-v5"))
    target.unwrapped.model.joint("joint1").range[:] = (-1.5, 1.6)  # type: ignore[attr-defined]
    for env in (target, corrected):
        env.reset(seed=0)
    for _ in range(40):
        seen = [env.step(np.array([0.0, 0.5], dtype=np.float32))[0] for env in (target, corrected)]
        np.testing.assert_allclose(*seen, rtol=0, atol=1e-5)
    assert np.arctan2(seen[0][3], seen[0][1]) == pytest.approx(1.6, abs=0.1)


@pytest.mark.slow
def test_stops_are_found_beside_another_effect() -> None:
    drag = partial(apply_effects, effects=[LIBRARY["quadratic_drag"]("motor1_rot", coefficient=0.3)])
    kinds = ["end_stop", "quadratic_drag", "coulomb_friction", "torque_offset"]
    report = traced("Swimmer-v5", ["torso.length"], 300, drag, kinds, motor2_rot=(-0.8, 0.9))
    assert report.verdict == "explained"
    found = {effect.label: effect.effect.values for effect in report.effects}
    assert set(found) == {"end_stop(motor2_rot)", "quadratic_drag(motor1_rot)"}
    low, high = gym.make("Swimmer-v5").unwrapped.model.joint("motor2_rot").range  # type: ignore[attr-defined]
    assert found["end_stop(motor2_rot)"] == pytest.approx([-0.8 - low, 0.9 - high], abs=1e-3)
    assert found["quadratic_drag(motor1_rot)"] == pytest.approx([0.3], rel=1e-3)


@pytest.mark.slow
def test_gusts_are_no_stops() -> None:
    class Gusts(gym.Wrapper):
        def step(self, action: Any) -> Any:
            force = 0.3 * np.random.default_rng(self.count).standard_normal()
            self.count += 1
            self.env.unwrapped.data.qfrc_applied[1] = force  # type: ignore[attr-defined]
            return self.env.step(action)

        count = 0

    report = traced("Reacher-v5", ["body0.length", "body1.length"], 200, Gusts)
    assert report.verdict == "unexplained"
    assert not any(effect.effect.kind == "end_stop" for effect in report.effects)
