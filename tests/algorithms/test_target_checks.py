"""A target that is not the machine of the simulator: refused where it shows its model, doubted where it does not."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import DelayObservation, FlattenObservation, TimeLimit, TransformObservation, TransformReward
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rpto import RPTO
from sb3_rpto.algorithms.target_checks import LARGE, check_machine, doubt_rules
from sb3_rpto.dynamics.base import Transitions
from sb3_rpto.effects import declare
from sb3_rpto.effects.model_numbers import sites_act
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.envs.task_rules import task_rules

POLES = "InvertedDoublePendulum-v5"
#: hinge and hinge2 (their sines, cosines and speeds) change places
SWAPPED = [0, 2, 1, 4, 3, 5, 7, 6, 8]


class Swapped(gym.Wrapper):
    """The second pole in the place of the first."""

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return observation[SWAPPED], info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return observation[SWAPPED], *rest


def shifted(length=0.7):
    source = gym.make(POLES)
    (number,) = declare(source.unwrapped.model, ["pole.length"])
    return apply_effects(source, [number.with_values(np.array([length]))])


def model(target, declared="pole.length", env=POLES, **kwargs):
    settings = {"seed": 0, "device": "cpu", "source_steps": 2, "model_train_freq": 40, "batch_size": 16, **kwargs}
    settings = {"dynamics": "physical", "dynamics_kwargs": {"threads": 1}, **settings}
    settings |= (
        {}
        if settings["dynamics"] == "ensemble"
        else {"declared": [declared] if isinstance(declared, str) else declared}
    )
    return RPTO("MlpPolicy", gym.make(env), target_env=target, **settings)


def venv(env):
    return DummyVecEnv([lambda: env])


def test_joints_of_another_machine_are_refused():
    with pytest.raises(ValueError, match="target_env has the joint 'bthigh' where env has the joint 'thigh_joint'"):
        check_machine(venv(gym.make("Walker2d-v5")), venv(gym.make("HalfCheetah-v5")))
    with pytest.raises(ValueError, match="has the joint 'hinge2' where env has no further joint"):
        check_machine(venv(gym.make("InvertedPendulum-v5")), venv(gym.make(POLES)))
    # Observations and actions of the two have the same shapes.
    with pytest.raises(ValueError, match="'thigh_joint' where env has the joint 'bthigh': phi"):
        model(gym.make("Walker2d-v5"), "torso.mass", "HalfCheetah-v5")


@pytest.mark.parametrize("dynamics", ["physical", "residual"])
def test_steps_of_another_length_are_refused(dynamics):
    with pytest.raises(ValueError, match=r"a step of target_env takes 0.1 s, one of env 0.05 s.*frame_skip"):
        model(gym.make(POLES, frame_skip=10), dynamics=dynamics)


def test_networks_may_learn_any_target():
    model(gym.make(POLES, frame_skip=10), dynamics="ensemble", dynamics_kwargs={"hidden": (8, 8)})


def test_other_numbers_wrappers_and_targets_without_a_model_pass():
    model(TimeLimit(FlattenObservation(shifted()), 50))
    check_machine(venv(gym.make(POLES)), venv(gym.make("Pendulum-v1")))


@pytest.mark.parametrize(
    ("change", "named"),
    [(lambda o: o[SWAPPED], "hinge2?"), (lambda o: np.r_[o[:5], np.rad2deg(o[5:8]), o[8:]], "the speed of slider")],
    ids=["order", "units"],
)
def test_observations_that_a_wrapper_makes_another_states_are_refused_untouched(change, named):
    target = gym.make(POLES)
    before = target.unwrapped.data.qpos.copy()
    with pytest.raises(ValueError, match=f"with TransformObservation its observations do not hold {named} as those of"):
        model(TransformObservation(target, change, target.observation_space))
    np.testing.assert_array_equal(target.unwrapped.data.qpos, before)


def test_noise_of_the_target_is_no_other_state():
    target, rng = gym.make(POLES), np.random.default_rng(0)
    model(TransformObservation(target, lambda o: o + rng.normal(0, 0.05, o.shape), target.observation_space))


@pytest.mark.parametrize("delay", [1, 4])
def test_late_sensors_of_the_target_are_no_other_state_and_remember_nothing_of_the_look(delay):
    late, twin = (DelayObservation(gym.make(POLES), delay=delay) for _ in range(2))
    for env in (late, twin):
        env.reset(seed=0)
    model(late)
    shown, expected = (env.step(np.zeros(1, dtype=np.float32))[0] for env in (late, twin))
    np.testing.assert_array_equal(shown, expected)
    assert len(late.observation_queue) == len(twin.observation_queue)


class Handmade(gym.Env):
    """A machine that somebody simulates by MuJoCo without gymnasium's class for it."""

    def __init__(self):
        twin = gym.make("InvertedPendulum-v5").unwrapped
        self.model, self.data = twin.model, twin.data
        self.observation_space, self.action_space = twin.observation_space, twin.action_space

    def _seen(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self._seen(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 2)
        return self._seen(), 1.0, False, False, {}


def test_a_target_that_does_not_tell_its_time_step_passes():
    model(Handmade(), "pole.mass", "InvertedPendulum-v5")


@pytest.mark.slow
def test_joints_in_another_order_are_doubted_once():
    made = model(Swapped(shifted()))
    with pytest.warns(UserWarning, match=r"one-step error is still .*model's joints in its order and units\?"):
        made.learn(45, source_timesteps=0)
    assert made.dynamics.error(made.transitions("target")) > LARGE
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="after the fit")
        made.learn(45, reset_num_timesteps=False)


