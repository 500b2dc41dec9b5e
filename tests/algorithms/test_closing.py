"""The loop closed inside learn(): what the target has and nobody declared joins phi."""

from __future__ import annotations

import csv
from collections import deque
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_rpto import RPTO
from sb3_rpto.algorithms import closing
from sb3_rpto.algorithms.closing import LoopCloser, outdated, stays_finite
from sb3_rpto.algorithms.source import EpisodeSource
from sb3_rpto.dynamics.physical import PhysicalDynamics
from sb3_rpto.effects import LIBRARY, Effect, declare
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.tracing import Report, trace

TASK = "InvertedDoublePendulum-v5"
KINDS = ["coulomb_friction", "torque_offset", "quadratic_drag"]
LEVEL, LENGTH = 3.0, 1.15


def target(lacks: list[Effect]) -> gym.Env:
    env = gym.make(TASK)
    declared = [d.with_values(LENGTH * d.values) for d in declare(env.unwrapped.model, ["pole.length"])]  # type: ignore[attr-defined]
    return apply_effects(env, [*declared, *lacks])


def friction() -> list[Effect]:
    return [LIBRARY["coulomb_friction"]("slider", level=LEVEL)]


def model(lacks: list[Effect], **kwargs: object) -> RPTO:
    settings: dict[str, object] = {
        **{"dynamics": "physical", "declared": ["pole.length"], "close_loop": KINDS, "seed": 0, "device": "cpu"},
        **{"source_steps": 4, "gradient_steps": 1, "weighting": None, "model_train_freq": 40, "batch_size": 32},
        **kwargs,
    }
    return RPTO("MlpPolicy", gym.make(TASK), target_env=target(lacks), **settings)  # type: ignore[arg-type]


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closing, "FIRST", 80)
    monkeypatch.setattr(closing, "FILL", 25)
    monkeypatch.setattr(closing, "FRESH", 25)


@cache
def learned() -> RPTO:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(closing, "FIRST", 80)
        patch.setattr(closing, "FILL", 25)
        patch.setattr(closing, "FRESH", 25)
        return model(friction()).learn(100, source_timesteps=100)


def dynamics(made: RPTO) -> PhysicalDynamics:
    assert isinstance(made.dynamics, PhysicalDynamics)
    return made.dynamics


def test_an_undeclared_effect_is_named_added_and_fitted() -> None:
    made = learned()
    assert made.loop is not None
    report: Report = made.loop.reports[0]
    assert report.verdict == "explained"
    assert [traced.effect.label for traced in report.effects] == ["coulomb_friction(slider)"]
    values = dynamics(made).describe()
    assert values["coulomb_friction(slider).level"] == pytest.approx(LEVEL, rel=0.01)
    assert values["pole.length"] == pytest.approx(LENGTH * 0.6, rel=0.01)


def test_a_trace_is_logged_before_any_episode_ends(soon: None, tmp_path: Path) -> None:
    made = filled([])
    made.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    assert made.loop is not None
    made.loop.close(made, dynamics(made))
    (line,) = csv.DictReader((tmp_path / "progress.csv").open())
    assert line["gap/verdict"] == "complete"
    assert line["gap/effects"] == "none"
    assert float(line["gap/residual_after"]) < 1e-3 < float(line["gap/residual_before"])


