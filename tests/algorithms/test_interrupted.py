"""Ctrl-C in a fit: it is made again, and what came before it in its round is not."""

import pytest
from conftest import SMALL_ENSEMBLE, pendulum, small
from stable_baselines3 import SAC

from sb3_rpto import RPTO, RTO
from sb3_rpto.baselines.mbpo import MBPO
from sb3_rpto.baselines.pdml import PDML
from sb3_rpto.baselines.ptp import PTP
from sb3_rpto.baselines.slbo import SLBO

STAGE = {"iterations": 3, "model_steps": 2, "policy_updates": 1, "rollout_samples": 40, "rollout_length": 20}
OWN = {
    PTP: {"error_steps": 5},
    PDML: {"block_steps": 15},
    SLBO: {**STAGE, "dynamics_kwargs": {"hidden": (16,)}},
}


@pytest.fixture(autouse=True)
def _short_value_fit(monkeypatch):
    monkeypatch.setattr("sb3_rpto.baselines.policy_distillation.clone.__defaults__", (20,))


def counted_fits(model, monkeypatch, interrupt):
    """Target steps at which the dynamics were fitted; the call of that number is interrupted."""
    begun, made, fit = [], [], model.dynamics.fit

    def counting(*args, **kwargs):
        begun.append(model.num_timesteps)
        if len(begun) == interrupt:
            raise KeyboardInterrupt
        made.append(model.num_timesteps)
        return fit(*args, **kwargs)

    monkeypatch.setattr(model.dynamics, "fit", counting)
    return made


@pytest.mark.parametrize("cls", [RTO, RPTO, MBPO, PTP, PDML])
def test_an_interrupted_fit_is_made_again_and_no_update_twice(cls, monkeypatch):
    model = small(cls, model_train_freq=20, gradient_steps=2, **OWN.get(cls, {})).learn(20, source_timesteps=0)
    fits = counted_fits(model, monkeypatch, interrupt=1)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (40, 80)
    model.learn(25, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (65, 130)
    assert fits == [41, 61]
    assert model.replay_buffer.target.size() == 65
    if cls is PDML:
        assert sum(block.size for block in model.blocks) + model.steps_since_block == 65


def test_an_error_network_that_was_interrupted_is_fitted(monkeypatch):
    model = small(PTP, model_train_freq=20, **OWN[PTP])
    with monkeypatch.context() as patch:
        patch.setattr(model.errors, "fit", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            model.learn(25, source_timesteps=0)
    assert not model.errors.fitted
    model.learn(1, reset_num_timesteps=False)
    assert model.errors.fitted


def test_an_interrupted_stage_goes_on(monkeypatch, tmp_path):
    model = small(SLBO, model_train_freq=20, **OWN[SLBO]).learn(5, source_timesteps=0)
    fits = counted_fits(model, monkeypatch, interrupt=3)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, reset_num_timesteps=False)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "m.pkl")
    loaded = SLBO.load(tmp_path / "m", pendulum(), target_env=pendulum(12.0))
    loaded.load_replay_buffer(tmp_path / "m.pkl")
    last = counted_fits(loaded, monkeypatch, interrupt=0)
    loaded.learn(25, reset_num_timesteps=False)
    assert (fits, last) == ([20, 20], [21, 41, 41, 41])
    assert loaded.num_timesteps == 45


def test_the_first_fit_to_a_log_is_made_again(monkeypatch):
    recorded = SAC("MlpPolicy", pendulum(12.0), learning_starts=100, seed=0, device="cpu").learn(60).replay_buffer
    model = MBPO(
        "MlpPolicy",
        pendulum(),
        target_data=recorded,
        policy_kwargs={"net_arch": [16]},
        dynamics_kwargs=SMALL_ENSEMBLE,
        **{"source_steps": 8, "gradient_steps": 1, "model_train_freq": 10, "batch_size": 32, "device": "cpu"},
    )
    fits = counted_fits(model, monkeypatch, interrupt=2)  # the first is of phi_0
    with pytest.raises(KeyboardInterrupt):
        model.learn(80, source_timesteps=0)
    assert fits == [0]
    model.learn(16, reset_num_timesteps=False)
    assert len(fits) == 2
