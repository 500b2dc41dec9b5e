"""What SAC users rely on holds for RPO, RTO and RPTO; SB3's own SAC runs through every test as the oracle."""

import io
import json
import pathlib
import types

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ALGORITHMS
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize
from stable_baselines3.sac.policies import SACPolicy
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms import pretraining
from sb3_rpto.algorithms.rollouts import EpisodeSource
from sb3_rpto.algorithms.transfer import TransferAlgorithm

EPISODE = 10
BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)

#: RPTO runs the code of all three.
OURS = [pytest.param(RPO, marks=pytest.mark.slow), pytest.param(RTO, marks=pytest.mark.slow), RPTO]
#: What SB3's own does changes with its version alone.
every_class = pytest.mark.parametrize("cls", [pytest.param(SAC, marks=pytest.mark.slow), *OURS])
ours = pytest.mark.parametrize("cls", OURS)
pytestmark = pytest.mark.filterwarnings("ignore:EnsembleDynamics learns terminations")


@pytest.fixture(autouse=True)
def _shortest_source_phase(_short_source_phase, monkeypatch):
    monkeypatch.setattr(pretraining, "PHI_0_STEPS", 20)
    monkeypatch.setattr(pretraining, "PHI_0_UPDATES", 3)
    monkeypatch.setattr(pretraining, "FIRST_SOURCE_STEPS", 20)


class Drift(gym.Env):
    """A point that the action pushes and a wind carries off; episodes of ten steps."""

    def __init__(self, wind: float = 0.0, action_space: spaces.Box = BOX, dtype: type = np.float32) -> None:
        self.observation_space = spaces.Box(-20.0, 20.0, (2,), dtype)
        self.action_space = action_space
        self.wind = wind
        self.received: list[np.ndarray] = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.normal(size=2), 0
        return self.place.astype(self.observation_space.dtype), {}

    def step(self, action):
        self.received.append(np.array(action))
        self.steps += 1
        self.place = np.clip(self.place + 0.1 * action + self.wind, -20, 20)
        reward = -float(np.abs(self.place).sum())
        return self.place.astype(self.observation_space.dtype), reward, False, self.steps >= EPISODE, {}


def windy(**kwargs):
    return Drift(wind=0.05, **kwargs)


class Still(Drift):
    """Always where it began, so that nothing but noise moves the actions."""

    def step(self, action):
        return np.zeros(2, np.float32), *super().step(action)[1:]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}


def build(cls, env=None, target=None, policy="MlpPolicy", **kwargs):
    """A tiny model; SAC has no target and acts in the source."""
    env = Drift() if env is None else env
    settings = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "learning_starts": 5, "buffer_size": 2_000}
    settings |= {"seed": 0, "device": "cpu", **kwargs}
    if cls is SAC:
        return SAC(policy, env, **settings)
    own = {"source_steps": 4, "gradient_steps": 1}
    if cls.updates_dynamics:
        network = {"hidden": (8,), "n_members": 2, "n_elites": 1, "max_steps": 5}
        own |= {"dynamics_kwargs": network, "model_train_freq": 15}
    return cls(policy, env, target_env=windy() if target is None else target, **{**own, **settings})


def learn(model, steps=30, **kwargs):
    if isinstance(model, TransferAlgorithm):
        kwargs.setdefault("source_timesteps", 0)
    return model.learn(steps, **kwargs)


def load(cls, path, env=None, target=None, **kwargs):
    target = {} if cls is SAC or target is None else {"target_env": target}
    return cls.load(path, env=env, device="cpu", **target, **kwargs)


def acting_env(model):
    """The VecEnv whose steps count: SAC's only one, our target."""
    return model.target_env if isinstance(model, TransferAlgorithm) else model.env


def observations(n: int = 10) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, 2)).astype(np.float32)


def same_predictions(a, b) -> bool:
    return np.array_equal(
        a.predict(observations(), deterministic=True)[0], b.predict(observations(), deterministic=True)[0]
    )


class Record(BaseCallback):
    """Keeps what ``look(model)`` says at each step."""

    def __init__(self, look):
        super().__init__()
        self.look, self.seen = look, []

    def _on_step(self):
        self.seen.append(self.look(self.model))
        return True


# ---------------------------------------------------------------------- arguments


@every_class
@pytest.mark.parametrize(("ent_coef", "start"), [("auto", 1.0), ("auto_0.1", 0.1), (0.2, 0.2)])
def test_entropy_coefficient(cls, ent_coef, start):
    model = build(cls, ent_coef=ent_coef)
    coefficient = model.ent_coef_tensor if model.log_ent_coef is None else model.log_ent_coef.exp()
    assert coefficient.item() == pytest.approx(start)
    learn(model)
    assert (model.ent_coef_optimizer is None) == (ent_coef == 0.2)
    if ent_coef != 0.2 and getattr(cls, "updates_policy", True):
        assert model.log_ent_coef.exp().item() != pytest.approx(start, abs=1e-6)


@every_class
def test_a_malformed_entropy_coefficient_is_refused(cls):
    with pytest.raises(ValueError, match=r"could not convert|ent_coef must be"):
        build(cls, ent_coef="otto")
    with pytest.raises((AssertionError, ValueError), match=r"greater than 0|ent_coef must be"):
        build(cls, ent_coef="auto_0.0")


@every_class
@pytest.mark.parametrize("n_critics", [1, 3])
def test_number_of_critics(cls, n_critics):
    model = learn(build(cls, policy_kwargs={"net_arch": [8], "n_critics": n_critics}))
    assert len(model.critic.q_networks) == len(model.critic_target.q_networks) == n_critics


@every_class
@pytest.mark.parametrize("train_freq", [4, (4, "step"), (1, "episode")])
def test_as_many_updates_as_steps(cls, train_freq):
    """gradient_steps=-1; SAC makes none before learning_starts, ours trains from the first target step."""
    model = learn(build(cls, train_freq=train_freq, gradient_steps=-1, learning_starts=0), 40)
    assert model._n_updates == model.num_timesteps == 40
    assert learn(build(cls, train_freq=train_freq, gradient_steps=-3, learning_starts=0), 40)._n_updates == 40
    assert learn(build(cls, train_freq=train_freq, gradient_steps=0), 40)._n_updates == 0


@every_class
def test_a_malformed_train_freq_is_refused(cls):
    with pytest.raises(ValueError, match=r"unit of the `train_freq`|train_freq must be"):
        build(cls, train_freq=(1, "fortnight"))
    with pytest.raises(ValueError):
        build(cls, train_freq=(1.5, "step"))


