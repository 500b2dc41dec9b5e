"""A robot's log in place of a target: D_target from it, and phi from a trace of it."""

from __future__ import annotations

import csv
import dataclasses
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import SMALL_ENSEMBLE, SMALL_POLICY
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import configure

from sb3_rpto import RPTO, RTO
from sb3_rpto.algorithms.closed_loop import controller
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop
from sb3_rpto.algorithms.offline_target import check_log, transitions
from sb3_rpto.buffers import chronological
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.settings import ProblemSettings, Settings

TASK, DT = "InvertedPendulum-v5", 0.04
RATE, EVERY = 0.01, 4  # s between samples, samples between decisions
GAINS = np.array([-0.741, -6.023, -0.868, -1.012])  # balance the pole
DAMPING, OFFSET = 1.4, 8.0
PUSH = LIBRARY["torque_offset"]("slider", offset=OFFSET)


def robot(lacks: tuple[Effect, ...] = ()) -> gym.Env:
    """The task with another damping and what nobody declared, in steps of a sample."""
    env = gym.make(TASK, frame_skip=2)
    base: Any = env.unwrapped
    base.model.opt.timestep = RATE / 2
    return apply_effects(env, [declare(base.model, ["hinge.damping"])[0].with_values(np.array([DAMPING])), *lacks])


@cache
def table(pushed: bool = False, noise: float = 3e-4, episodes: int = 5, decisions: int = 28) -> dict[str, np.ndarray]:
    """The columns of a log, and the true velocities in ``true``; the robot is balanced and pushed about."""
    env = robot((PUSH,) if pushed else ())
    data: Any = env.unwrapped.data  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    rows = []
    for episode in range(episodes):
        env.reset(seed=episode)
        for k in range(decisions * EVERY + 1):
            if k % EVERY == 0:
                state = np.concatenate([data.qpos, data.qvel])
                command = np.clip(-GAINS @ state + 0.7 * rng.uniform(-1, 1), -3, 3)
            rows.append(
                [episode, k * RATE, *(data.qpos + noise * rng.standard_normal(2)), command, *data.qpos, *data.qvel]
            )
            env.step(np.array([command]))
    columns = np.array(rows).T
    names = ["episode", "time", "qpos.slider", "qpos.hinge", "ctrl.slide"]
    return {**dict(zip(names, columns)), "episode": columns[0].astype(int).astype(str), "true": columns[5:].T}


def log(keep: Any = slice(None), **kwargs: Any) -> Measurements:
    """The log, of which some rows are kept."""
    return Measurements.from_tables({"log": {n: c[keep] for n, c in table(**kwargs).items() if n != "true"}})


def model(measured: Measurements, cls: type = RPTO, env: gym.Env | None = None, **kwargs: Any) -> Any:
    settings: dict[str, Any] = {
        **{"dynamics": "physical", "declared": ["hinge.damping"], "policy_kwargs": SMALL_POLICY, "device": "cpu"},
        **{"source_steps": 4, "gradient_steps": 1, "batch_size": 32, "model_train_freq": 5, "seed": 0, **kwargs},
    }
    return cls("MlpPolicy", env or gym.make(TASK), target_data=measured, **settings)


# --- D_target ---------------------------------------------------------------------------------------------------------


class Remembering(InvertedPendulumEnv):
    """Observes what was commanded last, or before that, behind sensors with noise."""

    def __init__(self, back: int) -> None:
        self.back, self.sent = back, [np.zeros(1), np.zeros(1)]
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (5,))

    def step(self, action: np.ndarray) -> Any:
        self.sent = [np.asarray(action), self.sent[0]]
        return super().step(action)

    def _get_obs(self) -> np.ndarray:
        shown = self.data.ctrl if self.back == 0 else self.sent[self.back]
        return np.concatenate([super()._get_obs() + self.np_random.normal(0, 1e-4, 4), shown])


