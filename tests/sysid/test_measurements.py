import builtins
import gzip
import re
from dataclasses import replace
from itertools import chain
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.tracing.planting import generate
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data import signal_quality
from sb3_rpto.sysid.data.columns import columns_of, read_columns
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.data.signal_quality import quantum, smoothed_velocity, split_at_gaps, unwrap, velocity_slope
from sb3_rpto.sysid.findings import Finding, FindingKind, grouped

MEASURED = Path(__file__).parents[3] / "shared" / "measured"


def swing(phase=0.0, n=200, dt=0.01, **extra):
    """A clean run of one joint."""
    time = np.arange(n) * dt
    table = {
        "time": time,
        "qpos.hinge": np.sin(2 * time + phase),
        "qvel.hinge": 2 * np.cos(2 * time + phase),
        "ctrl.motor": np.cos(time),
    }
    return {**table, **{name.replace("__", "."): value for name, value in extra.items()}}


def several(count, **extra):
    return Measurements.from_tables({f"run{i}": swing(phase=i, **extra) for i in range(count)})


def kinds(data):
    return [f.kind for f in data.findings]


def stack(*tables):
    """Several runs in one table, with an episode column."""
    table = {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
    return {"episode": np.repeat(np.arange(len(tables)), [len(t["time"]) for t in tables]), **table}


def write_csv(path, table):
    rows = zip(*(values.tolist() for values in table.values()))
    path.write_text("\n".join([",".join(table), *(",".join(map(str, row)) for row in rows)]))


def test_it_prints_in_a_line():
    data = several(2)
    assert repr(data) == str(data) == "<Measurements: 2 episodes, 400 samples, 3.98 s; joints hinge; actuators motor>"
    gaps = [Finding(FindingKind.GAP, f"episode {i}", "cut in two") for i in range(3)]
    assert str(replace(data, findings=gaps)) == f"{data!r}\n  gap in episode 0, episode 1 and episode 2: cut in two"


def test_clean_data_have_no_findings():
    data = Measurements.from_tables({"a": swing()})
    assert data.findings == []
    assert data.joints == ("hinge",)
    assert data.actuators == ("motor",)
    (episode,) = data.episodes
    assert episode.qpos.shape == episode.qvel.shape == episode.ctrl.shape == (200, 1)
    assert episode.qfrc.shape == (200, 0)
    assert episode.enabled.all()


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_round_trip_is_exact(kind, tmp_path):
    rng = np.random.default_rng(0)
    on = rng.integers(0, 2, 400).astype(float)
    extra = {"qfrc.hinge": rng.normal(size=400), "enabled.motor": on, "param.arm.mass": np.repeat([0.1, 1 / 3], 200)}
    table = {**stack(swing(), swing(1.0)), **extra, "split": np.repeat(["train", "test"], 200)}
    path = tmp_path / f"log.{kind}"
    if kind == "npz":
        np.savez(path, **table)
        data = Measurements.from_npz(path)
    elif kind == "csv":
        write_csv(path, table)
        data = Measurements.from_csv(str(tmp_path / "*.csv"))
    else:
        pytest.importorskip("pyarrow")
        pytest.importorskip("pandas").DataFrame(table).to_parquet(path)
        data = Measurements.from_parquet([path])
    back = data.tables()
    assert set(back) == set(table)
    for name, values in table.items():
        np.testing.assert_array_equal(back[name], values.astype(str) if name == "episode" else values)
    assert data.episodes[1].params == {"arm.mass": 1 / 3}
    np.testing.assert_array_equal(data.episodes[0].enabled[:, 0], on[:200] == 1)


def test_files_with_the_same_episode_numbers_are_kept_apart():
    data = Measurements.from_tables({"x/a.csv": stack(swing(0), swing(1)), "y/a.csv": stack(swing(2), swing(3))})
    assert [e.name for e in data.episodes] == ["x/a.csv:0", "x/a.csv:1", "y/a.csv:0", "y/a.csv:1"]


def test_free_joint_has_seven_and_six_columns():
    names = ["time", *(f"qpos.root.{i}" for i in range(7)), *(f"qvel.root.{i}" for i in range(6))]
    columns = read_columns(names, "a")
    assert len(columns.qpos) == 7
    assert len(columns.qvel) == 6
    with pytest.raises(ValueError, match="7 and 6 for a free joint, or leave out all its velocities"):
        read_columns(names[:-1], "a")
    assert read_columns(names[:8], "a").missing == columns.qvel
    with pytest.raises(ValueError, match="ends in a dot and a digit is a coordinate's: rename a joint"):
        read_columns(["time", "qpos.j.1"], "a")


def edited(**changes):
    table = swing()
    for name, value in changes.items():
        name = name.replace("__", ".")
        if value is None:
            del table[name]
        else:
            table[name] = value
    return table


def planted(value, row=7, column="qpos.hinge"):
    table = swing()
    table[column][row] = value
    return table


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (edited(qpso__hinge=np.zeros(200)), r"a: unknown column 'qpso.hinge'; did you mean 'qpos.hinge'"),
        (edited(axle_pos=np.zeros(200)), r"unknown column 'axle_pos'; did you mean 'qpos.<name>'"),
        (edited(time=np.repeat(["2026-01-01 10:00"], 200)), r"'time' holds .*10:00.* in row 0 .*; give seconds since"),
        (edited(zzz=np.zeros(200)), r"unknown column 'zzz'; columns are"),
        (edited(zzz=np.zeros(200), enc2=np.zeros(200)), r"'zzz'; .*drop what is not needed \(unknown, too: 'enc2'\)$"),
        ({"": np.arange(200), **swing()}, r"unknown column ''; an index .*index=False"),
        (edited(time=None), r"no column 'time'"),
        (edited(qpos__hinge=None, qvel__hinge=None), r"no column 'qpos.<joint>'"),
        (edited(qpos__hinge=None, qpos__arm=np.zeros(200)), r"'qvel.hinge' has no 'qpos.hinge'"),
        (edited(enabled__fan=np.ones(200)), r"'enabled.fan' has no 'ctrl.fan'"),
        (edited(enabled__motor=np.full(200, 0.5)), r"'enabled.motor' holds more than 0 and 1"),
        (edited(param__arm__mass=np.arange(200.0)), r"'param.arm.mass' changes within the episode"),
        (edited(split=np.repeat(["train", "test"], 100)), r"'split' changes within the episode"),
        (edited(split=np.repeat(["valid"], 200)), r"'split' holds 'valid'; use one of train, select, test"),
        (edited(episode=np.repeat([0, np.nan], 100)), r"'episode' is empty in row 100"),
        (edited(ctrl__motor=np.repeat(["on"], 200)), r"'ctrl.motor' holds .*'on'.*no number, in row 0.*correct"),
        (edited(ctrl__motor=np.zeros(3)), r"one shape"),
        (
            planted(np.nan),
            r"a: column 'qpos.hinge' has 1 NaN or .* first in row 7.* keep a row's command and",
        ),
        ({0: np.zeros(200), **swing()}, r"a: column 0 has no name; give each one"),
        (planted(np.inf, column="ctrl.motor"), r"'ctrl.motor' has 1 NaN or infinite"),
        (planted(0.01, row=2, column="time"), r"a, episode a: column 'time' does not increase at row 2"),
        (swing(n=4), r"4 rows are too few; give at least 5"),
    ],
)
def test_bad_tables_are_refused(table, message):
    with pytest.raises(ValueError, match=message):
        Measurements.from_tables({"a": table})


