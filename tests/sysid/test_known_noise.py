"""Whole states of known noise, as a robot's environment shows them at the rate of control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from simulated import compiled, problem, recorded
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_rpto.algorithms.offline_target import transitions
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.data.columns import columns_of
from sb3_rpto.sysid.data.recording import Episode, Noise
from sb3_rpto.sysid.selection.adequacy import adequacy
from sb3_rpto.sysid.shooting.initial_states import start_state
from sb3_rpto.sysid.shooting.prediction_errors import horizon_errors, noise_floor
from sb3_rpto.sysid.shooting.windows import EXACT, cut, first_sample, names_of, noise_levels

TASK = "InvertedDoublePendulum-v5"
#: place and angles in m and rad, speeds in m/s and rad/s, the force of a constraint without noise
NOISE = np.array([1e-3] * 5 + [1e-2] * 3 + [0.0])


def shaken(noise: Noise, effects: Sequence[Effect] = (), seed: int = 0, **kwargs) -> Measurements:
    """Runs of the pendulum with white noise on positions and on velocities."""
    data = recorded(effects, noise=0.0, seed=seed, **kwargs)
    rng = np.random.default_rng([seed, 2])
    episodes = [
        replace(
            e,
            qpos=e.qpos + noise.qpos * rng.standard_normal(e.qpos.shape),
            qvel=e.qvel + noise.qvel * rng.standard_normal(e.qvel.shape),
        )
        for e in data.episodes
    ]
    return replace(data, episodes=episodes, noise=noise, simulated=True)


def seen(lacks: Sequence[Effect], count: int, noise: np.ndarray = NOISE) -> ReplayBuffer:
    """Random steps of a double pendulum with a longer pole and these effects, as noisy sensors show them."""
    env = gym.make(TASK)
    longer = [d.with_values(1.15 * d.values) for d in declare(env.unwrapped.model, ["pole.length"])]  # type: ignore[attr-defined]
    env = apply_effects(env, [*longer, *lacks])
    buffer = ReplayBuffer(count, env.observation_space, env.action_space)
    rng = np.random.default_rng(0)

    def shown(observation: np.ndarray) -> np.ndarray:
        return observation + noise * rng.standard_normal(len(noise))

    observation = shown(env.reset(seed=0)[0])
    for _ in range(count):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        following, reward, terminated, truncated, _ = env.step(action)
        following = shown(following)
        ended = np.array([terminated or truncated])
        buffer.add(observation[None], following[None], action[None], np.array([reward]), ended, [{}])
        observation = shown(env.reset()[0]) if ended[0] else following
    return buffer


# --- from observations to states --------------------------------------------------------------------------------------


def test_the_noise_of_sines_and_cosines_is_that_of_their_angle() -> None:
    data = Measurements.from_replay(seen([], 60), gym.make(TASK), noise=NOISE)
    assert not data.exact
    assert data.simulated  # the environment's own steps are to meet them
    assert data.whole_states
    assert data.noise is not None
    np.testing.assert_allclose(data.noise.qpos, 1e-3, rtol=0.03)
    np.testing.assert_allclose(data.noise.qvel, 1e-2, rtol=0.03)


def test_one_number_is_the_noise_of_all_and_what_no_observation_holds_has_none() -> None:
    env = gym.make("HalfCheetah-v5")
    buffer = ReplayBuffer(20, env.observation_space, env.action_space)
    observation, _ = env.reset(seed=0)
    for _ in range(20):
        action = np.zeros((1, 6), np.float32)
        following, *_ = env.step(action[0])
        buffer.add(observation[None], following[None], action, np.zeros(1), np.zeros(1), [{}])
        observation = following
    noise = Measurements.from_replay(buffer, env, noise=0.02).noise
    assert noise is not None
    assert noise.qpos[0] == 0
    np.testing.assert_allclose(np.append(noise.qpos[1:], noise.qvel), 0.02, rtol=0.03)


def test_a_speed_that_noise_may_have_brought_below_its_bound_is_not_known() -> None:
    env = gym.make(TASK)  # shows speeds up to 10
    buffer = ReplayBuffer(40, env.observation_space, env.action_space)
    rng = np.random.default_rng(0)
    shown = np.tile([0.0, 0, 0, 1, 1, 0, 0, 0, 0], (41, 1))
    shown[20:, 5] = 10 + 1e-2 * rng.standard_normal(21)
    for row in range(40):
        buffer.add(shown[[row]], shown[[row + 1]], np.zeros((1, 1), np.float32), np.zeros(1), np.zeros(1), [{}])
    (episode,) = Measurements.from_replay(buffer, env, noise=NOISE).episodes
    assert episode.usable[:20].all()
    assert not episode.usable[20:].any()


@pytest.mark.parametrize("wrong", [-1e-3, 0.0, np.nan, True, [1e-3] * 4, [[1.0], [1.0, 2.0]], "much"])
def test_a_noise_that_is_none_is_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match=r"noise is .*; give a standard deviation above 0"):
        Measurements.from_replay(seen([], 4), gym.make(TASK), noise=wrong)  # type: ignore[arg-type]


def test_a_noisy_sample_without_a_velocity_is_no_state() -> None:
    env = gym.make("Pusher-v5")
    buffer = ReplayBuffer(20, env.observation_space, env.action_space)
    with pytest.raises(ValueError, match=r"Pusher-v5 do not hold the velocities of all joints \(2 of 11 are missing\)"):
        Measurements.from_replay(buffer, env, noise=1e-3)


def test_the_steps_behind_noisy_states_are_those_that_were_taken() -> None:
    env, buffer = gym.make(TASK), seen([], 60)
    data = Measurements.from_replay(buffer, env, noise=NOISE)
    steps = transitions(data, env)
    assert len(steps["actions"]) > 50  # but those that noise shows as over
    off = np.abs(steps["actions"] - buffer.actions[:60, 0].T)
    assert off.min(axis=1).max() < 1e-6


def test_without_a_noise_nothing_changes() -> None:
    data = Measurements.from_replay(seen([], 10), gym.make(TASK))
    assert data.exact
    assert data.noise is None


# --- windows ----------------------------------------------------------------------------------------------------------


def test_a_window_begins_at_the_sample_itself_with_the_spread_of_its_noise() -> None:
    noise = Noise(np.array([2e-3]), np.array([3e-2]))
    data, model = shaken(noise), compiled()
    episode = data.episodes[0]
    assert first_sample(model, episode, data.whole_states) == 0
    assert noise_levels(data) == pytest.approx([2e-3])
    q, v, _, spread = start_state(model, data, episode, 3, np.array([2e-3]), names_of(model, data.columns.qpos))
    assert (q[0], v[0]) == (episode.qpos[3, 0], episode.qvel[3, 0])
    np.testing.assert_array_equal(spread, [2e-3, 3e-2])
    windows = cut(model, data, noise_levels(data), 0.4, 20)
    assert not windows.exact
    assert windows.noisy_starts
    assert windows.trust == 1.0


def test_the_velocity_of_a_machine_leads_its_position_by_half_a_step() -> None:
    data = replace(shaken(Noise(np.array([1e-3]), np.array([1e-2]))), simulated=False)
    model = compiled()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    episode, address = data.episodes[0], names_of(model, data.columns.qpos)
    _, v, a, _ = start_state(model, data, episode, 3, np.array([1e-3]), address)
    assert v[0] == pytest.approx(episode.qvel[3, 0] - 0.5 * model.opt.timestep * a[0])


def test_positions_that_are_exact_count_as_noisy_as_exact_ones() -> None:
    data = shaken(Noise(np.zeros(1), np.array([1e-2])))
    spread = np.std(np.concatenate([e.qpos for e in data.episodes]))
    assert noise_levels(data) == pytest.approx([EXACT * spread])


def test_the_noise_of_a_free_body_is_that_of_its_turns() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1' mass='1'/></body></worldbody></mujoco>"
    )
    columns = columns_of(model)
    rng, sigma = np.random.default_rng(0), 1e-3
    whole = np.array([0, 0, 0, 1.0, 0, 0, 0])
    q = whole + sigma * rng.standard_normal((20_000, 7))
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    turns = np.zeros((len(q), 3))
    for turn, quaternion in zip(turns, q[:, 3:]):
        mujoco.mju_subQuat(turn, quaternion, whole[3:])
    spread_of_numbers = (q - whole).std(axis=0)
    empty = np.empty((len(q), 0))
    episode = Episode("e", "e", np.arange(len(q)) / 50, q, np.zeros((len(q), 6)), empty, empty, empty.astype(bool))
    data = Measurements([episode], columns, noise=Noise(spread_of_numbers, np.full(6, 0.1)))
    *_, spread = start_state(model, data, episode, 0, np.full(7, sigma), names_of(model, columns.qpos))
    np.testing.assert_allclose(spread[:3], sigma, rtol=0.03)
    np.testing.assert_allclose(spread[3:6], turns.std(), rtol=0.03)
    np.testing.assert_array_equal(spread[6:], 0.1)


# --- what is left is noise, or is not ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("speed", [3e-3, 3e-2, 0.3])
def test_a_true_model_is_adequate_whatever_the_noise_of_the_speeds(speed: float) -> None:
    noise, found = Noise(np.array([1e-3]), np.array([speed])), []
    for seed in range(6):
        p = problem([CoulombFriction("hinge")], shaken(noise, seed=seed, episodes=8))
        found.append(adequacy(p, p.score(np.zeros(1)), seed))
    assert all(a.adequate for a in found)
    assert np.mean([a.ratio for a in found]) == pytest.approx(1.0, abs=0.03)
    assert np.mean([a.strays for a in found]) < 0.02


def test_what_is_missing_shows_in_spite_of_the_noise() -> None:
    noise = Noise(np.array([1e-3]), np.array([3e-2]))
    p = problem([CoulombFriction("hinge")], shaken(noise, [CoulombFriction("hinge", level=0.08)], episodes=8))
    assert adequacy(p, p.score(np.zeros(1)), 0).low > 1.5
    fit = p.fit(np.zeros(1), np.array([0]))
    assert fit.values[0] == pytest.approx(0.08, rel=0.05)


@pytest.mark.slow
def test_the_floor_is_what_a_true_model_errs_by() -> None:
    noise = Noise(np.array([1e-3]), np.array([3e-2]))
    data = shaken(noise, episodes=12)
    p = problem([], data)
    (errs, *_), (floor, *_) = (
        f(p.simulation, np.zeros(0), data, np.array([1e-3]), 0) for f in (horizon_errors, noise_floor)
    )
    assert floor.horizon == errs.horizon == 0.1
    assert floor.rmse[0] == pytest.approx(errs.rmse[0], rel=0.1)


# --- the trace --------------------------------------------------------------------------------------------------------


@cache
def friction() -> Effect:
    return LIBRARY["coulomb_friction"]("slider", level=3.0)


KINDS = ["coulomb_friction", "torque_offset"]


@pytest.mark.slow
def test_a_trace_of_noisy_states_names_what_is_missing() -> None:
    env = gym.make(TASK)
    data = Measurements.from_replay(seen([friction()], 150), env, noise=NOISE)
    report = trace(env, data, ["pole.length"], candidates=KINDS, horizon=0.15, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == ["coulomb_friction(slider)"]
    (low, high), (short, long) = report.effects[0].interval[:, 0], report.declared[0].interval[:, 0]
    assert low < 3.0 < high
    assert high - low < 1.5
    assert short < 1.15 * 0.6 < long
    assert long - short < 0.05


@pytest.mark.slow
def test_a_trace_of_noisy_states_names_nothing_where_nothing_is_missing() -> None:
    env = gym.make(TASK)
    data = Measurements.from_replay(seen([], 150), env, noise=NOISE)
    report = trace(env, data, ["pole.length"], candidates=KINDS, horizon=0.15, threads=1)
    assert (report.verdict, report.effects) == ("complete", [])
    # Taken for exact, the same observations are explained by nothing.
    exact = Measurements.from_replay(seen([], 150), env)
    assert trace(env, exact, ["pole.length"], candidates=KINDS, horizon=0.15, threads=1).verdict == "unexplained"
