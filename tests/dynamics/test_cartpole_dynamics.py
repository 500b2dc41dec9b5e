import copy
import io
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TimeLimit, TransformObservation, TransformReward
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.dynamics.cartpole import DECLARABLE, CartPoleDynamics, cartpole_constants
from sb3_rpto.envs.cartpole import ContinuousCartPoleEnv

SOURCE = ContinuousCartPoleEnv()


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: RescaleAction(env, np.float32(-0.5), np.float32(0.5)),
        lambda env: TransformObservation(env, lambda seen: 2 * seen, env.observation_space),
        lambda env: TransformReward(env, lambda reward: reward - 5),
    ],
)
def test_the_equations_know_nothing_of_wrappers(wrap):
    env = wrap(ContinuousCartPoleEnv())
    for source in (env, DummyVecEnv([lambda: env])):
        with pytest.raises(ValueError, match=f"wrapper.s. {type(env).__name__} may change .* dynamics='ensemble'"):
            cartpole_constants(source)


def test_cart_poles_of_different_constants_are_refused():
    with pytest.raises(ValueError, match="cart-poles with different constants"):
        cartpole_constants(DummyVecEnv([ContinuousCartPoleEnv, lambda: ContinuousCartPoleEnv(gravity=20.0)]))


def collect(n: int = 500, seed: int = 0, **constants: float) -> Transitions:
    """``n`` transitions of a random policy, terminal ones included."""
    env = ContinuousCartPoleEnv(**constants)
    env.action_space.seed(seed)
    observation = env.reset(seed=seed)[0]
    rows = []
    for _ in range(n):
        action = env.action_space.sample()
        reached, reward, terminated, _, _ = env.step(action)
        rows.append((observation, action, np.float32(reward), reached, np.float32(terminated)))
        observation = env.reset()[0] if terminated else reached
    return Transitions(*(th.as_tensor(np.array(column)) for column in zip(*rows)))


def model(*declared: str, **kwargs) -> CartPoleDynamics:
    kwargs.setdefault("constants", cartpole_constants(SOURCE))
    if declared:
        kwargs["declared"] = declared
    return CartPoleDynamics(SOURCE.observation_space, SOURCE.action_space, **kwargs)


@pytest.mark.parametrize("length", [0.6, 1.2, 2.0, 4.0])
def test_recovers_the_pole_length(length):
    dynamics, data = model(max_step=0.02), collect(pole_length=length)
    assert dynamics.error(data) > 0.01
    log = dynamics.fit(data)
    assert log["pole_length"] == pytest.approx(length, abs=1e-5)
    assert dynamics.describe() == {"pole_length": log["pole_length"]}
    assert log["pole_length_se"] < 1e-5
    assert dynamics.error(data) < 1e-5


def test_default_pace_doubles_a_constant_in_a_few_hundred_steps():
    dynamics = model()
    log = dynamics.fit(collect(100, pole_length=2.0))
    assert 250 <= log["steps"] <= 300
    assert log["pole_length"] == pytest.approx(2.0, abs=1e-4)


def test_recovers_several_constants_at_once():
    truth = {"pole_length": 1.7, "gravity": 8.5, "force_scale": 13.0, "cart_friction": 0.4, "pole_friction": 0.01}
    dynamics = model(*truth, max_step=0.02)
    log = dynamics.fit(collect(**truth))
    for name, value in truth.items():
        assert log[name] == pytest.approx(value, rel=1e-3), name
    corrected = ContinuousCartPoleEnv(**dynamics.constants)
    assert corrected.parameters.gravity == log["gravity"]
    assert corrected.parameters.cart_mass == 1.0


def test_gradient_is_exact():
    dynamics, data = model(*DECLARABLE), collect(20)
    phi = th.linspace(-0.2, 0.3, len(DECLARABLE), dtype=th.float64)
    phi[-2:] = 0.1

    def predict(coordinates: th.Tensor) -> th.Tensor:
        return dynamics.simulate(data.observations, data.actions, coordinates)

    reached, jacobian = dynamics.linearise(data.observations, data.actions, phi)
    assert reached.equal(predict(phi))
    assert jacobian.shape == (20, 4, len(phi))
    for k in range(len(phi)):
        nudge = th.zeros_like(phi)
        nudge[k] = 1e-5
        difference = (predict(phi + nudge) - predict(phi - nudge)) / 2e-5
        assert jacobian[..., k].abs().max() > 1e-4
        th.testing.assert_close(jacobian[..., k], difference, rtol=1e-6, atol=1e-9)