def test_files_need_the_same_columns():
    with pytest.raises(ValueError, match=r"b: column 'ctrl.motor' is not in both"):
        Measurements.from_tables({"a": swing(), "b": edited(ctrl__motor=None)})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,qpos.hinge,qpos.hinge\n0,1,2\n", r"'qpos.hinge' is there twice"),
        ("", "the file is empty"),
        ("time,qpos.hinge\n0,1\n0.1\n", "row 1 has 1 fields, the header 2"),
        ("time,qpos.hinge\n0,1\n0.1,\n", r"'qpos.hinge' has 1 NaN or infinite value\(s\), first in row 1"),
        ("time,qpos.hinge\n", "0 rows are too few"),
        ("episode,time,qpos.hinge\n", "no rows"),
        ("time,qpos.hinge,temperature\n0,1,2\n", "unknown column 'temperature'.* rename it, or drop"),
    ],
)
def test_bad_csv_is_refused(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        Measurements.from_csv(tmp_path / "a.csv")


def test_blanks_around_a_name_are_no_part_of_it(tmp_path):
    (tmp_path / "a.csv").write_text("time, qpos.hinge\n" + "".join(f"{i / 100},{i}\n" for i in range(9)))
    assert Measurements.from_csv(tmp_path / "a.csv").joints == ("hinge",)


@pytest.mark.parametrize("other", [0, 1, 2])
def test_a_run_with_another_clock_is_refused_by_name(other):
    tables = {f"run{i}": swing(phase=i, dt=10.0 if i == other else 0.01) for i in range(3)}
    with pytest.raises(ValueError, match=rf"run{other}: the median step of column 'time' is 10, .* most.* 0\.01"):
        Measurements.from_tables(tables)


def test_what_is_found_in_many_places_is_said_once():
    tables = {f"run{i}": {k: v for k, v in swing(phase=i).items() if k != "qvel.hinge"} for i in range(3)}
    (once,) = grouped(Measurements.from_tables(tables).findings)
    assert (once.kind, once.where) == (FindingKind.MISSING_VELOCITY, "qvel.hinge of run0, run1 and run2")
    assert once.runs == ("run0", "run1", "run2")


def test_what_differs_by_run_in_numbers_alone_is_a_line_with_their_range():
    tables = {}
    for run in range(8):
        rng, table = np.random.default_rng(run), swing(phase=run)
        table["time"] = table["time"] + (0.002 + 0.0002 * run) * rng.uniform(-1, 1, 200)
        tables[f"run{run}"] = {k: v for k, v in table.items() if k != "qvel.hinge"}
    data = Measurements.from_tables(tables)
    shares = [f.message.split()[3].rstrip("%") for f in data.findings if f.kind == FindingKind.JITTER]
    assert len(shares) == 8
    found = grouped(data.findings)
    assert [f.kind for f in found] == [FindingKind.JITTER, FindingKind.MISSING_VELOCITY]
    assert found[0].where == "time of run0, run1, run2, run3, run4, run5 and 2 more"
    least, most = min(shares, key=int), max(shares, key=int)
    assert found[0].message.startswith(f"steps vary by {least} to {most}% around their median of ")
    assert found[0].runs == tuple(tables)
    assert grouped(found) == found
    assert len(str(data).splitlines()) == 3


def test_a_finding_is_said_of_several_places_and_numbers_of_names_are_no_range():
    of_run, plain = Finding.of_run, Finding
    found = grouped(
        [
            of_run(FindingKind.GAP, "a", "", "1 gap(s), the longest 0.5 s"),
            of_run(FindingKind.GLITCH, "a", "qpos.x", "3 far"),
            of_run(FindingKind.GLITCH, "a", "qpos.y", "3 far"),
            of_run(FindingKind.GAP, "b", "", "12 gap(s), the longest -1.5e-05 s"),
            of_run(FindingKind.GLITCH, "b", "qpos.x", "3 far"),
            of_run(FindingKind.GLITCH, "b", "qpos.y", "3 far"),
            of_run(FindingKind.VELOCITY_SLOPE, "a", "qvel.x", "it is 2"),
            of_run(FindingKind.VELOCITY_SLOPE, "b", "qvel.y", "it is 3"),
            of_run(FindingKind.DUPLICATE, "a", "", "the same as episode '1'"),
            of_run(FindingKind.DUPLICATE, "b", "", "the same as episode '2'"),
            of_run(FindingKind.JUMP, "a", "", "motor2 moves"),
            of_run(FindingKind.JUMP, "b", "", "motor3 moves"),
            plain(FindingKind.SOFT_TIE, "equality 0", "gives way over 20 ms"),
            plain(FindingKind.SOFT_TIE, "equality 1", "gives way over 20 ms"),
            plain(FindingKind.SOFT_TIE, "equality 2", "gives way over 30 ms"),
        ]
    )
    assert [str(one) for one in found] == [
        "gap in a and b: 1 to 12 gap(s), the longest -1.5e-05 to 0.5 s",
        "glitch in qpos.x and qpos.y of a and b: 3 far",
        "velocity slope in a, qvel.x: it is 2",
        "velocity slope in b, qvel.y: it is 3",
        "duplicate in a: the same as episode '1'",
        "duplicate in b: the same as episode '2'",
        "jump in a: motor2 moves",
        "jump in b: motor3 moves",
        "soft tie in equality 0 and equality 1: gives way over 20 ms",
        "soft tie in equality 2: gives way over 30 ms",
    ]
    assert grouped(found) == found


def test_gzipped_csv(tmp_path):
    write_csv(tmp_path / "a.csv", swing())
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress((tmp_path / "a.csv").read_bytes()))
    (episode,) = Measurements.from_csv(tmp_path / "*.gz").episodes
    np.testing.assert_array_equal(episode.qpos[:, 0], swing()["qpos.hinge"])


