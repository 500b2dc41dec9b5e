import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_rpto
from sb3_rpto.envs import observations as observations_module
from sb3_rpto.envs.observations import States, register_state_map
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.columns import columns_of, read_columns
from sb3_rpto.sysid.data.from_transitions import chain
from sb3_rpto.sysid.data.signal_quality import smoothed_velocity
from sb3_rpto.sysid.findings import FindingKind

HALF = {"Hopper-v5": 20, "Reacher-v5": 50, "HalfCheetah-v5": 60, "InvertedDoublePendulum-v5": 30}


class Recorder:
    """Steps environments with random actions, fills a buffer as SB3 does and keeps the true states and commands."""

    def __init__(self, env_id="Hopper-v5", n_envs=1, steps=120, size=1000, dual=False, make=gym.make, **kwargs):
        limit = HALF.get(env_id)
        self.envs = [make(env_id, max_episode_steps=limit) for _ in range(n_envs)]
        env = self.envs[0]
        cls = sb3_rpto.DualReplayBuffer if dual else ReplayBuffer
        self.buffer = cls(size, env.observation_space, env.action_space, "cpu", n_envs, **kwargs)
        self.true = [[] for _ in self.envs]  # for each environment its episodes: qpos, qvel, ctrl rows
        obs = np.stack([self._reset(i, seed=i) for i in range(n_envs)])
        rng = np.random.default_rng(0)
        low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
        for _ in range(steps):
            scaled = rng.uniform(-1, 1, (n_envs, len(low))).astype(np.float32)
            following, rewards, dones, infos = [], [], [], []
            for i, member in enumerate(self.envs):
                after, reward, terminated, truncated, _ = member.step(low + 0.5 * (scaled[i] + 1) * (high - low))
                self.true[i][-1]["ctrl"].append(member.unwrapped.data.ctrl.copy())
                self._note(i)
                following.append(after)
                rewards.append(reward)
                dones.append(terminated or truncated)
                infos.append({"TimeLimit.truncated": truncated and not terminated})
            following = np.stack(following)
            self.buffer.add(obs, following, scaled, np.array(rewards), np.array(dones), infos)
            obs = following.copy()
            for i in np.flatnonzero(dones):
                obs[i] = self._reset(i)

    def _reset(self, i, seed=None):
        obs, _ = self.envs[i].reset(seed=seed)
        self.true[i].append({"qpos": [], "qvel": [], "ctrl": []})
        self._note(i)
        return obs

    def _note(self, i):
        data = self.envs[i].unwrapped.data
        self.true[i][-1]["qpos"].append(data.qpos.copy())
        self.true[i][-1]["qvel"].append(data.qvel.copy())

    def long_ones(self):
        return [e for episodes in self.true for e in episodes if len(e["ctrl"]) >= 2]


def kinds(data):
    return sorted({f.kind for f in data.findings})


def assert_same(data, truth, hidden=1):
    assert len(data.episodes) == len(truth)
    for episode, true in zip(data.episodes, truth):
        qpos, qvel, ctrl = (np.array(true[name]) for name in ("qpos", "qvel", "ctrl"))
        np.testing.assert_allclose(episode.qpos[:, hidden:], qpos[:, hidden:], atol=1e-6)
        np.testing.assert_allclose(episode.qvel[episode.usable], qvel[episode.usable], atol=1e-6)
        np.testing.assert_allclose(episode.ctrl[:-1], ctrl, atol=1e-6)
        np.testing.assert_array_equal(episode.ctrl[-1], episode.ctrl[-2])


def test_a_buffer_gives_back_the_episodes():
    recorder = Recorder()
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert_same(data, recorder.long_ones())
    model = recorder.envs[0].unwrapped.model
    assert data.columns == columns_of(model)
    assert data.joints[:3] == ("rootx", "rootz", "rooty")
    assert data.actuators == ("actuator0", "actuator1", "actuator2")
    assert data.unobserved == ("rootx",)
    assert data.exact
    np.testing.assert_allclose(np.diff(data.episodes[0].time), 0.008)
    assert kinds(data) == [FindingKind.UNOBSERVED]
    assert not Measurements.from_replay(recorder.buffer, recorder.envs[0], exact=False).exact


