"""The two worlds: what their buffers hold, who moved the target, which sources a simulator can stand for."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import SMALL_POLICY, heavier, pendulum, small
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_rpto import RPO, RPTO
from sb3_rpto.buffers import chronological
from sb3_rpto.dynamics.factory import preset_section
from sb3_rpto.dynamics.simulator import physical_config
from sb3_rpto.effects import declare
from sb3_rpto.envs.corrected import apply_effects

POLE = "InvertedPendulum-v5"
#: Falls beyond this many rad end an episode.
FALLEN = 0.2


def simulated(source: Any, **kwargs: Any) -> RPTO:
    settings = {"dynamics": "physical", "declared": ["pole.mass"], "seed": 0, "device": "cpu", "source_steps": 4}
    settings |= {"gradient_steps": 1, "batch_size": 32, "model_train_freq": 40, "policy_kwargs": SMALL_POLICY}
    return RPTO("MlpPolicy", source, **{"target_env": heavier(), **settings, **kwargs})


# ---------------------------------------------------------------------- terminal observations


def narrow(venv: Any) -> VecNormalize:
    """Normalised as by a policy that balances: a fall is twenty standard deviations away, and is clipped at ten."""
    normalised = VecNormalize(venv, norm_reward=False)
    normalised.obs_rms.var, normalised.obs_rms.count = np.array([1e-2, 1e-4, 1e-1, 1e-1]), 1e6  # type: ignore[union-attr]
    return normalised


@pytest.mark.parametrize("dynamics", ["real", "physical"])
def test_buffers_hold_falls_as_they_were_where_normalisation_clips_them(dynamics: str) -> None:
    source = narrow(DummyVecEnv([lambda: gym.make(POLE)]))
    if dynamics == "real":
        made = small(RPO, source, heavier()).learn(100, source_timesteps=100)
    else:
        made = simulated(source).learn(100, source_timesteps=100)
    for side in (made.replay_buffer.source, made.replay_buffer.target):
        ended = side.dones[: side.size(), 0].astype(bool)
        assert ended.any()
        assert (np.abs(side.next_observations[: side.size(), 0, 1][ended]) > FALLEN).all()


def test_the_target_is_normalised_as_the_source_is() -> None:
    settings = {"clip_obs": 0.5, "clip_reward": 0.3, "epsilon": 0.1, "gamma": 0.9}
    source = VecNormalize(DummyVecEnv([lambda: gym.make(POLE)]), training=False, **settings)  # type: ignore[arg-type]
    source.obs_rms.mean, source.ret_rms.var = np.full(4, 0.2), np.float64(4.0)  # type: ignore[union-attr]
    target = small(RPO, source, heavier()).target_env
    assert isinstance(target, VecNormalize)
    assert target.gamma == 0.9
    seen, earned = np.linspace(-1, 1, 40).reshape(10, 4), np.linspace(-2, 2, 10)
    np.testing.assert_array_equal(target.normalize_obs(seen), source.normalize_obs(seen))
    np.testing.assert_array_equal(target.normalize_reward(earned), source.normalize_reward(earned))
    assert np.abs(target.normalize_obs(seen)).max() == 0.5
    assert target.normalize_reward(earned).max() == 0.3


def test_where_the_environments_are_elsewhere_falls_are_what_normalisation_left() -> None:
    source = narrow(SubprocVecEnv([lambda: gym.make(POLE)], start_method="fork"))
    made = small(RPO, source, heavier()).learn(20, source_timesteps=100)
    side = made.replay_buffer.source
    ended = side.dones[: side.size(), 0].astype(bool)
    np.testing.assert_allclose(np.abs(side.next_observations[: side.size(), 0, 1][ended]), 0.1, rtol=0.02)
    source.close()


# ---------------------------------------------------------------------- the target under somebody else's hands


def test_steps_of_somebody_else_between_two_runs_end_the_episode() -> None:
    made = simulated(gym.make(POLE)).learn(30, source_timesteps=100)
    evaluate_policy(made, made.target_env, n_eval_episodes=2, warn=False)
    made.learn(30, reset_num_timesteps=False)
    data = made.transitions("target")
    assert made.dynamics is not None
    made.dynamics.fit(data)
    assert made.dynamics.error(data) < 1e-6  # a transition from one episode into another would show


def test_without_them_the_episode_goes_on() -> None:
    made = small(RPO).learn(30, source_timesteps=0)
    made.learn(30, reset_num_timesteps=False)
    side = made.replay_buffer.target
    np.testing.assert_array_equal(side.next_observations[29, 0], side.observations[30, 0])


# ---------------------------------------------------------------------- sources that a simulator cannot stand for


class Scaled(InvertedPendulumEnv):
    def step(self, action: np.ndarray) -> Any:
        return super().step(0.3 * np.asarray(action))


class Pushed(InvertedPendulumEnv):
    def step(self, action: np.ndarray) -> Any:
        self.data.xfrc_applied[2, 0] = 3.0
        return super().step(action)


class Smoothed(InvertedPendulumEnv):
    """Its filter begins at an episode's first action."""

    def step(self, action: np.ndarray) -> Any:
        self.sent = np.asarray(action) if self.sent is None else 0.7 * self.sent + 0.3 * np.asarray(action)
        return super().step(self.sent)

    def reset_model(self) -> Any:
        self.sent: Any = None
        return super().reset_model()


