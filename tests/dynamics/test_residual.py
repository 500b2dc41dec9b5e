import copy
from dataclasses import replace
from functools import partial
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_rpto.dynamics.base import Transitions, relative_error
from sb3_rpto.dynamics.residual import ResidualDynamics
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.effects import Effect, from_json
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.task_rules import task_rules

TINY = {"n_members": 3, "n_elites": 3, "hidden": (64, 64), "max_steps": 800}
MISSING = {
    "InvertedPendulum-v5": {"kind": "torque_ripple", "on": "hinge", "values": {"cosine": 3.0, "turns": 2.0}},
    "InvertedDoublePendulum-v5": {"kind": "quadratic_drag", "on": "hinge", "values": {"coefficient": 0.5}},
}


def collect(env_id: str, n: int, seed: int, missing: bool = True, speed: float = 1.0) -> Transitions:
    """Small random actions for five steps at a time, from random states: the joints do not reach their limits."""
    effects: list[Effect] = [from_json(MISSING[env_id])] if missing else []
    env = apply_effects(gym.make(env_id), effects)
    base, rng, rows = env.unwrapped, np.random.default_rng(seed), []
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for i in range(n):
        if i % 5 == 0:
            env.reset()
            qpos, qvel = rng.uniform(-0.5, 0.5, base.model.nq), speed * rng.normal(size=base.model.nv)
            base.set_state(base.init_qpos + qpos, qvel)
            observation = base._get_obs()
        action = 0.3 * env.action_space.sample()
        following, reward, terminated, _, _ = env.step(action)
        rows.append((observation, action, reward, following, terminated))
        observation = following
    columns = [th.as_tensor(np.array(column)) for column in zip(*rows)]
    return Transitions(columns[0], columns[1], columns[2].float(), columns[3], columns[4].float())


def make(env_id: str = "InvertedPendulum-v5", seed: int = 0, attach: bool = True, **kwargs) -> ResidualDynamics:
    env = gym.make(env_id)
    th.manual_seed(seed)
    options = {"ensemble_kwargs": TINY, "threads": 1, **kwargs}
    dynamics = ResidualDynamics(env.observation_space, env.action_space, **physical_config(env), **options)
    dynamics.seed(seed)
    if attach:
        dynamics.attach(env)
    return dynamics


@pytest.fixture(scope="module")
def data() -> Transitions:
    return collect("InvertedPendulum-v5", 400, seed=0)


@pytest.fixture(scope="module")
def _fitted(data: Transitions) -> ResidualDynamics:
    dynamics = make()
    dynamics.fit(data)
    return dynamics


@pytest.fixture
def fitted(_fitted: ResidualDynamics) -> ResidualDynamics:
    """A fitted model of its own for each test."""
    dynamics = make()
    dynamics.load_state_dict(_fitted.state_dict())
    return dynamics


def same(one, other) -> bool:
    return all(th.equal(a, b) for a, b in zip(one, other))


# --- what it is for ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", MISSING)
def test_an_effect_that_no_declared_number_expresses_is_learned(env_id):
    declared = {"InvertedPendulum-v5": ["pole.mass"]}.get(env_id, [])
    dynamics = make(env_id, declared=declared)
    log = dynamics.fit(collect(env_id, 400, seed=0))
    assert log["residual_on"] == 1.0
    assert log["combined_error"] < 0.4 * log["physical_error"]
    fresh = collect(env_id, 100, seed=1)
    simulated = dynamics.physical.step(fresh.observations, fresh.actions).next_observations
    assert dynamics.error(fresh) < 0.4 * relative_error(simulated, fresh)


@pytest.mark.parametrize("env_id", MISSING)
def test_with_nothing_missing_it_is_the_simulator_exactly(env_id):
    dynamics = make(env_id)
    data = collect(env_id, 100, seed=0, missing=False)
    log = dynamics.fit(data)
    assert log["residual_on"] == 0.0
    assert log["combined_error"] == log["physical_error"] < 1e-6
    assert same(dynamics.step(data.observations, data.actions), dynamics.physical.step(data.observations, data.actions))