@every_class
@pytest.mark.parametrize(
    "noise",
    [
        NormalActionNoise(3 * np.ones(2), 0.01 * np.ones(2)),
        OrnsteinUhlenbeckActionNoise(3 * np.ones(2), 0.01 * np.ones(2), theta=1.0, dt=1.0),
    ],
    ids=["normal", "ornstein-uhlenbeck"],
)
def test_action_noise_acts(cls, noise):
    """Noise with a mean of 3 pushes every action to its bound; source actions of ours are free of it."""
    env, target = Drift(), windy()
    learn(build(cls, env, target, action_noise=noise, learning_starts=0), 25)
    acted = env if cls is SAC else target
    np.testing.assert_allclose(acted.received, 1.0)
    if cls is not SAC:
        assert np.min(env.received) < 0


@every_class
def test_action_noise_of_several_environments(cls):
    def vectorised(wind):
        return make_vec_env(lambda: Drift(wind), n_envs=2)

    noise = NormalActionNoise(np.zeros(2), 0.1 * np.ones(2))
    model = learn(build(cls, vectorised(0.0), vectorised(0.05), action_noise=noise))
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert model.action_noise.n_envs == 2
    ready = VectorizedActionNoise(noise, 2)
    model = learn(build(cls, vectorised(0.0), vectorised(0.05), action_noise=ready))
    assert model.action_noise is ready


@ours
@pytest.mark.parametrize(("train_freq", "sample_freq", "held"), [(1, -1, 1), (8, 4, 4), (8, -1, 8)])
def test_exploration_noise_in_the_source_is_held_as_long_as_in_the_target(cls, train_freq, sample_freq, held):
    kwargs = {"use_sde": True, "train_freq": train_freq, "sde_sample_freq": sample_freq}
    model = build(cls, Still(), Still(), **kwargs)
    EpisodeSource(model.env).interact(model, 24)
    actions = model.replay_buffer.source.actions[:24, 0, 0]
    assert len(set(actions.tolist())) == 24 // held
    assert all(len(set(actions[i : i + held].tolist())) == 1 for i in range(0, 24, held))


@ours
def test_exploration_noise_in_the_source_lasts_an_episode_where_it_does_in_the_target(cls):
    model = build(cls, gym.wrappers.TimeLimit(Still(), 6), Still(), use_sde=True, train_freq=(1, "episode"))
    EpisodeSource(model.env).interact(model, 24)
    actions = model.replay_buffer.source.actions[:24, 0, 0]
    assert [len(set(actions[i : i + 6].tolist())) for i in range(0, 24, 6)] == [1, 1, 1, 1]
    assert len(set(actions.tolist())) == 4


@pytest.mark.parametrize("cls", [cls for cls in ALGORITHMS if cls.updates_dynamics])
def test_every_branch_has_exploration_noise_of_its_own(cls):
    model = learn(build(cls, Still(), Still(), use_sde=True, source_steps=8, learning_starts=0), 5)
    side = model.replay_buffer.source
    newest = side.actions[: side.size(), 0, 0][-8:]
    assert len(set(newest.tolist())) == 8


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_every_update_has_exploration_noise_of_its_own(cls, monkeypatch):
    model, seen = learn(build(cls, Still(), Still(), use_sde=True, learning_starts=0), 5), []
    loss = cls.critic_loss

    def watched(self, batch, ent_coef):
        seen.append(self.actor.action_dist.exploration_mat[0, 0].item())
        return loss(self, batch, ent_coef)

    monkeypatch.setattr(cls, "critic_loss", watched)
    model.train(6, 8)
    assert len(set(seen)) == 6


class Normed(BaseFeaturesExtractor):
    """Batch normalisation alone."""

    def __init__(self, space):
        super().__init__(space, space.shape[0])
        self.norm = th.nn.BatchNorm1d(space.shape[0])

    def forward(self, observations):
        return self.norm(observations)


def test_a_policy_that_stays_keeps_its_batch_statistics():
    policy_kwargs = {"net_arch": [8], "features_extractor_class": Normed}
    model = learn(build(RTO, policy_kwargs=policy_kwargs, learning_starts=0), 5)
    before = {name: value.clone() for name, value in model.actor.state_dict().items()}
    critics = model.critic.features_extractor.norm.running_mean.clone()
    model.train(6, 8)
    for name, value in model.actor.state_dict().items():
        assert th.equal(value, before[name]), name
    assert not th.equal(model.critic.features_extractor.norm.running_mean, critics)


@ours
def test_a_policys_own_actions_are_those_in_the_source_too(cls):
    class Careful(SACPolicy):
        def _predict(self, observation, deterministic=False):
            return super()._predict(observation, deterministic).clamp(-0.1, 0.1)

    model = learn(build(cls, policy=Careful, learning_starts=0))
    for side in (model.replay_buffer.source, model.replay_buffer.target):
        assert 0.09 < np.abs(side.actions[: side.size()]).max() < 0.11


@every_class
@pytest.mark.parametrize("train_freq", [1, 8])
@pytest.mark.parametrize("warmup", [False, True])
def test_state_dependent_exploration(cls, train_freq, warmup):
    policy_kwargs = {"net_arch": [8], "log_std_init": -1, "use_expln": True}
    model = build(
        cls,
        use_sde=True,
        sde_sample_freq=4,
        use_sde_at_warmup=warmup,
        train_freq=train_freq,
        policy_kwargs=policy_kwargs,
        learning_starts=20,
    )
    learn(model, 40)
    assert model.actor.use_sde
    assert model._n_updates > 0
    assert np.isfinite(model.predict(observations())[0]).all()


@every_class
@pytest.mark.parametrize("warmup", [False, True])
def test_until_learning_starts_actions_are_random_or_explore_by_states(cls, warmup):
    """With next to no noise the policy's own are all near its mean, which an untrained one has near zero."""
    policy_kwargs = {"net_arch": [8], "log_std_init": -10}
    model = build(cls, use_sde=True, use_sde_at_warmup=warmup, policy_kwargs=policy_kwargs, learning_starts=20)
    learn(model, 20, **({} if cls is SAC else {"source_timesteps": 20}))
    acted = model.replay_buffer if cls is SAC else model.replay_buffer.source
    assert (np.abs(acted.actions[:20]).max() < 0.7) == warmup