def test_a_table_in_another_encoding_is_told(tmp_path):
    (tmp_path / "a.csv").write_text("time,qpos.hinge\n°,°\n", encoding="latin-1")
    with pytest.raises(ValueError, match=r"a\.csv: no text in UTF-8 .* save the table as CSV in UTF-8"):
        Measurements.from_csv(tmp_path / "a.csv")


def test_dates_are_no_seconds():
    table = swing()
    table["time"] = np.datetime64("2026-01-01") + (1e9 * table["time"]).astype("timedelta64[ns]")
    with pytest.raises(ValueError, match="column 'time' holds dates or durations; give numbers, times in seconds"):
        Measurements.from_tables({"a": table})


def test_seconds_since_1970_are_as_good_as_any():
    table = swing()
    (ours,) = Measurements.from_tables({"a": table}).episodes
    (theirs,) = Measurements.from_tables({"a": table | {"time": table["time"] + 1.7e9}}).episodes
    np.testing.assert_allclose(theirs.time, ours.time, atol=1e-6)
    assert theirs.time[0] == 0


def test_no_tables_no_files():
    with pytest.raises(ValueError, match="no tables"):
        Measurements.from_tables({})
    with pytest.raises(FileNotFoundError, match="no file matches"):
        Measurements.from_npz("nothing/*.npz")


def test_a_single_array_is_no_archive(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(ValueError, match="no whole npz archive of named arrays"):
        Measurements.from_npz(tmp_path / "a.npy")


def test_without_pandas_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match=r"experiments"):
        Measurements.from_parquet("a.parquet")


def test_gap_splits_the_episode_and_keeps_the_run_together():
    table = swing()
    table["time"][80:] += 0.2
    data = Measurements.from_tables({"a": table})
    assert [(e.name, e.run, len(e)) for e in data.episodes] == [("a/0", "a", 80), ("a/1", "a", 120)]
    assert kinds(data) == [FindingKind.GAP]
    train, select, test = data.split(0)
    assert [len(m.episodes) for m in (train, select, test)] == [2, 0, 0]


@pytest.mark.parametrize("burst", [3, 6])
def test_a_clock_that_comes_in_bursts_is_refused(burst):
    table = swing()
    rows = np.arange(len(table["time"]))
    table["time"] = 0.01 * burst * (rows // burst) + 1e-4 * (rows % burst)
    with pytest.raises(ValueError, match=r"the clock comes in bursts, of steps of 0\.0001 s where the mean is"):
        Measurements.from_tables({"a": table})


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(ValueError, match=r"is a folder; name its files, such as .*\*\.csv"):
        Measurements.from_csv(str(tmp_path))


def test_a_table_in_memory_is_no_file():
    with pytest.raises(TypeError, match="for a table in memory use"):
        Measurements.from_csv(swing())


def test_text_among_numbers_is_shown_as_it_is():
    table = swing()
    table["qpos.hinge"] = table["qpos.hinge"].astype(str)
    table["qpos.hinge"][3] = "n/a"
    with pytest.raises(ValueError, match="holds 'n/a', which is no number, in row 3"):
        Measurements.from_tables({"a": table})


def test_short_stretch_is_set_aside_with_a_finding():
    table = swing()
    table["time"][197:] += 0.2
    data = Measurements.from_tables({"a": table})
    assert [len(e) for e in data.episodes] == [197]
    assert kinds(data) == [FindingKind.GAP, FindingKind.SHORT]


@given(st.lists(st.floats(1e-3, 10.0), max_size=60))
@settings(max_examples=100, deadline=None)
def test_splitting_at_gaps_loses_no_sample(steps):
    time = np.concatenate([[0.0], np.cumsum(steps)])
    slices = split_at_gaps(time)
    np.testing.assert_array_equal(np.concatenate([time[s] for s in slices]), time)
    limit = 5 * np.median(np.diff(time)) if steps else 0
    assert all(np.all(np.diff(time[s]) <= limit) for s in slices)
    assert all(time[b.start] - time[b.start - 1] > limit for b in slices[1:])


def test_many_missing_rows_are_no_jitter():
    table = swing(n=300)
    kept = np.random.default_rng(0).uniform(size=300) > 0.1
    found = Measurements.from_tables({"a": {name: column[kept] for name, column in table.items()}}).findings
    assert {f.kind for f in found} == {FindingKind.MISSING_ROWS}


def test_jitter_is_reported():
    time = np.arange(200) * 0.01 + np.random.default_rng(0).uniform(-0.002, 0.002, 200)
    table = {"time": time, "qpos.hinge": np.sin(time), "qvel.hinge": np.cos(time)}
    assert kinds(Measurements.from_tables({"a": table})) == [FindingKind.JITTER]


def test_rows_that_are_missing_from_a_regular_clock_are_told():
    """As little as the last command's hold over them makes a right model wrong."""
    table, kept = swing(), np.ones(200, dtype=bool)
    kept[[20, 50, 51, 52, 90]] = False
    (found,) = Measurements.from_tables({"a": {name: values[kept] for name, values in table.items()}}).findings
    assert found.kind == FindingKind.MISSING_ROWS
    assert found.message.startswith("3 step(s) are longer")


def test_wrapped_angle_is_unwrapped_and_reported():
    time = np.arange(300) * 0.01
    true = 5 * np.sin(3 * time) + 2
    wrapped = np.angle(np.exp(1j * true))
    data = Measurements.from_tables({"a": {"time": time, "qpos.hinge": wrapped, "qvel.hinge": 15 * np.cos(3 * time)}})
    assert kinds(data) == [FindingKind.WRAPPED_ANGLE]
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], true, rtol=0, atol=1e-12)


