"""The harness: every method spends exactly its budget and says what it took; baselines do what defines them."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import PHI_0_STEPS, SMALL_ENSEMBLE, SMALL_POLICY
from stable_baselines3 import SAC
from stable_baselines3.common import base_class
from stable_baselines3.common.env_util import make_vec_env

from sb3_rpto.baselines import sac_variants
from sb3_rpto.baselines.registry import REGISTRY, Run
from sb3_rpto.baselines.transfer import METHODS, transfer
from sb3_rpto.buffers import chronological
from sb3_rpto.effects import declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.evaluation.learning_curve import LearningCurve
from sb3_rpto.presets import resolve_preset

BUDGET, EPISODES = 60, 2
LONG = ("rto", "sac-warm-high", "slbo", "ptp", "pdml")


def cartpole(**parameters: float) -> gym.Env:
    return gym.make("rpto/ContinuousCartPole-v0", **parameters)


class Counted(gym.Wrapper):
    """Counts its own steps, whoever takes them."""

    made: list[Counted] = []  # noqa: RUF012

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.steps = 0
        self.made.append(self)

    def step(self, action: Any) -> Any:
        self.steps += 1
        return super().step(action)


def target() -> gym.Env:
    return Counted(cartpole(pole_length=2.0))


@pytest.fixture(scope="module")
def source_model(tmp_path_factory: pytest.TempPathFactory) -> str:
    sac = SAC("MlpPolicy", cartpole(), policy_kwargs=SMALL_POLICY, learning_starts=50, seed=0, device="cpu")
    path = tmp_path_factory.mktemp("source") / "sac.zip"
    sac.learn(300).save(path)
    return str(path)


@pytest.fixture(autouse=True)
def _short_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_rpto.baselines.policy_distillation.clone.__defaults__", (50,))
    monkeypatch.setattr(sac_variants, "CRITIC_STEPS", 300)
    Counted.made.clear()


ENSEMBLE = {"dynamics_kwargs": SMALL_ENSEMBLE, "model_train_freq": 20}
SMALL: dict[str, dict[str, Any]] = {
    "rpo": {"gradient_steps": 1},
    "rto": ENSEMBLE,
    "rpto": ENSEMBLE,
    "mbpo": {**ENSEMBLE, "gradient_steps": 2},
    "ptp": {**ENSEMBLE, "gradient_steps": 2, "error_steps": 5, "source_steps": 20},
    "pdml": {**ENSEMBLE, "gradient_steps": 2, "block_steps": 20},
    "slbo": {
        "dynamics_kwargs": {"hidden": (16,)},
        **{"iterations": 2, "model_steps": 5, "policy_updates": 2, "rollout_samples": 40, "rollout_length": 20},
    },
    "sysid-retrain": {"declared": ["pole_length"], "retrain_steps": 50},
}


def run(method: str, source_model: str, **kwargs: Any) -> list[dict[str, Any]]:
    given = {"every": 20, "n_episodes": EPISODES, "seed": 3, **SMALL.get(method, {}), **kwargs}
    return transfer(method, source_model, cartpole, target, BUDGET, **given)


def test_all_methods_of_the_command_line_are_there() -> None:
    names = (
        "rpo rto rpto sac sac-warm sac-warm-high sac-mixed trpo-warm mbpo slbo ptp pdml sysid-retrain zero-shot oracle"
    )
    assert set(METHODS) == set(REGISTRY) == set(names.split())
    with pytest.raises(ValueError, match="method='ppo' does not exist"):
        transfer("ppo", "", cartpole, target, 1, every=1)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("method", [pytest.param(m, marks=pytest.mark.slow if m in LONG else ()) for m in METHODS])
def test_a_method_spends_its_budget_exactly_and_says_what_it_took(method: str, source_model: str) -> None:
    rows = run(method, source_model)
    evaluated, trained = Counted.made[:EPISODES], Counted.made[EPISODES:]
    spends = 0 if method == "zero-shot" else BUDGET
    assert sum(env.steps for env in trained) == spends
    assert all(env.steps > 0 for env in evaluated)
    assert [row["steps"] for row in rows] == list(range(0, spends + 1, 20))
    for row in rows:
        assert {"method", "seed", "steps", "return", "updates", "source_steps", "seconds"} <= set(row)
        assert (row["method"], row["seed"]) == (method, 3)
        assert np.isfinite(row["return"])
    for name in ("updates", "source_steps", "seconds"):
        assert all(earlier[name] <= later[name] for earlier, later in pairwise(rows))
    if method != "sac":  # which knows nothing of the source
        assert rows[0]["return"] == pytest.approx(run("zero-shot", source_model)[0]["return"])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "method", ["rpto", "sac", "sac-warm", "sac-warm-high", "sac-mixed", "trpo-warm", "sysid-retrain"]
)
def test_a_method_learns_on_the_device_that_it_is_given(
    method: str, source_model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr("sb3_rpto.algorithms.argument_ranges.check_device", lambda device: None)  # there may be no GPU
    monkeypatch.setattr(base_class, "get_device", lambda device: asked.append(str(device)) or th.device("cpu"))
    settings = {**SMALL.get(method, {}), **({"n_critics": 3} if method == "sac-warm-high" else {})}
    run = Run(source_model, cartpole, target, 20, kwargs=settings, device="cuda")
    REGISTRY[method].run(run, LearningCurve(target, 20, 1))
    source_transitions = {"sac-warm-high", "sac-mixed", "trpo-warm"}  # are collected on the CPU
    assert set(asked) == {"cuda"} | ({"cpu"} if method in source_transitions else set())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_updates_and_source_steps_are_counted(source_model: str) -> None:
    last = {method: run(method, source_model)[-1] for method in ("sac-warm", "sac-warm-high", "trpo-warm", "slbo")}
    # An evaluation after n steps comes before the update of the n-th where there is one at each.
    assert last["sac-warm"]["updates"] == BUDGET - 1
    rptos = resolve_preset("default", "ensemble", None, ())["gradient_steps"]
    assert last["sac-warm-high"]["updates"] == (BUDGET - 1) * rptos > BUDGET
    assert last["trpo-warm"]["updates"] == 4  # rollouts of 15, the last one's update included
    assert last["slbo"]["updates"] == 4 * 2 * 2
    assert last["slbo"]["source_steps"] == PHI_0_STEPS + 4 * 2 * 2 * 40
    assert last["sac-warm"]["source_steps"] == 0
    assert last["trpo-warm"]["source_steps"] == PHI_0_STEPS


@pytest.fixture
def source_data(source_model: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    data, spent = sac_variants.source_transitions(source_model, cartpole(), 0)
    assert spent == len(data["rewards"]) == PHI_0_STEPS
    names = {"obs": "observations", "act": "actions", "next_obs": "next_observations", "rew": "rewards"}
    path = tmp_path_factory.mktemp("data") / "d.npz"
    np.savez(path, done=data["terminations"], **{short: data[name] for short, name in names.items()})
    return str(path)


def test_given_source_data_cost_no_source_steps(source_model: str, source_data: str) -> None:
    rows = run("sac-mixed", source_model, source_data=source_data)
    assert [row["source_steps"] for row in rows] == [0] * 4


def test_mixed_sac_draws_half_of_each_world(source_model: str) -> None:
    data, _ = sac_variants.source_transitions(source_model, cartpole(), 0)
    model = sac_variants.mixed_sac(
        source_model, cartpole(pole_length=2.0), 0, {**data, "rewards": np.full(PHI_0_STEPS, -7.0)}
    )
    model.learn(40)
    for batch_size, of_source in ((64, 32), (33, 16)):
        batch = model.replay_buffer.sample(batch_size)
        assert len(batch.rewards) == len(batch.observations) == batch_size
        assert (batch.rewards == -7.0).sum() == of_source
    assert model.replay_buffer.size() == 40
    np.testing.assert_array_equal(chronological(model.replay_buffer.source)["observations"], data["observations"])


def test_a_trpo_rollout_divides_the_budget() -> None:
    lengths = {
        budget: sac_variants.rollout_length(budget, min(2048, max(budget // 4, 2))) for budget in (60, 77, 1000, 97)
    }
    assert lengths == {60: 15, 77: 11, 1000: 250, 97: 97}
    assert sac_variants.rollout_length(100_000, 2048) == 2000


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("trpo-warm", {"n_steps": 50}, "n_steps=50 must be an integer above 1 that divides"),
        ("trpo-warm", {"n_steps": 0}, "n_steps=0 must be"),
        ("trpo-warm", {"n_steps": "ten"}, "n_steps='ten' must be"),
        ("sac-warm-high", {"n_critics": 1}, "n_critics must be .* at least the source model's 2, got 1"),
        ("sac-warm-high", {"n_critics": "ten"}, "n_critics must be an integer"),
    ],
)
def test_what_a_method_cannot_do_costs_no_source_step(
    method: str, wrong: dict, said: str, source_model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent: list[Any] = []
    monkeypatch.setattr(sac_variants, "source_transitions", lambda *args: spent.append(args))
    with pytest.raises(ValueError, match=said):
        run(method, source_model, **wrong)
    assert not spent


def test_a_policy_that_cannot_be_cloned_costs_no_source_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SAC("MlpPolicy", cartpole(), use_sde=True, policy_kwargs=SMALL_POLICY, device="cpu").save(tmp_path / "sac.zip")
    spent: list[Any] = []
    monkeypatch.setattr(sac_variants, "source_transitions", lambda *args: spent.append(args))
    with pytest.raises(NotImplementedError, match="use_sde"):
        run("trpo-warm", str(tmp_path / "sac.zip"))
    assert not spent


def test_trpo_warm_starts_as_the_sac(source_model: str) -> None:
    states = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    model = sac_variants.cloned_trpo(source_model, cartpole(), 0, 1000, states)
    expected, _ = SAC.load(source_model).predict(states, deterministic=True)
    np.testing.assert_allclose(model.predict(states, deterministic=True)[0], expected, atol=1e-5)
    assert model.n_steps == 250


@pytest.mark.slow
def test_further_critics_agree_with_the_sources_and_are_their_own(source_model: str) -> None:
    data, _ = sac_variants.source_transitions(source_model, cartpole(), 0)
    source = SAC.load(source_model)
    model = sac_variants.with_more_critics(source_model, cartpole(), 0, 5, data)
    inputs = [th.as_tensor(data[name]).float() for name in ("observations", "actions")]
    with th.no_grad():
        known = source.critic(*inputs)
        answers = model.critic(*inputs)
    assert len(answers) == 5
    for i, answer in enumerate(answers):
        error = (answer - known[i % 2]).square().mean().sqrt()
        assert error == 0 if i < 2 else 0 < error < 0.3 * known[i % 2].std()
    assert th.equal(model.log_ent_coef, source.log_ent_coef)
    with pytest.raises(ValueError, match="n_critics"):
        sac_variants.with_more_critics(source_model, cartpole(), 0, 1, data)


def test_further_critics_leave_all_other_settings_to_the_user(source_model: str) -> None:
    data, _ = sac_variants.source_transitions(source_model, cartpole(), 0)
    settings = {"learning_rate": 1e-5, "buffer_size": 500, "ent_coef": 0.1}
    model = sac_variants.with_more_critics(source_model, cartpole(), 0, 3, data, **settings)
    assert model.actor.optimizer.param_groups[0]["lr"] == 1e-5
    assert model.replay_buffer.buffer_size == 500
    assert model.ent_coef_optimizer is None
    assert float(model.ent_coef_tensor) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("train_freq", "gradient_steps", "updates"),
    [(1, 1, 1), (64, 64, 1), (20, 40, 2), ((1, "episode"), -1, -1), ((2, "episode"), 50, 1)],
)
def test_a_fine_tuned_sac_meets_its_budget_step_by_step_whatever_the_source_did(
    train_freq: Any, gradient_steps: int, updates: int, tmp_path: Path
) -> None:
    settings = {"policy_kwargs": SMALL_POLICY, "train_freq": train_freq, "gradient_steps": gradient_steps}
    SAC("MlpPolicy", cartpole(), **settings, device="cpu").save(tmp_path / "sac.zip")
    where = target()
    model = sac_variants.fine_tuned_sac(tmp_path / "sac.zip", where, 0).learn(30)
    assert where.steps == model.num_timesteps == 30
    assert model.gradient_steps == updates
    assert model._n_updates == 30 * max(updates, 1)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"train_freq": 2}, "train_freq is 2, .* give 1"),
        ({"ent_coef": 0.1}, "ent_coef: .* leave it out"),
        ({"use_sde": True}, "use_sde is True and the source model's False"),
        ({"n_steps": 3}, "n_steps is 3 and the source model's 1"),
    ],
)
def test_settings_that_fine_tuning_cannot_have_are_named(source_model: str, settings: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        sac_variants.fine_tuned_sac(source_model, cartpole(), 0, **settings)


def test_a_temperature_that_is_asked_for_is_where_fine_tuning_begins(source_model: str) -> None:
    data, _ = sac_variants.source_transitions(source_model, cartpole(), 0)
    asked: dict[str, Any] = {"ent_coef": "auto_0.5", "use_sde": False, "n_steps": 1}  # the latter as it has them
    for model in (
        sac_variants.fine_tuned_sac(source_model, cartpole(), 0, **asked),
        sac_variants.with_more_critics(source_model, cartpole(), 0, 3, data, **asked),
    ):
        assert model.log_ent_coef is not None
        assert float(model.log_ent_coef.exp().item()) == pytest.approx(0.5)


def test_a_discount_holds_for_returns_of_several_steps_too(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"policy_kwargs": SMALL_POLICY, "n_steps": 3, "learning_starts": 5, "device": "cpu"}
    SAC("MlpPolicy", cartpole(), **settings).save(tmp_path / "sac.zip")
    model = sac_variants.fine_tuned_sac(tmp_path / "sac.zip", cartpole(), 0, gamma=0.5)
    assert model.gamma == model.replay_buffer.gamma == 0.5  # type: ignore[union-attr]
    data, _ = sac_variants.source_transitions(tmp_path / "sac.zip", cartpole(), 0)
    assert sac_variants.with_more_critics(tmp_path / "sac.zip", cartpole(), 0, 3, data).replay_buffer.n_steps == 3  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="n_steps is 1 and the source model's 3"):
        sac_variants.fine_tuned_sac(tmp_path / "sac.zip", cartpole(), 0, n_steps=1)


def test_fresh_source_transitions_are_as_many_as_they_cost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sac_variants.pretraining, "PHI_0_STEPS", 90)
    SAC("MlpPolicy", cartpole(), policy_kwargs=SMALL_POLICY, buffer_size=30, device="cpu").save(tmp_path / "sac.zip")
    found, spent = sac_variants.source_transitions(tmp_path / "sac.zip", cartpole(), 0)
    assert len(found["rewards"]) == spent == 90


def test_identify_then_retrain_finds_the_pole_and_trains_in_the_simulator_alone(source_model: str) -> None:
    recorder = sac_variants.fine_tuned_sac(source_model, cartpole(pole_length=2.0), 0, gradient_steps=0).learn(80)
    source = make_vec_env(cartpole)
    simulator, found = sac_variants.identified_source(recorder.replay_buffer, recorder, source, ["pole_length"], 0)
    assert found["pole_length"] == pytest.approx(2.0, rel=0.01)
    simulator.seed(0)
    observation = simulator.reset()
    twin = cartpole(pole_length=2.0)
    twin.reset(seed=0)
    twin.unwrapped.state = observation[0].astype(np.float64)
    action = np.array([[0.7]], dtype=np.float32)
    np.testing.assert_allclose(simulator.step(action)[0][0], twin.step(action[0])[0], atol=1e-3)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"declared": ()}, "declared"),
        ({"declared": ["pole_lenght"]}, "did you mean 'pole_length'"),
        ({"dynamics_kwargs": {"max_stepp": 1.0}}, "max_stepp"),
        ({"max_steps": 0}, "max_steps must be an integer of at least 1, got 0"),
        ({"retrain_steps": "ten"}, "retrain_steps must be an integer of at least 1, got 'ten'"),
        ({"train_freq": 4}, "step by step"),
    ],
)
def test_what_cannot_be_identified_costs_no_target_step(source_model: str, wrong: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        run("sysid-retrain", source_model, **wrong)
    trained = Counted.made[EPISODES:]  # the others evaluate
    assert sum(env.steps for env in trained) == 0


def test_the_row_of_a_method_that_learns_in_batches_is_of_what_it_has_learned(source_model: str) -> None:
    """TRPO's rollout ends with the budget: the last row is of the policy after that update."""
    kept: list[np.ndarray] = []
    states = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    transfer(
        *("trpo-warm", source_model, cartpole, target, BUDGET),
        every=[30, BUDGET],
        n_episodes=1,
        n_steps=30,
        read=lambda model: kept.append(model.predict(states, deterministic=True)[0]) or {},
    )
    start, middle, end = kept
    assert not np.allclose(start, middle)
    assert not np.allclose(middle, end)


@pytest.mark.slow
def test_runs_repeat(source_model: str) -> None:
    first, again = (run("mbpo", source_model) for _ in range(2))
    assert [row["return"] for row in first] == [row["return"] for row in again]


def test_a_physical_source_of_mujoco_is_identified_too(tmp_path: Path) -> None:
    make = partial(gym.make, "InvertedPendulum-v5")
    sac = SAC("MlpPolicy", make(), policy_kwargs=SMALL_POLICY, learning_starts=20, seed=0, device="cpu")
    sac.learn(60).save(tmp_path / "sac.zip")

    names = ["cart.mass", "pole.mass"]
    known = declare(make().unwrapped.model, names)
    heavy = apply_effects(make(), [effect.with_values(1.5 * effect.values) for effect in known])
    recorder = sac_variants.fine_tuned_sac(tmp_path / "sac.zip", heavy, 0, gradient_steps=0).learn(80)
    simulator, found = sac_variants.identified_source(recorder.replay_buffer, recorder, make_vec_env(make), names, 0)
    for effect in known:
        assert found[effect.label] == pytest.approx(1.5 * effect.values[0], rel=0.02)
    assert simulator.reset().shape == (1, 4)
