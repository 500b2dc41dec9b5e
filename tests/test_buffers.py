import pickle
import re

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from sb3_rpto.buffers import DualReplayBuffer, chronological, load_transitions

OBS = spaces.Box(-np.inf, np.inf, (3,), np.float64)
ACT = spaces.Box(-1, 1, (2,), np.float32)


def rows(start: int, n: int) -> dict[str, np.ndarray]:
    """Transitions whose every number tells their index."""
    index = np.arange(start, start + n, dtype=np.float64)
    return {
        "observations": index[:, None].repeat(3, 1),
        "next_observations": index[:, None].repeat(3, 1) + 0.5,
        "actions": np.full((n, 2), 0.25, np.float32),
        "rewards": index,
        "dones": np.arange(start, start + n) % 5 == 4,
        "timeouts": np.arange(start, start + n) % 10 == 9,
    }


def test_the_object_itself_means_the_target():
    buffer = DualReplayBuffer(100, OBS, ACT, device="cpu")
    infos = [{}, {"TimeLimit.truncated": True}]
    buffer.add(np.zeros((2, 3)), np.ones((2, 3)), np.zeros((2, 2)), np.ones(2), np.array([True, True]), infos)
    assert (buffer.size(), buffer.target.size(), buffer.source.size()) == (2, 2, 0)
    assert buffer.pos == 2
    sample = buffer.sample(64)
    assert set(sample.dones.flatten().tolist()) == {0.0, 1.0}  # the time limit does not count as terminal


def test_worlds_stay_apart():
    buffer = DualReplayBuffer(100, OBS, ACT, device="cpu")
    buffer.append("source", **rows(0, 10))
    buffer.append("target", **rows(1000, 7))
    assert buffer.sample(200, world="source").rewards.max() < 10
    assert buffer.sample(200).rewards.min() >= 1000


def test_sampling_equals_an_sb3_buffer_with_the_same_contents():
    ours = DualReplayBuffer(10, OBS, ACT, device="cpu", target_size=50)
    theirs = ReplayBuffer(50, OBS, ACT, device="cpu")
    data = rows(0, 70)
    ours.append("target", **data)
    for i in range(70):
        infos = [{"TimeLimit.truncated": data["timeouts"][i]}]
        row = {name: value[i : i + 1] for name, value in data.items()}
        theirs.add(row["observations"], row["next_observations"], row["actions"], row["rewards"], row["dones"], infos)
    # a chunk larger than the ring goes in row by row, so the positions agree too
    np.random.seed(0)
    a = ours.sample(128)
    np.random.seed(0)
    b = theirs.sample(128)
    for x, y in zip(a[:5], b[:5]):
        assert th.equal(x, y)


@settings(max_examples=50, deadline=None)
@given(chunks=st.lists(st.integers(1, 30), min_size=1, max_size=8), capacity=st.integers(2, 40))
def test_the_newest_transitions_are_kept_in_order(chunks, capacity):
    buffer = DualReplayBuffer(capacity, OBS, ACT, device="cpu")
    start = 0
    for n in chunks:
        buffer.append("source", **rows(start, n))
        start += n
    kept = chronological(buffer.source)
    expected = np.arange(max(0, start - capacity), start)
    assert kept["rewards"].tolist() == expected.tolist()
    assert kept["observations"][:, 0].tolist() == expected.tolist()
    terminal = (expected % 5 == 4) & (expected % 10 != 9)
    assert kept["terminations"].tolist() == terminal.astype(float).tolist()


def test_a_replay_buffer_class_of_the_users_sees_every_row():
    class Counting(ReplayBuffer):
        added = 0

        def add(self, *args):
            Counting.added += 1
            super().add(*args)

    buffer = DualReplayBuffer(100, OBS, ACT, device="cpu", side_class=Counting)
    buffer.append("source", **rows(0, 12))
    assert Counting.added == 12
    assert chronological(buffer.source)["rewards"].tolist() == list(range(12))


def test_pickle_keeps_both_worlds_and_the_device_is_settable():
    buffer = DualReplayBuffer(20, OBS, ACT, device="cpu")
    buffer.append("source", **rows(0, 5))
    buffer.append("target", **rows(100, 3))
    buffer.source_starts = rows(0, 4)["observations"]
    copy = pickle.loads(pickle.dumps(buffer))
    copy.device = th.device("meta")
    assert copy.source.device == copy.target.device == th.device("meta")
    assert chronological(copy.source)["rewards"].tolist() == [0, 1, 2, 3, 4]
    assert chronological(copy.target)["rewards"].tolist() == [100, 101, 102]
    assert len(copy.source_starts) == 4
    copy.dones[0] = True  # what SB3 does to the arrays of model.replay_buffer means the target
    assert copy.target.dones[0, 0] == 1


def test_resizing_the_source_keeps_the_newest():
    buffer = DualReplayBuffer(8, OBS, ACT, device="cpu")
    buffer.append("source", **rows(0, 6))
    before = chronological(buffer.source)
    buffer.resize("source", 50)
    for name, array in chronological(buffer.source).items():
        assert array.tolist() == before[name].tolist(), name
    buffer.append("source", **rows(6, 20))
    buffer.resize("source", 5)
    assert chronological(buffer.source)["rewards"].tolist() == [21, 22, 23, 24, 25]
    assert buffer.source.buffer_size == 5