TIME = np.arange(1500) * 0.01


def rotor(noise=1e-3):
    return 15 * np.sin(0.4 * TIME) + 0.2 * np.sin(9 * TIME) + noise * np.random.default_rng(0).normal(size=1500)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: (rotor() + 12.5) % 25.0 - 12.5, r"4 step\(s\) of 25 from"),
        (lambda: (rotor() + np.pi / 2) % np.pi - np.pi / 2, r"19 step\(s\) of 3.12 from"),
        (lambda: rotor() + 2 * np.pi * (TIME > 7.003), r"1 step\(s\) of 6.2"),
        (lambda: 0.1 * rotor() - 0.8 * (TIME > 3.003) + 0.5 * (TIME > 8.003), r"2 step\(s\) of 0.49\d* to 0.79"),
    ],
    ids=["period", "gear", "slip", "set anew"],
)
@pytest.mark.parametrize("measured", [False, True])
def test_steps_that_are_no_motion_are_told(make, said, measured):
    table = {"time": TIME, "qpos.wheel": make()}
    if measured:
        table["qvel.wheel"] = np.gradient(rotor(0.0), 0.01)
    (found,) = [
        finding for finding in Measurements.from_tables({"a": table}).findings if finding.kind == FindingKind.JUMP
    ]
    assert re.match(said, found.message)


def bouncing():
    """A ball on the floor: its velocity jumps, it does not."""
    fall = TIME % 0.8
    return 4.905 * fall * (0.8 - fall)


@pytest.mark.parametrize(
    "position",
    [
        rotor(),
        rotor(0.05),
        np.round(rotor() / 0.01) * 0.01,
        np.round(0.01 * rotor() / 0.01) * 0.01,  # fifteen counts in all
        np.repeat(rotor()[::25], 25),
        np.clip(np.sin(2 * TIME), 0.9, 1),
        0.2 * np.tanh(30 * (TIME - 3)) + 1e-4 * np.random.default_rng(0).normal(size=1500),
        bouncing(),
        np.zeros(1500),
        np.arange(1500.0),
    ],
)
def test_motion_is_no_jump_and_no_glitch(position):
    assert not signal_quality.jumps(TIME, position).any()
    assert not signal_quality.glitches(TIME, position).any()


def test_rows_that_are_stamped_late_are_no_jump_and_no_glitch():
    time = TIME.copy()
    time[[200, 600, 1100]] += 0.0095
    assert not signal_quality.jumps(time, np.sin(2 * time)).any()
    for position in (np.sin(2 * time), np.sin(2 * TIME)):
        assert not signal_quality.glitches(time, position).any()


def taps(every: int) -> dict:
    """A finger that taps within two samples when it is told to, and rests between."""
    command = np.where(np.arange(1500) % every < 2, 0.5, 0.0)
    position = np.roll(command, 1) + 1e-3 * np.random.default_rng(0).normal(size=1500)
    return {"time": TIME, "qpos.finger": position, "ctrl.finger": command}


def test_taps_that_a_command_asks_for_are_motion():
    assert signal_quality.glitches(TIME, taps(150)["qpos.finger"]).sum() == 18
    assert FindingKind.GLITCH not in kinds(Measurements.from_tables({"a": taps(150)}))


