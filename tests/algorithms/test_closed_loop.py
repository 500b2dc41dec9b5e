"""The loop closed inside learn(): what the target has and nobody declared joins phi."""

from __future__ import annotations

import csv
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import chain, count, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TransformAction
from queued import Queue
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPTO, RTO
from sb3_rpto.algorithms import arguments, pretraining
from sb3_rpto.algorithms.closed_loop import acceptance, controller
from sb3_rpto.algorithms.closed_loop.acceptance import source_buffer_is_foreign, stays_finite
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop
from sb3_rpto.algorithms.closed_loop.policy_selection import PolicySelection
from sb3_rpto.algorithms.closed_loop.retraining import Retraining, reset_source_buffer
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.dynamics.weights import rto_weights
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.findings import Finding, FindingKind

TASK = "InvertedDoublePendulum-v5"
KINDS = ["coulomb_friction", "torque_offset", "quadratic_drag"]
LEVEL, LENGTH = 3.0, 1.15


def target(lacks: list[Effect]) -> gym.Env:
    env = gym.make(TASK)
    declared = [d.with_values(LENGTH * d.values) for d in declare(env.unwrapped.model, ["pole.length"])]  # type: ignore[attr-defined]
    return apply_effects(env, [*declared, *lacks])


def friction() -> list[Effect]:
    return [LIBRARY["coulomb_friction"]("slider", level=LEVEL)]


def model(lacks: list[Effect], cls: type = RPTO, **kwargs: object) -> RPTO:
    settings: dict[str, object] = {
        **{"dynamics": "physical", "declared": ["pole.length"], "close_loop": True, "effects": KINDS},
        **{"seed": 0, "device": "cpu"},
        **{"source_steps": 4, "gradient_steps": 1, "weighting": None, "model_train_freq": 40, "batch_size": 32},
        **{"target_env": None if "target_data" in kwargs else target(lacks), "retrain_steps": 25},
        **kwargs,
    }
    if not settings["close_loop"]:
        del settings["effects"]
    return cls("MlpPolicy", gym.make(TASK), **settings)


def change(patch: pytest.MonkeyPatch, **settings: float) -> None:
    """Let closed loops have other settings."""
    patch.setattr(ClosedLoop, "settings", replace(ClosedLoop.settings, **settings))


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    change(monkeypatch, first_trace=80, fill_steps=25)


#: Reports that :func:`learned` was told of, and how many updates it had made by then.
TOLD: list[tuple[Report, int]] = []


@cache
def learned() -> RPTO:
    with pytest.MonkeyPatch.context() as patch:
        change(patch, first_trace=80, fill_steps=25)
        made = model(friction())
        made.loop.on_report = lambda report: TOLD.append((report, made._n_updates))
        return made.learn(100, source_timesteps=100)


@pytest.fixture(scope="module")
def kept_on_a_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a model is kept that has learned on a log, traced for what was declared alone."""
    folder = tmp_path_factory.mktemp("log")
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    with pytest.MonkeyPatch.context() as patch:
        change(patch, fill_steps=25)
        patch.setattr(pretraining, "FIRST_SOURCE_STEPS", 200)
        made = model([], target_data=measured, close_loop=False, model_train_freq=20).learn(40, source_timesteps=0)
    made.save(folder / "model")
    made.save_replay_buffer(folder / "buffer")
    return folder


def on_a_log(kept: Path) -> RPTO:
    made = RPTO.load(kept / "model", env=gym.make(TASK), device="cpu")
    made.load_replay_buffer(kept / "buffer")
    return made


def dynamics(made: RPTO) -> PhysicalDynamics:
    assert isinstance(made.dynamics, PhysicalDynamics)
    return made.dynamics


def test_an_undeclared_effect_is_named_added_and_fitted() -> None:
    made = learned()
    report: Report = made.loop.reports[0]
    assert report.verdict == "explained"
    assert [traced.effect.label for traced in report.effects] == ["coulomb_friction(slider)"]
    values = dynamics(made).describe()
    assert values["coulomb_friction(slider).level"] == pytest.approx(LEVEL, rel=0.01)
    assert values["pole.length"] == pytest.approx(LENGTH * 0.6, rel=0.01)


def test_a_report_is_told_before_the_policy_learns_in_what_it_corrects() -> None:
    made = learned()
    ((report, updates),) = TOLD
    assert report is made.loop.reports[0]
    owed = 100 - 80  # updates that the last target steps pay for
    assert updates + owed < made._n_updates


@pytest.mark.slow
def test_a_target_with_frictionloss_alone_is_explained(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody who sets it by hand makes it hold as a machine's does."""
    change(monkeypatch, first_trace=160)  # in fewer it turns too seldom to show that it gives way
    shifted = target([])
    shifted.unwrapped.model.dof_frictionloss[0] = LEVEL  # type: ignore[attr-defined]
    made = model([], target_env=shifted, effects=[*KINDS, "soft_friction"]).learn(161, source_timesteps=4)
    report: Report = made.loop.reports[0]
    assert report.verdict == "explained"
    assert [traced.effect.label for traced in report.effects] == ["soft_friction(slider)"]
    assert dynamics(made).describe()["soft_friction(slider).level"] == pytest.approx(LEVEL, rel=1e-3)
    assert dynamics(made).error(made.transitions("target")) < 1e-3, "the simulator gives way as the target does"


class Braked(gym.Wrapper):
    """Drag on the cart, written once a step."""

    def step(self, action: Any) -> Any:
        data: Any = self.env.unwrapped.data  # type: ignore[attr-defined]
        data.qfrc_applied[0] = -2.0 * abs(data.qvel[0]) * data.qvel[0]
        return self.env.step(action)


@pytest.mark.slow
def test_a_target_whose_wrapper_holds_a_force_for_a_step_is_met(soon: None, tmp_path: Path) -> None:
    made = model([], target_env=Braked(target([])), effects=["held_drag", "quadratic_drag"])
    made.learn(81, source_timesteps=4)
    data = made.transitions("target")
    values = dynamics(made).describe()
    assert values["held_drag(slider).coefficient"] == pytest.approx(2.0, rel=1e-3)
    assert "quadratic_drag(slider).coefficient" not in values
    assert dynamics(made).error(data) < 1e-4, "one-step predictions hold it, too"
    made.save(tmp_path / "held")
    again = RPTO.load(tmp_path / "held", env=gym.make(TASK), target_env=Braked(target([])))
    assert dynamics(again).error(data) == dynamics(made).error(data)


@pytest.mark.slow
def test_a_target_that_queues_actions_is_met_from_the_first_step_of_an_episode_on(soon: None, tmp_path: Path) -> None:
    made = model([], target_env=Queue(target([])), effects=["command_delay", "torque_offset"])
    made.learn(81, source_timesteps=4)
    data = made.transitions("target")
    assert data.terminations.sum() > 5
    assert dynamics(made).describe()["command_delay(slide).delay"] == pytest.approx(0.05, rel=1e-3)
    assert dynamics(made).error(data) < 1e-3
    made.save(tmp_path / "late")
    again = RPTO.load(tmp_path / "late", env=gym.make(TASK), target_env=Queue(target([])))
    assert dynamics(again).error(data) == dynamics(made).error(data)


@pytest.mark.slow
def test_a_trace_is_logged_before_any_episode_ends(soon: None, tmp_path: Path) -> None:
    made = filled([])
    made.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    made.loop.trace_transitions(made, dynamics(made))
    (line,) = csv.DictReader((tmp_path / "progress.csv").open())
    assert line["gap/verdict"] == "complete"
    assert line["gap/effects"] == "none"
    assert float(line["gap/residual_after"]) < 1e-3 < float(line["gap/residual_before"])
    assert float(line["dynamics/pole.length"]) == pytest.approx(dynamics(made).values[0], rel=1e-6)
    (events,) = tmp_path.glob("events*")
    assert b"gap/effects" in events.read_bytes()