@every_class
def test_exploration_noise_is_redrawn_every_sde_sample_freq_steps(cls):
    model = build(cls, use_sde=True, sde_sample_freq=4, train_freq=12, learning_starts=0)
    watch = Record(lambda model: model.actor.action_dist.exploration_mat[0, 0].item())
    learn(model, 12, callback=watch)
    assert [len(set(watch.seen[i : i + 4])) for i in (0, 4, 8)] == [1, 1, 1]
    assert len(set(watch.seen)) == 3


@every_class
def test_target_update_interval(cls):
    """With tau = 1 the target critic equals the critic exactly after the updates that renew it."""
    for interval, equal in ((1, True), (2, True), (3, False)):
        model = learn(build(cls, target_update_interval=interval, tau=1.0))
        model.train(gradient_steps=3, batch_size=8)  # renewed at the updates 0, interval, 2 interval ...
        pairs = zip(model.critic.parameters(), model.critic_target.parameters())
        assert all(th.equal(a, b) for a, b in pairs) is equal, interval


@every_class
def test_custom_networks_and_optimizers(cls):
    policy_kwargs = {
        "net_arch": {"pi": [4], "qf": [6, 5]},
        "activation_fn": th.nn.Tanh,
        "optimizer_class": th.optim.RMSprop,
        "optimizer_kwargs": {"eps": 1e-3},
    }
    model = learn(build(cls, policy_kwargs=policy_kwargs))
    assert [layer.out_features for layer in model.actor.latent_pi if isinstance(layer, th.nn.Linear)] == [4]
    assert [layer.out_features for layer in model.critic.qf0 if isinstance(layer, th.nn.Linear)] == [6, 5, 1]
    assert any(isinstance(layer, th.nn.Tanh) for layer in model.critic.qf0)
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        assert isinstance(optimizer, th.optim.RMSprop)
        assert optimizer.defaults["eps"] == 1e-3


@every_class
def test_learning_rate_schedule_decays_over_the_budget(cls):
    watch = Record(lambda model: [o.param_groups[0]["lr"] for o in optimizers(model)])
    model = learn(build(cls, learning_rate=lambda left: 1e-2 * left, learning_starts=0), 40, callback=watch)
    rates = np.array(watch.seen)[1:]  # the first update follows the first step
    assert (np.diff(rates, axis=0) < 0).all()
    np.testing.assert_allclose(rates[:, 0], 1e-2 * (1 - np.arange(1, 40) / 40), rtol=1e-6)
    assert optimizers(model)[0].param_groups[0]["lr"] == pytest.approx(0.0)


@every_class
@pytest.mark.parametrize("rate", [2e-3, lambda left: 2e-3], ids=["float", "callable"])
def test_a_constant_learning_rate_stays(cls, rate):
    model = learn(build(cls, learning_rate=rate))
    assert all(o.param_groups[0]["lr"] == pytest.approx(2e-3) for o in optimizers(model))


def optimizers(model):
    return [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]


@every_class
@pytest.mark.parametrize("use_sde", [False, True])
def test_the_seed_decides_the_run(cls, use_sde):
    def run(seed):
        env, target = Drift(), windy()
        source_phase = {} if cls is SAC else {"source_timesteps": 20}
        model = learn(build(cls, env, target, seed=seed, use_sde=use_sde), **source_phase)
        return np.array((env if cls is SAC else target).received), model.policy.state_dict()

    (actions, weights), (again, weights_again), (other, _) = run(3), run(3), run(4)
    np.testing.assert_array_equal(actions, again)
    assert all(th.equal(weights[name], weights_again[name]) for name in weights)
    assert not np.array_equal(actions, other)


@every_class
def test_a_policy_may_be_a_class(cls):
    class MyPolicy(SACPolicy):
        pass

    assert type(learn(build(cls, policy=MyPolicy)).policy) is MyPolicy
    with pytest.raises(ValueError, match=r"unknown|policy must be"):
        build(cls, policy="MlpPolice")


@every_class
def test_environments_by_id(cls):
    target = {} if cls is SAC else {"target_env": gym.make("Pendulum-v1", g=12.0)}
    model = cls("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, learning_starts=5, **target)
    assert model.get_env().num_envs == 1
    learn(model, 8)
    if cls is not SAC:
        model.set_target_env("Pendulum-v1")
        assert acting_env(model).observation_space == model.observation_space


@every_class
@pytest.mark.parametrize("device", ["cpu", "auto"])
def test_device(cls, device):
    model = learn(build(cls, device=device), 10)
    assert {parameter.device.type for parameter in model.policy.parameters()} == {model.device.type}
    assert model.replay_buffer.sample(4).observations.device.type == model.device.type


@every_class
def test_verbose_speaks_and_silence_is_the_default(cls, capsys):
    learn(build(cls), 20, log_interval=1)
    assert capsys.readouterr().out == ""
    learn(build(cls, verbose=1), 20, log_interval=1)
    out = capsys.readouterr().out
    for text in ("Using cpu device", "Wrapping the env", "ep_rew_mean", "total_timesteps"):
        assert text in out


@every_class
def test_stats_window_size(cls):
    model = learn(build(cls, stats_window_size=2), 5 * EPISODE)
    assert len(model.ep_info_buffer) == 2


# ---------------------------------------------------------------------- prediction


@every_class
def test_predict_one_and_many(cls):
    model = build(cls)
    one, state = model.predict(np.zeros(2, np.float32), deterministic=True)
    assert one.shape == (2,)
    assert state is None
    many, _ = model.predict(np.zeros((5, 2), np.float32), deterministic=True)
    assert many.shape == (5, 2)
    np.testing.assert_allclose(many, np.tile(one, (5, 1)), rtol=1e-5, atol=1e-6)
    from_vec_env, _ = model.predict(model.get_env().reset())
    assert from_vec_env.shape == (1, 2)
    np.testing.assert_allclose(model.predict(np.zeros(2), deterministic=True)[0], one, rtol=1e-5, atol=1e-6)
    draws = [model.predict(np.zeros(2, np.float32))[0] for _ in range(2)]
    assert not np.array_equal(*draws)
    assert model.action_space.contains(one)


@every_class
def test_predict_refuses_other_shapes(cls):
    model = build(cls)
    for shape in ((3,), (4, 3), (1, 2, 2), ()):
        with pytest.raises(ValueError, match="observation"):
            model.predict(np.zeros(shape, np.float32))
    with pytest.raises(ValueError, match="tuple"):
        model.predict((np.zeros(2, np.float32), {}))


@every_class
def test_evaluate_policy(cls):
    model = build(cls)
    mean, std = evaluate_policy(model, Monitor(windy()), n_eval_episodes=3)
    assert mean < 0 <= std
    returns, lengths = evaluate_policy(model, model.get_env(), n_eval_episodes=2, return_episode_rewards=True)
    assert lengths == [EPISODE, EPISODE]
    assert len(returns) == 2


# ---------------------------------------------------------------------- saving


@every_class
@pytest.mark.parametrize("kind", ["str", "str.zip", "path", "path.zip", "file", "bytes"])
def test_every_kind_of_path(cls, kind, tmp_path):
    model = learn(build(cls), 20)
    path = tmp_path / ("model.zip" if kind.endswith(".zip") else "model")
    if kind == "bytes":
        file = io.BytesIO()
        model.save(file)
        file.seek(0)
        loaded = load(cls, file)
    elif kind == "file":
        with path.open("wb") as stream:
            model.save(stream)
        with path.open("rb") as stream:
            loaded = load(cls, stream)
    else:
        path = str(path) if kind.startswith("str") else path
        model.save(path)
        assert [file.name for file in tmp_path.iterdir()] == ["model.zip"]
        loaded = load(cls, path)
    assert same_predictions(model, loaded)


@every_class
@pytest.mark.parametrize("use_sde", [False, True])
def test_policy_optimizers_and_temperature_come_back(cls, use_sde, tmp_path):
    model = learn(build(cls, use_sde=use_sde, ent_coef="auto_0.3", learning_rate=1e-3))
    model.save(tmp_path / "model")
    loaded = load(cls, tmp_path / "model")
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name]), name
    assert th.equal(model.log_ent_coef, loaded.log_ent_coef)
    for one, other in zip(optimizers(model), optimizers(loaded)):
        state, loaded_state = one.state_dict()["state"], other.state_dict()["state"]
        assert state.keys() == loaded_state.keys()
        assert all(th.equal(state[i]["exp_avg"], loaded_state[i]["exp_avg"]) for i in state)
    assert loaded.log_ent_coef is loaded.ent_coef_optimizer.param_groups[0]["params"][0]
    for name in ("gamma", "tau", "num_timesteps", "_n_updates", "batch_size", "learning_rate", "train_freq", "seed"):
        assert getattr(loaded, name) == getattr(model, name), name