def test_many_samples_that_look_like_no_readings_are_kept():
    table = {name: column for name, column in taps(150).items() if name != "ctrl.finger"}
    data = Measurements.from_tables({"a": table})
    (told,) = [finding for finding in data.findings if finding.kind == FindingKind.GLITCH]
    assert "18 sample(s)" in told.message
    assert "kept, as they are many" in told.message
    assert data.episodes[0].usable.all()
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], table["qpos.finger"])


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("reading", [0.0, 99.9])
def test_samples_that_are_no_readings_are_bridged_told_and_not_compared(reading, rows):
    true = 3 + np.sin(2 * TIME) + 1e-3 * np.random.default_rng(0).normal(size=1500)
    wrong = np.isin(np.arange(1500), [200 + k for k in range(rows)] + [777, 1100])
    table = {"time": TIME, "qpos.slide": np.where(wrong, reading, true), "qpos.other": true}
    data = Measurements.from_tables({"a": table})
    (told,) = [
        finding for finding in data.findings if finding.kind not in (FindingKind.MISSING_VELOCITY, FindingKind.JUMP)
    ]
    assert (told.kind, told.where) == (FindingKind.GLITCH, "a, qpos.slide")
    assert told.message.startswith(
        f"{rows + 2} sample(s) far from those before and after, the first {reading:.4g} at 2 s"
    )
    assert not [finding for finding in data.findings if finding.kind == FindingKind.JUMP]
    (run,) = data.episodes
    np.testing.assert_array_equal(run.usable, ~wrong)
    np.testing.assert_array_equal(run.placed, ~wrong)
    np.testing.assert_allclose(run.qpos[:, 0], true, rtol=0, atol=0.01)
    np.testing.assert_array_equal(run.qpos[~wrong, 0], true[~wrong])
    assert np.abs(run.qvel[:, 0]).max() < 2.1


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_unwrap_restores_any_smooth_angle(seed):
    steps = np.random.default_rng(seed).uniform(-1.5, 1.5, 100)
    true = np.cumsum(steps) - steps[0]
    np.testing.assert_allclose(unwrap(np.angle(np.exp(1j * true)))[0], true, atol=1e-10)


@pytest.mark.parametrize("rate", [-240.0, -90.0, 120.0, 200.0, 290.0])
def test_a_wheel_that_turns_fast_is_unwrapped_by_its_velocity(rate):
    """More than a quarter turn from one sample to the next."""
    time = np.arange(200) * 0.01
    true, velocity = rate * time + 5 * np.sin(20 * time), rate + 100 * np.cos(20 * time)
    table = {"time": time, "qpos.wheel": np.angle(np.exp(1j * true)), "qvel.wheel": velocity}
    data = Measurements.from_tables({"a": table})
    assert kinds(data) == [FindingKind.WRAPPED_ANGLE]
    np.testing.assert_allclose(data.episodes[0].qpos[:, 0], true, atol=1e-9)
    lost = Measurements.from_tables({"a": {**table, "qvel.wheel": np.zeros(200) + rate % 70}})  # which does not fit
    assert FindingKind.FAST_ANGLE in kinds(lost)


def test_a_bad_velocity_does_not_bend_an_angle():
    time = np.arange(300) * 0.01
    glitched = swing(n=300)
    glitched["qvel.hinge"][100] = 800.0
    data = Measurements.from_tables({"a": glitched})
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], glitched["qpos.hinge"])
    assert FindingKind.WRAPPED_ANGLE not in kinds(data)
    moves = np.clip(np.sin(2 * time), 0, 1)  # with pauses between, and a velocity in degrees
    velocity = 180 / np.pi * np.gradient(moves, 0.01)
    data = Measurements.from_tables({"a": {"time": time, "qpos.hinge": moves, "qvel.hinge": velocity}})
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], moves)
    assert kinds(data) == [FindingKind.VELOCITY_SLOPE]
    assert "in degrees" in data.findings[0].message


def test_a_wheel_whose_turns_cannot_be_told_is_said():
    time = np.arange(200) * 0.01
    data = Measurements.from_tables({"a": {"time": time, "qpos.wheel": np.angle(np.exp(1j * 250 * time))}})
    assert FindingKind.FAST_ANGLE in kinds(data)
    assert FindingKind.MISSING_VELOCITY in kinds(data)


def test_a_continuous_angle_is_left_alone():
    angle = np.linspace(-20, 20, 100)
    assert unwrap(angle)[0] is angle


def test_quantised_velocity_is_reported():
    table = swing()
    table["qvel.hinge"] = np.round(table["qvel.hinge"] / 0.25) * 0.25
    data = Measurements.from_tables({"a": table})
    assert kinds(data) == [FindingKind.QUANTISED_VELOCITY]
    assert "0.25" in data.findings[0].message
    assert quantum(np.concatenate([np.zeros(500), swing()["qvel.hinge"]])) is None
    assert quantum(1.5 + 2.2e-16 * (np.arange(120) % 7)) is None  # it is constant


def test_missing_velocity_is_estimated_and_reported():
    data = Measurements.from_tables({"a": edited(qvel__hinge=None)})
    assert kinds(data) == [FindingKind.MISSING_VELOCITY]
    np.testing.assert_allclose(data.episodes[0].qvel[:, 0], swing()["qvel.hinge"], atol=1e-3)


def tumble(kind):
    """A body thrown with a spin about all axes: its columns, times (T,), positions and velocities (T, nq + nv)."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.001"/><worldbody><body><joint name="top" type="{kind}"/>
        <geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody></mujoco>"""
    )
    state = mujoco.MjData(model)
    state.qvel[:] = np.linspace(-2.0, 3.0, model.nv)
    rows = []
    for _ in range(400):
        rows.append(np.concatenate([[state.time], state.qpos, state.qvel]))
        mujoco.mj_step(model, state)
    table = np.array(rows)
    return columns_of(model), table[:, 0], table[:, 1:]


@pytest.mark.parametrize("kind", ["free", "ball"])
def test_missing_velocities_of_a_turning_body_are_estimated(kind):
    columns, time, values = tumble(kind)
    positions, velocities = np.split(values, [len(columns.qpos)], axis=1)
    positions[200:, -4:] *= -1  # the same orientations
    names = [f"qpos.{name}" for name in columns.qpos]
    data = Measurements.from_tables({"a": {"time": time, **dict(zip(names, positions.T))}})
    assert set(kinds(data)) == {FindingKind.MISSING_VELOCITY, FindingKind.QUATERNION_SIGN}
    assert data.columns.missing == data.columns.qvel
    np.testing.assert_allclose(data.episodes[0].qvel, velocities, atol=0.02)


