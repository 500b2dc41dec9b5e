"""What looks into the simulation of an environment looks into its copy's in a copy."""

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
from sb3_rpto.envs.env_copy import copy_env, must_copy


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


WORLDS = [
    Helper,
    View,
    Closure,
    OverData,
    HeldByAFunction,
    Default,
    Partial,
    Named,
    NamedBeside,
    lambda: Watching(gym.make("InvertedPendulum-v5").unwrapped),
]


def episode(env: gym.Env) -> list[tuple]:
    env.reset(seed=0)
    steps = [env.step(np.ones(1))]
    while not steps[-1][2] and len(steps) < 50:
        steps.append(env.step(np.ones(1)))
    return [(*step[0].tolist(), *step[1:4]) for step in steps]


@pytest.mark.parametrize("make", WORLDS)
def test_copies_see_their_own_simulation(make) -> None:
    env = make()
    copy, again = copy_env(env), copy_env(env)
    expected = episode(make())
    assert 2 < len(expected) < 50
    assert episode(copy) == expected
    assert episode(env) == expected  # the copy's steps are not seen there
    assert episode(copy_env(copy)) == expected
    assert episode(again) == expected


def test_the_copy_of_a_view_of_the_model_is_one_of_the_copied_model() -> None:
    env = InvertedPendulumEnv()
    env.masses = env.model.body_mass[1:]
    copy = copy_env(env)
    copy.masses[0] = 3.0
    assert copy.model.body_mass[1] == 3.0
    assert env.model.body_mass[1] != 3.0


def test_a_corrected_environment_ends_and_rewards_by_its_own_simulation() -> None:
    pulled = [LIBRARY["torque_offset"]("hinge", offset=0.5)]
    made = apply_effects(Helper(), pulled)
    rows = episode(made)
    np.testing.assert_allclose([-row[-3] for row in rows], [abs(row[1]) for row in rows], rtol=1e-12)
    assert rows != episode(Helper())


def test_the_copy_of_what_mujoco_names_is_of_the_copied_model() -> None:
    env = InvertedPendulumEnv()
    env.cart = env.model.body("cart")
    copy = copy_env(env)
    copy.cart.mass[0] = 3.0
    assert copy.model.body("cart").mass[0] == 3.0
    assert env.model.body("cart").mass[0] != 3.0


def test_what_does_not_copy_is_named() -> None:
    assert copy_env(Opaque()) is None
    with pytest.raises(TypeError, match="generator"):
        must_copy(Opaque())
    with pytest.raises(ValueError, match=r"cannot be copied \(.*generator.*whose environment holds nothing that"):
        copied(DummyVecEnv([Opaque]))