@every_class
def test_a_fixed_temperature_comes_back(cls, tmp_path):
    build(cls, ent_coef=0.25).save(tmp_path / "model")
    loaded = load(cls, tmp_path / "model")
    assert loaded.ent_coef_tensor.item() == 0.25
    assert loaded.ent_coef_optimizer is None


@every_class
def test_load_then_set_env_then_learn(cls, tmp_path):
    model = learn(build(cls), 20)
    model.save(tmp_path / "model")
    loaded = load(cls, tmp_path / "model")
    assert loaded.get_env() is None
    assert same_predictions(model, loaded)
    loaded.set_env(Drift())
    if cls is not SAC:
        loaded.set_target_env(windy())
    learn(loaded, 20)
    assert loaded.num_timesteps == 20
    with pytest.raises(AssertionError, match="number of environments"):
        loaded.set_env(make_vec_env(Drift, n_envs=2))
    with pytest.raises(ValueError, match="space"):
        loaded.set_env(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="space"):
        load(cls, tmp_path / "model", env=gym.make("Pendulum-v1"))


@every_class
def test_load_with_another_number_of_environments(cls, tmp_path):
    learn(build(cls), 20).save(tmp_path / "model")
    loaded = load(cls, tmp_path / "model", make_vec_env(Drift, n_envs=3), make_vec_env(windy, n_envs=2))
    learn(loaded, 24)
    assert loaded.num_timesteps == 24
    assert loaded.get_env().num_envs == 3


@every_class
def test_exclude_and_include(cls, tmp_path):
    model = build(cls)
    model.custom = "mine"
    model.save(tmp_path / "without", exclude=["custom", "learning_starts"])
    data, _, _ = load_from_zip_file(tmp_path / "without")
    assert "custom" not in data
    assert "learning_starts" not in data
    assert not hasattr(load(cls, tmp_path / "without"), "custom")
    model._last_original_obs = np.ones(3)
    model.save(tmp_path / "with", include=["_last_original_obs"])
    data, params, _ = load_from_zip_file(tmp_path / "with")
    assert (data["_last_original_obs"] == 1).all()
    assert {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"} <= params.keys()
    for absent in ("env", "target_env", "replay_buffer", "dynamics", "actor", "critic", "_logger"):
        assert absent not in data


@every_class
def test_custom_objects_and_changed_arguments(cls, tmp_path):
    learn(build(cls, learning_rate=lambda left: 1e-3), 10).save(tmp_path / "model")
    loaded = load(cls, tmp_path / "model", custom_objects={"learning_rate": 5e-4, "batch_size": 4})
    assert (loaded.learning_rate, loaded.batch_size) == (5e-4, 4)
    assert loaded.lr_schedule(0.5) == 5e-4
    loaded = load(cls, tmp_path / "model", Drift(), windy(), gamma=0.5, learning_rate=7e-4)
    assert loaded.gamma == 0.5
    learn(loaded, 10)
    assert optimizers(loaded)[1].param_groups[0]["lr"] == 7e-4
    with pytest.raises(ValueError, match="policy kwargs"):
        load(cls, tmp_path / "model", policy_kwargs={"net_arch": [9]})


@every_class
def test_get_and_set_parameters(cls):
    model, other = learn(build(cls, seed=0)), build(cls, seed=1)
    assert not same_predictions(model, other)
    other.set_parameters(model.get_parameters())
    assert same_predictions(model, other)
    parameters = model.get_parameters()
    for wrong in ({**parameters, "nonsense": {}}, {"nonsense": {}}):
        with pytest.raises(ValueError, match="nonsense"):
            other.set_parameters(wrong)
    policy_alone = {"policy": parameters["policy"]}
    with pytest.raises(ValueError):
        other.set_parameters(policy_alone)
    fresh = build(cls, seed=2)
    fresh.set_parameters(policy_alone, exact_match=False)
    assert same_predictions(model, fresh)


@every_class
def test_set_parameters_from_a_file(cls, tmp_path):
    model = learn(build(cls))
    model.save(tmp_path / "model")
    other = build(cls, seed=1)
    other.set_parameters(str(tmp_path / "model"), device="cpu")
    assert same_predictions(model, other)


@every_class
@pytest.mark.parametrize("kind", ["path", "bytes"])
def test_the_replay_buffer_comes_back(cls, kind, tmp_path):
    model = learn(build(cls), 23)
    place = tmp_path / "buffer" if kind == "path" else io.BytesIO()
    model.save_replay_buffer(place)
    if kind == "bytes":
        place.seek(0)
    before = model.replay_buffer
    other = build(cls)
    other.load_replay_buffer(place)
    assert other.replay_buffer.size() == before.size() == 23
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(other.replay_buffer, name), getattr(before, name))
    learn(other, 10)
    assert other.replay_buffer.size() == 33