def test_bad_input():
    with pytest.raises(NotImplementedError, match="optimize_memory_usage"):
        DualReplayBuffer(10, OBS, ACT, optimize_memory_usage=True)
    buffer = DualReplayBuffer(10, OBS, ACT, device="cpu")
    with pytest.raises(ValueError, match="target side of the replay buffer is empty"):
        buffer.sample(4)
    with pytest.raises(ValueError, match="world"):
        buffer.sample(4, world="elsewhere")


def test_load_transitions_from_npz_pickle_and_buffer(tmp_path):
    data = rows(0, 6)
    path = tmp_path / "data.npz"
    done = data["dones"] & ~data["timeouts"]
    np.savez(
        path,
        obs=data["observations"],
        act=data["actions"],
        next_obs=data["next_observations"],
        rew=data["rewards"],
        done=done,
    )
    buffer = DualReplayBuffer(10, OBS, ACT, device="cpu")
    buffer.append("source", **data)
    with open(tmp_path / "buffer.pkl", "wb") as file:
        pickle.dump(buffer, file)
    for source in (path, str(path), buffer, tmp_path / "buffer.pkl", buffer.source):
        loaded = load_transitions(source)
        assert loaded["rewards"].tolist() == [0, 1, 2, 3, 4, 5]
        assert loaded["terminations"].tolist() == [0, 0, 0, 0, 1, 0]


def test_load_transitions_refuses_what_it_cannot_use(tmp_path):
    np.savez(tmp_path / "other.npz", obs=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="lacks the arrays"):
        load_transitions(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="empty"):
        load_transitions(ReplayBuffer(10, OBS, ACT, device="cpu"))
    nested = DictReplayBuffer(10, spaces.Dict({"a": OBS}), ACT, device="cpu")
    with pytest.raises(ValueError, match=r"DictReplayBuffer holds Dict observations; .*FlattenObservation"):
        load_transitions(nested)
    bad = DualReplayBuffer(10, OBS, ACT, device="cpu")
    data = rows(0, 3)
    data["rewards"][1] = np.nan
    bad.append("source", **data)
    with pytest.raises(ValueError, match="rewards"):
        load_transitions(bad)


@pytest.mark.parametrize("name", ["log.csv", "log/*.csv", "log.parquet"])
def test_load_transitions_says_how_tables_are_read(name):
    kind = name.rpartition(".")[2]
    with pytest.raises(ValueError, match=re.escape(f"pass target_data=Measurements.from_{kind}('{name}')")):
        load_transitions(name)


@pytest.mark.parametrize("data", [{"time": [0.0]}, ["run.csv"], None])
def test_load_transitions_says_what_it_reads(data):
    with pytest.raises(TypeError, match=r"not \w+; a robot's log is target_data=Measurements"):
        load_transitions(data)


class Costly(ReplayBuffer):
    """Keeps what an environment says a step cost."""

    costs: list

    def add(self, obs, next_obs, action, reward, done, infos):
        self.costs = [*getattr(self, "costs", []), infos[0].get("cost")]
        super().add(obs, next_obs, action, reward, done, infos)


def test_a_buffer_class_of_the_users_sees_the_infos():
    space = spaces.Box(-1, 1, (2,))
    buffer = DualReplayBuffer(10, space, space, side_class=Costly)
    rows = np.zeros((2, 2), dtype=np.float32)
    buffer.add(rows, rows, rows, np.zeros(2), np.zeros(2), [{"cost": 3}, {"cost": 4, "TimeLimit.truncated": True}])
    assert buffer.target.costs == [3, 4]
    assert buffer.target.timeouts[1, 0] == 1


def test_what_such_a_class_keeps_is_not_lost_by_a_new_capacity():
    space = spaces.Box(-1, 1, (2,))
    buffer = DualReplayBuffer(10, space, space, side_class=Costly)
    buffer.resize("source", 30)
    rows = np.zeros((20, 2), dtype=np.float32)
    buffer.append("source", rows, rows, rows, *np.zeros((3, 20)), [{"cost": i} for i in range(20)])
    buffer.resize("source", 10)
    assert (buffer.source.costs, buffer.source.size()) == (list(range(20)), 20)


def test_time_limits_end_episodes_where_nobody_handles_them():
    buffer = DualReplayBuffer(10, OBS, ACT, device="cpu", handle_timeout_termination=False)
    for world in ("source", "target"):
        buffer.append(world, **rows(0, 10))
        assert not buffer.side(world).timeouts.any()
        assert chronological(buffer.side(world))["terminations"].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("steps", [6, 25])
def test_transitions_of_a_buffer_that_saves_memory_are_those_that_it_still_knows(steps):
    space = spaces.Box(-np.inf, np.inf, (1,))
    whole, saving = (
        ReplayBuffer(10, space, space, handle_timeout_termination=False, optimize_memory_usage=flag)
        for flag in (False, True)
    )
    for k in range(steps):
        at = np.array([[float(k)]], dtype=np.float32)
        for buffer in (whole, saving):
            buffer.add(at, at + 1, at, np.array([float(k)]), np.array([k % 4 == 3]), [{}])
    expected, found = load_transitions(whole), load_transitions(saving)
    known = (expected["observations"][:, 0] % 4 != 3) & (np.arange(len(expected["rewards"])) >= (steps > 10))
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name][known], err_msg=name)


def test_another_capacity_keeps_what_ended_by_a_time_limit():
    buffer = DualReplayBuffer(15, OBS, ACT, device="cpu")
    for start in (0, 10):
        buffer.append("source", **rows(start, 10))
    buffer.resize("source", 12)
    kept, side = rows(8, 12), buffer.source
    for name in ("rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(side, name)[:, 0], kept[name])
    assert kept["timeouts"].any()
