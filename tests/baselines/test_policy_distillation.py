"""A cloned policy acts as the SAC that it was cloned from."""

import numpy as np
import pytest
import torch as th
from conftest import pendulum
from sb3_contrib import TRPO
from stable_baselines3 import SAC

from sb3_rpto.baselines.policy_distillation import SMALLEST_STD, SquashedMeanPolicy, clone, clone_kwargs


@pytest.fixture(scope="module")
def teacher() -> SAC:
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [24, 16]}, learning_starts=50, seed=0, device="cpu")
    sac.learn(200)
    sac.actor.mu.weight.data *= 10.0  # towards the bounds of the torque, 2 N m
    return sac


@pytest.fixture
def states() -> np.ndarray:
    angle, speed = np.random.default_rng(0).uniform(-1, 1, (2, 500)) * [[np.pi], [8]]
    return np.stack([np.cos(angle), np.sin(angle), speed], axis=1).astype(np.float32)


def cloned(teacher: SAC, states: np.ndarray, **kwargs) -> tuple[TRPO, dict[str, float]]:
    student = TRPO(
        SquashedMeanPolicy,
        pendulum(),
        policy_kwargs=clone_kwargs(teacher),
        n_steps=50,
        batch_size=50,
        seed=1,
        device="cpu",
    )
    return student, clone(student.policy, teacher, states, **kwargs)


def test_it_acts_as_the_teachers_mean(teacher, states):
    student, _ = cloned(teacher, states, value_steps=1)
    expected, _ = teacher.predict(states, deterministic=True)
    np.testing.assert_allclose(student.predict(states, deterministic=True)[0], expected, atol=1e-5)
    assert np.abs(expected).max() > 1.0  # the action range is the environment's


def test_its_noise_is_the_teachers(teacher, states):
    student, log = cloned(teacher, states, value_steps=1)
    seen = th.as_tensor(states)
    with th.no_grad():
        away = teacher.actor(seen, deterministic=False) - teacher.actor(seen, deterministic=True)
    expected = max(float(away.square().mean().sqrt()), SMALLEST_STD)
    assert log["std"] == pytest.approx(expected, rel=0.1)
    assert float(student.policy.log_std.exp().detach()) == pytest.approx(2 * log["std"])  # torques up to 2 N m


def test_its_value_is_the_teachers(teacher, states):
    student, log = cloned(teacher, states, value_steps=800)
    seen = th.as_tensor(states)
    with th.no_grad():
        q = th.cat(teacher.critic_target(seen, teacher.actor(seen, deterministic=True)), dim=1).min(dim=1)[0]
        value = student.policy.predict_values(seen)[:, 0]
    assert (value - q).square().mean().sqrt() < 0.3 * q.std()
    assert log["value_rmse"] == pytest.approx(float((value - q).square().mean().sqrt()), rel=0.5)


def test_trpo_trains_it_further(teacher, states):
    student, _ = cloned(teacher, states, value_steps=50)
    before = student.predict(states, deterministic=True)[0]
    student.learn(100)
    assert student.num_timesteps == 100
    assert not np.allclose(student.predict(states, deterministic=True)[0], before)


def test_what_cannot_be_cloned_is_refused(teacher, states):
    with pytest.raises(NotImplementedError, match="use_sde"):
        clone_kwargs(SAC("MlpPolicy", pendulum(), use_sde=True))
    with pytest.raises(ValueError, match="observations"):
        cloned(teacher, states[:0])