@pytest.mark.parametrize("kind", ["free", "ball"])
@pytest.mark.parametrize(
    ("last", "world", "said"),
    [
        (False, False, None),
        (True, False, "quaternions x, y, z, w"),
        (False, True, "angular velocities in the world's frame"),
        (True, True, "quaternions x, y, z, w and angular velocities in the world's frame"),
    ],
)
def test_another_convention_of_rotations_is_told(kind, last, world, said):
    columns, time, values = tumble(kind)
    turn = slice(len(columns.qpos) - 4, len(columns.qpos))
    if world:
        for row in values:
            mujoco.mju_rotVecQuat(row[-3:], row[-3:].copy(), row[turn].copy())
    if last:
        values[:, turn] = np.roll(values[:, turn], -1, axis=1)
    names = [*(f"qpos.{name}" for name in columns.qpos), *(f"qvel.{name}" for name in columns.qvel)]
    data = Measurements.from_tables({"a": {"time": time, **dict(zip(names, values.T))}})
    told = [finding.message for finding in data.findings if finding.kind == FindingKind.OTHER_CONVENTION]
    assert len(told) == (said is not None)
    assert said is None or f"the numbers fit {said};" in told[0]


@pytest.mark.parametrize("kind", ["free", "ball"])
@pytest.mark.parametrize(
    ("factor", "found"), [(1.0, None), (-1.0, FindingKind.FLIPPED_VELOCITY), (180 / np.pi, FindingKind.VELOCITY_SLOPE)]
)
def test_an_angular_velocity_against_the_quaternions_is_reported(kind, factor, found):
    columns, time, values = tumble(kind)
    values[:, -3:] *= factor
    names = [*(f"qpos.{name}" for name in columns.qpos), *(f"qvel.{name}" for name in columns.qvel)]
    data = Measurements.from_tables({"a": {"time": time, **dict(zip(names, values.T))}})
    assert [f.kind for f in data.findings if "convention" not in f.kind] == ([found] if found else [])
    assert found is None or ("in degrees" in data.findings[0].message) == (factor > 1)


@pytest.mark.parametrize("rate", [20, 50, 100])
@pytest.mark.parametrize("hertz", [1, 3, 6])
def test_a_right_angular_velocity_of_fast_motion_has_no_finding(rate, hertz):
    xml = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body><joint name="root" type="ball"
      stiffness="{}"/><geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.format((2 * np.pi * hertz) ** 2 * 0.1**2 * 2 / 3))
    mj, rows = mujoco.MjData(model), []
    mj.qvel[:] = 1.0, 0.5, 0.3
    for _ in range(6 * rate):
        rows.append([mj.time, *mj.qpos, *mj.qvel])
        mujoco.mj_step(model, mj, 1000 // rate)
    names = ["time", *(f"qpos.root.{i}" for i in range(4)), *(f"qvel.root.{i}" for i in range(3))]
    data = Measurements.from_tables({"a": dict(zip(names, np.array(rows).T))})
    assert not {FindingKind.VELOCITY_SLOPE, FindingKind.FLIPPED_VELOCITY} & set(kinds(data))


def test_quaternions_are_given_norm_one():
    columns, time, values = tumble("ball")
    names = [f"qpos.{name}" for name in columns.qpos]
    exact, scaled = (
        Measurements.from_tables({"a": {"time": time, **dict(zip(names, size * values[:, :4].T))}})
        for size in (1.0, 1.04)
    )
    assert kinds(scaled) == [FindingKind.QUATERNION_NORM, *kinds(exact)]
    np.testing.assert_allclose(scaled.episodes[0].qpos, exact.episodes[0].qpos, atol=1e-12)
    np.testing.assert_allclose(scaled.episodes[0].qvel, exact.episodes[0].qvel, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"episode": pd.array(["a", None] * 100, dtype="string")}, "column 'episode' is empty in row 1"),
        ({"ctrl.motor": np.ones(200) + 1j}, "holds complex numbers"),
        ({"ctrl.motor": np.ma.masked_greater(np.linspace(0, 1, 200), 0.9)}, "NaN or infinite"),
        ({"qpos": np.zeros(200)}, "write a column of shape .*'qpos.<name>'"),
    ],
)
def test_tables_of_other_kinds_are_refused_by_name(change, said):
    with pytest.raises(ValueError, match=f"run.*{said}"):
        Measurements.from_tables({"run": {**swing(), **change}})


def test_tables_may_be_named_by_numbers_and_are_not_columns():
    frame = pd.DataFrame(swing())
    assert [e.name for e in Measurements.from_tables({0: frame, 1: swing(phase=1.0)}).episodes] == ["0", "1"]
    for table in (swing(), dict(frame.items())):
        with pytest.raises(TypeError, match=r"write \{'run': table\}"):
            Measurements.from_tables(table)


def test_an_index_of_pandas_is_a_column(tmp_path):
    pd.DataFrame(swing()).set_index("time").to_parquet(tmp_path / "run.parquet")
    (run,) = Measurements.from_parquet(tmp_path / "run.parquet").episodes
    np.testing.assert_array_equal(run.time, swing()["time"])
    pd.DataFrame(swing()).set_index("time", drop=False).to_parquet(tmp_path / "twice.parquet")
    (twice,) = Measurements.from_parquet(tmp_path / "twice.parquet").episodes
    np.testing.assert_array_equal(twice.time, run.time)