@every_class
def test_the_policy_saves_alone(cls, tmp_path):
    model = learn(build(cls))
    model.policy.save(tmp_path / "policy")
    policy = SACPolicy.load(tmp_path / "policy", device="cpu")
    np.testing.assert_array_equal(
        policy.predict(observations(), deterministic=True)[0], model.predict(observations(), deterministic=True)[0]
    )


@every_class
def test_buffers_are_of_the_users_class(cls):
    class MyBuffer(ReplayBuffer):
        pass

    model = learn(build(cls, replay_buffer_class=MyBuffer, replay_buffer_kwargs={"handle_timeout_termination": False}))
    sides = [model.replay_buffer] if cls is SAC else [model.replay_buffer.source, model.replay_buffer.target]
    assert all(type(side) is MyBuffer and not side.handle_timeout_termination for side in sides)
    assert model.replay_buffer_class is MyBuffer


# ---------------------------------------------------------------------- callbacks


@every_class
def test_callbacks_fire_once_a_step_in_order(cls):
    events = []

    class Watch(BaseCallback):
        def _on_training_start(self):
            events.append("start")

        def _on_rollout_start(self):
            events.append("rollout")

        def _on_step(self):
            events.append(self.num_timesteps)
            assert self.locals["new_obs"].shape == (1, 2)
            assert self.locals["rewards"].shape == self.locals["dones"].shape == (1,)
            assert isinstance(self.locals["infos"][0], dict)
            assert self.model.num_timesteps == self.num_timesteps == self.n_calls
            return True

        def _on_rollout_end(self):
            events.append("end of rollout")

        def _on_training_end(self):
            events.append("end")

    learn(build(cls, train_freq=2), 4, callback=[Watch()])
    assert events == ["start", "rollout", 1, 2, "end of rollout", "rollout", 3, 4, "end of rollout", "end"]


@every_class
def test_functions_are_callbacks(cls):
    calls = []

    def stop_at_seven(local_variables, global_variables):
        calls.append(local_variables["self"].num_timesteps)
        return len(calls) < 7

    model = learn(build(cls), 50, callback=stop_at_seven)
    assert calls == [1, 2, 3, 4, 5, 6, 7]
    assert model.num_timesteps == 7


@every_class
def test_eval_callback(cls, tmp_path):
    best = Record(lambda model: model.num_timesteps)
    evaluation = EvalCallback(
        Monitor(windy()),
        callback_on_new_best=best,
        n_eval_episodes=2,
        eval_freq=10,
        log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
        verbose=0,
    )
    model = learn(build(cls), 30, callback=evaluation)
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [10, 20, 30]
        assert file["results"].shape == (3, 2)
        assert (file["ep_lengths"] == EPISODE).all()
        assert evaluation.best_mean_reward == file["results"].mean(axis=1).max()
    assert best.seen[0] == 10
    saved = load(cls, tmp_path / "best_model")
    assert saved.num_timesteps in (10, 20, 30)
    assert model.num_timesteps == 30
    assert evaluation.last_mean_reward < 0


@every_class
def test_evaluation_can_stop_the_run(cls):
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e6, verbose=0)
    evaluation = EvalCallback(Monitor(windy()), callback_on_new_best=stop, n_eval_episodes=1, eval_freq=5, verbose=0)
    assert learn(build(cls), 50, callback=evaluation).num_timesteps == 5
    patience = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=0, verbose=0)
    evaluation = EvalCallback(Monitor(windy()), callback_after_eval=patience, n_eval_episodes=1, eval_freq=5, verbose=0)
    evaluation.best_mean_reward = 0.0
    assert learn(build(cls), 50, callback=evaluation).num_timesteps < 50


@every_class
def test_events_and_episodes(cls):
    watch = Record(lambda model: model.num_timesteps)
    learn(build(cls), 25, callback=CallbackList([EveryNTimesteps(10, watch)]))
    assert watch.seen == [10, 20]
    assert learn(build(cls), 100, callback=StopTrainingOnMaxEpisodes(3)).num_timesteps == 3 * EPISODE


@ours
def test_max_episodes_are_the_targets(cls):
    """SB3 multiplies by the environments of ``get_env()``, which is the source."""
    stop = StopTrainingOnMaxEpisodes(2)
    assert learn(build(cls, make_vec_env(Drift, n_envs=3)), 100, callback=stop).num_timesteps == 2 * EPISODE
    stop = StopTrainingOnMaxEpisodes(2)
    model = build(cls, target=make_vec_env(windy, n_envs=2))
    assert learn(model, 100, callback=[stop]).num_timesteps == 2 * 2 * EPISODE


@every_class
def test_log_every_n_timesteps(cls):
    steps = []
    model = build(cls)
    model.set_logger(configure(None, []))
    dump = model.logger.dump
    model.logger.dump = lambda step=0: (steps.append(step), dump(step))
    learn(model, 25, callback=LogEveryNTimesteps(10), log_interval=None)
    assert steps == [10, 20]


@every_class
def test_checkpoints(cls, tmp_path):
    env = VecNormalize(make_vec_env(Drift))
    save = CheckpointCallback(10, str(tmp_path), name_prefix="run", save_replay_buffer=True, save_vecnormalize=True)
    model = learn(build(cls, env), 20, callback=save)
    assert {file.name for file in tmp_path.iterdir()} == {
        f"run_{kind}{n}_steps.{suffix}"
        for n in (10, 20)
        for kind, suffix in (("", "zip"), ("replay_buffer_", "pkl"), ("vecnormalize_", "pkl"))
    }
    statistics = VecNormalize.load(str(tmp_path / "run_vecnormalize_20_steps.pkl"), make_vec_env(Drift))
    assert statistics.training  # it is the source's, which goes on learning
    np.testing.assert_allclose(statistics.obs_rms.mean, env.obs_rms.mean, atol=0.2)
    resumed = load(cls, tmp_path / "run_10_steps", statistics, windy())
    resumed.load_replay_buffer(tmp_path / "run_replay_buffer_10_steps")
    assert resumed.replay_buffer.size() == 9  # SB3 saves before it stores the tenth
    learn(resumed, 10, reset_num_timesteps=False)
    assert resumed.num_timesteps == model.num_timesteps == 20