def test_a_wrong_declared_number_is_left_to_the_simulator():
    heavy = {"mj_model": gym.make("InvertedPendulum-v5").unwrapped.model.__copy__()}
    heavy["mj_model"].body("pole").mass *= 1.3
    heavy["mj_model"].body("pole").inertia *= 1.3
    env = gym.make("InvertedPendulum-v5")
    dynamics = ResidualDynamics(
        *(env.observation_space, env.action_space),
        **{**physical_config(env), **heavy, "declared": ["pole.mass"], "ensemble_kwargs": TINY, "threads": 1},
    )
    dynamics.attach(env)
    log = dynamics.fit(collect("InvertedPendulum-v5", 100, seed=0, missing=False))
    assert dynamics.describe()["pole.mass"] == pytest.approx(env.unwrapped.model.body("pole").mass[0], rel=1e-3)
    assert dynamics.describe() == dynamics.physical.describe()
    assert log["residual_on"] == 0.0


# --- when nothing is corrected ----------------------------------------------------------------------------------------


def test_before_the_first_fit_it_is_the_simulator_and_needs_no_phi_0(data):
    dynamics = make()
    few = data.take(slice(20))
    assert dynamics.rollout == "branches"
    assert dynamics.fitted
    assert same(dynamics.step(few.observations, few.actions), dynamics.physical.step(few.observations, few.actions))


def test_few_transitions_correct_nothing(data):
    assert make().fit(data.take(slice(49)))["residual_on"] == 0.0


def test_noise_is_not_corrected(data):
    noise = th.randn(data.observations.shape, generator=th.Generator().manual_seed(3), dtype=th.float64)
    exact = collect("InvertedPendulum-v5", 150, seed=2, missing=False)
    noisy = replace(exact, next_observations=exact.next_observations + 0.05 * noise[:150])
    assert make().fit(noisy)["residual_on"] == 0.0


def test_negligible_errors_are_left_alone():
    exact = collect("InvertedPendulum-v5", 100, seed=2, missing=False)
    change = exact.next_observations - exact.observations
    off = 5e-4 * change.std(dim=0) * (3 * exact.observations[:, 1:2]).sin()
    assert make().fit(replace(exact, next_observations=exact.next_observations + off))["residual_on"] == 0.0
    assert make().fit(replace(exact, next_observations=exact.next_observations + 100 * off))["residual_on"] == 1.0


@pytest.mark.slow
def test_a_later_fit_switches_off_what_no_longer_helps(fitted):
    assert fitted.corrected.any()
    log = fitted.fit(collect("InvertedPendulum-v5", 100, seed=2, missing=False))
    assert log["residual_on"] == 0.0
    assert not fitted.corrected.any()


def test_traced_effects_end_the_correction(fitted):
    found = from_json(MISSING["InvertedPendulum-v5"])
    fresh = collect("InvertedPendulum-v5", 40, seed=1)
    fitted.adopt([found])
    assert not fitted.corrected.any()
    assert fitted.error(fresh) < 1e-6


# --- the answer -------------------------------------------------------------------------------------------------------


def test_only_masked_dimensions_are_corrected(fitted, data):
    few = data.take(slice(30))
    fitted.corrected.copy_(th.tensor([False, False, True, False]))
    simulated = fitted.physical.step(few.observations, few.actions).next_observations
    difference = fitted.step(few.observations, few.actions).next_observations - simulated
    assert (difference[:, 2] != 0).any()
    assert not difference[:, [0, 1, 3]].any()