def test_hidden_positions_are_integrated():
    recorder = Recorder("HalfCheetah-v5")
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    for episode, true in zip(data.episodes, recorder.long_ones()):
        x = np.array(true["qpos"])[:, 0]
        np.testing.assert_allclose(episode.qpos[:, 0], x - x[0], atol=0.1 * np.ptp(x) + 0.05)
        assert episode.usable.all()
    assert [str(f) for f in data.findings] == [
        "unobserved in all episodes, qpos.rootx: not observed; integrated from its velocity, not compared"
    ]


def test_samples_at_a_clip_are_not_usable():
    recorder = Recorder("Walker2d-v5", steps=300)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    clipped = [(np.abs(np.array(e["qvel"])) >= 10).any(1) for e in recorder.long_ones()]
    assert sum(c.sum() for c in clipped) > 0
    for episode, mask in zip(data.episodes, clipped):
        np.testing.assert_array_equal(episode.usable, ~mask)
        assert episode.placed.all()  # the bound is of speeds alone
    counts = {f.where.split(".")[1]: int(f.message.split()[2]) for f in data.findings if f.kind == FindingKind.CLIPPED}
    speeds = np.concatenate([np.array(e["qvel"]) for e in recorder.long_ones()])
    for name, count in counts.items():
        assert count == (np.abs(speeds[:, data.columns.qvel.index(name)]) >= 10).sum()


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("dual", [False, True])
def test_several_environments(n_envs, dual):
    recorder = Recorder(n_envs=n_envs, dual=dual)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert FindingKind.GAP not in kinds(data)
    key = lambda rows: tuple(rows[0])  # noqa: E731
    truth = sorted(recorder.long_ones(), key=lambda e: key(np.array(e["qpos"])[:, 1:].round(6)))
    episodes = sorted(data.episodes, key=lambda e: key(e.qpos[:, 1:].round(6)))
    assert_same(Measurements(episodes, data.columns), truth)


@pytest.mark.parametrize("memory", [{}, {"optimize_memory_usage": True, "handle_timeout_termination": False}])
def test_a_full_buffer_starts_at_its_oldest_row(memory):
    recorder = Recorder(steps=130, size=100, **memory)
    assert recorder.buffer.full
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    truth = recorder.true[0]
    ends = np.cumsum([len(e["ctrl"]) for e in truth])
    oldest = 31 if memory else 30
    expected = []
    for true, end in zip(truth, ends):
        start = max(0, oldest - (end - len(true["ctrl"])))
        rows = {name: values[start:] for name, values in true.items()}
        if memory and true is not truth[-1]:  # there the terminal observation is not kept
            rows = {name: values[:-1] for name, values in rows.items()}
        if len(rows["ctrl"]) >= 2:
            expected.append(rows)
    assert_same(data, expected)


def test_turns_are_followed_with_the_velocity():
    recorder = Recorder("Reacher-v5", steps=0)
    env = recorder.envs[0]
    obs, _ = env.reset(seed=0)
    qpos, full = [env.unwrapped.data.qpos.copy()], np.array([1.0, 0.0], dtype=np.float32)
    for _ in range(50):  # a full turn in two samples at the end
        after = env.step(full)[0]
        recorder.buffer.add(obs, after, full, np.zeros(1), np.zeros(1), [{}])
        qpos.append(env.unwrapped.data.qpos.copy())
        obs = after
    data = Measurements.from_replay(recorder.buffer, env)
    assert np.ptp(np.array(qpos)[:, 0]) > 10 * np.pi
    np.testing.assert_allclose(data.episodes[0].qpos, np.array(qpos), atol=1e-6)
    assert kinds(data) == [FindingKind.WRAPPED_ANGLE]


def test_broken_chains_are_cut_and_counted():
    recorder = Recorder("HalfCheetah-v5", steps=60)
    buffer = recorder.buffer
    buffer.dones[:] = 0
    buffer.observations[20] += 1e-3
    data = Measurements.from_replay(buffer, recorder.envs[0])
    assert [len(e) for e in data.episodes] == [21, 41]
    assert [f.message for f in data.findings if f.kind == FindingKind.GAP] == [
        "1 time(s) a transition does not begin where one before it ended; cut there"
    ]