class Dragged(InvertedPendulumEnv):
    """Begins at rest, where nothing drags."""

    def step(self, action: np.ndarray) -> Any:
        self.data.qfrc_applied[0] = -3.0 * self.data.qvel[0]
        return super().step(action)

    def reset_model(self) -> Any:
        self.set_state(self.init_qpos, self.init_qvel)
        return self._get_obs()


class Leaning(InvertedPendulumEnv):
    """What its reset sets stays, and is in no position or velocity."""

    def reset_model(self) -> Any:
        self.data.xfrc_applied[2, 0] = 3.0
        return super().reset_model()


class Drawing(InvertedPendulumEnv):
    """Another machine in each episode, or another place of what is drawn."""

    def __init__(self, numbers: str) -> None:
        self.numbers = numbers
        super().__init__()

    def reset_model(self) -> Any:
        getattr(self.model, self.numbers)[2] = self.np_random.uniform(4, 6)
        return super().reset_model()


def test_a_reset_that_draws_the_machine_is_refused_and_one_that_places_something_is_not() -> None:
    with pytest.raises(ValueError, match=r"reset\(\) draws body_mass.*'randomise': 1.0"):
        simulated(gym.wrappers.TimeLimit(Drawing("body_mass"), 1_000))
    simulated(gym.wrappers.TimeLimit(Drawing("geom_rgba"), 1_000))


class Unseeded(InvertedPendulumEnv):
    """Its seed decides nothing."""

    def __init__(self, seed: int | None) -> None:
        self.own = np.random.default_rng(seed)
        super().__init__()

    def reset_model(self) -> Any:
        self.set_state(self.own.uniform(-0.1, 0.1, 2), np.zeros(2))
        return self._get_obs()


class Resting(InvertedPendulumEnv):
    def reset_model(self) -> Any:
        self.set_state(self.init_qpos, self.init_qvel)
        return self._get_obs()


def test_a_source_whose_copies_would_begin_alike_whatever_their_seeds_is_told() -> None:
    with pytest.warns(UserWarning, match=r"reset\(seed=\.\.\.\) does not decide.*draw from self\.np_random"):
        physical_config(gym.wrappers.TimeLimit(Unseeded(0), 1_000))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env in (Resting(), InvertedPendulumEnv()):
            physical_config(gym.wrappers.TimeLimit(env, 1_000))


def test_a_reset_that_undoes_an_effect_is_told() -> None:
    heavy = declare(Drawing("body_mass").model, ["pole.mass=1:20"])[0].with_values(np.array([9.0]))
    env = apply_effects(Drawing("body_mass"), [heavy])
    with pytest.raises(ValueError, match=r"reset\(\) of Drawing writes body_mass of its model"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("made_by", "message"),
    [
        (Scaled, "gives the commands"),
        (Smoothed, "gives the commands"),
        (Pushed, "moves otherwise"),
        (Leaning, "moves otherwise"),
        (Dragged, "moves otherwise"),
    ],
)
def test_a_step_that_is_more_than_its_simulation_is_refused(made_by: type[gym.Env], message: str) -> None:
    with pytest.raises(ValueError, match=rf"step\(\) {message}.*phi would make up for"):
        simulated(gym.wrappers.TimeLimit(made_by(), 1_000))