def test_files_that_are_broken_are_named(tmp_path):
    np.savez(tmp_path / "objects.npz", time=np.array([{}], dtype=object))
    (tmp_path / "text.npz").write_text("time,qpos.hinge")
    (tmp_path / "text.parquet").write_text("time,qpos.hinge")
    for name in ("objects", "text"):
        with pytest.raises(ValueError, match=rf"{name}\.npz: "):
            Measurements.from_npz(tmp_path / f"{name}.npz")
    (tmp_path / "torn.csv").write_bytes(b"time,qpos.hinge\n0.0,1.0\n0.1," + bytes(200_000))
    with pytest.raises(ValueError, match=r"torn\.csv: no CSV .*its end torn"):
        Measurements.from_csv(tmp_path / "torn.csv")
    with pytest.raises(ValueError, match=r"text\.parquet: no whole Parquet file"):
        Measurements.from_parquet(tmp_path / "text.parquet")


def test_velocity_estimate_is_exact_for_constant_speed_on_a_jittered_clock():
    time = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 40))
    np.testing.assert_allclose(smoothed_velocity(time, 3 * time + 1), 3.0, rtol=1e-9)
    np.testing.assert_allclose(smoothed_velocity(time[:5], 3 * time[:5]), 3.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("factor", "kind"), [(-1.0, FindingKind.FLIPPED_VELOCITY), (180 / np.pi, FindingKind.VELOCITY_SLOPE)]
)
def test_velocity_against_position_is_reported(factor, kind):
    table = swing()
    table["qvel.hinge"] *= factor
    data = Measurements.from_tables({"a": table})
    assert kinds(data) == [kind]
    said = re.search(r"slope .* is (-?[0-9.]+), not 1", data.findings[0].message)
    assert float(said[1]) == pytest.approx(factor, rel=2e-4)
    assert ("in degrees" in data.findings[0].message) == (factor > 0)


@pytest.mark.parametrize(
    "system", ["cartpole", *(pytest.param(name, marks=pytest.mark.slow) for name in ("reacher", "arm3"))]
)
@pytest.mark.parametrize("setting", [{}, {"jitter": 0.5}, {"rate": 50.0}, {"quantum": 2 * np.pi / 4096}])
def test_right_but_noisy_velocities_of_gentle_motion_have_no_finding(system, setting):
    """Noise of the differentiated position is no fault of the velocity."""
    data = generate(system, [], seed=1, episodes=4, duration=3.0, noise=5e-3, **setting).measurements
    assert not {FindingKind.VELOCITY_SLOPE, FindingKind.FLIPPED_VELOCITY} & set(kinds(data))
    slopes = [velocity_slope(e.time, e.qpos[:, j], e.qvel[:, j]) for e in data.episodes for j in range(e.qpos.shape[1])]
    np.testing.assert_allclose([s for s in slopes if s is not None], 1.0, atol=0.05)
    assert len([s for s in slopes if s is not None]) > 0.7 * len(slopes)


@pytest.mark.parametrize("factor", [-1.0, 0.5, 0.7, 1.5, 180 / np.pi])
def test_wrong_velocities_of_noisy_motion_are_all_found(factor):
    for e in generate("reacher", [], seed=1, episodes=4, duration=3.0, noise=5e-3).measurements.episodes:
        for q, v in zip(e.qpos.T, e.qvel.T):
            slope = velocity_slope(e.time, q, factor * v)
            assert slope == pytest.approx(factor, rel=0.1)
            assert not DATA.slope[0] <= slope <= DATA.slope[1]


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 1.5])
def test_the_slope_is_the_bound_nearest_to_one(noise):
    """The inverse regression's slope is too large by the noise's share of the integral's variance."""
    rng, time, h, span = np.random.default_rng(0), np.arange(20000) * 0.01, 0.01, 16
    velocity = 0.6 * np.cos(time) + noise * rng.normal(size=len(time))
    signal = np.mean((0.6 * 2 * np.sin(span * h / 2) * np.cos(time)) ** 2)
    expected = 0.6 * (1 + noise**2 * h**2 * (span - 0.5) / signal)
    assert velocity_slope(time, np.sin(time), velocity) == pytest.approx(min(expected, 1.0), rel=0.02)


def test_a_slow_filter_is_no_wrong_slope():
    time = np.arange(2000) * 0.01
    assert velocity_slope(time, np.sin(time), np.cos(time - 0.4)) == 1.0


def test_velocities_that_have_nothing_to_do_with_the_position_are_not_judged():
    time = np.arange(2000) * 0.01
    assert velocity_slope(time, np.sin(time), np.random.default_rng(0).normal(size=2000)) is None
    assert velocity_slope(time, np.sin(time), np.zeros(2000)) is None


def test_slope_of_a_resting_joint_is_not_judged():
    rng = np.random.default_rng(0)
    for n in (5, 6, 20, 200):
        assert velocity_slope(np.arange(n) * 0.01, rng.normal(size=n) * 1e-3, rng.normal(size=n)) is None
        assert velocity_slope(np.arange(n) * 0.01, np.ones(n), rng.normal(size=n)) is None


def test_duplicate_is_dropped_and_reported():
    later = swing()
    later["time"] = later["time"] + 100.0
    data = Measurements.from_tables({"a": swing(), "b": swing(1.0), "c": later})
    assert [e.name for e in data.episodes] == ["a", "b"]
    assert [str(f) for f in data.findings] == ["duplicate in c: the same samples as episode 'a'; only that one is kept"]


