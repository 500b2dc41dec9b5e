"""Algorithm 1's bookkeeping: budgets, worlds, checks, logs."""

import csv
import json
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ALGORITHMS, OURS, PHI_0_STEPS, SMALL_ENSEMBLE, pendulum, small
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rpto import RPO, RPTO, RTO
from sb3_rpto.algorithms import pretraining
from sb3_rpto.buffers import chronological


class CountingPendulum(gym.Wrapper):
    """Counts its own steps, whoever takes them."""

    steps = 0

    def step(self, action):
        self.steps += 1
        return super().step(action)


@pytest.mark.parametrize("cls", OURS)
def test_exactly_the_budget_is_spent_in_the_target(cls):
    target = CountingPendulum(pendulum(12.0))
    model = small(cls, target=target)
    model.learn(77, source_timesteps=20)
    assert target.steps == model.num_timesteps == model.replay_buffer.size() == 77
    assert model.target_spent == {"learning": 77}
    model.learn(23, reset_num_timesteps=False)
    assert target.steps == model.num_timesteps == 100
    assert model.source_timesteps > 77 * 8


@pytest.mark.parametrize(("train_freq", "n_envs", "budget", "spent"), [(10, 1, 25, 25), (3, 4, 50, 48), (1, 3, 10, 9)])
def test_the_budget_is_never_exceeded(train_freq, n_envs, budget, spent):
    targets = [CountingPendulum(pendulum(12.0)) for _ in range(n_envs)]
    vec = DummyVecEnv([lambda env=env: Monitor(env) for env in targets])
    model = small(RPO, target=vec, train_freq=train_freq)
    model.learn(budget, source_timesteps=0)
    assert sum(env.steps for env in targets) == model.num_timesteps == spent


def test_updates_are_counted_per_target_step():
    for gradient_steps, train_freq, expected in ((3, 1, 60), (2, 10, 40), (-1, 10, 20), (0, 1, 0)):
        model = small(RPO, gradient_steps=gradient_steps, train_freq=train_freq)
        model.learn(20, source_timesteps=0)
        assert model._n_updates == expected


def test_episodic_training_updates_between_episodes_only():
    class Watch(BaseCallback):
        def _on_step(self):
            self.updates_during_episodes = self.model._n_updates
            return True

    watch = Watch()
    model = small(RPO, train_freq=(1, "episode"), gradient_steps=-1)
    model.learn(250, callback=watch, source_timesteps=0)  # episodes take 200 steps, the budget ends in the second
    assert watch.updates_during_episodes == 200
    assert model._n_updates == 250


def test_no_random_action_in_the_target():
    """A policy that always pushes right must be seen from the first target step, whatever learning_starts says."""
    model = small(RPO, learning_starts=1000)
    for parameter in model.actor.mu.parameters():
        parameter.data.zero_()
    model.actor.mu.bias.data.fill_(10.0)
    model.actor.log_std.bias.data.fill_(-20.0)
    model.actor.log_std.weight.data.zero_()
    model.gradient_steps = 0
    model.learn(30, source_timesteps=0)
    assert chronological(model.replay_buffer.target)["actions"].min() > 0.99


@pytest.mark.parametrize("cls", OURS)
def test_a_fresh_model_trains_in_the_source_first_and_once(cls):
    calls = []

    class Count(BaseCallback):
        def _on_step(self):
            calls.append(self.num_timesteps)
            return True

    target = CountingPendulum(pendulum(12.0))
    model = small(cls, target=target)
    model.learn(10, callback=Count(), source_timesteps=150)
    assert model.state.pretraining_timesteps == 150
    assert calls == list(range(1, 11))
    assert target.steps == 10
    before = model.source_timesteps
    model.learn(10, reset_num_timesteps=False, source_timesteps=150)
    assert model.source_timesteps - before == 10 * 8
    assert model.state.pretraining_timesteps == 150


