"""SLBO in MBPO's loop: its stages, its policy, its checkpoints. Its loss is tested with its model."""

import numpy as np
import pytest
import torch as th
from conftest import PHI_0_STEPS, pendulum, small
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure

from sb3_rpto import RPO
from sb3_rpto.baselines.slbo import SLBO
from sb3_rpto.baselines.slbo_dynamics import DeterministicDynamics
from sb3_rpto.callbacks import RelativityGapCallback
from sb3_rpto.dynamics.vec_env import DynamicsVecEnv

STAGE = {"iterations": 2, "model_steps": 7, "policy_updates": 3, "rollout_samples": 40, "rollout_length": 20}


@pytest.fixture(autouse=True)
def _short_value_fit(monkeypatch):
    monkeypatch.setattr("sb3_rpto.baselines.policy_distillation.clone.__defaults__", (50,))


def slbo(**kwargs) -> SLBO:
    return small(SLBO, dynamics_kwargs={"hidden": (16,)}, **{**STAGE, **kwargs})


STATES = np.array([[1.0, 0.0, 0.5], [-1.0, 0.0, -3.0], [0.0, 1.0, 0.0]], dtype=np.float32)


def test_a_stage_takes_its_model_steps_and_policy_updates(monkeypatch):
    model = slbo(model_train_freq=30)
    fits, learned = [], []
    fit, learn = model.dynamics.fit, model.trpo.learn
    monkeypatch.setattr(model.dynamics, "fit", lambda *a, **k: (fits.append(k["max_steps"]), fit(*a, **k))[1])
    monkeypatch.setattr(model.trpo, "learn", lambda n, **k: (learned.append(n), learn(n, **k))[1])
    model.learn(75, source_timesteps=0)
    assert model.num_timesteps == model.replay_buffer.size() == 75
    assert model.target_spent == {"learning": 75}
    phi_0, *rest = fits
    assert rest == [7] * 2 * 2  # two stages, at 30 and 60 target steps
    assert learned == [40] * 2 * 2 * 3
    assert model._n_updates == 12
    assert model.source_timesteps == PHI_0_STEPS + 12 * 40
    assert phi_0 == 30


def test_rollouts_are_the_models_from_initial_states_of_the_source_cut_off():
    model = slbo(model_train_freq=30)
    model.learn(30, source_timesteps=0)
    rollouts = model.trpo.env
    assert isinstance(rollouts, DynamicsVecEnv)
    assert rollouts.dynamics is model.dynamics
    assert isinstance(model.dynamics, DeterministicDynamics)
    assert (rollouts.num_envs, rollouts.max_episode_steps) == (2, 20)
    starts = rollouts.reset()
    assert np.abs(starts[:, 2]).max() <= 1.0  # where Pendulum's episodes begin


def test_before_learning_it_acts_as_its_teacher():
    model = slbo()
    expected = SAC.predict(model, STATES, deterministic=True)[0]
    np.testing.assert_array_equal(model.predict(STATES, deterministic=True)[0], expected)
    model.learn(1, source_timesteps=0)
    assert (model.predict(STATES, deterministic=True)[0] != expected).any()


def test_what_it_does_not_use_is_refused():
    for name, value in (("gradient_steps", 5), ("source_steps", 9), ("real_ratio", 0.5), ("rollout_start", "target")):
        with pytest.raises(ValueError, match=f"SLBO does not use \\['{name}'\\]"):
            slbo(**{name: value})


def test_its_sac_is_no_source_model():
    with pytest.raises(ValueError, match="is an SLBO, which acts by TRPO's policy"):
        RPO.from_source(slbo(), pendulum(), pendulum(12.0))


def test_its_gap_is_not_that_of_sacs_policy():
    with pytest.raises(TypeError, match="SLBO acts by TRPO's"):
        slbo().learn(1, RelativityGapCallback(), source_timesteps=0)


def test_with_a_log_stages_are_logged(tmp_path):
    recorded = SAC("MlpPolicy", pendulum(12.0), learning_starts=100, seed=0, device="cpu").learn(60).replay_buffer
    settings = {"policy_kwargs": {"net_arch": [16]}, "dynamics_kwargs": {"hidden": (16,)}, "device": "cpu"}
    model = SLBO("MlpPolicy", pendulum(), target_data=recorded, **settings, **STAGE)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(10, source_timesteps=0)
    assert "slbo/policy_objective" in (tmp_path / "progress.csv").read_text().splitlines()[0]


def test_before_the_first_stage_it_acts_as_the_sac_that_it_came_from():
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [16]}, learning_starts=20, seed=0, device="cpu")
    sac.learn(60)
    model = SLBO.from_source(sac, pendulum(), pendulum(12.0), dynamics_kwargs={"hidden": (16,)}, seed=1, **STAGE)
    model.learn(10)
    expected, _ = sac.predict(STATES, deterministic=True)
    np.testing.assert_allclose(model.predict(STATES, deterministic=True)[0], expected, atol=1e-5)
    model.model_train_freq = 5
    model.learn(5, reset_num_timesteps=False)
    assert not np.allclose(model.predict(STATES, deterministic=True)[0], expected)
    for name, value in sac.actor.state_dict().items():
        assert th.equal(value, model.actor.state_dict()[name].cpu())  # only the teacher
    model.rollback("source")
    np.testing.assert_allclose(model.predict(STATES, deterministic=True)[0], expected, atol=1e-5)


def test_target_actions_are_those_of_trpos_policy():
    model = slbo(model_train_freq=1000)
    model.learn(1, source_timesteps=0)
    model.trpo.policy.log_std.data.fill_(-20.0)
    model.trpo.policy.action_net[0].weight.data.zero_()
    model.trpo.policy.action_net[0].bias.data.fill_(10.0)
    model.learn(20, reset_num_timesteps=False)
    assert model.transitions("target").actions[1:].min() == pytest.approx(2.0, abs=1e-4)


def test_a_checkpoint_keeps_policy_and_model(tmp_path):
    model = slbo(model_train_freq=30).learn(40, source_timesteps=0)
    model.save(tmp_path / "m.zip")
    predicts_alone = SLBO.load(tmp_path / "m.zip", device="cpu")
    loaded = SLBO.load(tmp_path / "m.zip", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    for again in (predicts_alone, loaded):
        np.testing.assert_array_equal(
            again.predict(STATES, deterministic=True)[0], model.predict(STATES, deterministic=True)[0]
        )
    for name, value in model.dynamics.networks.state_dict().items():
        assert th.equal(value, loaded.dynamics.networks.state_dict()[name])
    before = loaded.predict(STATES, deterministic=True)[0]
    loaded.learn(5, reset_num_timesteps=False)  # no stage yet, and no second clone
    np.testing.assert_array_equal(loaded.predict(STATES, deterministic=True)[0], before)


def test_numbers_are_the_papers_and_must_fit():
    model = SLBO("MlpPolicy", pendulum())
    assert (model.iterations, model.model_steps, model.policy_updates) == (20, 100, 40)
    assert (model.rollout_samples, model.rollout_length, model.trpo.n_envs, model.trpo.n_steps) == (4000, 500, 8, 500)
    assert (model.dynamics.horizon, model.model_train_freq) == (2, 10_000)
    with pytest.raises(ValueError, match="rollout_samples=4000 is no multiple"):
        SLBO("MlpPolicy", pendulum(), rollout_length=300)
    with pytest.raises(ValueError, match="iterations"):
        SLBO("MlpPolicy", pendulum(), iterations=0)