def test_what_is_not_explained_is_said(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled([])
    monkeypatch.setattr(
        closing, "trace", lambda *args, **kwargs: replace(trace(*args, **kwargs), verdict="unexplained")
    )
    assert made.loop is not None
    with pytest.warns(UserWarning, match=r"on 101 target transitions is 'unexplained'.*reports\[-1\].*in its order"):
        made.loop.close(made, dynamics(made))


def test_no_target_step_is_spent_on_tracing() -> None:
    made = learned()
    assert made.num_timesteps == 100
    assert made.target_spent == {"learning": 100}


def test_what_an_uncorrected_source_produced_is_dropped() -> None:
    made = learned()
    # Since the trace at step 80 alone: the first and the fresh steps, then four for each target step.
    assert made.replay_buffer.source.size() < 25 + 28 + 4 + 4 * 21


def test_source_episodes_have_the_effect() -> None:
    made = learned()
    copy = made._source_world.copies[0]  # type: ignore[union-attr]
    assert "coulomb_friction(slider)" in [effect.label for effect in copy.effects]


def test_the_corrected_simulator_comes_back_from_a_checkpoint(tmp_path: Path) -> None:
    made = learned()
    made.save(tmp_path / "model")
    loaded = RPTO.load(tmp_path / "model", device="cpu")
    assert dynamics(loaded).describe() == dynamics(made).describe()
    assert loaded.loop is not None
    assert loaded.loop.found[0]["verdict"] == "explained"


@pytest.mark.parametrize("stop", [60, 90], ids=["before the trace", "after it"])
def test_a_loop_that_was_stopped_goes_on_as_if_it_had_not_been(stop: int, soon: None, tmp_path: Path) -> None:
    def begun() -> RPTO:
        return model(friction()).learn(stop, source_timesteps=100)

    unbroken = begun().learn(100 - stop, reset_num_timesteps=False)
    stopped = begun()
    stopped.save(tmp_path / "model")
    stopped.save_replay_buffer(tmp_path / "buffer")
    resumed = RPTO.load(tmp_path / "model", env=gym.make(TASK), target_env=target(friction()), device="cpu")
    resumed.load_replay_buffer(tmp_path / "buffer")
    resumed.learn(100 - stop, reset_num_timesteps=False)
    assert resumed.loop is not None
    assert unbroken.loop is not None
    assert resumed.loop.found == unbroken.loop.found
    assert "coulomb_friction(slider).level" in dynamics(resumed).names
    np.testing.assert_array_equal(dynamics(resumed).values, dynamics(unbroken).values)
    assert resumed.source_timesteps == unbroken.source_timesteps
    for ours, theirs in zip(resumed.policy.parameters(), unbroken.policy.parameters()):
        assert th.equal(ours, theirs)


def test_a_learned_model_predicts_the_target() -> None:
    made = learned()
    assert dynamics(made).error(made.transitions("target")) < 1e-3


def filled(lacks: list[Effect], count: int = 100) -> RPTO:
    """A model whose D_target holds random actions in the target, ready to close the loop."""
    made = model(lacks)
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
    assert made.loop is not None
    made.loop.close(made, dynamics(made))
    assert made.loop.reports[0].verdict == "complete"
    assert dynamics(made).names == ["pole.length"]


def test_what_other_declared_numbers_produced_is_dropped_too(soon: None) -> None:
    made = model([])
    made.learn(1, source_timesteps=60)
    append(made, [], 100)
    assert not outdated(made, dynamics(made))
    dynamics(made).fit(made.transitions("target"), max_steps=30)
    assert outdated(made, dynamics(made))
    assert made.loop is not None
    steps = made.source_timesteps
    made.loop.close(made, dynamics(made))
    assert made.source_timesteps - steps == made.replay_buffer.source.size() >= 50
    assert not outdated(made, dynamics(made))
    made.loop.close(made, dynamics(made))  # the source stays as it is where the simulator does
    assert made.source_timesteps - steps == made.replay_buffer.source.size()


def test_an_unstable_correction_is_refused(soon: None, monkeypatch: pytest.MonkeyPatch) -> None:
    made = filled(friction())
    before = dynamics(made).describe()
    monkeypatch.setattr(closing, "stays_finite", lambda *_: False)
    assert made.loop is not None
    with pytest.warns(UserWarning, match=r"coulomb_friction\(slider\).*unstable: refused"):
        made.loop.close(made, dynamics(made))
    assert dynamics(made).describe() == before


@pytest.mark.parametrize("seen", [30, 0])
def test_instability_is_seen(seen: int) -> None:
    made = filled([], 30)
    assert made.env is not None
    data = made.transitions("target").take(slice(0, seen))
    assert stays_finite(dynamics(made), data, made.env)
    spring = LIBRARY["spring"]("hinge", stiffness=1e9)
    dynamics(made).adopt([spring])
    assert not stays_finite(dynamics(made), data, made.env)


def test_another_trace_is_due_when_new_transitions_are_no_longer_predicted(
    soon: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closing, "AGAIN", 20)
    made = filled(friction())
    loop = made.loop
    assert isinstance(loop, LoopCloser)
    assert loop.due(made, dynamics(made))
    loop.close(made, dynamics(made))
    assert not loop.due(made, dynamics(made))
    append(made, friction(), 30)
    assert not loop.due(made, dynamics(made))
    append(made, [LIBRARY["torque_offset"]("hinge", offset=2.0)], 30)
    assert loop.due(made, dynamics(made))


def test_a_new_target_is_traced_anew(soon: None) -> None:
    made = filled(friction())
    assert made.loop is not None
    made.loop.close(made, dynamics(made))
    lacks: list[Effect] = [LIBRARY["torque_offset"]("hinge", offset=2.0)]
    with pytest.warns(UserWarning, match="D_target loses 101"):
        made.set_target_env(target(lacks))
    append(made, lacks, 70)
    assert not made.loop.due(made, dynamics(made))
    append(made, lacks, 10)  # as many as a first trace takes
    assert made.loop.due(made, dynamics(made))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dynamics": "ensemble", "declared": ()}, "close_loop=True traces what a MuJoCo simulator lacks"),
        ({"close_loop": False, "declared": ()}, "nothing to fit"),
        ({"declared": ["pole.lenght"]}, "has no 'lenght'; did you mean 'length'"),
    ],
)
def test_what_cannot_be_closed_is_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        model([], **settings)


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

    def interact(self, model: object, n_steps: int, random: bool = False) -> int:
        self.returns.extend([r] if (r := next(self.earns, None)) is not None else [])
        return n_steps


@pytest.mark.parametrize(
    ("earns", "rounds"),
    [
        ([3.0, 2.0, 1.0, 9.0], 3),  # two rounds in a row without a gain
        ([1.0, 2.0, 1.5, 2.5, 2.0, 2.5, 9.0], 6),  # one of them alone does not end it, and as much is no gain
        ([-9.0, -8.0, -7.0, -6.0, -5.0, -4.0, -3.0, -2.0], 8),  # to the last step
        ([], 8),  # nothing to judge by
    ],
)
def test_learning_in_the_corrected_simulator_goes_on_while_it_pays(
    earns: list[float], rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closing, "ROUND", 20)
    monkeypatch.setattr(closing, "FRESH", 160)
    updates: list[int] = []
    noises: list[None] = []
    made = SimpleNamespace(
        use_sde=True,
        actor=SimpleNamespace(reset_noise=lambda: noises.append(None)),
        _source_world=Scripted(earns),
        gradient_steps=30,
        source_steps=20,
        batch_size=32,
        source_timesteps=5,
        verbose=0,
        train=lambda n, batch_size: updates.append(n),
    )
    closing.learn_in_source(made)  # type: ignore[arg-type]
    assert updates == [30] * rounds
    assert len(noises) == rounds
    assert made.source_timesteps == 5 + 20 * rounds