def test_rules_see_the_corrected_next_observation(fitted, data):
    few = data.take(slice(30))
    assert th.equal(
        fitted.step(few.observations, few.actions).rewards,
        fitted.physical.step(few.observations, few.actions).rewards,
    )
    fitted.reward_fn = lambda observations, actions, following: following[:, 3]
    fitted.termination_fn = lambda observations, actions, following: following[:, 3] > 0
    answer = fitted.step(few.observations, few.actions)
    assert th.equal(answer.rewards, answer.next_observations[:, 3])
    assert th.equal(answer.terminations, answer.next_observations[:, 3] > 0)


def test_the_tasks_own_rules_agree_with_the_simulator(data):
    rules = task_rules(gym.make("InvertedPendulum-v5"))
    few = data.take(slice(30))
    ruled, plain = make(reward_fn=rules.reward_fn, termination_fn=rules.termination_fn), make()
    one, other = (d.step(few.observations, few.actions) for d in (ruled, plain))
    assert th.equal(one.rewards, other.rewards.double())
    assert th.equal(one.terminations, other.terminations)
    assert one.terminations.any()


def test_the_answer_has_the_observations_dtype(fitted, data):
    answer = fitted.step(data.observations[:5].float(), data.actions[:5])
    assert answer.next_observations.dtype == th.float32


def test_deterministic_answers_ignore_the_noise(data):
    dynamics = make(ensemble_kwargs={**TINY, "noise": True, "max_steps": 50})
    dynamics.fit(data.take(slice(100)))
    dynamics.corrected.fill_(True)
    given = data.observations[:5], data.actions[:5]
    assert same(dynamics.step(*given, deterministic=True), dynamics.step(*given, deterministic=True))
    assert not same(dynamics.step(*given), dynamics.step(*given))


# --- the fit ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_missed_touch_downs_do_not_drown_the_rest(data):
    jumps = th.zeros_like(data.observations)
    jumps[::50] = 20.0
    dynamics = make()
    dynamics.fit(replace(data, next_observations=data.next_observations + jumps))
    fresh = collect("InvertedPendulum-v5", 100, seed=1)
    simulated = dynamics.physical.step(fresh.observations, fresh.actions).next_observations
    assert dynamics.error(fresh) < 0.5 * relative_error(simulated, fresh)


def test_a_missed_touch_down_counts_as_three_times_what_others_miss_at_most(data, monkeypatch):
    jumps = th.zeros_like(data.observations)
    jumps[::50] = 20.0
    dynamics, taught = make(), []
    monkeypatch.setattr(dynamics.ensemble, "fit_rows", lambda examples, *others: taught.append(examples))
    dynamics.fit(replace(data, next_observations=data.next_observations + jumps))
    (examples,) = taught
    missed = (examples.next_observations - examples.observations).abs()
    usual = missed[th.arange(len(missed)) % 50 != 0].quantile(0.95, dim=0)
    learned = usual > 0.0
    assert learned.any()
    assert (missed[::50, learned] < 4.0 * usual[learned]).all()
    assert (missed[::50, learned] > 2.0 * usual[learned]).all()


def test_unknown_states_are_left_out():
    fast = collect("InvertedDoublePendulum-v5", 200, seed=0, missing=False, speed=6.0)
    dynamics = make("InvertedDoublePendulum-v5")
    log = dynamics.fit(fast)
    assert log["left_out"] > 20
    assert log["physical_error"] < 1e-6
    clipped = fast.take((fast.observations[:, 5:8].abs() >= 10).any(dim=1))
    assert np.isnan(dynamics.error(clipped))


def test_weights_and_caps_reach_both_parts(data, monkeypatch):
    dynamics, seen = make(), []
    weights = th.rand(len(data), generator=th.Generator().manual_seed(0))
    physical, ensemble = dynamics.physical.fit, dynamics.ensemble.fit_rows

    def fit(original, data, *others):
        seen.append((len(data), *others[-2:]))
        return original(data, *others)

    monkeypatch.setattr(dynamics.physical, "fit", partial(fit, physical))
    monkeypatch.setattr(dynamics.ensemble, "fit_rows", partial(fit, ensemble))
    dynamics.fit(data, weights, max_steps=7)
    (n_all, given, cap), (n_train, trained, cap_too) = seen
    assert (n_all, n_train, cap, cap_too) == (400, 320, 7, 7)
    assert th.equal(given, weights)
    assert th.equal(trained, weights[:320])


