from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers

from sb3_rpto.sysid import Measurements

minari = pytest.importorskip("minari")
EpisodeBuffer = minari.data_collector.EpisodeBuffer
pytestmark = pytest.mark.filterwarnings("ignore")


class Collector(gym.Wrapper):
    """minari.DataCollector, which asks for jax, in short."""

    def __init__(self, env):
        super().__init__(env)
        self.buffers = []

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        self.buffers.append(EpisodeBuffer(id=len(self.buffers), observations=[observation], actions=[]))
        return observation, info

    def step(self, action):
        outcome = self.env.step(action)
        buffer = self.buffers[-1]
        columns = (buffer.observations, buffer.rewards, buffer.terminations, buffer.truncations, buffer.actions)
        for column, value in zip(columns, (*outcome[:4], action)):
            column.append(value)
        return outcome

    def create_dataset(self, dataset_id):
        buffers = [
            replace(b, observations=np.array(b.observations), actions=np.array(b.actions))
            for b in self.buffers
            if b.actions
        ]
        return minari.create_dataset_from_buffers(dataset_id, buffers, env=self.env, data_format="arrow")


def record(dataset_id, env, steps=80, collect=Collector):
    """Collect random actions; returns the dataset and the true states, episode by episode."""
    collector = collect(env)
    collector.action_space.seed(0)
    data, truth = env.unwrapped.data, []

    def note():
        truth[-1].append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))

    collector.reset(seed=0)
    truth.append([])
    note()
    for _ in range(steps):
        _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
        note()
        if terminated or truncated:
            collector.reset()
            truth.append([])
            note()
    return collector.create_dataset(dataset_id), truth


@pytest.fixture
def folder(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))


def check(data, truth):
    truth = [e for e in truth if len(e) >= 3]
    assert len(data.episodes) == len(truth) > 1
    for episode, rows in zip(data.episodes, truth):
        qpos, qvel, ctrl = map(np.array, zip(*rows))
        np.testing.assert_allclose(episode.qpos[:, 1:], qpos[:, 1:], atol=1e-9)
        np.testing.assert_allclose(episode.qvel[episode.usable], qvel[episode.usable], atol=1e-9)
        np.testing.assert_allclose(episode.ctrl[:-1], ctrl[1:], atol=1e-9)
        np.testing.assert_allclose(np.diff(episode.time), 0.008)


@pytest.mark.usefixtures("folder")
def test_a_dataset_gives_back_the_episodes():
    dataset, truth = record("test/hopper-v0", gym.make("Hopper-v5", max_episode_steps=25))
    data = Measurements.from_minari(dataset)
    check(data, truth)
    assert data.exact
    assert data.unobserved == ("rootx",)
    by_id = Measurements.from_minari("test/hopper-v0", env=gym.make("Hopper-v5"))
    check(by_id, truth)


@pytest.mark.usefixtures("folder")
def test_a_dataset_of_minaris_own_collector():
    pytest.importorskip("jax")
    env = gym.make("Hopper-v5", max_episode_steps=25)
    dataset, truth = record("test/collected-v0", env, collect=lambda e: minari.DataCollector(e, data_format="arrow"))
    check(Measurements.from_minari(dataset), truth)


@pytest.mark.usefixtures("folder")
def test_actions_are_in_the_units_of_the_recorded_environment():
    env = wrappers.RescaleAction(gym.make("Hopper-v5", max_episode_steps=25), np.float32(-3), np.float32(3))
    dataset, truth = record("test/rescaled-v0", env)
    check(Measurements.from_minari(dataset, env=env), truth)


@pytest.mark.usefixtures("folder")
def test_a_task_without_a_model_is_named():
    collector = Collector(gym.make("rpto/ContinuousCartPole-v0"))
    collector.reset(seed=0)
    for _ in range(5):
        collector.step(collector.action_space.sample())
    dataset = collector.create_dataset("test/cartpole-v0")
    with pytest.raises(ValueError, match="has no MuJoCo model"):
        Measurements.from_minari(dataset)


def test_dictionaries_are_refused():
    class Episode:
        id, observations, actions = 0, {"state": np.zeros((3, 11))}, np.zeros((2, 3))

    class Dataset:
        id = "test/dicts-v0"

        def iterate_episodes(self):
            return [Episode]

    with pytest.raises(ValueError, match=r"episode 0 of the dataset test/dicts-v0.*not dict"):
        Measurements.from_minari(Dataset(), env=gym.make("Hopper-v5"))