def test_what_is_not_explained_is_said(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled([])
    steps = [
        Finding(FindingKind.TIME_STEP, "the model", "with steps of 1 ms it errs less"),
        Finding(FindingKind.AT_ITS_BOUND, "declared pole.length", "0.3 is its bound"),
    ]
    monkeypatch.setattr(
        controller,
        "trace",
        lambda *args, **kwargs: replace(trace(*args, **kwargs), verdict="unexplained", findings=steps),
    )
    said = r"on 101 target transitions is 'unexplained'.*reports\[-1\].*in its order.*with steps of 1 ms it errs less"
    said += r". declared pole.length: 0.3 is its bound$"
    with pytest.warns(UserWarning, match=said):
        made.loop.trace_transitions(made, dynamics(made))


class Unseen(gym.Env):
    """A machine that shows no MuJoCo model, and whose observations hold its two hinges in the other order."""

    def __init__(self) -> None:
        self.env = target([])
        self.observation_space, self.action_space = self.env.observation_space, self.env.action_space

    @staticmethod
    def shown(observation: np.ndarray) -> np.ndarray:
        return observation[[0, 2, 1, 4, 3, 5, 7, 6, 8]]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation, info = self.env.reset(seed=seed, options=options)
        return self.shown(observation), info

    def step(self, action: np.ndarray) -> Any:
        observation, *rest = self.env.step(action)
        return self.shown(observation), *rest


def test_joints_in_another_order_are_found(soon: None) -> None:
    made = model([], target_env=Unseen(), effects=[], retrain_steps=0)
    with pytest.warns(
        UserWarning, match="'unexplained'.*with the positions of hinge and hinge2 exchanged the model errs"
    ):
        made.learn(90, source_timesteps=0)
    (found,) = [f for f in made.loop.reports[0].findings if f.kind == FindingKind.EXCHANGED]
    assert found.where == "qpos.hinge, qpos.hinge2"


@pytest.mark.slow
def test_an_empty_list_traces_the_declared_numbers_alone(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    began = []
    monkeypatch.setattr(Retraining, "learn", lambda self, made, *_: began.append(made.num_timesteps))
    made = model(friction(), effects=[])
    with pytest.warns(UserWarning, match="unexplained"):
        made.learn(90, source_timesteps=100)
    report: Report = made.loop.reports[0]
    assert [traced.label for traced in report.declared] == ["pole.length"]
    assert not report.effects
    assert dynamics(made).names == ["pole.length"]
    assert began == [80]


@pytest.mark.slow
def test_a_trace_knows_the_effects_that_were_passed(soon: None) -> None:
    late = LIBRARY["command_delay"]("slide", delay=0.1)
    passed = {"effects": [late.with_values(np.array([0.08])).to_json()]}
    made = filled([late, *friction()], 120, dynamics_kwargs=passed)
    made.update_dynamics()
    made.loop.trace_transitions(made, dynamics(made))
    report = made.loop.reports[-1]
    assert report.verdict == "explained"
    assert [t.label for t in report.declared] == ["pole.length", "command_delay(slide)"]
    assert [t.label for t in report.effects] == ["coulomb_friction(slider)"]
    assert dynamics(made).names == ["pole.length", "command_delay(slide).delay", "coulomb_friction(slider).level"]
    assert dynamics(made).describe()["command_delay(slide).delay"] == pytest.approx(0.1, rel=0.02)


def noisy(noise: np.ndarray) -> gym.Env:
    """A target with friction whose sensors are noisy."""
    env, rng = target(friction()), np.random.default_rng(0)
    return gym.wrappers.TransformObservation(
        env, lambda observation: observation + noise * rng.standard_normal(len(noise)), env.observation_space
    )


@cache
def learned_from_noise() -> RPTO:
    noise = np.array([3e-4] * 5 + [3e-3] * 3 + [0.0])
    with pytest.MonkeyPatch.context() as patch:
        change(patch, first_trace=120, fill_steps=25)
        passed = {"observation_noise": noise.tolist()}
        made = model([], target_env=noisy(noise), dynamics_kwargs=passed, effects=["coulomb_friction"])
        return made.learn(170, source_timesteps=180)


@pytest.mark.slow
def test_what_noisy_sensors_show_is_explained_all_the_same() -> None:
    made = learned_from_noise()
    (report,) = made.loop.reports
    assert report.verdict == "explained"
    assert made.loop.simulator_validated
    assert dynamics(made).names == ["pole.length", "coulomb_friction(slider).level"]


@pytest.mark.slow
def test_phi_stays_what_a_trace_found_where_sensors_are_noisy() -> None:
    made = learned_from_noise()
    (report,) = made.loop.reports
    traced = np.concatenate([t.effect.values for t in (*report.declared, *report.effects)])
    made.state.steps_since_fit = made.model_train_freq
    made.update_dynamics()
    np.testing.assert_array_equal(dynamics(made).values, traced)


def test_of_another_target_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = ClosedLoop(())
    loop.freezes_dynamics = loop.source_buffer_stale = True
    loop.traced_at = 100
    loop.forget_target()
    assert not loop.freezes_dynamics
    renewed: list[object] = []
    monkeypatch.setattr(controller, "reset_source_buffer", lambda made, steps: renewed.append(made))
    monkeypatch.setattr(Retraining, "learn", lambda *_: pytest.fail("it would learn for the target that was left"))
    made: Any = SimpleNamespace(updates_policy=True, target_env=object(), updates_per_step=1, snapshots={})
    loop.retrain(made)
    assert renewed == [made]
    assert not loop.source_buffer_stale


@pytest.mark.slow
def test_phi_goes_on_being_fitted_where_what_was_traced_is_refused(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled(friction(), dynamics_kwargs={"observation_noise": 1e-4})
    monkeypatch.setattr(acceptance, "stays_finite", lambda *_: False)
    with pytest.warns(UserWarning, match="unstable: refused"):
        made.loop.trace_transitions(made, dynamics(made))
    assert not made.loop.freezes_dynamics


def test_transitions_that_hold_no_window_end_no_run(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    change(monkeypatch, window=1_000)
    made = model([])
    with pytest.warns(UserWarning, match=r"80 target transitions were not traced: no episode holds.*twice as many"):
        made.learn(90, source_timesteps=10)
    assert made.num_timesteps == 90
    assert not made.loop.reports
    assert not made.loop.trace_due(made, dynamics(made))
    append(made, [], 210)
    assert made.loop.trace_due(made, dynamics(made))


@pytest.mark.slow
def test_transitions_that_were_not_traced_are_tried_again_after_a_settled_trace(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = filled([])
    made.loop.trace_transitions(made, dynamics(made))
    assert made.loop.found[-1]["verdict"] == "complete"
    with monkeypatch.context() as patch:
        change(patch, window=1_000)
        with pytest.warns(UserWarning, match="not traced"):
            made.loop.trace_transitions(made, dynamics(made))
    assert not made.loop.trace_due(made, dynamics(made))
    append(made, [], 210)
    assert made.loop.trace_due(made, dynamics(made))


def test_a_late_sensor_is_taken_into_phi_by_the_reports_word() -> None:
    """What it saw before a step began, one-step errors do not know: they do not judge it."""
    late = LIBRARY["sensor_delay"]("hinge", delay=0.09)
    made = filled([late])
    data = made.transitions("target")
    traced = SimpleNamespace(effect=late, label=late.label)
    covariance = np.array([[0.005**2]])
    report = SimpleNamespace(declared=(), effects=(traced,), covariance=covariance, verdict="explained")
    assert made.loop.accept(made, dynamics(made), report, data, before=1e-3) == [late.label]  # type: ignore[arg-type]
    assert dynamics(made).error(data) > 1e-3
    assert made.loop.freezes_dynamics


def test_windows_are_as_long_as_stretches_of_known_positions() -> None:
    def seen(*placed: list[int]) -> Measurements:
        episodes = [SimpleNamespace(placed=np.array(flags, dtype=bool)) for flags in placed]
        return SimpleNamespace(exact=False, episodes=episodes)  # type: ignore[return-value]

    assert controller.window(seen([1] * 20), 0.0) == ClosedLoop.settings.noisy_window
    assert controller.window(seen([1] * 20), 5.0) == ClosedLoop.settings.window  # where feet touch down
    assert controller.window(seen([1] * 5, [1] * 5, [1] * 20), 0.0) == 5
    assert controller.window(seen([1, 0, 1, 1, 0, 1, 0] + [1] * 9), 0.0) == ClosedLoop.settings.window
    assert controller.window(seen([0] * 9), 0.0) == ClosedLoop.settings.window


@pytest.mark.parametrize(("noise", "traced_at", "due"), [(1e-3, 200, True), (1e-3, 400, False), (None, 200, False)])
def test_noisy_transitions_are_traced_once_more_when_they_fill_all_windows(
    noise: float | None, traced_at: int, due: bool
) -> None:
    loop = ClosedLoop(())
    loop.traced_at, loop.found, loop.traced_error = traced_at, [{"verdict": "complete"}], 1.0
    seen = SimpleNamespace(size=lambda: 2 * traced_at, buffer_size=10_000)
    made = SimpleNamespace(
        replay_buffer=SimpleNamespace(target=seen, target_added=2 * traced_at),
        transitions=lambda _: SimpleNamespace(take=lambda rows: rows),
    )
    phi = SimpleNamespace(observation_noise=noise, error=lambda _: 1.0)
    assert loop.trace_due(made, phi) is due  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_checkpoint_knows_the_noise(tmp_path: Path) -> None:
    made = learned_from_noise()
    made.save(tmp_path / "model")
    noise = dynamics(RPTO.load(tmp_path / "model")).observation_noise
    np.testing.assert_array_equal(noise, dynamics(made).observation_noise)


def test_no_target_step_is_spent_on_tracing() -> None:
    made = learned()
    assert made.num_timesteps == 100
    assert made.target_spent == {"learning": 100}


def test_what_an_uncorrected_source_produced_is_dropped() -> None:
    made = learned()
    source = made.transitions("source")
    assert made.source_timesteps - made.loop.selection.steps - len(source) >= 100 + 80  # all from before the trace
    assert dynamics(made).error(source) < ClosedLoop.settings.foreign_error


def test_source_episodes_have_the_effect() -> None:
    made = learned()
    copy = made.rollouts.copies[0]  # type: ignore[union-attr]
    assert "coulomb_friction(slider)" in [effect.label for effect in copy.effects]


def test_the_corrected_simulator_comes_back_from_a_checkpoint(tmp_path: Path) -> None:
    made = learned()
    made.save(tmp_path / "model")
    loaded = RPTO.load(tmp_path / "model", device="cpu")
    assert dynamics(loaded).describe() == dynamics(made).describe()
    assert loaded.loop.found[0]["verdict"] == "explained"


@pytest.mark.slow
@pytest.mark.parametrize("stop", [pytest.param(60, id="before the trace"), pytest.param(90, id="after it")])
def test_a_loop_that_was_stopped_goes_on_as_if_it_had_not_been(stop: int, soon: None, tmp_path: Path) -> None:
    def begun() -> RPTO:
        return model(friction(), effects=["coulomb_friction"]).learn(stop, source_timesteps=100)

    unbroken = begun().learn(100 - stop, reset_num_timesteps=False)
    stopped = begun()
    stopped.save(tmp_path / "model")
    stopped.save_replay_buffer(tmp_path / "buffer")
    resumed = RPTO.load(tmp_path / "model", env=gym.make(TASK), target_env=target(friction()), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    resumed.learn(100 - stop, reset_num_timesteps=False)
    assert resumed.loop.found == unbroken.loop.found
    assert "coulomb_friction(slider).level" in dynamics(resumed).names
    np.testing.assert_array_equal(dynamics(resumed).values, dynamics(unbroken).values)
    assert resumed.source_timesteps == unbroken.source_timesteps
    for ours, theirs in zip(resumed.policy.parameters(), unbroken.policy.parameters()):
        assert th.equal(ours, theirs)


def test_a_learned_model_predicts_the_target() -> None:
    made = learned()
    assert dynamics(made).error(made.transitions("target")) < 1e-3


def filled(lacks: list[Effect], count: int = 100, **kwargs: Any) -> RPTO:
    """A model whose D_target holds random actions in the target, ready to close the loop."""
    made = model(lacks, **kwargs)
    made.learn(1, source_timesteps=0)
    append(made, lacks, count)
    return made


def append(made: RPTO, lacks: list[Effect], count: int) -> None:
    """Let D_target hold random actions in a target with these effects."""
    env = target(lacks)
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    for _ in range(count):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        following, reward, terminated, _, _ = env.step(action)
        made.replay_buffer.add(
            observation[None], following[None], action[None], np.array([reward]), np.array([terminated]), [{}]
        )
        observation = env.reset()[0] if terminated else following


def test_nothing_is_added_where_nothing_is_missing(soon: None) -> None:
    made = filled([])
    dynamics(made).fit(made.transitions("target"), max_steps=30)
    made.loop.trace_transitions(made, dynamics(made))
    assert made.loop.reports[0].verdict == "complete"
    assert dynamics(made).names == ["pole.length"]


def is_foreign(made: RPTO) -> bool:
    """Whether another simulator made D_source."""
    return source_buffer_is_foreign(made, dynamics(made), made.transitions("source"), ClosedLoop.settings)


@pytest.mark.slow
def test_what_other_declared_numbers_produced_is_dropped_too(soon: None) -> None:
    made = model([])
    made.learn(1, source_timesteps=60)
    append(made, [], 100)
    assert not is_foreign(made)
    dynamics(made).fit(made.transitions("target"), max_steps=30)
    assert is_foreign(made)
    steps = made.source_timesteps

    def learned_from() -> int:
        return made.source_timesteps - steps - made.loop.selection.steps

    made.loop.trace_transitions(made, dynamics(made))
    assert learned_from() == made.replay_buffer.source.size() >= 50
    assert not is_foreign(made)
    made.loop.trace_transitions(made, dynamics(made))  # the source stays as it is where the simulator does
    assert learned_from() == made.replay_buffer.source.size()


def test_renewed_data_are_the_simulators_own_where_commands_are_late() -> None:
    late = LIBRARY["command_delay"]("slide", delay=0.05).to_json()
    made = model([], dynamics_kwargs={"effects": [late]})
    made.learn(1, source_timesteps=63)
    reset_source_buffer(made, 1_000)
    assert not is_foreign(made)


def test_data_that_have_lost_their_past_are_not_another_simulators() -> None:
    late = LIBRARY["command_delay"]("slide", delay=0.05).to_json()
    made = model([], dynamics_kwargs={"effects": [late]}, buffer_size=200)
    made.learn(1, source_timesteps=0)
    assert made.rollouts is not None
    made.rollouts.interact(made, 303)
    assert made.replay_buffer.source.full
    error = dynamics(made).error(made.transitions("source"))
    assert error > ClosedLoop.settings.foreign_error  # the oldest commands are gone
    assert not is_foreign(made)
    dynamics(made).adopt([LIBRARY["coulomb_friction"]("slider", level=50.0)])
    assert is_foreign(made)


def test_weights_are_normalised_over_what_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled([], 60, weighting="value_aware", weight_floor=0.25)
    monkeypatch.setattr(PhysicalDynamics, "fits_newest", 20)
    data = made.transitions("target")
    weights = made.fit_weights(data)
    assert weights is not None
    assert weights.shape == (len(data),)
    assert (weights[:-20] == 0).all()
    fitted = weights[-20:]
    assert (fitted.min().item(), fitted.max().item()) == pytest.approx((0.25, 1.25))
    th.manual_seed(0)
    weights = made.fit_weights(data)
    th.manual_seed(0)
    alone = made.fit_weights(data.take(slice(-20, None)))
    assert weights is not None
    assert alone is not None
    assert th.equal(weights[-20:], alone)


@pytest.mark.parametrize("weighting", ["paper", "centred", "value_aware", None])
def test_a_fit_has_the_weights_that_were_asked_for(weighting: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled([], 30, weighting=weighting, weight_floor=0.25, gamma=0.9)
    fitted = []
    monkeypatch.setattr(dynamics(made), "fit", lambda data, weights: fitted.append(weights) or {})
    data = made.transitions("target")
    th.manual_seed(3)
    made.fit_dynamics()
    th.manual_seed(3)
    alive = 1 - data.terminations.float()
    if weighting == "value_aware":
        raw = rto_weights("value_aware", data, dynamics(made), made.soft_value, made.q_value, 0.9, 0.25)
    else:
        raw = data.rewards + 0.9 * alive * made.soft_value(data.next_observations)
        raw = (raw - made.q_value(data.observations, data.actions) if weighting == "centred" else raw) ** 2
        raw = (raw - raw.min()) / (raw.max() - raw.min()) + 0.25
    (weights,) = fitted
    assert (weights is None) == (weighting is None)
    if weights is not None:
        th.testing.assert_close(weights, raw)


def test_an_unstable_correction_is_refused(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled(friction())
    before = dynamics(made).describe()
    monkeypatch.setattr(acceptance, "stays_finite", lambda *_: False)
    with pytest.warns(UserWarning, match=r"coulomb_friction\(slider\).*unstable: refused"):
        made.loop.trace_transitions(made, dynamics(made))
    assert dynamics(made).describe() == before
    assert not made.loop.simulator_validated  # the simulator lacks what was found


@pytest.mark.slow
def test_what_does_not_lower_the_error_is_refused_and_the_simulator_judges_nothing(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    change(monkeypatch, accepted_error=0.0)
    made = filled(friction())
    with pytest.warns(UserWarning, match=r"found coulomb_friction\(slider\), with which .* last simulator is kept"):
        made.loop.trace_transitions(made, dynamics(made))
    assert made.loop.found[-1]["verdict"] == "explained"
    assert dynamics(made).names == ["pole.length"]
    assert not made.loop.simulator_validated


@pytest.mark.parametrize("seen", [30, 0])
def test_instability_is_seen(seen: int) -> None:
    made = filled([], 30)
    assert made.env is not None
    data = made.transitions("target").take(slice(0, seen))
    assert stays_finite(dynamics(made), data, made.env)
    spring = LIBRARY["spring"]("hinge", stiffness=1e9)
    dynamics(made).adopt([spring])
    assert not stays_finite(dynamics(made), data, made.env)


@pytest.mark.slow
def test_another_trace_is_due_when_new_transitions_are_no_longer_predicted(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    change(monkeypatch, next_trace=20)
    made = filled(friction())
    loop = made.loop
    assert isinstance(loop, ClosedLoop)
    assert loop.trace_due(made, dynamics(made))
    loop.trace_transitions(made, dynamics(made))
    assert not loop.trace_due(made, dynamics(made))
    append(made, friction(), 30)
    assert not loop.trace_due(made, dynamics(made))
    append(made, [LIBRARY["torque_offset"]("hinge", offset=2.0)], 30)
    assert loop.trace_due(made, dynamics(made))


@pytest.mark.parametrize(("error", "due"), [(1.9, False), (2.1, True)])
def test_new_transitions_have_to_be_predicted_twice_as_badly_for_another_trace(
    error: float, due: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = filled(friction(), 120)
    loop = made.loop
    assert isinstance(loop, ClosedLoop)
    change(monkeypatch, next_trace=20)
    loop.found, loop.traced_at, loop.traced_error, loop.trace_failed = [{"verdict": "explained"}], 100, 0.01, False
    asked = []
    monkeypatch.setattr(dynamics(made), "error", lambda data: (asked.append(data.observations), 0.01 * error)[1])
    assert loop.trace_due(made, dynamics(made)) is due
    th.testing.assert_close(asked[0], made.transitions("target").observations[100:])  # what came since


@pytest.mark.parametrize(
    ("after", "declared", "found"), [(0.95, True, False), (0.85, True, True), (1.01, False, False)]
)
def test_effects_have_to_pay_and_declared_numbers_to_be_no_worse(
    after: float, declared: bool, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = filled(friction(), 60)
    loop, (length,) = made.loop, dynamics(made).effects()
    assert isinstance(loop, ClosedLoop)
    data = made.transitions("target")
    monkeypatch.setattr(dynamics(made), "error", lambda _: after)

    def taken(*effects: Effect) -> list[str]:
        traced = [SimpleNamespace(effect=e, label=e.label) for e in effects]
        fine = SimpleNamespace(ratio=1.0)
        report = SimpleNamespace(
            **{"declared": traced[:1], "effects": traced[1:], "verdict": "explained"},
            **{"adequacy_before": fine, "adequacy_after": fine, "covariance": None},
        )
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r"the trace found coulomb_friction")
            loop.accept(made, dynamics(made), cast(Report, report), data, before=1.0)
        return dynamics(made).names

    moved = length.with_values(1.1 * length.values)
    assert taken(moved) == ["pole.length"]
    assert (dynamics(made).values[0] == moved.values[0]) == declared
    assert ("coulomb_friction(slider).level" in taken(moved, *friction())) is found


@pytest.mark.slow
@pytest.mark.parametrize(("verdict", "due"), [("unexplained", True), ("partly explained", True), ("explained", False)])
def test_what_was_not_explained_is_looked_for_again_in_twice_as_many_transitions(
    soon: None, verdict: str, due: bool
) -> None:
    made = filled(friction())
    loop = made.loop
    assert isinstance(loop, ClosedLoop)
    loop.trace_transitions(made, dynamics(made))
    loop.found[-1]["verdict"] = verdict
    append(made, friction(), 99)
    assert not loop.trace_due(made, dynamics(made))
    append(made, friction(), 110)
    assert loop.trace_due(made, dynamics(made)) == due


@pytest.mark.slow
def test_a_new_target_is_traced_anew(soon: None) -> None:
    made = filled(friction())
    made.loop.trace_transitions(made, dynamics(made))
    lacks: list[Effect] = [LIBRARY["torque_offset"]("hinge", offset=2.0)]
    with pytest.warns(UserWarning, match="D_target loses 101"):
        made.set_target_env(target(lacks))
    append(made, lacks, 70)
    assert not made.loop.trace_due(made, dynamics(made))
    append(made, lacks, 10)  # as many as a first trace takes
    assert made.loop.trace_due(made, dynamics(made))


def explanation(
    effects: list[Effect], verdict: str = "explained", zeros: EncoderOffsets | None = None
) -> SimpleNamespace:
    """What a trace would report."""
    traced = tuple(SimpleNamespace(effect=e, label=e.label) for e in effects)
    ratio = SimpleNamespace(ratio=1.0)
    said = {"verdict": verdict, "declared": (), "effects": traced, "zeros": zeros, "findings": []}
    return SimpleNamespace(adequacy_before=ratio, adequacy_after=ratio, covariance=None, **said)


def test_a_later_explanation_takes_the_place_of_an_earlier_one() -> None:
    made = filled(friction())
    data, phi = made.transitions("target"), dynamics(made)
    phi.adopt([LIBRARY["viscous_friction"]("slider", coefficient=0.5)])
    phi.fit(data, max_steps=30)
    report = explanation([*phi.effects()[:1], *friction()])
    added = made.loop.accept(made, phi, report, data, phi.error(data))  # type: ignore[arg-type]
    assert added == ["coulomb_friction(slider)"]
    assert phi.names == ["pole.length", "coulomb_friction(slider).level"]


@pytest.mark.slow
@pytest.mark.parametrize("forgotten", ["the oldest", "all, for it was not loaded"])
def test_another_trace_is_due_though_transitions_are_forgotten(
    forgotten: str, soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    change(monkeypatch, next_trace=20)
    wide = None if forgotten.startswith("all") else {"target_size": 90}
    made = filled(friction(), replay_buffer_kwargs=wide)
    made.loop.trace_transitions(made, dynamics(made))
    if wide is None:
        made.replay_buffer = model(friction()).replay_buffer
    append(made, [LIBRARY["torque_offset"]("hinge", offset=2.0)], 19)
    assert not made.loop.trace_due(made, dynamics(made))
    append(made, [LIBRARY["torque_offset"]("hinge", offset=2.0)], 11)
    assert made.loop.trace_due(made, dynamics(made))


def test_a_small_memory_is_traced_when_it_is_full(soon: None) -> None:
    made = filled(friction(), 48, replay_buffer_kwargs={"target_size": 50})
    assert not made.loop.trace_due(made, dynamics(made))
    append(made, friction(), 1)
    assert made.loop.trace_due(made, dynamics(made))


@pytest.mark.slow
def test_learning_in_the_corrected_simulator_goes_on_where_it_was_interrupted(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = model(friction(), retrain_steps=400).learn(60, source_timesteps=100)
    train, left = made.train, iter(range(5))

    def interrupted(steps: int, batch_size: int) -> None:
        if made.loop is not None and made.loop.source_buffer_stale and next(left, None) is None:
            raise KeyboardInterrupt
        train(steps, batch_size)

    monkeypatch.setattr(made, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        made.learn(40, reset_num_timesteps=False)
    loop = made.loop
    assert loop is not None
    assert loop.found
    assert loop.source_buffer_stale
    assert loop.retraining is not None
    done = loop.retraining.steps
    assert done == 5 * made.fresh_source_steps()
    acting, learner = weights(made), made.snapshots["learner"]
    made.rollback("simulator")
    np.testing.assert_array_equal(acting, weights(made))  # not what was learned and judged by nobody
    made.snapshots["learner"] = learner
    before, begun = made.source_timesteps, list[np.ndarray]()
    monkeypatch.setattr(made, "train", lambda *_: begun.append(weights(made)) if loop.source_buffer_stale else None)  # type: ignore[func-returns-value]
    monkeypatch.setattr(loop.selection, "evaluate", lambda *_: None)
    made.learn(1, reset_num_timesteps=False)
    assert (loop.source_buffer_stale, loop.retraining) == (False, None)
    learned = made.fresh_source_steps() * len(begun)
    assert learned == 400 - done
    assert made.source_timesteps - before >= learned
    made.snapshots["learner"] = learner
    made.rollback("learner")
    np.testing.assert_array_equal(begun[0], weights(made))


@pytest.mark.slow
def test_encoder_zeros_that_differ_by_run_are_taken_off_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    runs = tuple(dict.fromkeys(episode.run for episode in measured.episodes))

    def positions(zeros: EncoderOffsets | None) -> tuple[RPTO, np.ndarray]:
        made = model([], target_data=measured)
        said = explanation([], zeros=zeros)
        monkeypatch.setattr(made.loop, "identify", lambda *_: made.loop.found.append({"verdict": "explained"}) or said)  # type: ignore[union-attr,func-returns-value]
        made.learn(4, source_timesteps=0)
        return made, made.transitions("target").observations[:, 0].numpy()

    plain = positions(None)[1]
    made, homed = positions(EncoderOffsets(("slider",), runs, np.full((len(runs), 1), 0.3), 0.5, 9.0))
    np.testing.assert_allclose(plain - homed, 0.3, atol=1e-6)
    made.replay_buffer.target.reset()  # a checkpoint that is loaded without its buffers
    made.learn(4, reset_num_timesteps=False)
    np.testing.assert_array_equal(made.transitions("target").observations[:, 0], homed)


@pytest.mark.slow
def test_a_budget_of_source_steps_is_not_exceeded_by_the_loop(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = filled(friction()).replay_buffer
    made = model([], target_data=recorded)
    monkeypatch.setattr(made.loop, "identify", lambda *_: explanation(friction()))
    monkeypatch.setattr(Retraining, "learn", lambda *_: pytest.fail("learns beyond the budget"))
    made.learn(200, source_timesteps=0)
    assert "coulomb_friction(slider).level" in dynamics(made).names


def test_a_policy_that_knows_the_source_begins_in_the_corrected_one(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = Measurements.from_replay(filled(friction()).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured)
    made.state.knows_source = True
    monkeypatch.setattr(
        made.loop, "identify", lambda *_: made.loop.found.append({"verdict": "explained"}) or explanation(friction())
    )  # type: ignore[union-attr,func-returns-value]
    monkeypatch.setattr(
        controller, "reset_source_buffer", lambda *_: pytest.fail("drops what the corrected simulator produced")
    )
    made.learn(8)
    seen = made.replay_buffer.target.size()
    made.replay_buffer.target.reset()  # as of a model that is loaded without its buffers
    made.learn(8, reset_num_timesteps=False)
    assert made.replay_buffer.target.size() == seen > 50


def test_long_names_of_effects_are_logged(soon: None) -> None:
    effects = [LIBRARY["viscous_friction"]("slider", coefficient=0.1).to_json()]
    made = model([], dynamics_kwargs={"effects": effects}, close_loop=False, verbose=1, model_train_freq=5)
    assert made.learn(12, log_interval=1, source_timesteps=0).num_timesteps == 12


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dynamics": "ensemble", "declared": ()}, "close_loop=True traces what a MuJoCo simulator lacks"),
        ({"close_loop": False, "declared": ()}, "nothing to fit"),
        ({"declared": ["pole.lenght"]}, "has no 'lenght'; did you mean 'length'"),
        ({"dynamics_kwargs": {"observation_noise": 1e-3}, "close_loop": False}, "close_loop=True on a MuJoCo env"),
        ({"dynamics_kwargs": {"observation_noise": -1e-3}}, "standard deviation above 0"),
        ({"dynamics_kwargs": {"observation_noise": [1e-3] * 5}}, "each of the 9 observations"),
        ({"dynamics_kwargs": {"observation_noise": "much"}}, "'much'; give a standard deviation"),
        ({"dynamics_kwargs": {"frame_skip": 0}}, r"\['frame_skip'\] are read off the source environment"),
    ],
)
def test_what_cannot_be_closed_is_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        model([], **settings)


@pytest.mark.parametrize("kind", [friction()[0], type(friction()[0]), 1])
def test_what_to_look_for_is_told_by_kinds(kind: object) -> None:
    with pytest.raises(TypeError, match=r"effects holds kinds .*dynamics_kwargs=\{'effects'"):
        model([], effects=[kind])


@pytest.mark.slow
def test_recorded_transitions_that_are_few_are_traced_as_they_become_no_more() -> None:
    recorded = filled(friction()).replay_buffer
    made = model([], target_env=None, target_data=recorded, model_train_freq=20)
    made.learn(40, source_timesteps=0)
    assert recorded.target.size() == 101 < ClosedLoop.settings.first_trace
    assert [found["verdict"] for found in made.loop.found] == ["explained"]


def test_rpo_has_no_loop_to_close() -> None:
    from sb3_rpto import RPO

    with pytest.raises(ValueError, match="close_loop"):
        RPO("MlpPolicy", gym.make(TASK), target_env=target([]), close_loop=True)


def test_weights_of_the_target_reach_the_fit() -> None:
    made = filled([], 40)
    data = made.transitions("target")
    weights = th.zeros(len(data))
    weights[:20] = 1.0
    first = dynamics(made).fit(data.take(slice(0, 20)), max_steps=3)
    values = dynamics(made).values.copy()
    again = model([])
    second = dynamics(again).fit(data, weights, max_steps=3)
    assert first["steps"] == second["steps"]
    np.testing.assert_allclose(dynamics(again).values, values, rtol=0.05)


# --- learning in the corrected simulator ------------------------------------------------------------------------------


class Scripted(EpisodeSource):
    """A source whose rounds earn what is written; a round without a number ends no episode."""

    def __init__(self, earns: list[float]) -> None:
        self.returns = deque()
        self.earns = iter(earns)
        self.asked: list[int] = []

    def interact(self, agent: Any, n_steps: int, random: bool = False) -> int:
        self.asked.append(n_steps)
        agent.state.source_timesteps += n_steps
        self.returns.extend([r] if (r := next(self.earns, None)) is not None else [])
        return n_steps


class Judge:
    """Stands for the evaluation of policies in the simulator: each earns the next of ``earns``."""

    def __init__(self, earns: list[float]) -> None:
        self.earns = earns
        self.best, self.asked = -np.inf, 0

    def due(self, updates: int) -> bool:
        return True

    def is_behind(self, agent: Any) -> bool:
        return True

    def evaluate(self, agent: Any, dynamics: Any) -> None:
        self.best = max([self.best, *self.earns[: self.asked]])
        self.asked += 1


GAINS = [
    ([3.0, 2.0, 1.0, 9.0], 3),  # two rounds in a row without a gain
    ([1.0, 2.0, 1.5, 2.5, 2.0, 2.5, 9.0], 6),  # one of them alone does not end it, and as much is no gain
    ([-9.0, -8.0, -7.0, -6.0, -5.0, -4.0, -3.0, -2.0], 8),  # to the last step
    ([900.0, 900.2, 900.4, 999.0], 3),  # a trifle is no gain
    ([-900.0, -899.8, -899.6, 0.0], 3),
    ([900.0, 900.8, 901.6, 902.4, 903.2, 904.0, 904.8, 905.6], 8),  # but trifles add up
]


@pytest.mark.parametrize(
    ("earns", "lasts", "judges"),
    [
        *((*gain, False) for gain in GAINS),
        *((*gain, True) for gain in GAINS),
        ([], 8, False),  # nothing to judge by
    ],
)
def test_learning_in_the_corrected_simulator_goes_on_while_it_pays(
    earns: list[float], lasts: int, judges: bool
) -> None:
    updates: list[int] = []
    remaining: list[float] = []
    told: list[float] = []
    # What does not count earns ever more.
    source, judge = Scripted([float(i) for i in range(9)] if judges else earns), Judge(earns)
    made = SimpleNamespace(
        rollouts=source,
        state=SimpleNamespace(source_timesteps=5),
        n_updates=0,
        updates_per_step=30,
        source_steps=20,
        retrain_steps=1_280,
        batch_size=32,
        verbose=0,
        train=lambda n, batch_size: updates.append(n),
        fresh_source_steps=lambda: 160,
        set_progress=lambda taken, most: remaining.append(1 - taken / most),
    )

    def progress(share: float, what: str) -> None:
        assert what.startswith("learning in the corrected simulator")
        told.append(share)

    learning = Retraining(replace(ClosedLoop.settings, round_steps=160))
    learning.learn(made, object(), judge if judges else None, progress)  # type: ignore[arg-type]
    assert remaining == [1 - 160 * i / 1_280 for i in range(lasts)]  # for a schedule of the learning rate
    assert updates == [30] * lasts
    assert told == [i / 8 for i in range(lasts + 1)]
    assert judge.asked == (1 + lasts + 1 if judges else 0)
    assert source.asked == [8 * 20] * lasts  # in the source each call draws gSDE's noise anew
    assert made.state.source_timesteps == 5 + 8 * 20 * lasts


@pytest.mark.parametrize(("updates", "copies", "steps"), [(20, 20, 160), (20, 160, 160), (1, 20, 20), (3, 10, 30)])
def test_eight_steps_for_each_update_are_taken_by_whole_copies(updates: int, copies: int, steps: int) -> None:
    assert filled([], 1, gradient_steps=updates, source_steps=copies).fresh_source_steps() == steps


def test_a_schedule_of_the_learning_rate_does_not_end_what_target_steps_paid_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = forgetful()
    made._total_timesteps, made.num_timesteps, made.state.deferred_target_steps = 10, 10, 4
    left: list[float] = []
    monkeypatch.setattr(made, "train", lambda steps, batch_size: left.append(made._current_progress_remaining))
    made.loop.simulator_validated = False
    made.rollouts = Scripted([])  # type: ignore[assignment]
    made.loop.learn_deferred_steps(made)
    assert left == pytest.approx([0.4, 0.3, 0.2, 0.1])


# --- rehearsals -------------------------------------------------------------------------------------------------------


def forgetful() -> RPTO:
    """A model in a simulator that accounts for the target."""
    made = filled([], 20)
    made.loop.simulator_validated = True
    made.take_snapshot("source")
    spoil(made, 1e-3)  # not saturated, so that it can learn
    return made


def plays(earns: Callable[[], float]) -> Callable[..., np.ndarray]:
    """PolicySelection whose episodes all earn what is told, the further ones of a policy as much as its first."""
    earned: dict[bytes, float] = {}

    def play(model: RPTO, dynamics: PhysicalDynamics, starts: range) -> np.ndarray:
        policy = weights(model).tobytes()
        if starts.start == 0:
            earned[policy] = earns()
        return np.full(len(starts), earned[policy])

    return play


def scripted(made: RPTO, monkeypatch: pytest.MonkeyPatch, *earns: float) -> None:
    """Let rehearsals earn what is written."""
    found = iter(earns)
    monkeypatch.setattr(made.loop.selection, "play", plays(lambda: next(found)))
    monkeypatch.setattr(made.loop.selection, "due", lambda _: True)


def weights(made: RPTO) -> np.ndarray:
    return th.cat([p.detach().flatten() for p in made.actor.parameters()]).numpy()


def spoil(made: RPTO, by: float = 0.1) -> None:
    with th.no_grad():
        for parameter in made.actor.parameters():
            parameter += by


@pytest.mark.parametrize("earned", [96.0, 98.0, 120.0])
def test_the_best_policy_acts_and_one_that_did_not_clearly_get_worse_goes_on_learning(
    earned: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 100.0, earned)
    made.loop.learn_deferred(made)  # that of the source earned 50
    best = weights(made)
    spoil(made)
    changed = weights(made)
    made.loop.learn_deferred(made)
    np.testing.assert_array_equal(weights(made), changed if earned > 100 else best)
    assert ("learner" in made.snapshots) == (earned == 98.0)
    made.rollback("simulator")
    np.testing.assert_array_equal(weights(made), changed if earned > 100 else best)
    assert "learner" not in made.snapshots  # what a user goes back to goes on learning


@pytest.mark.parametrize(("earned", "goes_on"), [(96.0, "best"), (98.0, "learner")])
def test_what_is_owed_is_learned_by_the_policy_that_goes_on_learning(
    earned: float, goes_on: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 100.0, earned, 99.0)
    made.loop.learn_deferred(made)
    wanted = {"best": weights(made)}
    spoil(made)
    wanted["learner"] = weights(made)
    made.loop.learn_deferred(made)
    begun: list[np.ndarray] = []
    monkeypatch.setattr(made, "train", lambda *_: begun.append(weights(made)))
    made.state.deferred_target_steps = 3
    monkeypatch.setattr(made.loop.selection, "due", lambda updates: updates > made._n_updates)
    made.loop.learn_deferred(made)
    np.testing.assert_array_equal(begun, [wanted[goes_on]] * 3)
    np.testing.assert_array_equal(weights(made), wanted["best"])
    assert made.state.deferred_target_steps == 0


class Watch(BaseCallback):
    """Sees at each target step how many updates there were, and which policy acts."""

    def __init__(self) -> None:
        super().__init__()
        self.updates: list[int] = []
        self.acting: list[float] = []

    def _on_step(self) -> bool:
        self.updates.append(self.model._n_updates)
        self.acting.append(float(weights(self.model).sum()))  # type: ignore[arg-type]
        return True


def judged(monkeypatch: pytest.MonkeyPatch, every: int = 40, earns: Callable[[], float] = lambda: 1.0) -> RPTO:
    """A model whose simulator judges a policy of so many updates, and finds it to earn what is told."""
    change(monkeypatch, updates_between=every)
    monkeypatch.setattr(PolicySelection, "play", staticmethod(plays(earns)))
    monkeypatch.setattr(ClosedLoop, "trace_due", lambda *_: False)
    made = forgetful()
    made.state.steps_since_fit = 0
    return made


@pytest.mark.slow
def test_between_fits_the_policy_stays_as_the_simulator_judged_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made, seen = judged(monkeypatch, earns=count(1.0).__next__), Watch()
    updates, source = made._n_updates, made.source_timesteps
    made.learn(130, callback=seen, reset_num_timesteps=False)
    assert [n - updates for n in seen.updates] == [0] * 40 + [40] * 40 + [80] * 40 + [120] * 10
    assert [len(set(seen.acting[i : i + 40])) for i in (0, 40, 80, 120)] == [1, 1, 1, 1]
    assert len(set(seen.acting)) == 4
    # What is owed in the end is learned, too.
    assert (made._n_updates - updates, made.state.deferred_target_steps) == (130, 0)
    assert made.source_timesteps - source == 4 * 130  # rehearsals are scripted


def test_the_end_of_learning_leaves_the_learner_where_nothing_is_owed(monkeypatch: pytest.MonkeyPatch) -> None:
    earned = chain([50.0, 100.0], repeat(99.0))
    made = judged(monkeypatch, earns=lambda: next(earned))
    monkeypatch.setattr(PolicySelection, "has_moved", lambda self, _: self._phi is None)
    made.learn(80, reset_num_timesteps=False)  # ends with a fit
    acting = weights(made)
    made.rollback("learner")
    assert not np.array_equal(acting, weights(made))


def test_policies_are_rehearsed_on_the_way_where_much_is_owed(monkeypatch: pytest.MonkeyPatch) -> None:
    at: list[int] = []
    made = judged(monkeypatch, every=10, earns=lambda: at.append(made._n_updates) or 1.0)  # type: ignore[func-returns-value]
    made.loop.learn_deferred(made)
    at.clear()
    updates, made.state.deferred_target_steps = made._n_updates, 34
    made.loop.learn_deferred(made)
    assert [n - updates for n in at] == [10, 20, 30, 34]


@pytest.mark.slow
def test_a_judged_policy_that_was_stopped_goes_on_as_if_it_had_not_been(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # That of the source, the first one, which is the best, and all later ones.
    earned = chain([50.0, 100.0], repeat(99.0))
    unbroken = judged(monkeypatch, earns=lambda: next(earned))
    monkeypatch.setattr(PolicySelection, "has_moved", lambda self, _: self._phi is None)
    at = unbroken.num_timesteps + 95
    unbroken.learn(200, callback=lambda *_: unbroken.num_timesteps < at, reset_num_timesteps=False)
    unbroken.save(tmp_path / "model")
    unbroken.save_replay_buffer(tmp_path / "buffer")

    def end(made: RPTO) -> np.ndarray:
        assert made.state.deferred_target_steps == 14  # the round of the last step is open
        assert "learner" in made.snapshots
        made.learn(60, reset_num_timesteps=False)
        assert made.state.deferred_target_steps == 0
        acting = weights(made)
        made.rollback("learner")
        assert not np.array_equal(acting, weights(made))
        return np.array([made._n_updates, *acting, *weights(made)])

    goes_on = end(unbroken)
    resumed = RPTO.load(tmp_path / "model", env=gym.make(TASK), target_env=target([]), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_array_equal(end(resumed), goes_on)


@pytest.mark.slow
def test_a_judged_policy_acts_where_learning_was_interrupted_and_nothing_is_learned_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = judged(monkeypatch)
    made.learn(80, reset_num_timesteps=False)
    updates, acting, train = made._n_updates, weights(made), made.train
    left = iter(range(30))

    def interrupted(steps: int, batch_size: int) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        train(steps, batch_size)

    monkeypatch.setattr(made, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        made.learn(40, reset_num_timesteps=False)
    np.testing.assert_array_equal(weights(made), acting)
    assert (made._n_updates - updates, made.state.deferred_target_steps) == (30, 10)
    monkeypatch.setattr(made, "train", train)
    begun: list[np.ndarray] = []
    learn = controller.learn_for_a_step
    monkeypatch.setattr(controller, "learn_for_a_step", lambda m, n: begun.append(weights(m)) or learn(m, n))  # type: ignore[func-returns-value]
    made.learn(40, reset_num_timesteps=False)
    assert (made._n_updates - updates, made.state.deferred_target_steps) == (80, 0)
    assert not np.array_equal(begun[0], acting)  # the one that was interrupted


def test_what_the_policy_that_acts_earns_is_the_last_word(capsys: pytest.CaptureFixture[str]) -> None:
    made = forgetful()
    made.loop.on_end(made)
    assert not capsys.readouterr().out
    made.verbose = 1
    made.loop.on_end(made)
    earns = f"{made.loop.selection.best:.5g}"
    assert capsys.readouterr().out.splitlines()[-1].endswith(f"the best so far, earns {earns} in the simulator")


def test_parameters_that_a_user_sets_go_on_learning() -> None:
    made = forgetful()
    made.take_snapshot("learner")
    made.set_parameters(made.get_parameters())
    assert "learner" not in made.snapshots


def test_another_target_is_owed_nothing() -> None:
    made = forgetful()
    made.state.deferred_target_steps = 30
    made.take_snapshot("learner")
    with pytest.warns(UserWarning, match="D_target loses"):
        made.set_target_env(target(friction()))
    assert made.state.deferred_target_steps == 0
    assert "learner" not in made.snapshots
    assert made.replay_buffer.target_added == 0, "else a second trace of this target waits for twice both"
    assert made.loop.awaits_trace()


def test_what_is_owed_is_learned_where_a_new_trace_no_longer_accounts_for_the_target(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = judged(monkeypatch)
    made.learn(20, reset_num_timesteps=False, callback=lambda *_: made.state.deferred_target_steps < 10)
    updates, owed = made._n_updates, made.state.deferred_target_steps
    made.loop.simulator_validated = False
    made.loop.learn_deferred(made)
    assert (owed, made._n_updates - updates, made.state.deferred_target_steps) == (10, 10, 0)


@pytest.mark.parametrize("accounts", [True, False])
def test_the_actor_sees_the_simulators_states_alone_where_it_accounts_for_the_target(accounts: bool) -> None:
    made = forgetful()
    made.loop.simulator_validated = accounts
    made.replay_buffer.source.rewards[:], made.replay_buffer.target.rewards[:] = -1, 1
    worlds = {float(actor.rewards.mean()) for _, actor in made.sample_batches(10, 16)}
    assert worlds == ({-1.0} if accounts else {-1.0, 1.0})


@pytest.mark.slow
@pytest.mark.parametrize(("accounts", "share"), [(True, 0.0), (False, 0.5)])
def test_the_critic_sees_no_estimated_states_where_the_simulator_accounts_for_a_log(
    accounts: bool, share: float
) -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured, close_loop=False, real_ratio=0.5).learn(40, source_timesteps=0)
    made.loop.simulator_validated = accounts
    made.replay_buffer.source.rewards[:], made.replay_buffer.target.rewards[:] = 0, 1
    assert [float(batch.rewards.mean()) for batch in made.critic_batches(3, 16)] == [share] * 3


@pytest.mark.slow
@pytest.mark.parametrize(("accounts", "updates"), [(True, 10), (False, 20)])
def test_many_steps_are_taken_for_each_update_where_the_simulator_accounts_for_a_log(
    accounts: bool, updates: int
) -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured, close_loop=False, source_steps=5).learn(40, source_timesteps=0)
    made.loop.simulator_validated = accounts
    taken, before = made.source_timesteps - made.loop.selection.steps, made._n_updates
    made.learn(100, reset_num_timesteps=False)
    assert made.num_timesteps == 140  # the budget counts each of them
    assert made.source_timesteps - made.loop.selection.steps - taken == 100
    assert made._n_updates - before == updates


@pytest.mark.slow
def test_after_a_log_the_best_policy_is_left_and_the_last_one_goes_on_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured, close_loop=False, model_train_freq=1).learn(60, source_timesteps=0)
    scripted(made, monkeypatch, 99.0, 99.0)
    monkeypatch.setattr(made.loop.selection, "due", lambda _: False)
    made.loop.selection.last_leads = False
    best = weights(made)
    made.take_snapshot("simulator")
    spoil(made)
    last = weights(made)
    made.loop.on_end(made)
    np.testing.assert_array_equal(weights(made), best)
    made.loop.on_start(made)
    np.testing.assert_array_equal(weights(made), last)


def test_a_callback_that_stops_a_run_on_a_log_leaves_the_best_policy(
    kept_on_a_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = on_a_log(kept_on_a_log)
    assert made.loop.simulator_validated
    finished: list[object] = []
    monkeypatch.setattr(made.loop, "on_end", finished.append)
    made.learn(500, callback=lambda *_: made.num_timesteps < 200, reset_num_timesteps=False)
    assert made.num_timesteps < 540
    assert finished == [made]


def test_a_target_after_a_log_is_not_traced_where_nobody_asked(
    kept_on_a_log: Path, soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = on_a_log(kept_on_a_log)
    with pytest.warns(UserWarning, match="D_target loses"):
        made.set_target_env(target([]))
    with pytest.warns(UserWarning, match="ends before the first fit of the dynamics, after 20"):
        arguments.check_ready(made, 10, None)
    judged: list[float] = []
    monkeypatch.setattr("sb3_rpto.algorithms.target_checks.doubt", lambda _, error, data: judged.append(error))
    made.learn(45)
    assert len(judged) == 1
    assert len(made.loop.found) == 1  # that of the log


def test_the_first_policy_to_be_beaten_is_that_of_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 30.0)
    made.loop.learn_deferred(made)
    last = weights(made)
    made.rollback("source")
    np.testing.assert_array_equal(weights(made), last)


def test_what_was_earned_in_another_simulator_is_earned_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 100.0, 40.0, 45.0)
    made.loop.learn_deferred(made)
    dynamics(made).fit(made.transitions("target"), max_steps=30)  # the target's pole is longer
    made.loop.learn_deferred(made)
    assert (made.loop.selection.best, made.loop.selection.last) == (45.0, 45.0)


def test_a_loss_within_what_episodes_differ_by_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near a return of zero any change is a large share of it."""
    made = forgetful()
    spread = np.random.default_rng(0).normal(0.0, 0.5, 100)
    played = plays(iter([0.0, 0.02, 0.01, -5.0]).__next__)
    monkeypatch.setattr(made.loop.selection, "play", lambda _, __, starts: played(_, __, starts) + spread[starts])
    monkeypatch.setattr(made.loop.selection, "due", lambda _: True)
    made.loop.learn_deferred(made)
    spoil(made)
    changed = weights(made)
    made.loop.learn_deferred(made)
    made.loop.selection.take_up_learner(made)
    np.testing.assert_array_equal(weights(made), changed)
    made.loop.learn_deferred(made)
    assert "learner" not in made.snapshots
    assert not np.array_equal(weights(made), changed)


def test_what_an_earlier_simulator_said_undoes_nothing(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 100.0, 98.0)
    made.loop.learn_deferred(made)
    made.loop.learn_deferred(made)  # worse, but not clearly
    made.loop.simulator_validated, made.loop.source_buffer_stale, made.loop.traced_at = False, True, 1
    made.loop.retrain(made)  # learns in a simulator that may not judge
    learned_there = weights(made)
    made.rollback("simulator")
    assert not np.array_equal(weights(made), learned_there)


def test_another_target_is_not_judged_by_the_simulator_of_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    scripted(made, monkeypatch, 50.0, 100.0)
    made.loop.learn_deferred(made)
    with pytest.warns(UserWarning, match="D_target loses"):
        made.set_target_env(target(friction()))
    assert "simulator" not in made.snapshots
    made.loop.learn_deferred(made)
    assert made.loop.selection.best == -np.inf


def test_a_snapshot_of_ones_own_does_not_stand_for_that_of_the_source(soon: None) -> None:
    made = model([])
    made.take_snapshot("mine")
    made.learn(1, source_timesteps=0)
    assert {"mine", "source"} <= set(made.snapshots)


def test_a_simulator_that_does_not_account_for_the_target_judges_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    made.loop.simulator_validated = False
    scripted(made, monkeypatch)
    made.loop.learn_deferred(made)
    assert made.loop.selection.best == -np.inf


def test_a_rehearsal_plays_the_deterministic_policy_in_the_fitted_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    data = made.transitions("target")
    for _ in range(5):
        dynamics(made).fit(data, max_steps=30)
    rehearsals, before = made.loop.selection, made.source_timesteps
    rehearsals.settings = replace(rehearsals.settings, few_episodes=2, some_episodes=3)
    made.rollback("source")
    rehearsals.evaluate(made, dynamics(made))
    returns, lengths = [], []
    env = target([])
    for i in range(3):
        observation, _ = env.reset(seed=30_000 + i)
        lengths.append(0)
        over = False
        earned = 0.0
        while not over:
            observation, reward, terminated, truncated, _ = env.step(made.predict(observation, deterministic=True)[0])
            over, earned, lengths[i] = terminated or truncated, earned + float(reward), lengths[i] + 1
        returns.append(earned)
    # That of the source, the same one here, is the best, and neither ahead of itself nor behind.
    assert [rehearsals.best, rehearsals.last] == pytest.approx([np.mean(returns)] * 2, rel=1e-3)
    assert made.source_timesteps - before == rehearsals.steps == 2 * sum(lengths)
    assert not rehearsals.due(made._n_updates)
    assert not rehearsals.is_behind(made)


def test_a_rehearsal_lasts_as_long_as_episodes_do_and_shows_the_policy_what_it_knows() -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make("HalfCheetah-v5")]), training=False)
    env.obs_rms.mean, env.obs_rms.var = np.full(17, 0.3), np.full(17, 4.0)  # type: ignore[union-attr]
    made = RPTO(
        *("MlpPolicy", env),
        **{"target_env": gym.make("HalfCheetah-v5"), "dynamics": "physical", "declared": ["torso.mass", "bfoot.mass"]},
        **{"close_loop": True, "policy_kwargs": {"net_arch": [16]}, "seed": 0, "device": "cpu"},
    )
    rehearsals = PolicySelection(ClosedLoop.settings)
    (earned,) = rehearsals.play(made, dynamics(made), range(1))
    assert rehearsals.steps == made.source_timesteps == 1_000
    real = gym.make("HalfCheetah-v5")
    observation, _ = real.reset(seed=30_000)
    returned = 0.0
    for _ in range(1_000):
        action, _ = made.predict(((observation - 0.3) / 2).clip(-10, 10), deterministic=True)
        observation, reward, *_ = real.step(action)
        returned += float(reward)
    assert earned == pytest.approx(returned, rel=1e-3)
    rehearsals._phi, rehearsals._names = dynamics(made).values.copy(), list(dynamics(made).names)
    assert not rehearsals.has_moved(dynamics(made))
    rehearsals._phi[1] *= 1.01  # one of them is enough
    assert rehearsals.has_moved(dynamics(made))


FALLS, SPREAD = np.where(np.arange(100) % 5 == 3, 40.0, 100.0), np.random.default_rng(0).normal(size=100)


@pytest.mark.parametrize(
    ("returns", "episodes", "further", "taken"),
    [
        (np.full(100, 50.0), 5, 0, False),  # clearly behind
        (np.full(100, 98.0), 25, 20, False),  # behind, but not clearly
        (np.full(100, 100.05), 25, 20, False),  # a trifle ahead
        (np.full(100, 110.0), 100, 95, True),  # clearly ahead
        (np.full(100, 101.0), 100, 95, True),  # ahead
        (np.where(np.arange(100) < 25, 101.0, 99.0), 100, 95, False),  # it only seemed so
        (100 + 20 * SPREAD, 25, 20, False),  # as good: the first ones are unlucky
        (110 + 20 * SPREAD, 100, 95, True),  # better by more than LOST, which does not show at once
        (FALLS, 25, 20, False),
    ],
)
def test_a_policy_plays_until_it_is_clear_whether_it_is_the_best(
    returns: np.ndarray, episodes: int, further: int, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = forgetful()
    best, changed = made.snapshots["source"]["policy"]["actor.mu.weight"].numpy(), weights(made)
    played = {"best": 0, "last": 0}

    def play(model: RPTO, dynamics: PhysicalDynamics, starts: range) -> np.ndarray:
        who = "best" if np.array_equal(model.actor.mu.weight.detach().numpy(), best) else "last"
        played[who] += len(starts)
        return np.full(len(starts), 100.0) if who == "best" else returns[starts]

    rehearsals = made.loop.selection  # type: ignore[union-attr]
    monkeypatch.setattr(rehearsals, "play", play)
    rehearsals.evaluate(made, dynamics(made))
    assert played == {"best": 5 + further, "last": episodes}  # so many as it is compared with
    assert rehearsals.last == pytest.approx(returns[:episodes].mean())
    assert rehearsals.best == pytest.approx(rehearsals.last if taken else 100.0)
    assert rehearsals.clearly_worse() == (rehearsals.last < 97 - returns[:episodes].std(ddof=1) / episodes**0.5)
    made.rollback("simulator")
    assert np.array_equal(weights(made), changed) == taken


def test_a_policy_that_falls_now_and_then_gives_way_to_one_that_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The episodes that they are compared in first show no fall of either."""
    made = forgetful()
    falls = np.where(np.arange(100) >= 25, np.where(np.arange(100) % 8, 100.0, 20.0), 100.0)
    earned = iter([np.full(100, 10.0), falls, falls, np.full(100, 100.0), np.full(100, 100.0)])
    known: dict[bytes, np.ndarray] = {}

    def play(model: RPTO, dynamics: PhysicalDynamics, starts: range) -> np.ndarray:
        policy = weights(model).tobytes()
        if policy not in known:
            known[policy] = next(earned)
        return known[policy][starts]

    rehearsals = made.loop.selection  # type: ignore[union-attr]
    monkeypatch.setattr(rehearsals, "play", play)
    taken = []
    for _ in range(4):
        rehearsals.evaluate(made, dynamics(made))
        best = made.snapshots["simulator"]["policy"]["actor.mu.weight"]
        taken.append(th.equal(best, made.actor.mu.weight))
        spoil(made, 1e-3)
    # One that falls as often does not take the place, and one that never does as well as it does not either.
    assert taken == [True, False, True, False]
    assert rehearsals.best == pytest.approx(100.0)


def test_a_reward_that_is_no_number_is_said_in_a_rehearsal_too(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    monkeypatch.setattr(
        "sb3_rpto.algorithms.closed_loop.policy_selection.StandingEnv.step",
        lambda env, action: (env.observation_space.sample(), np.nan, True, False, {}),
    )
    with pytest.raises(ValueError, match=r"source.*reward"):
        made.loop.learn_deferred(made)


@pytest.mark.slow
def test_a_policy_is_rehearsed_where_a_log_was_traced_and_no_step_of_the_budget_is_spent_on_it() -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured, close_loop=False, model_train_freq=1).learn(60, source_timesteps=0)
    assert made.loop.found[-1]["verdict"] == "complete"
    assert made.loop.selection.steps > 0
    assert made.num_timesteps == 60


@pytest.mark.slow
def test_a_policy_that_stays_is_not_sent_to_learn_in_the_corrected_simulator(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = filled(friction(), cls=RTO)
    monkeypatch.setattr(Retraining, "learn", lambda *_: pytest.fail("RTO does not move the policy"))
    made.loop.trace_transitions(made, dynamics(made))
    assert "coulomb_friction(slider).level" in dynamics(made).names


def test_a_budget_that_ends_before_the_first_trace_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    made = model([])
    with pytest.warns(UserWarning, match=r"ends before the closed loop's first trace, for which it waits 200 target"):
        made.learn(50, source_timesteps=0)
    with pytest.warns(UserWarning, match="waits 150 target steps"):
        made.learn(50, reset_num_timesteps=False)
    change(monkeypatch, first_trace=120)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert made.loop.first_trace_after(made) == 20
        arguments.check_ready(made, 20, None)


def test_the_first_trace_waits_for_a_fit() -> None:
    made = model([], model_train_freq=150)
    with pytest.warns(UserWarning, match="for which it waits 300 target steps"):
        arguments.check_ready(made, 290, None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arguments.check_ready(made, 300, None)


def test_what_is_owed_is_owed_to_a_run_that_counts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    made = judged(monkeypatch)
    made.learn(20, reset_num_timesteps=False, callback=lambda *_: made.state.deferred_target_steps < 10)
    updates = made._n_updates
    made.learn(30)
    assert (made._n_updates - updates, made.state.deferred_target_steps) == (40, 0)


@pytest.mark.slow
def test_a_target_after_its_log_begins_anew(soon: None) -> None:
    measured = Measurements.from_replay(filled(friction()).replay_buffer, gym.make(TASK))
    made = model([], target_data=measured).learn(40, source_timesteps=0)
    assert made.loop.simulator_validated
    made.take_snapshot("learner")
    with pytest.warns(UserWarning, match=r"D_target loses \d+ transitions of the log, whose states are estimates"):
        made.set_target_env(target(friction()))
    assert (made.replay_buffer.target.size(), made.loop.simulator_validated) == (0, False)
    assert "learner" not in made.snapshots
    made.learn(130)
    assert [found["verdict"] for found in made.loop.found] == ["explained", "explained"]
    assert dynamics(made).describe()["coulomb_friction(slider).level"] == pytest.approx(LEVEL, rel=0.01)


@pytest.mark.slow
def test_a_checkpoint_of_a_log_goes_on_in_a_target_without_a_word_of_its_state(soon: None, tmp_path: Path) -> None:
    measured = Measurements.from_replay(filled([]).replay_buffer, gym.make(TASK))
    model([], target_data=measured).learn(40, source_timesteps=0).save(tmp_path / "model")
    made = RPTO.load(tmp_path / "model", env=gym.make(TASK), target_env=target([]), device="cpu")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*cannot be restored")
        made.learn(45, reset_num_timesteps=False)
    assert made.target_spent == {"learning": 45}


def test_a_source_that_was_corrected_already_is_refused(soon: None, tmp_path: Path) -> None:
    made = model([])
    made.save(tmp_path / "model")
    corrected = apply_effects(gym.make(TASK), [LIBRARY["torque_offset"]("slider", offset=8.0)])
    said = r"torque_offset\(slider\).*or have twice"
    with pytest.raises(ValueError, match=said):
        RPTO.load(tmp_path / "model", env=corrected, device="cpu")
    before = made.env
    with pytest.raises(ValueError, match=said):
        made.set_env(corrected)
    with pytest.raises(ValueError, match="TransformAction changes actions"):
        made.set_env(TransformAction(gym.make(TASK), lambda a: 2 * a, None))
    assert made.env is before


@pytest.mark.parametrize("first", ["the buffer", "the target"])
def test_a_target_after_a_log_begins_without_the_logs_estimates(
    first: str, kept_on_a_log: Path, tmp_path: Path
) -> None:
    later = target([])
    loses = pytest.warns(UserWarning, match=r"D_target loses \d+ transitions of the log, whose states are estimates")
    if first == "the buffer":
        made = on_a_log(kept_on_a_log)
        with loses:
            made.set_target_env(later)
    else:
        made = RPTO.load(kept_on_a_log / "model", env=gym.make(TASK), target_env=later, device="cpu")
        with loses:
            made.load_replay_buffer(kept_on_a_log / "buffer")
    assert made.replay_buffer.target.size() == made.replay_buffer.target_added == 0
    assert made.replay_buffer.source.size() > 0
    made.save_replay_buffer(tmp_path / "later")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="D_target loses")
        made.load_replay_buffer(tmp_path / "later")


def test_a_rehearsal_that_was_interrupted_is_played_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = forgetful()
    made._n_updates += 10
    with monkeypatch.context() as patch:
        patch.setattr(made.loop.selection, "play", interrupt)
        with pytest.raises(KeyboardInterrupt):
            made.loop.selection.evaluate(made, dynamics(made))
    assert made.loop.selection.is_behind(made)


def interrupt(*_: object) -> np.ndarray:
    raise KeyboardInterrupt


def test_rounding_alone_is_no_reason_for_another_trace(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    change(monkeypatch, next_trace=20)
    made = filled([], 120)
    made.loop.traced_at, made.loop.traced_error, made.loop.found = 80, 1e-12, [{"verdict": "complete"}]
    monkeypatch.setattr(PhysicalDynamics, "error", lambda *_: 5e-12)
    assert not made.loop.trace_due(made, dynamics(made))
    monkeypatch.setattr(PhysicalDynamics, "error", lambda *_: 5e-3)
    assert made.loop.trace_due(made, dynamics(made))