def test_the_simulators_own_tasks_pass() -> None:
    names = "Ant HalfCheetah Hopper Humanoid HumanoidStandup InvertedDoublePendulum Pusher Reacher Swimmer Walker2d"
    for name in names.split():
        physical_config(gym.make(f"{name}-v5"))


def test_sources_with_different_models_are_refused() -> None:
    with pytest.raises(ValueError, match=r"simulate different models \(.*body_mass.*'randomise'"):
        simulated(DummyVecEnv([lambda: gym.make(POLE), lambda: heavier(2.0)]))
    simulated(DummyVecEnv([lambda: gym.make(POLE), lambda: gym.make(POLE)]))


def test_another_simulator_in_the_place_of_the_source_is_told(tmp_path: Any) -> None:
    made = simulated(gym.make(POLE))
    made.save(tmp_path / "model.zip")
    with pytest.warns(UserWarning, match="another model than the one that phi was fitted for"):
        made.set_env(heavier(2.0))
    with pytest.warns(UserWarning, match="another model"):
        RPTO.load(tmp_path / "model.zip", heavier(2.0), device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RPTO.load(tmp_path / "model.zip", gym.make(POLE), device="cpu").set_env(gym.make(POLE))


def test_episodes_of_the_simulator_are_counted_without_a_monitor() -> None:
    made = simulated(VecNormalize(DummyVecEnv([lambda: gym.make(POLE)])))
    made.learn(10, source_timesteps=50)
    assert made.rollouts is not None
    assert made.rollouts.log()["ep_rew_mean"] > 0


def test_the_cart_poles_preset_is_for_cart_poles() -> None:
    class Own(InvertedPendulumEnv):
        parameters = {"note": 1}  # noqa: RUF012

    assert preset_section("physical", DummyVecEnv([Own])) == "mujoco"
    assert preset_section("physical", DummyVecEnv([lambda: gym.make("rpto/ContinuousCartPole-v0")])) == "physical"


def test_a_source_whose_vec_env_changes_observations_is_not_compared() -> None:
    source = VecFrameStack(DummyVecEnv([pendulum]), 2)
    target = VecFrameStack(DummyVecEnv([lambda: pendulum(12.0)]), 2)
    assert small(RPO, source, target).learn(30, source_timesteps=50).num_timesteps == 30


def test_an_episodes_end_below_a_frame_stack_is_had_from_the_normalised_one() -> None:
    def short() -> gym.Env:
        return gym.wrappers.TimeLimit(pendulum().unwrapped, 10)

    source = VecNormalize(VecFrameStack(DummyVecEnv([short]), 2))
    target = VecFrameStack(DummyVecEnv([short]), 2)
    model = small(RPO, source, target).learn(30, source_timesteps=50)
    ends = chronological(model.replay_buffer.target)["next_observations"].reshape(30, -1)[9::10]
    np.testing.assert_allclose(np.hypot(*ends.T[3:5]), 1.0, atol=1e-4)  # cosine and sine of the newest frame


# ---------------------------------------------------------------------- what is carried over, and what is not


def sac(**kwargs: Any) -> SAC:
    return SAC("MlpPolicy", pendulum(), learning_starts=10, seed=0, device="cpu", policy_kwargs=kwargs).learn(30)


def warm(source: SAC, **kwargs: Any) -> RPO:
    return RPO.from_source(source, pendulum(), pendulum(12.0), device="cpu", **kwargs)


def test_the_optimizers_options_are_those_that_were_passed() -> None:
    source = sac(net_arch=[16])
    options = {"net_arch": [16], "optimizer_kwargs": {"weight_decay": 1e-2, "betas": (0.5, 0.9)}}
    made = warm(source, policy_kwargs=options)
    (group,) = made.actor.optimizer.param_groups
    assert (group["weight_decay"], group["betas"]) == (1e-2, (0.5, 0.9))
    assert len(made.actor.optimizer.state) == len(source.actor.optimizer.state) > 0
    made.learn(10)


@pytest.mark.parametrize("optimizer", [th.optim.SGD, th.optim.RMSprop, th.optim.AdamW])
def test_another_optimizer_begins_anew(optimizer: type[th.optim.Optimizer]) -> None:
    made = warm(sac(net_arch=[16]), policy_kwargs={"net_arch": [16], "optimizer_class": optimizer})
    assert len(made.actor.optimizer.state) == 0
    made.learn(10)


@pytest.mark.parametrize(
    "name", ["close_loop", "effects", "declared", "dynamics_kwargs", "preset", "use_sde", "n_steps"]
)
def test_loading_refuses_what_it_cannot_change(name: str, tmp_path: Any) -> None:
    simulated(gym.make(POLE)).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=rf"load\(\) does not change {name}"):
        RPTO.load(tmp_path / "model.zip", **{name: True})