def test_path_is_smooth_and_monotone():
    dynamics, data = model(max_step=0.01), collect(100, pole_length=2.0)
    path = [1.0] + [dynamics.fit(data, max_steps=1)["pole_length"] for _ in range(80)]
    change = np.diff(np.log(path))
    assert (change >= -1e-7).all()
    assert change.max() <= 0.01 + 1e-12
    assert (change[:60] > 0.0099).all()
    assert max(path) <= 2.0 + 1e-5
    assert path[-1] == pytest.approx(2.0, abs=1e-5)


def test_two_short_fits_equal_one_long_fit():
    data = collect(100, pole_length=2.0, gravity=8.0)
    once, twice = model("pole_length", "gravity"), model("pole_length", "gravity")
    assert once.fit(data, max_steps=30)["steps"] == 30
    twice.fit(data, max_steps=10)
    twice.fit(data, max_steps=20)
    assert once.coordinates.equal(twice.coordinates)


def test_transitions_of_weight_zero_are_ignored():
    good, bad = collect(200, pole_length=1.2), collect(100, seed=1)
    bad = replace(bad, next_observations=bad.next_observations * 50, observations=bad.observations * math.nan)
    both = Transitions(*(th.cat([getattr(bad, k), getattr(good, k)]) for k in vars(good)))
    weights = th.cat([th.zeros(100), th.rand(200, generator=th.Generator().manual_seed(0)) + 0.5])
    mixed, alone = model(), model()
    log = mixed.fit(both, weights)
    assert log == alone.fit(good, weights[100:])
    assert log["pole_length"] == pytest.approx(1.2, abs=1e-5)


def test_weights_decide_between_two_worlds():
    worlds = [collect(200, pole_length=1.1), collect(200, pole_length=1.3)]
    both = Transitions(*(th.cat([getattr(world, k) for world in worlds]) for k in vars(worlds[0])))
    found = []
    for share in (0.1, 0.5, 0.9):
        weights = th.cat([th.full((200,), 1 - share), th.full((200,), share)])
        found.append(model().fit(both, weights)["pole_length"])
    assert 1.1 < found[0] < found[1] < found[2] < 1.3
    assert model().fit(both, 7 * weights)["pole_length"] == pytest.approx(
        found[2], abs=1e-9
    )  # scale of weights: no matter


def test_a_weight_of_two_is_a_transition_seen_twice():
    data = collect(60, pole_length=1.5, cart_friction=1.0)
    weights = th.arange(60) % 3
    repeated = Transitions(*(getattr(data, k).repeat_interleave(weights, 0) for k in vars(data)))
    weighted, plain = model(), model()
    log, expected = weighted.fit(data, weights.float(), max_steps=50), plain.fit(repeated, max_steps=50)
    assert log["pole_length"] == pytest.approx(expected["pole_length"], rel=1e-12)
    assert log["loss"] == pytest.approx(expected["loss"], rel=1e-12)
    assert log["loss"] == pytest.approx(plain.error(repeated) ** 2, rel=1e-6)
    assert log["loss"] > 1e-3


def test_loss_never_rises_even_with_steps_too_long():
    # Towards a shorter pole Gauss-Newton overshoots: the effect of the length grows as 1 / length.
    dynamics = model(bounds={"pole_length": (1e-3, 1e3)}, max_step=100.0)
    data = collect(200, pole_length=0.2)
    losses = [dynamics.error(data) ** 2] + [dynamics.fit(data, max_steps=1)["loss"] for _ in range(20)]
    assert (np.diff(losses) <= 0).all()
    assert dynamics.describe()["pole_length"] == pytest.approx(0.2, abs=1e-5)


