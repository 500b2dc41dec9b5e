"""D_source in a corrected simulator: the same states and actions, with what follows there."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import SMALL_POLICY

from sb3_rpto import RPTO
from sb3_rpto.algorithms.relabel import relabelled
from sb3_rpto.buffers import chronological
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.envs.corrected import apply_effects

POLES = "InvertedDoublePendulum-v5"


def made(task: str) -> tuple[RPTO, PhysicalDynamics]:
    """A model whose D_source holds 300 steps of the source."""
    model = RPTO(
        *("MlpPolicy", gym.make(task)),
        **{"target_env": gym.make(task), "dynamics": "physical", "buffer_size": 300, "policy_kwargs": SMALL_POLICY},
        **{"gradient_steps": 0, "seed": 0, "device": "cpu", "close_loop": True},
    )
    model.learn(1, source_timesteps=0)
    assert isinstance(model.dynamics, PhysicalDynamics)
    return model, model.dynamics


def answered(task: str, effects: list[Effect], observation: np.ndarray, action: np.ndarray) -> tuple[Any, ...]:
    """What the corrected environment itself makes of a state of a Hopper, told by an observation, and an action."""
    env = apply_effects(gym.make(task), effects)
    env.reset(seed=0)
    base: Any = env.unwrapped
    base.set_state(np.concatenate([[0.0], observation[:5]]), observation[5:])
    return env.step(action)


def test_in_the_same_simulator_it_is_what_is_there() -> None:
    model, dynamics = made("Hopper-v5")
    there, again = chronological(model.replay_buffer.source), relabelled(model, dynamics)
    known = (np.abs(there["observations"][:, 5:]) < 10).all(axis=1)
    assert 100 < known.sum() <= 300
    for name, values in again.items():
        np.testing.assert_allclose(values, there[name][known], rtol=1e-4, atol=2e-4, err_msg=name)


def test_what_follows_is_the_corrected_simulators() -> None:
    model, dynamics = made("Hopper-v5")
    dynamics.adopt([LIBRARY["coulomb_friction"]("thigh_joint", level=20.0)])
    again = relabelled(model, dynamics)
    assert len(again["actions"]) > 100
    for row in range(0, len(again["actions"]), 10):
        observation, reward, terminated, _, _ = answered(
            "Hopper-v5", dynamics.effects(), again["observations"][row], again["actions"][row]
        )
        np.testing.assert_allclose(again["next_observations"][row], observation, rtol=1e-4, atol=1e-4)
        assert again["rewards"][row] == pytest.approx(reward, abs=1e-4)
        assert again["terminations"][row] == terminated


@pytest.mark.parametrize("longer", [0.8, 1.2])
def test_a_walker_whose_legs_have_changed_is_as_far_from_the_floor_as_before(longer: float) -> None:
    model, dynamics = made("Hopper-v5")
    usual = relabelled(model, dynamics)
    (leg,) = declare(dynamics.model, ["leg.length"])
    dynamics.adopt([leg.with_values(longer * leg.values)])
    again = relabelled(model, dynamics)
    assert len(again["actions"]) == len(usual["actions"])
    raised = again["observations"][:, 0] - usual["observations"][:, 0]
    assert np.abs(raised).max() < 1.01 * abs(longer - 1) * float(leg.values[0])
    assert np.median(raised) * (longer - 1) > 0
    np.testing.assert_allclose(again["observations"][:, 1:], usual["observations"][:, 1:], atol=1e-6)
    # No foot is pushed out of the floor.
    assert np.abs(again["next_observations"][:, 0] - again["observations"][:, 0]).max() < 0.1


def test_an_observation_that_the_state_does_not_account_for_is_left_out() -> None:
    model, dynamics = made(POLES)
    usual = len(relabelled(model, dynamics)["actions"])
    assert usual == 300
    model.replay_buffer.source.observations[:10, 0, 8] = 5.0  # as a goal would be, which no state holds
    assert len(relabelled(model, dynamics)["actions"]) == 290


@pytest.mark.parametrize(
    "effect",
    [
        LIBRARY["sensor_bias"]("foot_joint", offset=0.1),
        LIBRARY["command_delay"]("actuator0", delay=0.01),
        LIBRARY["actuator_lag"]("actuator1", time_constant=0.02),
    ],
    ids=lambda effect: effect.kind,
)
def test_nothing_is_made_where_the_state_is_not_all(effect: Effect) -> None:
    model, dynamics = made("Hopper-v5")
    dynamics.adopt([effect])
    again = relabelled(model, dynamics)
    assert {name: len(values) for name, values in again.items()} == dict.fromkeys(again, 0)
    assert again["observations"].shape == (0, 11)


def test_nothing_is_made_where_no_step_ends_an_episode() -> None:
    model, dynamics = made("HalfCheetah-v5")
    assert len(relabelled(model, dynamics)["actions"]) == 0


def test_what_a_corrected_simulator_made_is_not_corrected_twice() -> None:
    model, dynamics = made("Hopper-v5")
    (leg,) = declare(dynamics.model, ["leg.length"])
    dynamics.adopt([leg.with_values(1.2 * leg.values)])
    once = relabelled(model, dynamics)
    model.replay_buffer.source.reset()
    model.replay_buffer.append(
        "source", dones=once["terminations"], **{n: v for n, v in once.items() if n != "terminations"}
    )
    twice = relabelled(model, dynamics, dynamics.effects())
    for name, values in twice.items():
        np.testing.assert_allclose(values, once[name], atol=2e-4, err_msg=name)