@pytest.mark.parametrize("back", [0, 1])
def test_observations_that_no_state_tells_are_refused(back: int) -> None:
    env = gym.wrappers.TimeLimit(Remembering(back), 100)
    if back == 0:
        check_log(log(), env)
    else:
        with pytest.raises(ValueError, match=r"observation\[4\] does not follow from the state and the command alone"):
            check_log(log(), env)


def test_an_encoder_that_counts_from_another_turn_makes_the_same_transitions() -> None:
    columns = {n: c for n, c in table().items() if n != "true"}
    turned = Measurements.from_tables({"log": {**columns, "qpos.hinge": columns["qpos.hinge"] + 2 * np.pi}})
    plain, found = transitions(log(), gym.make(TASK)), transitions(turned, gym.make(TASK))
    assert len(found["actions"]) > 50
    for name, column in plain.items():
        np.testing.assert_allclose(found[name], column, atol=1e-6, err_msg=name)


def test_transitions_of_a_simulator_come_back() -> None:
    env = gym.make(TASK)
    agent = SAC("MlpPolicy", env, learning_starts=120, seed=0, device="cpu").learn(120)
    kept = chronological(agent.replay_buffer)  # type: ignore[arg-type]
    found = transitions(Measurements.from_replay(agent.replay_buffer, env), env)  # type: ignore[arg-type]
    assert kept["terminations"].sum() > 5
    for name, array in found.items():
        np.testing.assert_allclose(array, kept[name][: len(array)], atol=1e-6, err_msg=name)  # the buffer has float32
    assert len(found["actions"]) >= 117  # an episode of one transition is none to measure on


def test_noisy_samples_are_smoothed_onto_the_grid_of_the_environment() -> None:
    found = transitions(log(episodes=1), gym.make(TASK))
    truth, commands = table(episodes=1)["true"], table(episodes=1)["ctrl.slide"]
    nodes = np.arange(EVERY, len(truth) - EVERY, EVERY)  # cubics that lean to one side are left out at the ends
    assert len(found["actions"]) == len(nodes) - 1
    np.testing.assert_allclose(found["observations"][:, :2], truth[nodes[:-1], :2], atol=1.2e-3)
    error = found["next_observations"][:, 2:] - truth[nodes[1:], 2:]
    assert np.sqrt((error**2).mean()) < 0.15 * truth[:, 2:].std()  # forces jump at the nodes, cubics do not
    np.testing.assert_allclose(found["actions"][:, 0], commands[nodes[:-1]] / 3, atol=1e-9)
    assert (found["rewards"] == 1).all()
    assert not found["terminations"].any()


def test_the_grid_begins_where_commands_change() -> None:
    found = transitions(log(slice(3, None), episodes=1), gym.make(TASK))
    commands = table(episodes=1)["ctrl.slide"][::EVERY] / 3
    first = int(np.argmin(np.abs(commands - found["actions"][0, 0])))
    np.testing.assert_allclose(found["actions"][:, 0], commands[first : first + len(found["actions"])], atol=1e-9)


def test_steps_end_between_samples_too() -> None:
    """A log of 40 Hz under steps of 40 ms, without noise."""
    env = gym.make(TASK)
    time = 0.025 * np.arange(60)
    swing = {"time": time, "qpos.slider": 0.1 * np.sin(3 * time), "qvel.slider": 0.3 * np.cos(3 * time)}
    swing |= {"qpos.hinge": 0.05 * np.cos(2 * time), "qvel.hinge": -0.1 * np.sin(2 * time), "ctrl.slide": time}
    found = transitions(replace(Measurements.from_tables({"swing": swing}), exact=True), env)
    at = DT * np.arange(len(found["actions"]))
    truth = np.stack([0.1 * np.sin(3 * at), 0.05 * np.cos(2 * at), 0.3 * np.cos(3 * at), -0.1 * np.sin(2 * at)], axis=1)
    np.testing.assert_allclose(found["observations"], truth, atol=1e-5)
    assert len(at) == int(time[-1] / DT)