def test_the_newest_transitions_are_fitted():
    old, new = collect(50), collect(100, pole_length=1.1)
    new = Transitions(*(getattr(new, k).repeat_interleave(CartPoleDynamics.fits_newest // 100, 0) for k in vars(new)))
    both = Transitions(*(th.cat([getattr(old, k), getattr(new, k)]) for k in vars(old)))
    assert model().fit(both)["pole_length"] == pytest.approx(1.1, abs=1e-5)


def test_bounds_hold_and_do_not_stop_the_others():
    bounds = {"pole_length": (0.5, 1.25), "cart_friction": (0.0, 1.0)}
    dynamics = model("pole_length", "force_scale", "cart_friction", bounds=bounds, max_step=0.02)
    data = collect(pole_length=2.0, force_scale=12.0)
    log = dynamics.fit(data)
    assert log["pole_length"] == 1.25
    assert 0.0 <= log["cart_friction"] <= 1.0
    # what is free is at its optimum given the bound: a model with the length fixed there finds the same
    fixed = model("force_scale", "cart_friction", constants={"pole_length": 1.25}, bounds={"cart_friction": (0.0, 1.0)})
    expected = fixed.fit(data)
    assert log["force_scale"] == pytest.approx(expected["force_scale"], rel=1e-5)
    assert log["loss"] == pytest.approx(expected["loss"], rel=1e-8)
    ContinuousCartPoleEnv(**dynamics.constants)


def test_a_friction_comes_back_to_its_bound():
    dynamics = model("cart_friction", constants={"cart_friction": 0.3})
    log = dynamics.fit(collect())
    assert log["cart_friction"] == pytest.approx(0.0, abs=1e-5)
    assert ContinuousCartPoleEnv(**dynamics.constants).parameters.cart_friction >= 0


@given(st.floats(1e-3, 9.9), st.floats(0.1, 9.9), st.booleans())
def test_values_at_a_bound_are_within_it(friction, length, upper):
    constants = {"cart_friction": friction, "pole_length": length}
    dynamics = model(*constants, constants=constants)
    with th.no_grad():
        dynamics.coordinates.copy_(dynamics._upper if upper else dynamics._lower)
    for name, value in dynamics.describe().items():
        assert dynamics.bounds[name][0] <= value <= dynamics.bounds[name][1]
        assert value == pytest.approx(dynamics.bounds[name][upper], rel=1e-12, abs=1e-12)


def test_what_the_data_cannot_identify_stays_nominal():
    # Without friction, masses and force scaled by one factor give the same motion.
    dynamics = model("cart_mass", "pole_mass", "force_scale", "pole_length", max_step=0.02)
    log = dynamics.fit(collect(force_scale=15.0))
    assert dynamics.error(collect(force_scale=15.0, seed=7)) < 1e-5
    assert dynamics.coordinates[:3].sum().item() == pytest.approx(0.0, abs=1e-6)
    assert log["force_scale"] / log["cart_mass"] == pytest.approx(15.0, rel=1e-5)
    assert math.isinf(log["cart_mass_se"])
    assert math.isinf(log["force_scale_se"])
    assert log["pole_length_se"] < 1e-5


def test_nothing_moves_where_the_data_say_nothing():
    still = Transitions(th.zeros(9, 4), th.zeros(9, 1), th.ones(9), th.zeros(9, 4), th.zeros(9))
    dynamics = model("pole_length", "gravity")
    log = dynamics.fit(still)
    assert (log["pole_length"], log["gravity"], log["steps"], log["loss"]) == (1.0, 9.8, 0.0, 0.0)
    assert math.isinf(log["pole_length_se"])


@pytest.mark.parametrize("declared", [("pole_length",), ("pole_length", "gravity", "force_scale"), tuple(DECLARABLE)])
def test_equal_worlds_keep_phi(declared):
    dynamics = model(*declared)
    dynamics.fit(collect())
    assert dynamics.coordinates.abs().max() < 1e-6


@pytest.mark.slow
def test_standard_errors_match_the_spread_over_noise():
    clean = collect(200, pole_length=1.2)
    noise = th.tensor([1e-4, 1e-2, 1e-4, 3e-2])  # unequal: the plain Gauss-Newton error would be wrong
    generator = th.Generator().manual_seed(0)
    estimates, errors = [], []
    for _ in range(60):
        disturbed = clean.next_observations + noise * th.randn(200, 4, generator=generator)
        log = model(constants={"pole_length": 1.2}).fit(replace(clean, next_observations=disturbed))
        estimates.append(log["pole_length"])
        errors.append(log["pole_length_se"])
    assert np.mean(errors) == pytest.approx(np.std(estimates, ddof=1), rel=0.3)
    assert np.mean(estimates) == pytest.approx(1.2, abs=3 * np.mean(errors) / math.sqrt(60))


def test_step_is_the_environments():
    constants = {"pole_length": 1.4, "theta_threshold": 0.1, "cart_friction": 0.2}
    env, dynamics = ContinuousCartPoleEnv(**constants), model(constants=constants)
    data = collect(300, **constants)
    prediction = dynamics.step(data.observations, data.actions)
    assert prediction.next_observations.dtype == th.float32
    assert not prediction.next_observations.requires_grad
    # the environment kept the float64 state that these observations were rounded from
    th.testing.assert_close(prediction.next_observations, data.next_observations, rtol=0, atol=5e-7)
    assert prediction.terminations.equal(data.terminations.bool())
    assert 0 < data.terminations.sum() < 300
    th.testing.assert_close(prediction.rewards, data.rewards, check_dtype=False)
    for observation, action, expected in zip(data.observations[:50], data.actions, prediction.next_observations):
        env.reset(seed=0)
        env.set_state({**env.get_state(), "physics": tuple(observation.double().tolist())})
        np.testing.assert_array_max_ulp(env.step(action.numpy())[0], expected.numpy())
    assert dynamics.step(data.observations.double(), data.actions).next_observations.dtype == th.float64


def test_checkpoint_round_trip():
    first = model("pole_length", "gravity")
    first.fit(collect(100, pole_length=1.3), max_steps=20)
    first.seed(4)
    file = io.BytesIO()
    th.save(first.state_dict(), file)
    file.seek(0)
    state = th.load(file, weights_only=True)
    second = CartPoleDynamics(
        SOURCE.observation_space,
        SOURCE.action_space,
        constants=first.nominal,
        declared=first.declared,
        bounds=first.bounds,
    )
    second.load_state_dict(state)
    assert second.describe() == first.describe()
    assert second.constants == copy.deepcopy(first).constants
    assert th.rand(1, generator=second.generator) == th.rand(1, generator=first.generator)
    with pytest.raises(ValueError, match="declared"):
        model("gravity", "pole_length").load_state_dict(state)
    with pytest.raises(ValueError, match="constants"):
        model("pole_length", "gravity", constants={"cart_mass": 3.0}).load_state_dict(state)


def test_constants_are_read_through_wrappers():
    env = TimeLimit(ContinuousCartPoleEnv(pole_length=1.4), 500)
    assert cartpole_constants(env)["pole_length"] == 1.4
    assert cartpole_constants(DummyVecEnv([lambda: env]))["pole_length"] == 1.4
    with pytest.raises(ValueError, match="ContinuousCartPoleEnv"):
        cartpole_constants(gym.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"declared": ["pole_lenght"]}, "did you mean 'pole_length'"),
        ({"declared": ["theta_threshold"]}, "unknown constant 'theta_threshold'"),
        ({"declared": ["dt"]}, "unknown constant 'dt'"),
        ({"declared": []}, "one or more"),
        ({"declared": "gravity"}, "list"),
        ({"declared": ["gravity", "gravity"]}, "different"),
        ({"constants": {"gravty": 9.0}}, "did you mean 'gravity'"),
        ({"constants": {"gravity": -9.0}}, "gravity"),
        ({"bounds": {"gravity": (1.0, 20.0)}}, "not declared"),
        ({"bounds": {"pole_length": (1.5, 2.0)}}, "around its nominal"),
        ({"bounds": {"pole_length": (1.0, 1.0)}}, "around its nominal"),
        ({"bounds": {"pole_length": (-1.0, 2.0)}}, "positive"),
        ({"bounds": {"pole_length": (0.5, math.inf)}}, "finite"),
        ({"max_step": 0.0}, "max_step"),
    ],
)
def test_bad_arguments_are_named(kwargs, match):
    with pytest.raises(ValueError, match=match):
        model(**kwargs)


def test_other_spaces_are_refused():
    with pytest.raises(ValueError, match="cart-pole"):
        CartPoleDynamics(spaces.Box(-1, 1, (3,)), SOURCE.action_space, constants={})


@pytest.mark.parametrize(
    "weights", [th.ones(20, 1), th.ones(19), -th.ones(20), th.zeros(20), th.full((20,), math.nan)], ids=str
)
def test_bad_weights_are_refused(weights):
    with pytest.raises(ValueError, match="weights"):
        model().fit(collect(20), weights)


def test_bad_data_are_refused_and_change_nothing():
    data = collect(20, pole_length=2.0)
    data.next_observations[3, 2] = math.nan
    dynamics = model()
    with pytest.raises(ValueError, match="next_observations"):
        dynamics.fit(data)
    with pytest.raises(ValueError, match="empty"):
        dynamics.fit(data.take(slice(0, 0)))
    assert dynamics.describe() == {"pole_length": 1.0}
