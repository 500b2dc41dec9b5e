"""Copies look into their own simulation, or are refused, or are made anew by the function that made the original."""

from __future__ import annotations

import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rpto.algorithms.rollouts import copied
from sb3_rpto.effects import LIBRARY
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.env_copy import CopyError, copy_env, make_env, must_copy


class Arm:
    """A helper as robots' environments have them."""

    def __init__(self, model, data) -> None:
        self.model, self.data = model, data

    def angle(self) -> float:
        return float(self.data.qpos[1])


class Tilting(InvertedPendulumEnv):
    """Rewards and ends are told by whatever looks at the hinge."""

    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.looks = self.looking()

    def angle(self) -> float:
        return float(self.looks())

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), -abs(self.angle()), abs(self.angle()) > 0.2, False, {}


def _angle(data) -> float:
    return data.qpos[1]


class Helper(Tilting):
    def looking(self):
        self.arm = Arm(self.model, self.data)
        return self.arm.angle


class View(Tilting):
    def looking(self):
        self.views = {"hinge": self.data.qpos[1:]}
        return self.first

    def first(self) -> float:
        return self.views["hinge"][0]


class Closure(Tilting):
    def looking(self):
        return lambda: self.data.qpos[1]


class OverData(Tilting):
    def looking(self):
        data, scale = self.data, 1.0
        return lambda: scale * data.qpos[1]


class HeldByAFunction(Tilting):
    def looking(self):
        arm = Arm(self.model, self.data)

        def angle(again=True):
            return angle(again=False) if again else arm.angle()

        return lambda: angle()


class Default(Tilting):
    def looking(self):
        return lambda data=self.data: data.qpos[1]


class Partial(Tilting):
    def looking(self):
        return functools.partial(_angle, self.data)


class Watching(gym.Wrapper):
    """A wrapper that holds the simulation of what it wraps."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.data = env.unwrapped.data

    def step(self, action):
        observation, _, _, truncated, info = super().step(action)
        return observation, -abs(self.data.qpos[1]), bool(abs(self.data.qpos[1]) > 0.2), truncated, info


class Named(Tilting):
    def looking(self):
        self.hinge = self.data.joint("hinge")
        return lambda: self.hinge.qpos[0]


class NamedBeside(Tilting):
    """There is another simulation, too."""

    def looking(self):
        self.other = mujoco.MjData(self.model)
        self.hinges = {"other": self.other.joint("hinge"), "own": self.data.joint(1)}
        return lambda: self.hinges["own"].qpos[0] + self.hinges["other"].qpos[0]


class Opaque(Tilting):
    def looking(self):
        self.numbers = iter(x for x in [1.0])
        return lambda: self.data.qpos[1]


#: those that copy, and those that look into the simulation in ways that a copy would not follow
COPIED = [Helper, Partial, lambda: Watching(gym.make("InvertedPendulum-v5").unwrapped)]
REFUSED = [View, Closure, OverData, HeldByAFunction, Default, Named, NamedBeside]


def episode(env: gym.Env) -> list[tuple]:
    env.reset(seed=0)
    steps = [env.step(np.ones(1))]
    while not steps[-1][2] and len(steps) < 50:
        steps.append(env.step(np.ones(1)))
    return [(*step[0].tolist(), *step[1:4]) for step in steps]


@pytest.mark.parametrize("make", COPIED)
def test_copies_see_their_own_simulation(make) -> None:
    env = make()
    copy, again = copy_env(env), copy_env(env)
    expected = episode(make())
    assert 2 < len(expected) < 50
    assert episode(copy) == expected
    assert episode(env) == expected  # the copy's steps are not seen there
    assert episode(copy_env(copy)) == expected
    assert episode(again) == expected


@pytest.mark.parametrize("make", REFUSED)
def test_what_a_copy_would_not_follow_is_refused_unless_a_function_makes_it(make) -> None:
    assert copy_env(make()) is None
    with pytest.raises(CopyError, match="pass a function that makes it, or an id"):
        must_copy(make())
    expected = episode(make())
    env = make_env(make)
    env.reset(seed=0)
    copy, around = copy_env(env), copy_env(Watching(env))
    for one in (copy, around, copy_env(copy), env):
        assert episode(one) == expected


def test_a_copy_by_a_function_goes_on_from_where_the_original_is() -> None:
    env = make_env(Closure)
    env.model.body_mass[1] *= 2
    env.reset(seed=3)
    env.step(np.ones(1))
    copy = copy_env(env)
    assert copy is not env
    np.testing.assert_array_equal(copy.model.body_mass, env.model.body_mass)
    for one in (copy, env):  # with the same random numbers later
        one.seen = [one.step(np.ones(1))[0].tolist(), one.reset()[0].tolist()]
    assert copy.seen == env.seen


def test_functions_over_plain_values_are_shared_with_a_copy() -> None:
    scale, shift = 2.0, np.ones(4)
    env = gym.wrappers.TransformObservation(Helper(), lambda obs: scale * obs + shift, None)
    assert episode(copy_env(env)) == episode(env)


@pytest.mark.parametrize("wrapper", [gym.wrappers.ClipAction, gym.wrappers.FlattenObservation])
def test_functions_of_gymnasiums_wrappers_are_shared_with_a_copy(wrapper) -> None:
    env = wrapper(Helper())
    expected = episode(wrapper(Helper()))
    assert episode(copy_env(env)) == expected
    assert episode(env) == expected


def test_an_environment_is_made_of_an_id_a_function_or_itself() -> None:
    env = Helper()
    assert make_env(env) is env
    assert make_env("InvertedPendulum-v5").spec.id == "InvertedPendulum-v5"
    assert isinstance(make_env(Helper), Helper)
    assert isinstance(make_env(lambda: DummyVecEnv([Helper])), DummyVecEnv)
    with pytest.raises(TypeError, match="target_env: the function returned int; it must return a new environment"):
        make_env(lambda: 3, "target_env")


def test_a_corrected_environment_ends_and_rewards_by_its_own_simulation() -> None:
    pulled = [LIBRARY["torque_offset"]("hinge", offset=0.5)]
    made = apply_effects(Helper(), pulled)
    rows = episode(made)
    np.testing.assert_allclose([-row[-3] for row in rows], [abs(row[1]) for row in rows], rtol=1e-12)
    assert rows != episode(Helper())


def test_what_does_not_copy_is_named() -> None:
    assert copy_env(Opaque()) is None
    with pytest.raises(CopyError, match="generator"):
        must_copy(Opaque())
    with pytest.raises(ValueError, match=r"cannot be copied \(.*generator.*whose environment holds nothing that"):
        copied(DummyVecEnv([Opaque]))