def test_weights_that_leave_nothing_to_train_on_fit_phi_alone(data):
    dynamics, alone = make(), make()
    weights = th.zeros(len(data))
    weights[-60:] = 1  # the newest, which are held out
    log = dynamics.fit(data, weights)
    alone.physical.fit(data, weights)
    assert th.equal(dynamics.physical._values, alone.physical._values)
    assert log["residual_on"] == 0
    assert log["combined_error"] == log["physical_error"]


def test_what_was_trained_on_is_not_held_out_when_the_window_moves_on(data, monkeypatch):
    monkeypatch.setattr("sb3_rpto.dynamics.residual.MAX_TRANSITIONS", 150)
    dynamics, masks = make(), []
    mask = dynamics.ensemble.holdout_mask

    def watched(rows):
        held = mask(rows)
        masks.append(({*rows[held].tolist()}, {*rows[~held].tolist()}))
        return held

    monkeypatch.setattr(dynamics.ensemble, "holdout_mask", watched)
    for n in (300, 330, 365):
        dynamics.fit(data.take(slice(n)), max_steps=1)
    assert len(masks) == 3
    for (_, trained), (held, _) in pairwise(masks):
        assert held
        assert not held & trained


def test_weights_of_another_shape_are_refused(data):
    with pytest.raises(ValueError, match="weights"):
        make().fit(data, th.ones(3))


def test_the_newest_fifth_is_not_trained_on(data):
    one, other = make(), make()
    shuffled = data.next_observations.clone()
    shuffled[320:] = shuffled[320:].flip(0)
    one.fit(data, max_steps=20)
    other.fit(replace(data, next_observations=shuffled), max_steps=20)
    assert same(one.ensemble.networks.parameters(), other.ensemble.networks.parameters())


def test_seeds_repeat_a_fit(data):
    def weights(seed: int) -> list[th.Tensor]:
        dynamics = make()
        dynamics.seed(seed)
        dynamics.fit(data, max_steps=20)
        return list(dynamics.ensemble.networks.parameters())

    assert same(weights(1), weights(1))
    assert not same(weights(1), weights(2))


def test_step_and_fit_need_the_environment(data):
    dynamics = make(attach=False)
    for use in (lambda: dynamics.step(data.observations, data.actions), lambda: dynamics.fit(data)):
        with pytest.raises(RuntimeError, match="attach"):
            use()


def test_unknown_arguments_are_refused():
    with pytest.raises(TypeError, match="no_such_thing"):
        make(no_such_thing=1)
    with pytest.raises(TypeError, match="no_such_thing"):
        make(ensemble_kwargs={"no_such_thing": 1})


# --- checkpoints ------------------------------------------------------------------------------------------------------


def test_a_checkpoint_restores_answers_and_the_next_fit(data):
    saved = make(declared=["pole.mass"])
    saved.fit(data, max_steps=100)
    saved.corrected.fill_(True)
    state = copy.deepcopy((saved.state_dict(), saved.optimizer.state_dict()))
    loaded = make(seed=5, declared=["pole.mass"])
    loaded.load_state_dict(state[0])
    loaded.optimizer.load_state_dict(state[1])
    given = data.observations[:20], data.actions[:20]
    assert th.equal(loaded.corrected, saved.corrected)
    assert loaded.describe() == saved.describe()
    assert same(loaded.step(*given), saved.step(*given))
    for dynamics in (saved, loaded):
        dynamics.fit(data, max_steps=20)
    assert same(loaded.ensemble.networks.parameters(), saved.ensemble.networks.parameters())
