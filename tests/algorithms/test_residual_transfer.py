"""RPTO over a simulator with a small ensemble on what it misses: learns, corrects, comes back from a checkpoint."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_rpto import RPTO
from sb3_rpto.algorithms import pretraining
from sb3_rpto.dynamics.residual import ResidualDynamics
from sb3_rpto.effects import LIBRARY, declare
from sb3_rpto.envs.corrected import apply_effects

TASK = "InvertedPendulum-v5"
TINY = {"n_members": 2, "n_elites": 2, "hidden": (16, 16), "max_steps": 150}


MASS = 1.3


def target():
    env = gym.make(TASK)
    (mass,) = declare(env.unwrapped.model, ["pole.mass"])
    drag = LIBRARY["quadratic_drag"]("slider", coefficient=8.0)
    return apply_effects(env, [mass.with_values(MASS * mass.values), drag])


@pytest.fixture(scope="module")
def learned():
    made = RPTO(
        *("MlpPolicy", gym.make(TASK)),
        target_env=target(),
        dynamics="residual",
        declared=["pole.mass"],
        dynamics_kwargs={"threads": 1, "ensemble_kwargs": TINY},
        **{"seed": 0, "device": "cpu", "gradient_steps": 1, "source_steps": 2, "model_train_freq": 60},
        **{"batch_size": 16, "policy_kwargs": {"net_arch": [16]}, "buffer_size": 500},
    )
    return made.learn(65, source_timesteps=50)


def test_a_simulator_that_needs_no_fit_takes_few_source_steps_to_begin_with(monkeypatch):
    made = RPTO(
        *("MlpPolicy", gym.make(TASK)),
        target_env=target(),
        dynamics="residual",
        dynamics_kwargs={"threads": 1, "ensemble_kwargs": TINY},
        **{"seed": 0, "device": "cpu", "gradient_steps": 0, "source_steps": 2, "model_train_freq": 60},
    )
    monkeypatch.setattr(pretraining, "FIRST_SOURCE_STEPS", 40)
    made.learn(1, source_timesteps=0)
    assert len(made.replay_buffer.source_starts) == 40


def test_what_acts_late_is_refused_before_it_is_lost():
    late = LIBRARY["command_delay"]("slide", delay=0.04)
    with pytest.raises(ValueError, match=r"command_delay\(slide\) would be lost; pass dynamics='physical'"):
        RPTO(
            *("MlpPolicy", gym.make(TASK)),
            target_env=target(),
            dynamics="residual",
            dynamics_kwargs={"effects": [late]},
        )


def test_its_simulator_is_had_without_the_networks(learned):
    corrected = apply_effects(gym.make(TASK), learned.dynamics.effects())
    mass = corrected.unwrapped.model.body("pole").mass[0]
    assert mass == pytest.approx(learned.dynamics.describe()["pole.mass"], rel=1e-6)


def test_it_learns_within_the_budget(learned):
    assert learned.num_timesteps == learned.target_spent["learning"] == 65
    assert isinstance(learned.dynamics, ResidualDynamics)
    nominal = gym.make(TASK).unwrapped.model.body("pole").mass[0]
    assert learned.dynamics.describe()["pole.mass"] == pytest.approx(MASS * nominal, rel=0.1)
    log = learned.dynamics.fit(learned.transitions("target"))
    assert log["combined_error"] <= log["physical_error"]


def test_it_comes_back_from_a_checkpoint_and_goes_on(learned, tmp_path):
    learned.save(tmp_path / "model")
    learned.save_replay_buffer(tmp_path / "buffer")
    loaded = RPTO.load(tmp_path / "model", env=gym.make(TASK), target_env=target(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.dynamics.describe() == learned.dynamics.describe()
    data = learned.transitions("target")
    for model in (learned, loaded):
        model.dynamics.attach(gym.make(TASK))
    answers = [m.dynamics.step(data.observations, data.actions, deterministic=True) for m in (learned, loaded)]
    np.testing.assert_array_equal(answers[0].next_observations, answers[1].next_observations)
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.num_timesteps == 75