def test_short_episodes_are_dropped_and_counted():
    recorder = Recorder("HalfCheetah-v5", steps=60)
    recorder.buffer.dones[0] = 1
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert [len(e) for e in data.episodes] == [60]
    assert [f.message for f in data.findings if f.kind == FindingKind.SHORT] == [
        "1 of 2 with fewer than 2 transitions; dropped"
    ]
    recorder.buffer.dones[:] = 1
    with pytest.raises(ValueError, match="none with 2 transitions"):
        Measurements.from_replay(recorder.buffer, recorder.envs[0])


def test_commands_pass_the_action_wrappers_and_the_actuators_range():
    def make(env_id, **kwargs):
        return wrappers.RescaleAction(gym.make(env_id, **kwargs), np.float32(-4), np.float32(4))

    recorder = Recorder(make=make)
    assert_same(Measurements.from_replay(recorder.buffer, recorder.envs[0]), recorder.long_ones())
    for env in recorder.envs:  # a narrower range: MuJoCo cuts what it is told
        env.unwrapped.model.actuator_ctrlrange[:] = [-0.25, 0.5]
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert data.episodes[0].ctrl.min() == -0.25
    assert data.episodes[0].ctrl.max() == 0.5


class Deadband(gym.ActionWrapper):
    def action(self, action):
        return np.where(np.abs(action) < 0.3, 0, action)


def test_a_users_action_wrapper_belongs_to_the_machine():
    recorder = Recorder(make=lambda env_id, **kwargs: Deadband(gym.make(env_id, **kwargs)))
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert (np.abs(data.episodes[0].ctrl) < 0.3).any()
    assert FindingKind.WRAPPER in kinds(data)


def test_pushers_object_is_rough_and_its_velocity_estimated():
    recorder = Recorder("Pusher-v5", steps=40)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert data.unobserved == data.columns.missing == ("obj_slidey", "obj_slidex")
    assert kinds(data) == [FindingKind.MISSING_VELOCITY, FindingKind.UNOBSERVED]
    (episode,) = data.episodes
    assert episode.usable.all()
    assert np.isfinite(episode.qvel).all()


@pytest.mark.parametrize("env_id", ["Ant-v5", "Swimmer-v5", "InvertedDoublePendulum-v5"])
def test_other_tasks(env_id):
    recorder = Recorder(env_id, steps=60)
    hidden = {"Ant-v5": 2, "Swimmer-v5": 2}.get(env_id, 0)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert_same(data, recorder.long_ones(), hidden)
    assert data.unobserved == data.columns.qpos[:hidden]
    if hidden:
        true = np.array(recorder.long_ones()[0]["qpos"])
        moved = data.episodes[0].qpos[:, :2]
        np.testing.assert_allclose(moved, true[:, :2] - true[0, :2], atol=0.1 * np.ptp(true[:, :2]) + 0.02)


def test_sb3_itself_fills_the_buffer():
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("Hopper-v5")] * 2))
    model = SAC("MlpPolicy", venv, learning_starts=50, seed=0, device="cpu", policy_kwargs={"net_arch": [8]})
    model.learn(100)
    data = Measurements.from_replay(model.replay_buffer, model.get_env())
    assert sum(len(e) - 1 for e in data.episodes) >= 95
    assert set(kinds(data)) <= {FindingKind.CLIPPED, FindingKind.UNOBSERVED, FindingKind.SHORT}
    for episode in data.episodes:
        moved = 0.004 * (episode.qvel[1:, 1] + episode.qvel[:-1, 1])
        np.testing.assert_allclose(np.diff(episode.qpos[:, 1]), moved, atol=2e-3)


def test_split_and_tables_work_on_them():
    recorder = Recorder(steps=150)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    train, _, test = data.split(seed=0)
    assert train.exact
    assert test.unobserved == ("rootx",)
    with pytest.warns(UserWarning, match="a table does not hold exact, unobserved of these recordings"):
        table = data.tables()
    assert Measurements.from_tables({"log": table}).columns == data.columns