def physics_hold(buffer) -> bool:
    """Whether every stored transition is one that ``windy`` makes."""
    n = buffer.size()
    moved = buffer.next_observations[:n, 0] - buffer.observations[:n, 0]
    return np.allclose(moved, 0.1 * buffer.actions[:n, 0] + 0.05, atol=1e-5)


class Restorable(Drift):
    """The wind with a state that can be saved."""

    def __init__(self, wind: float = 0.05):
        super().__init__(wind)

    def get_state(self):
        return self.place.copy(), self.steps

    def set_state(self, state):
        self.place, self.steps = state[0].copy(), state[1]


@pytest.mark.slow
@ours
@pytest.mark.parametrize("saved_at", [14, 20])
@pytest.mark.parametrize("normalise", [False, True])
def test_a_callbacks_checkpoint_resumes_as_if_never_stopped(cls, normalise, saved_at, tmp_path):
    """SB3 calls the callback between the step and its storing; the twentieth step also ends an episode."""

    def source():
        return VecNormalize(make_vec_env(lambda: Restorable(0.0), seed=0)) if normalise else Restorable(0.0)

    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2))
    env = source()
    statistics = CheckpointCallback(saved_at, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True)
    unbroken = learn(build(cls, env, Restorable(), action_noise=noise), 34, callback=statistics)
    env = source()
    if normalise:
        env = VecNormalize.load(str(tmp_path / f"rl_model_vecnormalize_{saved_at}_steps.pkl"), env.venv)
    resumed = load(cls, tmp_path / f"rl_model_{saved_at}_steps", env, Restorable())
    resumed.load_replay_buffer(tmp_path / f"rl_model_replay_buffer_{saved_at}_steps")
    learn(resumed, 34 - saved_at, reset_num_timesteps=False)
    assert resumed.num_timesteps == resumed.replay_buffer.size() == 34
    assert resumed.target_spent == {"learning": 34}
    assert resumed.state == unbroken.state
    for name in ("_n_updates", "_episode_num"):
        assert getattr(resumed, name) == getattr(unbroken, name), name
    for side in ("source", "target"):
        for name in ("observations", "next_observations", "actions", "rewards"):
            one, other = (getattr(getattr(model.replay_buffer, side), name) for model in (resumed, unbroken))
            np.testing.assert_array_equal(one, other, err_msg=f"{side} {name}")
    assert physics_hold(resumed.replay_buffer.target)
    for name, value in unbroken.policy.state_dict().items():
        assert th.equal(value, resumed.policy.state_dict()[name]), name


@ours
@pytest.mark.parametrize("train_freq", [4, (1, "episode")])
def test_a_checkpoint_inside_a_longer_rollout_keeps_every_transition_and_update(cls, train_freq, tmp_path):
    settings = {"train_freq": train_freq, "gradient_steps": -1}
    save = CheckpointCallback(14, str(tmp_path), save_replay_buffer=True)
    learn(build(cls, Restorable(0.0), Restorable(), **settings), 20, callback=save)
    resumed = load(cls, tmp_path / "rl_model_14_steps", Restorable(0.0), Restorable())
    resumed.load_replay_buffer(tmp_path / "rl_model_replay_buffer_14_steps")
    learn(resumed, 20, reset_num_timesteps=False)
    assert resumed.num_timesteps == resumed.replay_buffer.size() == resumed._n_updates == 34
    assert physics_hold(resumed.replay_buffer.target)


@ours
def test_a_stopped_run_keeps_its_last_step_and_goes_on(cls):
    model = build(cls)
    learn(model, 50, callback=lambda local, _: local["self"].num_timesteps < 7)
    assert model.replay_buffer.size() == model.num_timesteps == 7
    learn(model, 12, reset_num_timesteps=False)
    assert model.replay_buffer.size() == model.num_timesteps == 19
    assert physics_hold(model.replay_buffer.target)


@every_class
@pytest.mark.parametrize("as_callback", [False, True])
def test_progress_bar_advances_by_the_steps_that_count(cls, as_callback, monkeypatch):
    bars = fake_bars(monkeypatch)
    progress = {"callback": ProgressBarCallback()} if as_callback else {"progress_bar": True}
    model = learn(build(cls), 30, **progress)
    assert [(bar.total, bar.n) for bar in bars] == [(30, 30)]
    learn(model, 12, reset_num_timesteps=False, progress_bar=True)
    assert (bars[-1].total, bars[-1].n) == (12, 12)


@ours
@pytest.mark.parametrize(("n_source", "n_target"), [(3, 1), (1, 2), (2, 3)])
def test_progress_bar_counts_target_steps_alone(cls, n_source, n_target, monkeypatch):
    bars = fake_bars(monkeypatch)
    model = build(cls, make_vec_env(Drift, n_envs=n_source), make_vec_env(windy, n_envs=n_target))
    learn(model, 30, progress_bar=True)
    assert [(bar.total, bar.n) for bar in bars] == [(30, 30)]


def fake_bars(monkeypatch):
    """SB3's ``tqdm`` replaced by one that only counts."""
    bars = []

    def bar(total, **kwargs):
        fake = types.SimpleNamespace(total=total, n=0, refresh=lambda: None, close=lambda: None)
        fake.update = lambda n: setattr(fake, "n", fake.n + n)
        bars.append(fake)
        return fake

    monkeypatch.setattr("stable_baselines3.common.callbacks.tqdm", bar)
    return bars


# ---------------------------------------------------------------------- learning in pieces


@every_class
def test_learning_again_counts_on_or_starts_over(cls):
    model = learn(build(cls), 20)
    assert model.num_timesteps == 20
    learn(model, 15, reset_num_timesteps=False)
    assert (model.num_timesteps, model._total_timesteps) == (35, 35)
    learn(model, 12)
    assert model.num_timesteps == 12
    assert model.replay_buffer.size() == 47


@every_class
def test_consecutive_learning_does_not_cut_the_episode(cls):
    model = build(cls)
    for _ in range(5):
        learn(model, 4, reset_num_timesteps=False)
    assert [episode["l"] for episode in model.ep_info_buffer] == [EPISODE, EPISODE]
    assert model._episode_num == 2