@pytest.mark.slow
def test_a_number_at_its_bound_is_doubted():
    made = model(shifted(0.7), "pole.length=0.55:0.65")
    with pytest.warns(UserWarning, match=r"after the fit pole\.length = 0\.65 lies at its bound: do the target's"):
        made.learn(45, source_timesteps=0)


@pytest.mark.slow
def test_what_fits_is_not_doubted():
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="after the fit")
        made = model(shifted()).learn(45, source_timesteps=0)
    assert made.state.fit_checked


class Fragile(gym.Wrapper):
    """A machine that trips at a speed which its simulator allows."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(abs(observation[2]) > 2), truncated, info


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (Fragile, r"termination_fn is not that of \d+ of 30 target transitions; pass .*'termination_fn'"),
        pytest.param(
            lambda env: TransformReward(env, lambda r: r + 30),
            r"reward_fn is not that of 30 of 30 .*'reward_fn'",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda env: TransformReward(env, lambda r: 1.5 * r),
            r"reward_fn is not that of \d+ of 30",
            marks=pytest.mark.slow,
        ),
        (lambda env: env, None),
    ],
)
def test_a_rule_of_the_source_that_the_target_disproves_is_told_once(change, said):
    source, target = gym.make("Pendulum-v1"), change(gym.make("Pendulum-v1", g=12.0))
    settings = {"dynamics_kwargs": {"hidden": (8, 8)}, "model_train_freq": 30, "seed": 0, "device": "cpu"}
    made = RPTO("MlpPolicy", source, target_env=target, policy_kwargs={"net_arch": [4]}, source_steps=20, **settings)
    told = "what is known of the source's task does not hold in the target"
    with pytest.warns(UserWarning, match=f"{told}: {said}") if said else warnings.catch_warnings():
        if said is None:
            warnings.filterwarnings("error", message=told)
        made.learn(60, source_timesteps=100)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=told)
        made.learn(30, reset_num_timesteps=False)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("task", ["Hopper", "Walker2d", "Ant", "HalfCheetah", "Swimmer", "InvertedDoublePendulum"])
def test_rules_of_a_task_hold_for_its_shifted_targets(task, noise):
    """The healthy heights of a walker are those of its own body."""
    env = gym.make(f"rpto/{task}-target0-v0")
    rules, rows, rng = task_rules(env), [], np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(300):
        action = env.action_space.sample()
        following, reward, ended, truncated, _ = env.step(action)
        rows.append([observation, action, reward, following, ended])
        observation = env.reset()[0] if ended or truncated else following
    columns = [np.array(column, dtype=np.float32) for column in zip(*rows)]
    for column in (columns[0], columns[3]):
        column += noise * rng.standard_normal(column.shape)
    data = Transitions(*map(th.as_tensor, columns))
    assert rules.reward_fn or rules.termination_fn
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not doubt_rules(rules, data)


def test_another_cart_pole_as_source_is_told(tmp_path):
    def cartpole(**constants):
        return gym.make("rpto/ContinuousCartPole-v0", **constants)

    settings = {"dynamics": "physical", "declared": ["pole_length"], "policy_kwargs": {"net_arch": [4]}}
    rpto = RPTO("MlpPolicy", cartpole(), target_env=cartpole(pole_length=1.5), device="cpu", **settings)
    rpto.set_env(cartpole())
    with pytest.warns(UserWarning, match=r"another model than the one that phi was fitted for \(pole_length differ"):
        rpto.set_env(cartpole(pole_length=0.6))
    rpto.save(tmp_path / "m.zip")
    with pytest.warns(UserWarning, match=r"\(gravity differ"):
        RPTO.load(tmp_path / "m.zip", cartpole(gravity=20.0))


@pytest.mark.parametrize("held", [False, True], ids=["a mark", "a motor's place"])
def test_a_mark_that_a_task_moves_is_no_other_simulator(held: bool) -> None:
    pushed = '<actuator><general site="goal" gear="1 0 0 0 0 0"/></actuator>' if held else ""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='hinge'/><geom size='.1'/><site name='goal'/></body></worldbody>"
        f"{pushed}</mujoco>"
    )
    assert sites_act(model) == held


def heavier_without_inertia(factor=1.3):
    """A pole whose mass was scaled, and its inertia not."""
    env = gym.make("InvertedPendulum-v5")
    robot = env.unwrapped
    robot.model.body_mass[2] *= factor
    mujoco.mj_setConst(robot.model, robot.data)
    return env


def test_exact_data_that_a_fit_still_misses_are_told_once():
    made = model(heavier_without_inertia(), "pole.mass", "InvertedPendulum-v5")
    with pytest.warns(UserWarning, match=r"sensor noise does not explain it: something differs that was not declared"):
        made.learn(160, source_timesteps=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="after the fit")
        made.learn(45, reset_num_timesteps=False)


def test_exact_data_that_a_fit_meets_are_not_doubted():
    target = heavier_without_inertia()
    made = model(target, env="InvertedPendulum-v5", declared=["pole.mass", "pole.inertia"])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="after the fit")
        made.learn(160, source_timesteps=0)
    assert made.dynamics.values[0] == pytest.approx(1.3 * 5.01859164, rel=1e-4)
