"""What recordings turn out to be of: friction that gives way, queues of commands that are empty at a reset."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from queued import Queue
from simulated import compiled, recorded
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_rpto.effects import LIBRARY, Effect
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.hypotheses.hypothesis import kept_effects

OWN = """<mujoco><option timestep="0.005"/><worldbody><body name="pole">
<joint name="hinge" axis="0 -1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
KINDS = ["coulomb_friction", "stribeck_friction", "torque_offset"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["soft_friction", "coulomb_friction"])
@pytest.mark.parametrize("noise", [0.0, 2e-4], ids=["exact", "noisy"])
def test_dry_friction_is_found_as_the_robot_has_it(kind: str, noise: float) -> None:
    data = recorded([LIBRARY[kind]("hinge", level=0.3)], compiled(OWN), noise=noise, exact=not noise)
    report = trace(OWN, data, ["pole.mass"], candidates=KINDS, horizon=0.2, simulated=True, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == [f"{kind}(hinge)"]
    assert report.effects[0].effect.values == pytest.approx([0.3], rel=1e-2 if noise else 1e-6)
    assert [f.kind for f in report.findings].count(FindingKind.SOFT_FRICTION) == (kind == "soft_friction")


@pytest.mark.slow
def test_friction_that_gives_way_is_not_looked_for_where_no_dry_one_is() -> None:
    data = recorded([LIBRARY["soft_friction"]("hinge", level=0.3)], compiled(OWN), noise=0.0, exact=True)
    report = trace(OWN, data, ["pole.mass"], candidates=["torque_offset"], simulated=True, threads=1)
    assert report.verdict == "unexplained"
    assert [c.label for c in report.candidates] == ["torque_offset(hinge)"]


def test_a_known_effect_that_the_fit_takes_away_is_not_in_what_is_told_apart() -> None:
    known, found = LIBRARY["coulomb_friction"]("hinge", level=0.1).as_known(), LIBRARY["torque_offset"]("hinge")
    simulation = SimpleNamespace(effects=[known, found], slices=[slice(0, 1), slice(1, 2)])
    model = SimpleNamespace(effects=[1], fit=SimpleNamespace(values=np.array([0.0, 0.2])))
    fine = SimpleNamespace(simulation=simulation)
    result: Any = SimpleNamespace(selection=SimpleNamespace(model=model), on=SimpleNamespace(fine=fine))
    assert [effect.label for effect in kept_effects(result)] == ["torque_offset(hinge)"]


class Smooth(gym.Wrapper):
    """Sends a running mean of the actions, from rest on."""

    def reset(self, **kwargs: Any) -> Any:
        self.mean = np.zeros_like(self.action_space.sample())
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        self.mean = 0.4 * self.mean + 0.6 * action
        return self.env.step(self.mean)


@pytest.mark.slow
def test_a_filter_of_the_actions_is_found_as_it_was_written() -> None:
    source, target = gym.make("InvertedDoublePendulum-v5"), Smooth(gym.make("InvertedDoublePendulum-v5"))
    agent = SAC("MlpPolicy", Monitor(target), buffer_size=150, learning_starts=150, seed=0, device="cpu").learn(150)
    assert agent.replay_buffer is not None
    data = Measurements.from_replay(agent.replay_buffer, source)
    kinds = ["command_smoothing", "actuator_lag", "command_delay", "command_gain"]
    report = trace(source, data, ["pole.length"], candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert [(t.label, t.effect.idle) for t in report.effects] == [("command_smoothing(slide)", True)]
    assert report.effects[0].effect.values == pytest.approx([0.4], abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("lacks", ["a queue", "a late command", "nothing"])
def test_what_came_before_a_run_is_told_by_its_first_steps(lacks: str) -> None:
    source, name = gym.make("InvertedDoublePendulum-v5"), "slide"
    target = gym.make("InvertedDoublePendulum-v5")
    delay = source.unwrapped.dt  # type: ignore[attr-defined]
    if lacks == "a queue":
        target = Queue(target)
    elif lacks == "a late command":
        target = apply_effects(target, [LIBRARY["command_delay"](name, delay=delay)])
    agent = SAC("MlpPolicy", Monitor(target), buffer_size=120, learning_starts=120, seed=0, device="cpu").learn(120)
    assert agent.replay_buffer is not None
    data = Measurements.from_replay(agent.replay_buffer, source)
    assert len(data.episodes) > 10, "many of the steps are first ones"
    report = trace(source, data, ["pole.length"], candidates=["command_delay", "torque_offset"], threads=1)
    assert report.verdict == ("complete" if lacks == "nothing" else "explained")
    assert [(t.label, t.effect.idle) for t in report.effects] == (
        [] if lacks == "nothing" else [(f"command_delay({name})", lacks == "a queue")]
    )
    assert [t.effect.values[0] for t in report.effects] == pytest.approx([delay] * len(report.effects), rel=1e-3)
    assert [f.kind for f in report.findings].count(FindingKind.IDLE_START) == (lacks == "a queue")
    corrected = report.apply(gym.make("InvertedDoublePendulum-v5"))
    for seed in (3, 4):
        seen = [env.reset(seed=seed)[0] for env in (target, corrected)]
        np.testing.assert_allclose(*seen, rtol=0, atol=1e-9)
        for action in (0.3, -0.2, 0.1):
            seen = [env.step(np.array([action], dtype=np.float32))[0] for env in (target, corrected)]
            np.testing.assert_allclose(*seen, rtol=0, atol=1e-5)


def transitions(source: gym.Env, target: gym.Env) -> Measurements:
    agent = SAC("MlpPolicy", Monitor(target), buffer_size=150, learning_starts=150, seed=0, device="cpu").learn(150)
    assert agent.replay_buffer is not None
    return Measurements.from_replay(agent.replay_buffer, source)


@pytest.mark.slow
def test_another_gravity_is_found_in_the_states_of_a_simulator_where_nothing_is_declared() -> None:
    source, target = gym.make("rpto/InvertedDoublePendulum-v0"), gym.make("rpto/InvertedDoublePendulum-gravity-x0.5-v0")
    report = trace(source, transitions(source, target), threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == ["gravity_scale"]
    assert report.effects[0].effect.values == pytest.approx([-0.5], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "planted",
    [
        [LIBRARY["mass_scale"]("pole", change=-0.3)],
        [LIBRARY["com_offset"]("pole", x=0.03, z=0.1)],
        [LIBRARY["viscous_friction"](hinge, coefficient=-0.03) for hinge in ("hinge", "hinge2")],
        [LIBRARY["link_length"]("pole2", change=0.1), LIBRARY["viscous_friction"]("hinge", coefficient=-0.02)],
    ],
    ids=["a lighter body", "a centre of mass elsewhere", "less damping", "two kinds"],
)
def test_other_numbers_of_a_simulator_are_explained_where_nothing_is_declared(planted: list[Effect]) -> None:
    source = gym.make("InvertedDoublePendulum-v5")
    target = apply_effects(gym.make("InvertedDoublePendulum-v5"), planted)
    kinds = ["mass_scale", "payload", "com_offset", "link_length", "viscous_friction", "asymmetric_damping", "armature"]
    report = trace(source, transitions(source, target), candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == [effect.label for effect in planted]
    for traced, effect in zip(report.effects, planted):
        assert traced.effect.values == pytest.approx(effect.values, abs=2e-4)


def test_a_softer_ground_is_found_in_the_states_of_a_simulator() -> None:
    source, softer = gym.make("HalfCheetah-v5"), LIBRARY["contact_softness"]("floor", softness=0.5, damping=-0.2)
    target = apply_effects(gym.make("HalfCheetah-v5"), [softer])
    kinds = ["contact_softness", "geom_friction", "end_stop", "viscous_friction", "gravity_tilt"]
    report = trace(source, transitions(source, target), candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == [softer.label]
    assert report.effects[0].effect.values == pytest.approx(softer.values, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("less", [True, False])
def test_a_log_tells_that_the_model_has_too_much(less: bool) -> None:
    lacks = [LIBRARY["viscous_friction"]("hinge", coefficient=-0.035)] if less else []
    data = recorded(lacks, compiled(OWN), noise=1e-3)
    report = trace(OWN, data, ["pole.mass"], candidates=["viscous_friction", *KINDS], simulated=True, threads=1)
    assert report.verdict == ("explained" if less else "complete")
    assert [traced.label for traced in report.effects] == [effect.label for effect in lacks]
    for traced in report.effects:
        assert traced.effect.values == pytest.approx([-0.035], rel=0.02)
        low, high = (bound[0] for bound in traced.interval)
        assert low < traced.effect.values[0] < high < 0


class Braked(gym.Wrapper):
    """A force against the motion of the cart, written once a step."""

    def __init__(self, env: gym.Env, kind: str) -> None:
        super().__init__(env)
        self.kind = kind

    def step(self, action: Any) -> Any:
        data: Any = self.env.unwrapped.data  # type: ignore[attr-defined]
        v = data.qvel[0]
        data.qfrc_applied[0] = -2.0 * abs(v) * v if self.kind == "held_drag" else -8.0 * np.sign(v)
        return self.env.step(action)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "value"), [("held_drag", 2.0), ("held_friction", 8.0)])
def test_a_force_that_a_wrapper_writes_once_a_step_is_found_as_it_is_held(kind: str, value: float) -> None:
    source = gym.make("InvertedDoublePendulum-v5")
    report = trace(source, transitions(source, Braked(gym.make("InvertedDoublePendulum-v5"), kind)), threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == [f"{kind}(slider)"]
    assert report.effects[0].effect.values == pytest.approx([value], rel=1e-3)
    assert [f.kind for f in report.findings].count(FindingKind.HELD_FORCES) == 1
    # The corrected environment moves as the target does.
    target = Braked(gym.make("InvertedDoublePendulum-v5"), kind)
    corrected = report.apply(gym.make("InvertedDoublePendulum-v5"))
    for env in (target, corrected):
        env.reset(seed=3)
    for action in (0.9, -0.7, 0.1):
        seen = [env.step(np.array([action], dtype=np.float32))[0] for env in (target, corrected)]
        np.testing.assert_allclose(*seen, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_held_force_is_found_beside_another_effect() -> None:
    source = gym.make("InvertedDoublePendulum-v5")
    weak = apply_effects(gym.make("InvertedDoublePendulum-v5"), [LIBRARY["command_gain"]("slide", change=-0.2)])
    report = trace(source, transitions(source, Braked(weak, "held_drag")), threads=1)
    assert report.verdict == "explained"
    values = {traced.label: traced.effect.values[0] for traced in report.effects}
    assert values == pytest.approx({"held_drag(slider)": 2.0, "command_gain(slide)": -0.2}, rel=1e-2)
    assert [f.kind for f in report.findings].count(FindingKind.HELD_FORCES) == 1


@pytest.mark.slow
def test_what_acts_in_every_substep_is_not_called_held() -> None:
    source = gym.make("InvertedDoublePendulum-v5")
    target = apply_effects(
        gym.make("InvertedDoublePendulum-v5"), [LIBRARY["quadratic_drag"]("slider", coefficient=2.0)]
    )
    report = trace(source, transitions(source, target), ["pole.length"], threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == ["quadratic_drag(slider)"]


class Biased(gym.ActionWrapper):
    """Adds to every action, beyond what the motor takes."""

    def action(self, action: Any) -> Any:
        return action + np.float32(0.15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["command_offset", "torque_offset"])
def test_an_offset_of_the_commands_is_told_from_a_torque_by_those_that_are_clipped(kind: str) -> None:
    source, target = gym.make("InvertedDoublePendulum-v5"), gym.make("InvertedDoublePendulum-v5")
    target = Biased(target) if kind == "command_offset" else apply_effects(target, [LIBRARY[kind]("slider", offset=75)])
    report = trace(source, transitions(source, target), ["pole.length"], threads=1)
    assert report.verdict == "explained"
    assert [traced.effect.kind for traced in report.effects] == [kind]
    assert report.effects[0].effect.values == pytest.approx([0.15 if kind == "command_offset" else 75], rel=1e-3)


class Pushed(gym.Wrapper):
    """A wind on the torso."""

    def step(self, action: Any) -> Any:
        self.env.unwrapped.data.xfrc_applied[1, :3] = (12.0, 0.0, -5.0)  # type: ignore[attr-defined]
        return self.env.step(action)


@pytest.mark.slow
def test_a_push_at_the_centre_of_mass_is_found_where_the_base_turns_about_another_point() -> None:
    source, target = gym.make("HalfCheetah-v5"), Pushed(gym.make("HalfCheetah-v5"))
    kinds = ["external_force", "torque_offset", "torque_ripple", "coulomb_friction", "gravity_tilt", "command_offset"]
    report = trace(source, transitions(source, target), candidates=kinds, threads=1)
    assert report.verdict == "explained"
    assert [traced.label for traced in report.effects] == ["external_force(torso)"]
    x, _, z = report.effects[0].effect.values  # nothing moves sideways
    assert (x, z) == pytest.approx((12.0, -5.0), abs=0.01)