@every_class
def test_getters(cls):
    env = make_vec_env(Drift, n_envs=2)
    model = build(cls, env)
    assert model.get_env() is env
    assert model.get_vec_normalize_env() is None
    normalised = VecNormalize(make_vec_env(Drift, n_envs=2))
    model = build(cls, normalised)
    assert model.get_env() is model.get_vec_normalize_env() is normalised
    watch = Record(lambda model: model.get_vec_normalize_env() is normalised)
    learn(model, 10, callback=watch)
    assert all(watch.seen)
    assert model.get_vec_normalize_env() is normalised


# ---------------------------------------------------------------------- logging


@every_class
def test_a_logger_of_the_users(cls, tmp_path):
    model = build(cls)
    logger = configure(str(tmp_path), ["csv", "json"])
    model.set_logger(logger)
    learn(model, 40, log_interval=1)
    assert model.logger is logger
    logger.close()
    with (tmp_path / "progress.json").open() as file:
        rows = [json.loads(line) for line in file]
    rows = [row for row in rows if "time/total_timesteps" in row]
    assert [row["time/total_timesteps"] for row in rows] == [10, 20, 30, 40]
    assert all(row["rollout/ep_len_mean"] == EPISODE for row in rows)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0]
    assert {"train/critic_loss", "train/n_updates", "rollout/ep_rew_mean"} <= set(header.split(","))


@every_class
def test_the_logged_values_are_sacs(cls):
    model = build(cls, learning_starts=0)
    model.set_logger(configure(None, []))
    learn(model, 40, log_interval=1000)
    logged = model.logger.name_to_value
    assert {"train/n_updates", "train/ent_coef", "train/critic_loss", "train/learning_rate"} <= logged.keys()
    assert logged["train/n_updates"] == 40
    if getattr(cls, "updates_policy", True):
        assert {"train/actor_loss", "train/ent_coef_loss"} <= logged.keys()
        assert logged["train/ent_coef"] > model.log_ent_coef.exp().item()  # of the update, before its own step
    else:
        assert not {"train/actor_loss", "train/ent_coef_loss"} & logged.keys()


@every_class
def test_tensorboard_holds_returns_against_steps(cls, tmp_path):
    model = learn(build(cls, tensorboard_log=str(tmp_path)), 40, log_interval=1)
    learn(model, 20, log_interval=1, tb_log_name="named")
    learn(model, 20, log_interval=1, tb_log_name="named", reset_num_timesteps=False)
    learn(model, 10, tb_log_name="named")
    folders = {folder.name for folder in pathlib.Path(tmp_path).iterdir()}
    assert folders == {f"{cls.__name__}_1", "named_1", "named_2"}
    events = EventAccumulator(str(tmp_path / f"{cls.__name__}_1")).Reload()
    returns = events.Scalars("rollout/ep_rew_mean")
    assert [event.step for event in returns] == [10, 20, 30, 40]
    assert all(event.value < 0 for event in returns)
    assert {"rollout/ep_len_mean", "time/fps", "train/critic_loss"} <= set(events.Tags()["scalars"])
    continued = EventAccumulator(str(tmp_path / "named_1")).Reload()
    assert sorted(event.step for event in continued.Scalars("rollout/ep_rew_mean")) == [10, 20, 30, 40]


@every_class
def test_success_rate(cls):
    class Succeeds(Drift):
        def step(self, action):
            *answer, _ = super().step(action)
            return *answer, {"is_success": True}

    model = build(cls, Succeeds(), Succeeds(0.05))
    logged = []
    model.set_logger(configure(None, []))
    record = model.logger.record
    model.logger.record = lambda key, value, **kwargs: (logged.append((key, value)), record(key, value, **kwargs))
    learn(model, 25, log_interval=2)
    assert list(model.ep_success_buffer) == [True, True]
    assert ("rollout/success_rate", 1.0) in logged


# ---------------------------------------------------------------------- environments


@every_class
@pytest.mark.parametrize("kwargs", [{"norm_reward": False}, {"norm_obs": False}, {"gamma": 0.9, "clip_obs": 2.0}])
def test_vec_normalize(cls, kwargs):
    env = VecNormalize(make_vec_env(Drift, n_envs=2), **kwargs)
    evaluated = VecNormalize(make_vec_env(windy), training=False, **kwargs)
    evaluation = EvalCallback(evaluated, eval_freq=10, n_eval_episodes=1, verbose=0)
    model = learn(build(cls, env), 30, callback=evaluation)
    assert env.training
    if env.norm_obs:
        assert env.obs_rms.count > 20
        assert evaluated.obs_rms is not env.obs_rms  # EvalCallback copies
        assert evaluated.obs_rms.count > 1
    assert env.ret_rms.count > 20
    env.training = env.norm_reward = False
    assert np.isfinite(evaluate_policy(model, env, n_eval_episodes=2)[0])


@every_class
def test_stored_data_are_raw_and_sampled_normalised(cls):
    env = VecNormalize(make_vec_env(lambda: Drift(1.0)))
    model = learn(build(cls, env, Drift(1.1)), 50)
    stored = model.replay_buffer.observations[: model.replay_buffer.size()]
    assert stored.max() > 6
    seen = model.replay_buffer.sample(200, env=model.get_vec_normalize_env()).observations
    assert abs(seen.mean()) < 1.5
    assert acting_env(model).obs_rms is env.obs_rms


@every_class
@pytest.mark.parametrize("wrap", [DummyVecEnv, VecMonitor], ids=["dummy", "vecmonitor"])
def test_kinds_of_vector_environments(cls, wrap):
    def several(make):
        venv = DummyVecEnv([make, make])
        return venv if wrap is DummyVecEnv else VecMonitor(venv)

    model = learn(build(cls, several(Drift), several(windy)), 40)
    assert model.num_timesteps == 40
    assert len(model.ep_info_buffer) == (0 if wrap is DummyVecEnv else 4)


@every_class
def test_environments_in_other_processes(cls):
    env = SubprocVecEnv([Drift, Drift], start_method="fork")  # quick to start
    target = SubprocVecEnv([windy], start_method="fork")
    try:
        model = learn(build(cls, env, target), 20)
        assert model.num_timesteps == 20
        assert model.get_env() is env
    finally:
        env.close()
        target.close()


@every_class
def test_plain_environments_are_monitored(cls, tmp_path):
    env, target = Monitor(Drift(), str(tmp_path / "source")), Monitor(windy(), str(tmp_path / "target"))
    learn(build(cls, env, target), 30)
    acted = env if cls is SAC else target
    assert acted.get_episode_lengths() == [EPISODE] * 3
    model = learn(build(cls), 30)
    assert [episode["l"] for episode in model.ep_info_buffer] == [EPISODE] * 3