def test_the_source_phase_is_plain_sac():
    """Same seed, same environment: the phase leaves the parameters that SB3's SAC has after as many steps."""
    kwargs = {"policy_kwargs": {"net_arch": [16]}, "batch_size": 32, "learning_starts": 20, "seed": 5, "device": "cpu"}
    sac = SAC("MlpPolicy", pendulum(), **kwargs).learn(60)
    model = RPO("MlpPolicy", pendulum(), target_env=pendulum(12.0), gradient_steps=0, **kwargs)
    model.learn(1, source_timesteps=60)
    for name, value in sac.policy.state_dict().items():
        np.testing.assert_allclose(model.snapshots["source"]["policy"][name], value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("cls", OURS)
def test_callbacks_can_stop(cls):
    model = small(cls)
    model.learn(1000, callback=StopTrainingOnMaxEpisodes(1), source_timesteps=0)
    assert model.num_timesteps == 200


def test_defaults_of_learn_count_target_steps():
    import inspect

    parameters = inspect.signature(RPTO.learn).parameters
    assert parameters["total_timesteps"].default == 10_000
    assert parameters["source_timesteps"].kind is inspect.Parameter.KEYWORD_ONLY


def test_the_signature_is_sacs_then_ours():
    import inspect

    sac = inspect.signature(SAC.__init__).parameters
    for cls in ALGORITHMS:
        ours = inspect.signature(cls.__init__).parameters
        assert list(ours)[: len(sac)] == list(sac)
        for name, parameter in sac.items():
            assert ours[name].default == parameter.default, name
        assert all(ours[name].kind is inspect.Parameter.KEYWORD_ONLY for name in list(ours)[len(sac) :])


@pytest.mark.slow
def test_logged_keys_are_those_of_the_docs():
    model = small(RPTO, model_train_freq=100)
    model.set_logger(configure(None, []))
    seen = set()
    dump = model.logger.dump

    def keep(step=0):
        seen.update(model.logger.name_to_value)
        dump(step)

    model.logger.dump = keep
    model.learn(450, source_timesteps=100, log_interval=1)
    expected = {
        *("rollout/ep_rew_mean", "rollout/ep_len_mean", "time/episodes", "time/fps", "time/total_timesteps"),
        *("time/source_timesteps", "train/actor_loss", "train/critic_loss", "train/ent_coef", "train/ent_coef_loss"),
        *("dynamics/error", "dynamics/error_before", "rto/effective_samples", "pretrain/timesteps"),
    }
    assert expected <= seen
    assert all(len(key) <= 33 and key == key.lower() for key in seen)


def test_every_row_of_a_log_tells_its_target_steps(tmp_path):
    """Readers of progress files, such as SB3's plots, draw all else against them; the source phase takes none."""
    model = small(RPTO, target=gym.make("Pendulum-v1", g=12.0, max_episode_steps=20), model_train_freq=30)
    model.set_logger(configure(str(tmp_path), ["json", "csv"]))
    model.learn(60, source_timesteps=110, log_interval=1)
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    steps = [row["time/total_timesteps"] for row in rows]
    phase = [row for row in rows if "pretrain/timesteps" in row]
    assert len(phase) == 10
    assert steps == [0] * len(phase) + [20, 40, 60]
    with open(tmp_path / "progress.csv") as file:
        assert [float(row["time/total_timesteps"]) for row in csv.DictReader(file)] == steps


@pytest.mark.parametrize("cls", OURS)
def test_a_target_equal_to_the_source_is_noticed_without_a_step(cls):
    target = CountingPendulum(pendulum())
    env = gym.make("Pendulum-v1", g=10.0)
    with pytest.warns(UserWarning, match="exactly like env"):
        small(cls, env, pendulum()).learn(30, source_timesteps=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small(RPO, env, pendulum(10.01)).learn(30, source_timesteps=0)
    model = small(RPO, env, target)
    model.learn(30, source_timesteps=0)
    assert target.steps == 30


def test_sides_of_data_hold_what_their_world_does():
    """g = 0 and no torque effect in the source: its transitions differ visibly from the target's."""
    model = small(RPO, pendulum(0.001), pendulum(20.0))
    model.learn(60, source_timesteps=0)

    def gravity(arrays):  # thdot' = thdot + (3g/2 sin th + 3u) dt
        sin, speed = arrays["observations"][:, 1], arrays["observations"][:, 2]
        torque = 2 * arrays["actions"][:, 0]
        keep = (np.abs(sin) > 0.3) & (np.abs(arrays["next_observations"][:, 2]) < 7.9)
        g = ((arrays["next_observations"][:, 2] - speed) / 0.05 - 3 * torque) / (1.5 * sin)
        return np.median(g[keep])

    assert gravity(chronological(model.replay_buffer.source)) == pytest.approx(0.0, abs=0.1)
    assert gravity(chronological(model.replay_buffer.target)) == pytest.approx(20.0, abs=0.1)


def test_vec_normalize_statistics_are_the_sources_alone():
    source = VecNormalize(make_vec_env(pendulum, n_envs=2, seed=0))
    model = small(RPTO, source, pendulum(12.0))
    model.learn(40, source_timesteps=60)
    shared = model.target_env
    assert shared.obs_rms is source.obs_rms
    assert not shared.training
    counted = source.obs_rms.count
    # what phi_0 is fitted to, the source phase's steps among it
    assert counted == pytest.approx(PHI_0_STEPS + 3 * 2, abs=12)
    speeds = chronological(model.replay_buffer.target)["observations"][:, :2]
    np.testing.assert_allclose((speeds**2).sum(1), 1.0, atol=1e-5)  # cos, sin: stored raw
    model.set_env(VecNormalize(make_vec_env(pendulum, n_envs=2, seed=1)))
    assert model.target_env.obs_rms is model.env.obs_rms is not source.obs_rms


@pytest.mark.parametrize(("budget", "steps"), [(7, 70), (30_001, 300_000)])
def test_the_source_phase_is_ten_times_the_budget_and_has_an_end(budget, steps, monkeypatch):
    asked = []

    def stop(self, source_timesteps, progress_bar):
        asked.append(source_timesteps)
        raise KeyboardInterrupt

    monkeypatch.setattr(RPO, "prepare_in_source", stop)
    with pytest.raises(KeyboardInterrupt):
        small(RPO).learn(budget)
    assert asked == [steps]


@pytest.mark.parametrize("cls", OURS)
def test_several_source_environments(cls):
    model = small(cls, make_vec_env(pendulum, n_envs=3, seed=0), pendulum(12.0))
    model.learn(30, source_timesteps=60)
    assert model.num_timesteps == 30
    assert model.get_env().num_envs == 3
    if cls is RPO:  # the others' source is the model
        seen, then = (getattr(model.replay_buffer.source, n)[:60, 0] for n in ("observations", "next_observations"))
        np.testing.assert_array_equal(seen[3:], then[:-3])  # the source phase's, side by side
        assert (seen[1:] != seen[:-1]).any(axis=1).all()


class Better(gym.Wrapper):
    """Each episode of five steps earns one more a step than the one before, or one less."""

    def __init__(self, by):
        super().__init__(gym.make("Pendulum-v1", g=12.0, max_episode_steps=5))
        self.by, self.episodes = by, 0

    def reset(self, **kwargs):
        self.episodes += 1
        return super().reset(**kwargs)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(self.by * self.episodes), *rest


@pytest.mark.parametrize(("by", "best"), [(1, 5 * (4 + 5 + 6 + 7 + 8) / 5), (-1, -5 * (1 + 2 + 3 + 4 + 5) / 5)])
def test_the_newest_episodes_judge(by, best):
    model = small(RPO, target=Better(by)).learn(40, source_timesteps=0)
    assert model.snapshots.best_mean_reward == pytest.approx(best)


def test_the_worlds_have_starts_of_their_own():
    model = small(RPO)
    source, target = model.env.reset(), model.target_env.reset()
    assert not np.isclose(source, target).any()
    np.testing.assert_array_equal(target[0], pendulum().reset(seed=10_000)[0])


def test_the_best_policy_is_kept_and_can_be_brought_back():
    model = small(RPO, target=gym.make("Pendulum-v1", g=12.0, max_episode_steps=20))
    model.learn(120, source_timesteps=0)
    assert set(model.snapshots) == {"source", "best"}
    assert np.isfinite(model.snapshots.best_mean_reward)
    now = model.predict(np.ones(3), deterministic=True)[0]
    assert model.temperature() != 1.0
    model.rollback("source")
    assert model.temperature() == 1.0
    source = model.predict(np.ones(3), deterministic=True)[0]
    assert not np.allclose(now, source)
    fresh = small(RPO)
    np.testing.assert_allclose(source, fresh.predict(np.ones(3), deterministic=True)[0])
    with pytest.raises(ValueError, match="best"):
        fresh.rollback("best")


class NaNAt(gym.Wrapper):
    """Answers NaN at one step."""

    def __init__(self, env, at):
        super().__init__(env)
        self.at, self.count = at, 0

    def step(self, action):
        obs, reward, *rest = super().step(action)
        self.count += 1
        return (obs * np.nan if self.count == self.at else obs), reward, *rest


class NoSeed(gym.Env):
    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self):
        return np.zeros(3, np.float32), {}


class DictEnv(gym.Env):
    observation_space = spaces.Dict({"a": spaces.Box(-1, 1, (3,))})
    action_space = spaces.Box(-1, 1, (1,))


def test_bad_input_is_refused_at_construction():
    env = pendulum()
    with pytest.raises(ValueError, match="target_env is env"):
        small(RPTO, env, env)
    with pytest.raises(ValueError, match="observation_space"):
        small(RPO, env, gym.make("MountainCarContinuous-v0"))
    with pytest.raises(ValueError, match=r"env: reset\(\) .* takes no seed"):
        small(RPO, NoSeed())
    with pytest.raises(NotImplementedError, match="FlattenObservation"):
        small(RPO, DictEnv())
    with pytest.raises(NotImplementedError, match="continuous"):
        small(RPO, gym.make("CartPole-v1"))
    with pytest.raises(NotImplementedError, match="n_steps"):
        small(RPO, n_steps=3)
    with pytest.raises(ValueError, match="preset='papre'"):
        small(RPTO, preset="papre")
    with pytest.raises(ValueError, match="weighting"):
        small(RPTO, weighting="centered")
    with pytest.raises(ValueError, match="rollout_start"):
        small(RPTO, rollout_start="middle")
    with pytest.raises(ValueError, match="dynamics"):
        RPTO("MlpPolicy", env, dynamics="gp")
    with pytest.raises(ValueError, match="batch_size"):
        small(RPO, batch_size=0)
    with pytest.raises(ValueError, match="buffer_size"):
        small(RPO, buffer_size=0)
    with pytest.raises(ValueError, match="dynamics_kwargs"):
        small(RPTO, dynamics_kwargs={"foo": 1})
    with pytest.raises(ValueError, match="dynamics='ensemble'"):
        small(RPTO, dynamics="physical")
    with pytest.raises(ValueError, match="real_ratio"):
        small(RPTO, real_ratio=1.5)
    for floor in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="weight_floor"):
            small(RPTO, weight_floor=floor)
    for freq in (0, (0, "episode"), 1.5):
        with pytest.raises(ValueError, match="train_freq"):
            small(RPO, train_freq=freq)
    for size in (0, -3, 2.5):
        with pytest.raises(ValueError, match="target_size"):
            small(RPO, replay_buffer_kwargs={"target_size": size})
    with pytest.raises(ValueError, match="source_steps"):
        small(RPTO, source_steps=0)
    with pytest.raises(ValueError, match="RPO does not use"):
        RPO("MlpPolicy", env, weighting=None)
    with pytest.raises(ValueError, match="physical"):
        RPTO("MlpPolicy", env, declared=["pole_length"])
    with pytest.raises(TypeError, match="weihgting"):
        RPTO("MlpPolicy", env, weihgting=None)