def test_names_survive_the_file_format():
    model = gym.make("Ant-v5").unwrapped.model
    columns = columns_of(model)
    assert columns.qpos[:8] == (*(f"root.{i}" for i in range(7)), "hip_1")
    assert columns.qvel[:7] == (*(f"root.{i}" for i in range(6)), "hip_1")
    prefixed = [f"{p}.{n}" for p, names in (("qpos", columns.qpos), ("qvel", columns.qvel)) for n in names]
    read = read_columns(["time", *prefixed, *(f"ctrl.{n}" for n in columns.ctrl)], "log")
    assert (read.qpos, read.qvel, read.ctrl) == (columns.qpos, columns.qvel, columns.ctrl)


def test_what_cannot_be_read_is_named():
    recorder = Recorder(steps=20)
    cartpole = gym.make("rpto/ContinuousCartPole-v0")
    with pytest.raises(ValueError, match=r"rpto/ContinuousCartPole-v0 has no MuJoCo model"):
        Measurements.from_replay(recorder.buffer, cartpole)
    with pytest.raises(ValueError, match=r"actions of Ant-v5"):
        Measurements.from_replay(recorder.buffer, gym.make("Ant-v5"))
    with pytest.raises(ValueError, match="must be an SB3 ReplayBuffer"):
        Measurements.from_replay([], recorder.envs[0])
    recorder.buffer.observations[3] = np.nan
    with pytest.raises(ValueError, match="NaN or infinite"):
        Measurements.from_replay(recorder.buffer, recorder.envs[0])


def test_holes_of_a_registered_map_are_not_usable(monkeypatch):
    monkeypatch.setattr(observations_module, "_registered", {})

    def make(env):
        def recover(obs):
            qpos, qvel = obs[:, :2].copy(), obs[:, 2:].copy()
            qpos[5, 1] = np.nan
            return States(qpos, qvel, ~np.isnan(qpos), ~np.isnan(qvel))

        return recover

    register_state_map("InvertedPendulum-v5", make)
    recorder = Recorder("InvertedPendulum-v5", steps=40)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert np.flatnonzero(~data.episodes[0].usable).tolist() == [5] or not data.episodes[1].usable.all()
    assert all(np.isfinite(e.qpos).all() for e in data.episodes)


def blind(position, monkeypatch):
    """InvertedPendulum without the speed of its pole, or without its angle too."""

    def recover(obs):
        qpos, qvel = obs[:, :2].copy(), obs[:, 2:].copy()
        qvel[:, 1] = np.nan
        qpos[:, 1] = qpos[:, 1] if position else np.nan
        return States(qpos, qvel, ~np.isnan(qpos), ~np.isnan(qvel))

    monkeypatch.setattr(observations_module, "_registered", {})
    register_state_map("InvertedPendulum-v5", lambda env: recover)
    return Recorder("InvertedPendulum-v5", steps=40)


def test_a_speed_that_is_not_observed_is_estimated(monkeypatch):
    recorder = blind(True, monkeypatch)
    data = Measurements.from_replay(recorder.buffer, recorder.envs[0])
    assert data.columns.missing == ("hinge",)
    assert kinds(data) == [FindingKind.MISSING_VELOCITY]
    long = [e for e in data.episodes if len(e) >= 5]
    assert len(long) >= 2
    for episode in long:
        assert episode.usable.all()
        estimate = smoothed_velocity(episode.time, episode.qpos[:, 1])
        np.testing.assert_array_equal(episode.qvel[:, 1], estimate)


def test_what_follows_from_nothing_is_refused(monkeypatch):
    recorder = blind(False, monkeypatch)
    with pytest.raises(ValueError, match="neither position nor velocity of hinge"):
        Measurements.from_replay(recorder.buffer, recorder.envs[0])


def test_chain_follows_interleaved_rows():
    a, b = np.arange(5.0)[:, None], 10 + np.arange(5.0)[:, None]
    before = np.concatenate([np.stack([x, y]) for x, y in zip(a, b)])
    dones = np.zeros(10, dtype=bool)
    dones[4] = True
    rows, cut = chain(before, before + 1, dones)
    assert [r.tolist() for r in rows] == [[0, 2, 4], [1, 3, 5, 7, 9], [6, 8]]
    assert cut == 0
    after = before[:6] + np.array([[1], [1], [1], [1.5], [1], [1]])
    rows, cut = chain(before[:6], after, np.zeros(6, dtype=bool))
    assert [r.tolist() for r in rows] == [[0, 2, 4], [1, 3], [5]]
    assert cut == 1
