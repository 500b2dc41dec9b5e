"""The networks' model of a source is fitted once for all runs that begin alike."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import SMALL_ENSEMBLE, SMALL_POLICY
from stable_baselines3 import SAC

from benchmarks.transfer import shared_dynamics
from sb3_rpto.baselines import sac_variants
from sb3_rpto.baselines.transfer import transfer

ENSEMBLE = {"dynamics_kwargs": SMALL_ENSEMBLE, "model_train_freq": 20}
SMALL: dict[str, dict[str, Any]] = {
    "rpo": {"gradient_steps": 1},
    "rpto": ENSEMBLE,
    "ptp": {**ENSEMBLE, "gradient_steps": 2, "error_steps": 5, "source_steps": 20},
    "slbo": {
        "dynamics_kwargs": {"hidden": (16,)},
        **{"iterations": 2, "model_steps": 5, "policy_updates": 2, "rollout_samples": 40, "rollout_length": 20},
    },
}
cartpole = partial(gym.make, "rpto/ContinuousCartPole-v0")


@pytest.fixture(scope="module")
def source_model(tmp_path_factory: pytest.TempPathFactory) -> str:
    sac = SAC("MlpPolicy", cartpole(), policy_kwargs=SMALL_POLICY, learning_starts=50, seed=0, device="cpu")
    path = tmp_path_factory.mktemp("source") / "sac.zip"
    sac.learn(300).save(path)
    return str(path)


@pytest.fixture
def source_data(source_model: str, tmp_path: Path) -> str:
    data, _ = sac_variants.source_transitions(source_model, cartpole(), 0)
    names = {"obs": "observations", "act": "actions", "next_obs": "next_observations", "rew": "rewards"}
    path = tmp_path / "recorded" / "d.npz"
    path.parent.mkdir()
    np.savez(path, done=data["terminations"], **{short: data[name] for short, name in names.items()})
    return str(path)


@pytest.fixture
def models(tmp_path: Path) -> Path:
    (tmp_path / "models").mkdir()
    return tmp_path / "models"


def run(
    method: str, source_model: str, source_data: str | None, models: Path | None = None, seed: int = 3
) -> list[dict[str, Any]]:
    shared = {"before_learning": partial(shared_dynamics.fit_once, folder=models)} if models else {}
    target = partial(cartpole, pole_length=2.0)
    given = {"every": 20, "n_episodes": 2, "seed": seed, "source_data": source_data, **SMALL[method], **shared}
    return transfer(method, source_model, cartpole, target, 60, **given)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("method", ["rpto", "slbo", "ptp"])
def test_phi_0_is_fitted_once_and_is_what_a_run_fits_by_itself(
    method: str, source_model: str, source_data: str, models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_dynamics, "commit", lambda: "abc")

    def returns(**kwargs: Any) -> list[tuple[float, ...]]:
        rows = run(method, source_model, source_data, **kwargs)
        return [(row["return"], row["updates"], row["source_steps"]) for row in rows]

    alone, first, again = returns(), returns(models=models), returns(models=models)
    assert alone == first == again
    (kept,) = models.iterdir()
    before = kept.stat().st_mtime_ns
    returns(models=models)
    assert kept.stat().st_mtime_ns == before
    returns(models=models, seed=4)
    monkeypatch.setattr(shared_dynamics, "commit", lambda: "abd")
    returns(models=models)
    assert len(list(models.iterdir())) == 3  # another seed and another commit have fits of their own
    monkeypatch.setattr(shared_dynamics, "commit", lambda: "abd-dirty")
    returns(models=models, seed=5)
    assert len(list(models.iterdir())) == 3


@pytest.mark.filterwarnings("ignore")
def test_what_fits_no_networks_to_recorded_steps_keeps_none(
    source_model: str, source_data: str, models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_dynamics, "commit", lambda: "abc")
    run("rpo", source_model, source_data, models=models)
    run("rpto", source_model, None, models=models)  # which collects its steps in learn()
    assert list(models.iterdir()) == []