def test_bad_input_is_refused_before_learning():
    with pytest.raises(ValueError, match="target_env="):
        RPO("MlpPolicy", pendulum()).learn(10)
    for budget in (0, -5, 1.5, float("nan"), True, "many"):
        with pytest.raises(ValueError, match="total_timesteps"):
            small(RPO).learn(budget)
    with pytest.raises(ValueError, match="source_timesteps"):
        small(RPO).learn(10, source_timesteps=-1)
    with pytest.raises(ValueError, match="log_interval must be a number of target episodes from 1"):
        small(RPO).learn(10, log_interval=0)
    with pytest.raises(ValueError, match="4 environments"):
        small(RPO, target=make_vec_env(pendulum, n_envs=4)).learn(3)


@pytest.mark.parametrize("world", ["source", "target"])
def test_nan_from_an_environment_names_the_world(world):
    broken, sound = NaNAt(pendulum(), 40), pendulum(12.0)
    model = small(RPO, broken, sound) if world == "source" else small(RPO, sound, broken)
    with pytest.raises(ValueError, match=f"{world} environment returned"):
        model.learn(100, source_timesteps=0)


def test_a_run_goes_on_after_a_target_step_that_was_not_finite(tmp_path):
    broken = NaNAt(pendulum(12.0), 15)
    model = small(RPO, target=broken)
    with pytest.raises(ValueError, match="target environment returned"):
        model.learn(30, source_timesteps=0)
    assert (broken.count, model.num_timesteps, model.replay_buffer.size()) == (15, 15, 14)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = RPO.load(tmp_path / "model", env=pendulum(), target_env=pendulum(12.0), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    for one in (model, loaded):  # the step is spent, its transition is not stored, a new episode begins
        one.learn(10, reset_num_timesteps=False)
        assert (one.num_timesteps, one.replay_buffer.size()) == (25, 24)
        assert np.isfinite(one.replay_buffer.target.observations[:24]).all()


def test_offline_data_stand_in_for_the_target():
    recorder = SAC("MlpPolicy", pendulum(12.0), policy_kwargs={"net_arch": [16]}, learning_starts=300, seed=0).learn(
        300
    )
    model = RPTO(
        "MlpPolicy",
        pendulum(),
        target_data=recorder.replay_buffer,
        policy_kwargs={"net_arch": [16]},
        dynamics_kwargs=SMALL_ENSEMBLE,
        model_train_freq=20,
        gradient_steps=1,
        source_steps=10,
        batch_size=32,
        seed=0,
    )
    assert model.replay_buffer.size() == 300
    fits, fit = [], model.dynamics.fit

    def watched(*args, **kwargs):
        fits.append(model._n_updates)
        return fit(*args, **kwargs)

    model.dynamics.fit = watched
    model.learn(400, source_timesteps=0)
    assert fits == [0, 1, 21]  # phi_0; then in the first round, when all data are there already; then every 20
    assert model.num_timesteps == 400
    assert model.replay_buffer.size() == 300
    assert model._n_updates == 40
    with pytest.raises(ValueError, match="RPO does not use"):
        RPO("MlpPolicy", pendulum(), target_data=recorder.replay_buffer)
    with pytest.raises(ValueError, match="exclude each other"):
        RPTO("MlpPolicy", pendulum(), target_env=pendulum(12.0), target_data=recorder.replay_buffer)


def test_a_dual_buffer_as_target_data_means_its_target_side(tmp_path):
    recorded = small(RTO).learn(60, source_timesteps=0)
    recorded.save_replay_buffer(tmp_path / "buffer.pkl")
    log = chronological(recorded.replay_buffer.target)["observations"]
    for data in (recorded.replay_buffer, tmp_path / "buffer.pkl"):
        model = RTO("MlpPolicy", pendulum(), target_data=data, dynamics_kwargs=SMALL_ENSEMBLE)
        np.testing.assert_array_equal(chronological(model.replay_buffer.target)["observations"], log)


def test_the_budget_of_source_steps_is_not_exceeded():
    data = small(RTO).learn(60, source_timesteps=0).replay_buffer
    model = RTO("MlpPolicy", pendulum(), target_data=data, dynamics_kwargs=SMALL_ENSEMBLE, source_steps=40)
    model.learn(100, source_timesteps=0)
    assert model.num_timesteps == 100


@pytest.mark.parametrize(
    ("sources", "targets", "train_freq", "budgets"),
    [
        (1, 1, 10, [45, 12]),
        (1, 4, 1, [40]),
        (8, 1, 1, [20]),
        (1, 2, 5, [44]),
        (1, 1, (1, "episode"), [45]),
    ],
)
def test_every_target_step_is_matched_with_so_many_source_steps(sources, targets, train_freq, budgets, monkeypatch):
    monkeypatch.setattr(pretraining, "FIRST_SOURCE_STEPS", 0)
    env = make_vec_env(pendulum, n_envs=sources)
    target = make_vec_env(lambda: gym.make("Pendulum-v1", g=12.0, max_episode_steps=20), n_envs=targets)
    model = small(RPO, env, target, train_freq=train_freq, source_steps=4)
    for budget in budgets:
        model.learn(budget, source_timesteps=0, reset_num_timesteps=False)
        assert model.source_timesteps == 4 * model.num_timesteps
    assert model.num_timesteps == sum(budgets)


@pytest.mark.parametrize("change", ["next_obs", "rew", "rew2d"])
def test_a_log_with_arrays_of_other_shapes_is_refused(change, tmp_path):
    arrays = {name: np.zeros((20, 3), np.float32) for name in ("obs", "next_obs")}
    arrays |= {"act": np.zeros((20, 1), np.float32), "rew": np.ones(20), "done": np.zeros(20)}
    arrays |= {
        "next_obs": {"next_obs": np.zeros((20, 2))},
        "rew": {"rew": np.ones(9)},
        "rew2d": {"rew": np.ones((20, 2))},
    }[change]
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(ValueError, match="target_data holds"):
        RTO("MlpPolicy", pendulum(), target_data=tmp_path / "log.npz", dynamics_kwargs=SMALL_ENSEMBLE)


@pytest.mark.parametrize(("argument", "data"), [("source_data", b"no zip"), ("target_data", b"")])
def test_what_holds_no_transitions_is_refused_by_the_arguments_name(argument, data, tmp_path):
    (tmp_path / "log.npz").write_bytes(data)
    worlds = {"target_env": pendulum(12.0)} if argument == "source_data" else {}
    sac = SAC("MlpPolicy", pendulum(), policy_kwargs={"net_arch": [16]}, device="cpu")
    with pytest.raises(ValueError, match=rf"{argument}: .*log.npz' is no .npz file"):
        RTO.from_source(sac, pendulum(), dynamics_kwargs=SMALL_ENSEMBLE, **worlds, **{argument: tmp_path / "log.npz"})


def test_rewards_that_a_log_lacks_come_from_the_tasks_reward_function(tmp_path):
    recorder = SAC("MlpPolicy", pendulum(12.0), policy_kwargs={"net_arch": [16]}, learning_starts=50, seed=0).learn(50)
    log = chronological(recorder.replay_buffer)
    arrays = {"obs": "observations", "act": "actions", "next_obs": "next_observations", "done": "terminations"}
    np.savez(tmp_path / "log.npz", **{key: log[name] for key, name in arrays.items()})
    model = RPTO("MlpPolicy", pendulum(), target_data=tmp_path / "log.npz", dynamics_kwargs=SMALL_ENSEMBLE)
    np.testing.assert_allclose(chronological(model.replay_buffer.target)["rewards"], log["rewards"], atol=1e-4)
    unknown = make_vec_env(lambda: CountingPendulum(pendulum()), n_envs=1)
    with pytest.raises(ValueError, match="reward_fn"):
        RPTO("MlpPolicy", unknown, target_data=tmp_path / "log.npz", dynamics_kwargs=SMALL_ENSEMBLE)


def test_source_steps_auto_is_the_presets_number():
    assert RPTO("MlpPolicy", pendulum(), source_steps="auto").source_steps == 400


def test_from_the_first_fit_on_the_rules_are_the_targets():
    def hopper(lowest):
        return gym.make("Hopper-v5", healthy_z_range=(lowest, float("inf")))

    model = small(RPTO, hopper(0.7), hopper(0.9))
    rows = th.zeros(1, 11)
    rows[0, 0] = 0.8  # the torso's height
    action = th.zeros(1, 3)
    assert not model.dynamics.termination_fn(rows, action, rows).any()
    model.learn(60, source_timesteps=0)
    assert model.dynamics.termination_fn(rows, action, rows).all()


def test_the_source_phase_keeps_more_than_the_transfer_does():
    model = small(RPO, buffer_size=40)
    model.learn(3, source_timesteps=90)
    assert model.replay_buffer.source.size() == 40
    assert model.state.pretraining_timesteps == 90
    model = small(RPTO, buffer_size=40)
    model.learn(3, source_timesteps=90)
    assert len(model.replay_buffer.source_starts) == PHI_0_STEPS  # the phase's 90 and as many more as phi_0 wants


@pytest.mark.parametrize("cls", [RTO, RPTO])
@pytest.mark.parametrize("weighting", ["paper", "centred", "value_aware", None])
def test_every_weighting_runs(cls, weighting):
    model = small(cls, weighting=weighting)
    model.set_logger(configure(None, []))
    model.learn(60, source_timesteps=0)
    logged = model.logger.name_to_value
    assert np.isfinite(logged["dynamics/error"])
    assert logged["dynamics/error"] < logged["dynamics/error_before"]
    assert ("rto/effective_samples" in logged) == (weighting is not None)


class BlowsUp(gym.Wrapper):
    """Ends an episode where the simulation does: the observation after it is that of the reset."""

    def step(self, action):
        obs, reward, _, truncated, info = self.env.step(action)
        return obs * np.nan, reward, True, truncated, info


def test_nan_at_the_end_of_a_target_episode_is_noticed():
    model = small(RPO, target=BlowsUp(pendulum(12.0)), real_ratio=0.5)
    with pytest.raises(ValueError, match="target"):
        model.learn(60, source_timesteps=0)
    assert model.replay_buffer.target.size() == 0


def test_a_log_for_a_target_bears_callbacks_that_count_episodes():
    data = small(RPO).learn(40, source_timesteps=0).replay_buffer.target
    model = RPTO(
        "MlpPolicy",
        pendulum(),
        target_data=data,
        policy_kwargs={"net_arch": [16]},
        batch_size=16,
        source_steps=8,
        gradient_steps=1,
        dynamics_kwargs=SMALL_ENSEMBLE,
    )
    model.learn(16, callback=StopTrainingOnMaxEpisodes(1), source_timesteps=0)
    assert model.num_timesteps == 16


def test_a_log_is_not_in_a_checkpoint_and_that_is_said(tmp_path):
    data = small(RPO).learn(40, source_timesteps=0).replay_buffer.target
    settings = {"policy_kwargs": {"net_arch": [16]}, "dynamics_kwargs": SMALL_ENSEMBLE}
    RPTO("MlpPolicy", pendulum(), target_data=data, **settings).save(tmp_path / "m")
    with pytest.raises(ValueError, match="load_replay_buffer"):
        RPTO.load(tmp_path / "m", env=pendulum()).learn(16)