@pytest.mark.parametrize(
    ("integrator", "simulated", "lead"), [("EULER", False, 0.01), ("EULER", True, 0), ("RK4", False, 0)]
)
def test_commands_of_a_robot_act_from_half_a_step_before_their_instant(
    integrator: str, simulated: bool, lead: float
) -> None:
    env = gym.make(TASK)
    base: Any = env.unwrapped
    base.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    assert base.model.opt.timestep == 0.02
    time = 0.001 * np.arange(1000)
    ramp = {"time": time, "qpos.slider": time, "qpos.hinge": 0 * time, "ctrl.slide": time}
    ramp |= {"qvel.slider": 1 + 0 * time, "qvel.hinge": 0 * time} if simulated else {}
    found = transitions(replace(Measurements.from_tables({"ramp": ramp}), simulated=simulated), env)
    mean = 3 * found["actions"][:, 0] - found["observations"][:, 0]
    np.testing.assert_allclose(mean, 0.5 * (DT - 0.001) - lead, atol=2e-4)


def test_no_step_spans_what_was_not_measured() -> None:
    rows = np.delete(np.arange(113), np.arange(50, 70))
    whole, gap = transitions(log(episodes=1), gym.make(TASK)), transitions(log(rows, episodes=1), gym.make(TASK))
    assert len(whole["actions"]) - len(gap["actions"]) in range(5, 9)
    measured = log(episodes=1)
    (episode,) = measured.episodes
    off = episode.enabled.copy()
    off[60] = False
    lost = transitions(replace(measured, episodes=[replace(episode, enabled=off)]), gym.make(TASK))
    assert len(whole["actions"]) - len(lost["actions"]) in range(2, 5)  # with those whose smoothing reaches there


def test_steps_after_the_end_of_the_task_are_left_out() -> None:
    measured = log(episodes=1)
    (episode,) = measured.episodes
    tilted = episode.qpos + np.outer(np.maximum(0, episode.time - 0.6), [0, 1.0])
    found = transitions(replace(measured, episodes=[replace(episode, qpos=tilted)]), gym.make(TASK))
    assert found["terminations"].tolist() == [0.0] * (len(found["actions"]) - 1) + [1.0]
    assert np.abs(found["observations"][:, 1]).max() <= 0.2 < np.abs(found["next_observations"][-1, 1])
    assert found["rewards"][-1] == 0


def test_observations_are_those_of_the_corrected_environment() -> None:
    env = gym.make("InvertedDoublePendulum-v5")
    time = 0.01 * np.arange(100)
    columns = {"time": time, "qpos.slider": 0.1 * np.sin(3 * time), "ctrl.slide": 0 * time}
    columns |= {"qpos.hinge": 0 * time, "qpos.hinge2": 0.02 * np.cos(3 * time)}
    measured = Measurements.from_tables({"log": columns})
    plain = transitions(measured, env)
    rubbed = transitions(measured, env, [LIBRARY["coulomb_friction"]("slider", level=2.0)])
    assert not plain["observations"][:, 8].any()  # the force on the slider
    assert np.abs(rubbed["observations"][:, 8]).max() == pytest.approx(2.0)
    shown = transitions(measured, env, [LIBRARY["sensor_bias"]("hinge2", offset=0.03)])
    np.testing.assert_allclose(shown["observations"][:, 2], plain["observations"][:, 2], atol=1e-9)  # as measured


def test_a_late_sensor_shows_what_the_log_saw() -> None:
    time = 0.01 * np.arange(100)
    columns = {"time": time, "qpos.slider": 0.1 * np.sin(3 * time), "ctrl.slide": 0 * time}
    columns |= {"qpos.hinge": 0.02 * np.sin(9 * time), "qpos.hinge2": 0.02 * np.cos(3 * time)}
    measured, env = Measurements.from_tables({"log": columns}), gym.make("InvertedDoublePendulum-v5")
    plain = transitions(measured, env)
    shown = transitions(measured, env, [LIBRARY["sensor_delay"]("hinge", delay=0.08)])
    np.testing.assert_allclose(shown["observations"][:, :8], plain["observations"][:, :8], atol=1e-9)