@given(st.integers(1, 15), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_split_parts_the_runs(count, seed):
    data = several(count, n=8)
    parts = [[e.name for e in m.episodes] for m in data.split(seed)]
    again = [[e.name for e in m.episodes] for m in data.split(seed)]
    assert parts == again
    assert sorted(chain(*parts)) == sorted(e.name for e in data.episodes)
    assert parts[0]
    assert bool(parts[2]) == (count >= 2)
    assert len(parts[0]) >= 3 or not parts[1]


def test_seed_changes_the_split_and_file_order_does_not():
    data = several(10)
    draws = {tuple(e.name for e in data.split(seed)[2].episodes) for seed in range(5)}
    assert len(draws) > 1
    tables = {f"run{i}": swing(phase=i) for i in reversed(range(10))}
    other = Measurements.from_tables(tables).split(0)[2]
    assert {e.name for e in other.episodes} == {e.name for e in data.split(0)[2].episodes}
    assert [len(m.episodes) for m in data.split(0)] == [6, 2, 2]


@given(st.lists(st.integers(6, 200), min_size=2, max_size=8), st.integers(0, 100))
@settings(max_examples=30, deadline=None)
def test_a_split_never_sets_most_of_the_data_apart(lengths, seed):
    tables = {f"run{i}": swing(phase=i, n=n) for i, n in enumerate(lengths)}
    train, select, test = Measurements.from_tables(tables).split(seed)
    apart = len(select.episodes) + len(test.episodes)
    kept = sum(len(e.time) for e in train.episodes)
    assert kept >= 0.5 * sum(lengths) * (1 - apart / len(lengths))
    assert test.episodes


def test_few_runs_are_a_finding():
    train, select, test = several(4).split(0)
    assert [len(m.episodes) for m in (train, select, test)] == [3, 0, 1]
    assert "use blocks of the training runs" in train.findings[-1].message
    assert "no test data" in several(1).split(0)[0].findings[0].message


def test_split_column_is_honoured():
    parts = ["test", "train", "train", "select"]
    tables = {f"run{i}": swing(phase=i, split=np.repeat([p], 200)) for i, p in enumerate(parts)}
    split = Measurements.from_tables(tables).split(0)
    assert [[e.name for e in m.episodes] for m in split] == [["run1", "run2"], ["run3"], ["run0"]]
    del tables["run3"]
    train, select, _ = Measurements.from_tables(tables).split(0)
    assert select.episodes == []
    assert "names no select episode" in train.findings[-1].message
    with pytest.raises(ValueError, match="no episode has 'train'"):
        Measurements.from_tables({"run0": tables["run0"]}).split(0)


@pytest.mark.parametrize("fractions", [(0.5, 0.5), (0.5, 0.2, 0.2), (1.2, -0.2, 0.0), (0.0, 0.5, 0.5)])
def test_bad_fractions(fractions):
    with pytest.raises(ValueError, match="fractions must be"):
        several(3).split(0, fractions)


@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured sets are not here")
def test_simple_pendulum_loads_with_its_quantised_velocity():
    pandas = pytest.importorskip("pandas")
    names = {"position": "qpos.hinge", "velocity": "qvel.hinge", "torque": "ctrl.motor"}
    tables = {}
    for path in sorted((MEASURED / "simple_pendulum").glob("*.csv")):
        frame = pandas.read_csv(path).rename(columns=names)
        tables[path.name] = {name: frame[name].to_numpy() for name in frame}
    data = Measurements.from_tables(tables)
    assert sum(len(e) for e in data.episodes) == sum(len(t["time"]) for t in tables.values()) == 6340
    assert len(data.episodes) == 4
    assert kinds(data).count(FindingKind.QUANTISED_VELOCITY) == 4
    assert not {
        FindingKind.FLIPPED_VELOCITY,
        FindingKind.VELOCITY_SLOPE,
        FindingKind.WRAPPED_ANGLE,
        FindingKind.GAP,
    } & set(kinds(data))


@pytest.mark.parametrize("tables", [{"time": np.arange(9.0), "qpos.hinge": np.arange(9.0)}, [1.0], "runs.csv"])
def test_a_table_in_the_place_of_tables_is_refused(tables):
    with pytest.raises(TypeError, match="for a single one"):
        Measurements.from_tables(tables)


@pytest.mark.parametrize("name", ["qpos_hinge", "qpos-hinge", "qpos/hinge"])
def test_another_mark_than_a_dot_is_seen(name):
    with pytest.raises(ValueError, match=r"did you mean 'qpos\.hinge'"):
        Measurements.from_tables({"run": {"time": np.arange(9.0), name: np.arange(9.0)}})


def test_held_samples_are_told_and_coarse_encoders_are_not() -> None:
    time = np.arange(0, 4, 0.001)
    motion = np.sin(3 * time) + 0.3 * np.cos(7 * time) + 1e-3 * np.random.default_rng(0).standard_normal(len(time))
    held = motion[np.arange(len(time)) // 10 * 10]
    for position, found in (
        (motion, None),
        (held, 10),
        (np.round(np.sin(3 * time), 2), None),
        (0.01 * time // 1e-4, None),
    ):
        assert signal_quality.rows_per_reading(position[:, None]) == found
    table = {"time": time, "qpos.hinge": held, "ctrl.motor": np.cos(time)}
    assert FindingKind.HELD_SAMPLES in kinds(Measurements.from_tables({"a": table}))
    mixed = Measurements.from_tables({"a": {**table, "qpos.elbow": motion}})  # one sensor is slower than the other
    assert [(f.kind, f.where) for f in mixed.findings if f.kind == FindingKind.HELD_SAMPLES] == [
        (FindingKind.HELD_SAMPLES, "a, qpos.hinge")
    ]


def test_what_is_no_quaternion_is_refused() -> None:
    time = np.arange(50) * 0.01
    still = dict.fromkeys([f"qvel.ball.{i}" for i in range(3)], np.zeros(50))
    degrees = {f"qpos.ball.{i}": np.full(50, 30.0 * i) for i in range(4)}
    with pytest.raises(ValueError, match=r"qpos\.ball holds no unit quaternion.*give w, x, y, z"):
        Measurements.from_tables({"a": {"time": time, **degrees, **still}})