@every_class
@pytest.mark.parametrize(
    ("low", "high", "dtype"), [(0.0, 2.0, np.float32), (-1.0, 3.0, np.float64), ([-3, 0], [1, 0.5], np.float32)]
)
def test_action_bounds(cls, low, high, dtype):
    """The environment receives actions in its bounds, the buffer keeps them in [-1, 1]."""
    space = spaces.Box(np.broadcast_to(low, 2).astype(dtype), np.broadcast_to(high, 2).astype(dtype), dtype=dtype)
    env, target = Drift(action_space=space), windy(action_space=space)
    model = learn(build(cls, env, target), 30)
    acted = env if cls is SAC else target
    received = np.array(acted.received)
    for actions in (received, np.array(env.received)):
        assert (actions >= space.low - 1e-6).all()
        assert (actions <= space.high + 1e-6).all()
    scaled = 2 * (received - space.low) / (space.high - space.low) - 1
    np.testing.assert_allclose(model.replay_buffer.actions[:30, 0], scaled, atol=1e-5)
    assert received.std() > 0


@every_class
def test_float64_observations(cls):
    model = learn(build(cls, Drift(dtype=np.float64), windy(dtype=np.float64)), 30)
    assert model.replay_buffer.observations.dtype == np.float64
    assert np.isfinite(model.predict(np.zeros(2))[0]).all()


@every_class
def test_time_limits_are_not_terminal(cls):
    model = learn(build(cls), 30)
    buffer = model.replay_buffer
    assert buffer.dones[:30].sum() == buffer.timeouts[:30].sum() == 3
    assert buffer.sample(100).dones.sum() == 0
    last = EPISODE - 1
    assert not np.allclose(buffer.next_observations[last, 0], buffer.observations[last + 1, 0])


@every_class
def test_unbounded_actions_are_refused(cls):
    endless = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        build(cls, Drift(action_space=endless), windy(action_space=endless))


class Spaces(gym.Env):
    """Any spaces at all."""

    def __init__(self, observation_space=None, action_space=BOX):
        self.observation_space = observation_space or spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


FLAT = spaces.Box(-1, 1, (2,), np.float32)


@ours
@pytest.mark.parametrize(
    "refused",
    [
        {"env": Spaces(spaces.Dict({"a": FLAT})), "policy": "MultiInputPolicy"},
        {"env": Spaces(spaces.Dict({"observation": FLAT, "achieved_goal": FLAT, "desired_goal": FLAT}))},
        {"env": Spaces(spaces.Box(0, 255, (36, 36, 3), np.uint8)), "policy": "CnnPolicy"},
        {"env": Spaces(spaces.Box(-1, 1, (2, 3), np.float32))},
        {"env": Spaces(spaces.Discrete(3))},
        {"env": Spaces(spaces.MultiBinary(3))},
        {"env": Spaces(action_space=spaces.Discrete(3))},
        {"env": Spaces(action_space=spaces.MultiDiscrete([3, 3]))},
        {"env": Spaces(action_space=spaces.MultiBinary(3))},
        {"n_steps": 3},
        {"optimize_memory_usage": True},
        {"replay_buffer_class": HerReplayBuffer},
        {"replay_buffer_class": DictReplayBuffer},
        {"replay_buffer_class": NStepReplayBuffer},
    ],
    ids=lambda refused: "-".join(str(getattr(value, "observation_space", value)) for value in refused.values())[:40],
)
def test_what_is_not_supported_is_refused_at_construction(cls, refused):
    with pytest.raises(NotImplementedError):
        build(cls, **refused)


# ---------------------------------------------------------------------- modes of the networks


class Normalising(BaseFeaturesExtractor):
    """Features with batch normalisation and dropout."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=4)
        self.layers = th.nn.Sequential(
            th.nn.Linear(2, 4, bias=False), th.nn.BatchNorm1d(4, momentum=0.5), th.nn.Dropout(0.5)
        )

    def forward(self, seen):
        return self.layers(seen)


def batch_norm(network):
    return network.features_extractor.layers[1]


@every_class
def test_batch_statistics_and_dropout_belong_to_training(cls):
    settings = {"policy_kwargs": {"net_arch": [8], "features_extractor_class": Normalising}, "learning_starts": 0}
    model = build(cls, **settings)
    learn(model, 10)
    modes = Record(lambda model: (model.actor.training, model.critic.training, model.critic_target.training))
    learn(model, 10, callback=modes)
    assert set(modes.seen) == {(False, False, False)}
    critic, target = batch_norm(model.critic), batch_norm(model.critic_target)
    assert th.equal(critic.running_mean, target.running_mean)
    assert th.equal(critic.running_var, target.running_var)
    assert critic.num_batches_tracked > 0
    before = [batch_norm(net).running_mean.clone() for net in (model.actor, model.critic, model.critic_target)]
    model.predict(observations())
    evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    after = [batch_norm(net).running_mean for net in (model.actor, model.critic, model.critic_target)]
    assert all(th.equal(a, b) for a, b in zip(before, after))
    assert same_predictions(model, model)  # dropout is off
    model.train(1, 8)
    assert model.actor.training == (cls is not RTO)  # which leaves the policy as it is
    assert not th.equal(before[1], batch_norm(model.critic).running_mean)


@ours
def test_weighing_transitions_leaves_the_networks_statistics(cls):
    """Values for RTO's weights, and branches of the model, are not training."""
    settings = {"policy_kwargs": {"net_arch": [8], "features_extractor_class": Normalising}}
    model = learn(build(cls, **settings), 20)
    model.train(1, 8)
    before = batch_norm(model.actor).running_mean.clone()
    model.state.steps_since_fit = 1000
    model.update_dynamics()
    model.collect_source()
    assert th.equal(before, batch_norm(model.actor).running_mean)


# ---------------------------------------------------------------------- files of other algorithms


def test_files_of_another_algorithm_are_refused_in_words(tmp_path):
    build(SAC).save(tmp_path / "sac")
    for cls in ALGORITHMS:
        with pytest.raises(ValueError, match="from_source"):
            cls.load(tmp_path / "sac", env=Drift(), target_env=windy())
    for saved, loading in ((RPO, RPTO), (RPTO, RPO)):
        learn(build(saved), 5).save(tmp_path / "model")
        with pytest.raises(ValueError, match=saved.__name__):
            loading.load(tmp_path / "model")


@ours
def test_a_replay_buffer_of_sac_is_refused_in_words(cls, tmp_path):
    learn(build(SAC), 10).save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match="source_data"):
        build(cls).load_replay_buffer(tmp_path / "buffer")