def test_observation_wrappers_are_applied() -> None:
    env = gym.make(TASK)
    twice = gym.wrappers.TransformObservation(env, lambda o: 2 * o, env.observation_space)
    measured = log(episodes=1)
    found = transitions(measured, twice, reward_fn=lambda o, a, n: n[:, 0])
    np.testing.assert_allclose(found["observations"], 2 * transitions(measured, env)["observations"])
    np.testing.assert_allclose(found["rewards"], found["next_observations"][:, 0])


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "said"),
    [
        ("InvertedDoublePendulum-v5", r"the model's joint 'hinge2' has no column 'qpos.hinge2'"),
        ("Reacher-v5", r"column 'qpos.slider': the model has no joint 'slider'"),
        ("Pendulum-v1", r"target_data: the joints of Measurements.*pass a replay buffer"),
    ],
)
def test_a_log_of_another_machine_is_refused(env: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        model(log(), env=gym.make(env), dynamics="ensemble", declared=())


def test_a_clock_that_is_not_in_seconds_is_refused_before_anything_is_done() -> None:
    columns = {name: values for name, values in table(episodes=1).items() if name != "true"}
    measured = Measurements.from_tables({"log": {**columns, "time": 1e3 * columns["time"]}})
    with pytest.raises(ValueError, match=r"'time' is 10 s.*are these milliseconds"):
        model(measured)


def test_wrappers_that_a_log_does_not_tell_of_are_refused() -> None:
    env = gym.make(TASK)
    for wrapped, said in (
        (gym.wrappers.FrameStackObservation(env, 2), "FrameStackObservation shows more than the state"),
        (gym.wrappers.TimeAwareObservation(env), "TimeAwareObservation shows more"),
        (gym.wrappers.RescaleAction(env, -1.0, 1.0), "RescaleAction changes actions, and target_data=Measurements"),
    ):
        with pytest.raises(ValueError, match=said):
            transitions(log(episodes=1), wrapped)


def test_unknown_rewards_are_not_made_up() -> None:
    env = gym.wrappers.TransformReward(gym.make(TASK), lambda r: r)
    with pytest.raises(ValueError, match=r"holds no rewards.*pass real_ratio=0"):
        model(log(), env=env, real_ratio=0.05)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*real_ratio")  # of a log that is traced the critic sees nothing
        made = model(log(), env=env)
    assert not chronological(made.replay_buffer.target)["rewards"].any()
    with pytest.warns(UserWarning, match="without the share real_ratio="):
        other = model(log(), env=env, dynamics="residual", declared=["hinge.damping"], weighting=None)
    for one in (made, other):
        one.real_ratio = 0.5  # which the target that comes after the log has use for
        one.replay_buffer.append("source", **tens(one.replay_buffer.target))
        assert (next(one.critic_batches(1, 16)).rewards == 10).all()
    with pytest.warns(UserWarning, match="D_target loses"):
        made.set_target_env(gym.wrappers.TransformReward(gym.make(TASK), lambda r: r))
    made.replay_buffer.append("target", **{**tens(made.replay_buffer.source), "rewards": np.zeros(20)})
    assert next(made.critic_batches(1, 16)).rewards.mean() == 5


def tens(side: ReplayBuffer) -> dict[str, np.ndarray]:
    """Twenty transitions of a side, each of which earned 10."""
    rows = {name: values[:20] for name, values in chronological(side).items()}
    return {"dones": rows.pop("terminations"), **rows, "rewards": np.full(20, 10.0)}


def test_networks_are_not_taught_that_unknown_rewards_are_zero() -> None:
    env = gym.wrappers.TransformReward(gym.make(TASK), lambda r: r)
    plain = {"env": env, "declared": (), "weighting": None, "real_ratio": 0.0}
    with pytest.raises(ValueError, match=r"'ensemble' would learn them.*reward_fn"):
        model(log(), dynamics="ensemble", **plain)
    made = model(log(), dynamics="residual", **plain | {"declared": ["hinge.damping"]})
    assert not chronological(made.replay_buffer.target)["rewards"].any()


def test_a_log_of_other_motion_corrects_the_simulator_alone() -> None:
    measured = log(episodes=1)
    (episode,) = measured.episodes
    fallen = replace(measured, episodes=[replace(episode, qpos=episode.qpos + np.array([0, 0.6]))])
    with pytest.warns(UserWarning, match="learns there alone"):
        assert model(fallen).replay_buffer.target.size() == 0
    with pytest.raises(ValueError, match="record motion of the task"):
        model(fallen, dynamics="ensemble", declared=())


# --- learning ---------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch)


def quick(patch: pytest.MonkeyPatch) -> None:
    """Few windows and long steps in time: a trace of some seconds."""
    patch.setattr(ClosedLoop, "settings", replace(ClosedLoop.settings, fill_steps=50))
    settings = Settings(problem=ProblemSettings(longest_step=0.005, few_windows=8))
    patch.setitem(trace.__kwdefaults__, "settings", settings)


@cache
def learned() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        quick(patch)
        return model(log(pushed=True), close_loop=True, effects=["torque_offset"]).learn(40, source_timesteps=20)


def test_what_the_log_shows_joins_phi() -> None:
    made = learned()
    (report,) = made.loop.reports
    assert report.verdict == "explained"
    values = made.dynamics.describe()
    assert values["torque_offset(slider).offset"] == pytest.approx(OFFSET, rel=0.03)
    assert values["hinge.damping"] == pytest.approx(DAMPING, rel=0.1)
    assert "torque_offset(slider)" in [effect.label for effect in made.rollouts.copies[0].effects]


def test_what_the_trace_left_open_is_what_episodes_differ_by(monkeypatch: pytest.MonkeyPatch) -> None:
    made = learned()
    traced = (*made.loop.reports[0].declared, *made.loop.reports[0].effects)
    widths = np.concatenate([np.diff(t.interval, axis=0)[0] for t in traced])
    assert (widths > 0).all()
    np.testing.assert_allclose(made.dynamics.deviation, widths / 3.92)
    np.testing.assert_array_equal(made.dynamics.covariance, made.loop.reports[0].covariance)
    monkeypatch.setattr(made.dynamics, "randomise", 2.0)
    rng = np.random.default_rng(0)
    drawn = np.array([np.concatenate([e.values for e in made.dynamics.effects(rng)]) for _ in range(200)])
    np.testing.assert_allclose(drawn.std(axis=0), 2 * made.dynamics.deviation, rtol=0.2)


@pytest.mark.parametrize(("ratio", "joins"), [(0.9, True), (1.0, False), (1.2, False)])
def test_what_does_not_explain_a_log_joins_phi_where_it_helps_at_all(
    ratio: float, joins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = learned().loop.reports[0]
    after = dataclasses.replace(report.adequacy_before, ratio=ratio * report.adequacy_before.ratio)
    unexplained = dataclasses.replace(report, verdict="unexplained", adequacy_after=after)
    monkeypatch.setattr(controller, "trace", lambda *_, **__: unexplained)
    made = model(log(pushed=True), RTO, close_loop=True, effects=["torque_offset"])
    with pytest.warns(UserWarning, match="the trace on 5 recorded episodes is 'unexplained'"):
        made.learn(40, source_timesteps=0)
    assert ("torque_offset(slider).offset" in made.dynamics.names) == joins
    assert (made.dynamics.values[0] == pytest.approx(DAMPING, rel=0.1)) == joins


@pytest.mark.parametrize(("verdict", "times"), [("complete", 1), ("unexplained", 0)])
def test_what_a_log_does_not_tell_is_said_and_phi_is_logged(
    verdict: str, times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vague = [
        Finding(FindingKind.UNDETERMINED, "declared cart.friction", "these data do not tell it"),
        Finding(FindingKind.AT_ITS_BOUND, "declared hinge.damping", "2 is its bound"),
    ]
    report = dataclasses.replace(learned().loop.reports[0], verdict=verdict, findings=vague)
    monkeypatch.setattr(controller, "trace", lambda *_, **__: report)
    made = model(log(pushed=True), RTO, close_loop=True, effects=["torque_offset"])
    made.set_logger(configure(str(tmp_path), ["csv"]))
    with pytest.warns(UserWarning, match="these data do not tell it") as said:
        made.learn(10, source_timesteps=0)
    messages = [str(warning.message) for warning in said]
    assert sum("5 recorded episodes: declared cart.friction: these data do not tell it" in m for m in messages) == 1
    assert sum("do not tell it. declared hinge.damping: 2 is its bound" in m for m in messages) == times
    assert sum("2 is its bound" in m for m in messages) == 1
    lines = list(csv.DictReader((tmp_path / "progress.csv").open()))
    (value,) = {line["dynamics/hinge.damping"] for line in lines if line["dynamics/hinge.damping"]}
    assert float(value) == pytest.approx(made.dynamics.values[0], rel=1e-6)


def test_source_steps_are_counted_and_old_ones_dropped() -> None:
    made = learned()
    assert made.num_timesteps == 40
    assert 50 + 40 <= made.replay_buffer.source.size() <= made.source_timesteps - 100
    assert made.dynamics.error(made.transitions("source")) < ClosedLoop.settings.foreign_error


def test_the_zip_holds_what_was_found_and_not_the_log(tmp_path: Path) -> None:
    made = learned()
    made.save(tmp_path / "model")
    made.save_replay_buffer(tmp_path / "buffer")
    loaded = RPTO.load(tmp_path / "model", env=gym.make(TASK), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.measured is None
    assert loaded.dynamics.describe() == made.dynamics.describe()
    loaded.learn(20, reset_num_timesteps=False)  # without another trace
    assert loaded.num_timesteps == 60
    assert len(loaded.loop.found) == 1


def test_a_model_saved_before_its_trace_asks_for_the_log(tmp_path: Path) -> None:
    model(log()).save(tmp_path / "model")
    loaded = RPTO.load(tmp_path / "model", env=gym.make(TASK), device="cpu")
    with pytest.raises(ValueError, match=r"set model\.measured"):
        loaded.learn(20, source_timesteps=0)


@pytest.mark.slow
def test_a_log_that_corrects_the_simulator_alone_is_not_asked_for_again(tmp_path: Path) -> None:
    measured = log(pushed=True)
    fallen = [replace(episode, qpos=episode.qpos + np.array([0, 0.6])) for episode in measured.episodes]
    with pytest.warns(UserWarning, match="learns there alone"):
        made = model(replace(measured, episodes=fallen), close_loop=True, effects=["torque_offset"]).learn(
            20, source_timesteps=20
        )
    made.save(tmp_path / "model")
    loaded = RPTO.load(tmp_path / "model", env=gym.make(TASK), device="cpu")
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 40


def test_a_log_that_is_too_short_to_trace_is_named_before_anything_is_learned() -> None:
    made = model(log(episodes=1, decisions=12))
    with pytest.raises(ValueError, match=r"^target_data: .*too few to select on; record longer"):
        made.learn(8)
    assert made.num_timesteps == 0


@pytest.mark.slow
def test_with_the_loop_open_the_declared_numbers_alone_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[int] = []
    monkeypatch.setattr(PhysicalDynamics, "fit", lambda *_, **__: fits.append(1))
    made = model(log(), RTO).learn(40, source_timesteps=0)
    assert made.dynamics.names == ["hinge.damping"]
    assert made.dynamics.values == pytest.approx(DAMPING, rel=0.05)
    assert not made.loop.reports[0].effects
    assert not fits


def test_networks_learn_from_a_log() -> None:
    made = model(log(), dynamics="ensemble", declared=(), dynamics_kwargs=SMALL_ENSEMBLE)
    size = made.replay_buffer.target.size()
    assert size == 5 * 26
    made.learn(40, source_timesteps=0)
    assert not made.loop.closed
    assert made.replay_buffer.target.size() == size