def test_a_source_policys_forgotten_normalisation_is_told() -> None:
    normalised = VecNormalize(DummyVecEnv([pendulum]))
    source = SAC("MlpPolicy", normalised, learning_starts=10, device="cpu", policy_kwargs=SMALL_POLICY).learn(20)
    with pytest.warns(UserWarning, match="normalised by VecNormalize, and env is in none"):
        warm(source)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RPO.from_source(source, normalised, pendulum(12.0), device="cpu")


def test_another_normalisation_than_the_source_policys_is_told(tmp_path: Path) -> None:
    def made(**kwargs: Any) -> VecNormalize:
        return VecNormalize(DummyVecEnv([pendulum]), **kwargs)

    seen, settings = made(), {"device": "cpu", "policy_kwargs": SMALL_POLICY}
    source = SAC("MlpPolicy", seen, learning_starts=10, **settings).learn(20)
    with pytest.warns(UserWarning, match="normalised by other statistics than env's"):
        RPO.from_source(source, made(), pendulum(12.0), device="cpu")
    raw = SAC("MlpPolicy", pendulum(), learning_starts=10, **settings).learn(20)
    with pytest.warns(UserWarning, match="saw raw observations, and env normalises them"):
        RPO.from_source(raw, made(), pendulum(12.0), device="cpu")
    RPO.from_source(source, seen, pendulum(12.0), device="cpu").save(tmp_path / "normalised.zip")
    RPO.from_source(raw, pendulum(), pendulum(12.0), device="cpu").save(tmp_path / "raw.zip")
    with pytest.warns(UserWarning, match="the model saw observations normalised by VecNormalize, and env is in none"):
        RPO.load(tmp_path / "normalised.zip", env=pendulum(), device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RPO.from_source(raw, made(norm_obs=False), pendulum(12.0), device="cpu")
        source.save(tmp_path / "sac.zip")
        loaded = SAC.load(tmp_path / "sac.zip", env=pendulum(), device="cpu")  # it has learned elsewhere
        RPO.from_source(loaded, seen, pendulum(12.0), device="cpu")
        RPO.load(tmp_path / "normalised.zip", env=made(), device="cpu")
        RPO.load(tmp_path / "raw.zip", env=pendulum(), device="cpu")
        RPO.load(tmp_path / "normalised.zip", device="cpu")


@pytest.mark.parametrize("by", ["evaluate_policy", "EvalCallback", "reset"])
def test_steps_of_somebody_in_the_source_begin_its_episodes_anew(by: str) -> None:
    """Else a transition would lead from one episode into another."""
    settings = {"device": "cpu", "policy_kwargs": SMALL_POLICY, "source_steps": 7}
    model = RPO("MlpPolicy", pendulum(), target_env=pendulum(12.0), **settings)
    model.learn(10, source_timesteps=30)
    callback = None
    if by == "evaluate_policy":
        evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    elif by == "reset":
        model.get_env().reset()
    else:
        callback = EvalCallback(model.get_env(), eval_freq=4, n_eval_episodes=1, verbose=0)
    model.learn(10, callback=callback, reset_num_timesteps=False)
    data = model.transitions("source")
    angle, after = (np.arctan2(x[:, 1], x[:, 0]) for x in (data.observations.numpy(), data.next_observations.numpy()))
    moved = np.angle(np.exp(1j * (after - angle)))
    np.testing.assert_allclose(moved, 0.05 * data.next_observations[:, 2].numpy(), atol=1e-5)  # Pendulum's own step
