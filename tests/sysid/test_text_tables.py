"""Tables as common tools write them are read to the digit, or refused with the one thing to change."""

from __future__ import annotations

import gzip
import io

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.text_tables import parse_rename, read_text

NAMES = ["time", "qpos.hinge", "qvel.hinge", "ctrl.motor"]
UNITS = ["s", "rad", "rad/s", "N m"]


def values(n: int = 30) -> np.ndarray:
    t = np.arange(n) / 100
    return np.stack([t, np.sin(3 * t) / 3, np.cos(3 * t), 1e-7 * np.sin(9 * t)], axis=1)


def plain(rows: np.ndarray, mark: str = ",", names: list[str] | None = None, end: str = "\n") -> str:
    lines = [mark.join(names or NAMES), *(mark.join(map(repr, row)) for row in rows.tolist())]
    return end.join(lines) + end


def savetxt(rows: np.ndarray, **how: object) -> str:
    stream = io.StringIO()
    np.savetxt(stream, rows, fmt="%.18e", **how)  # type: ignore[arg-type]
    return stream.getvalue()


def written(rows: np.ndarray) -> dict[str, bytes]:
    """One table in the styles of many tools."""
    usual, frame = plain(rows), pd.DataFrame(rows, columns=NAMES)
    below = usual.split("\n", 1)
    comma, mark = ",".join(NAMES), "\n"
    german = frame.to_csv(index=False, sep=";", decimal=",")
    texts = {
        "plain": usual,
        "savetxt": savetxt(rows, delimiter=",", header=comma),
        "savetxt, blanks": savetxt(rows, header=" ".join(NAMES)),
        "savetxt, blanks below commas": savetxt(rows, header=comma),
        "savetxt, tabs": savetxt(rows, delimiter="\t", header="\t".join(NAMES)),
        "savetxt, two lines": savetxt(rows, delimiter=",", header="robot 1, Tuesday\n" + comma),
        "savetxt, footer": savetxt(rows, delimiter=",", header=comma, footer="the end"),
        "savetxt, no mark": savetxt(rows, delimiter=",", header=comma, comments=""),
        "percent": "%" + usual,
        "percent, units behind another": f"% {comma}{mark}% {','.join(UNITS)}{mark}{below[1]}",
        "units below a mark": f"# {comma}{mark}{','.join(UNITS)}{mark}{below[1]}",
        "comment above": "# robot log\n" + usual,
        "comment within": f"{below[0]}\n# begins, here, it, does, so\n{below[1]}",
        "units": f"{below[0]}\n{','.join(UNITS)}\n{below[1]}",
        "units in brackets": f"{below[0]}\n[s],[rad],[rad/s],[N·m]\n{below[1]}",
        "units in part": f"{below[0]}\n(s),,,\n{below[1]}",
        "units in names": "time [s],qpos.hinge (rad),qvel.hinge [rad/s],ctrl.motor\n" + below[1],
        "marks at the ends": usual.replace("\n", ",\n"),
        "marks at the ends of rows": f"{below[0]}\n" + below[1].replace("\n", ",\n"),
        "a mark at the header's end": f"{below[0]},\n{below[1]}",
        "semicolons": plain(rows, ";"),
        "semicolons, decimal commas": german,
        "spreadsheet": "sep=;\n" + german,
        "tabs": plain(rows, "\t"),
        "tabs, decimal commas": plain(rows, "\t").replace(".", ",").replace("qpos,", "qpos.").replace("qvel,", "qvel."),
        "commas quoted": frame.to_csv(index=False, decimal=",", quoting=1),
        "blanks": plain(rows, "   "),
        "blanks around": plain(rows, " , "),
        "quoted names": usual.replace(comma, ",".join(f'"{name}"' for name in NAMES)),
        "quoted names, blanks": usual.replace(comma, ", ".join(f'"{name}"' for name in NAMES)),
        "single quotes": usual.replace(comma, ",".join(f"'{name}'" for name in NAMES)),
        "all quoted": frame.to_csv(index=False, quoting=1),
        "windows": plain(rows, end="\r\n"),
        "old mac": plain(rows, end="\r"),
        "blank lines": "\n" + usual.replace("\n", "\n\n"),
    }
    texts["tabs, decimal commas"] = "\t".join(NAMES) + "\n" + plain(rows, "\t").split("\n", 1)[1].replace(".", ",")
    coded = {name: text.encode() for name, text in texts.items()}
    coded["byte-order mark"] = usual.encode("utf-8-sig")
    coded["byte-order mark and a hash"] = ("#" + usual).encode("utf-8-sig")
    return coded | {"utf-16": usual.encode("utf-16"), "utf-16, tabs": plain(rows, "\t", end="\r\n").encode("utf-16")}


@pytest.mark.parametrize("style", written(values()))
def test_every_style_holds_the_same_table(style: str, tmp_path) -> None:
    rows = values()
    content = written(rows)[style]
    (tmp_path / "a.csv").write_bytes(content)
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress(content))
    for file in ("a.csv", "b.csv.gz"):
        (episode,) = Measurements.from_csv(tmp_path / file).episodes
        read = np.concatenate([episode.time[:, None], episode.qpos, episode.qvel, episode.ctrl], axis=1)
        np.testing.assert_allclose(read, rows, rtol=1e-12, atol=0)


@settings(max_examples=40)
@given(
    numbers=st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=12),
    style=st.sampled_from(sorted(written(values()))),
)
def test_any_numbers_are_read_to_the_digit(numbers: list[float], style: str, tmp_path_factory) -> None:
    rows = np.stack([np.arange(len(numbers)) / 8, *3 * [np.array(numbers)]], axis=1)
    path = tmp_path_factory.mktemp("tables") / "a.csv"
    path.write_bytes(written(rows)[style])
    found = read_text(str(path))
    assert [*found] == NAMES
    np.testing.assert_allclose(np.stack([*found.values()], axis=1).astype(float), rows, rtol=1e-12, atol=0)


def test_text_columns_keep_their_commas_and_names_of_runs_may_begin_with_a_mark(tmp_path) -> None:
    rows = "".join(f'"#{k // 9}, left";{k % 9},0;{k},5\n' for k in range(18))
    (tmp_path / "a.csv").write_text("# episode;time;qpos.hinge\n" + rows)
    data = Measurements.from_csv(tmp_path / "a.csv")
    assert [e.name for e in data.episodes] == ["#0, left", "#1, left"]
    np.testing.assert_array_equal(data.episodes[1].qpos[:, 0], np.arange(9, 18) + 0.5)


HEAD = "time,qpos.hinge,ctrl.motor\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.0,1.0,2.0\n0.1,1.0,2.0\n", "the first line holds numbers; put a header of names above it"),
        (HEAD + "0,00,0,50,1,00\n0,01,0,51,1,00\n", "row 0 has 6 fields, the header 3; write decimals with points, or"),
        (HEAD + "ms,rad,Nm\n0,1,2\n", "the units say 'ms' of column 'time'; give it in s"),
        (HEAD + "s,deg,Nm\n0,1,2\n", "the units say 'deg' of column 'qpos.hinge'; give it in rad"),
        (HEAD + "[s],[°],[V]\n0,1,2\n", "the units say '\\[°\\]' of column 'qpos.hinge'; give it in rad"),
        ("time [ms],qpos.hinge\n0,1\n", "the units say 'ms' of column 'time'"),
        ("time,qpos.hinge (deg)\n0,1\n", "the units say 'deg' of column 'qpos.hinge'"),
        (HEAD + "a,b,c\n0,1,2\n", "'time' holds 'a', which is no number, in row 0"),
        (HEAD.replace(",", ";") + "0,0;1,5;0.5\n", "'time' holds '0,0' beside '0.5': is its comma a decimal's"),
        (HEAD.replace(",", ";") + "1,000;2,500;3,125\n", "'time' holds '1,000': is its comma .* thousands"),
        (HEAD.replace(",", ";") + "1.000,5;2;3\n", "'time' holds '1.000,5': is its comma"),
        ("# robot log\n0,1\n", "unknown column 'robot'.*unknown, too: 'log'"),
    ],
)
def test_what_may_be_meant_otherwise_is_refused_with_what_to_change(text: str, message: str, tmp_path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        Measurements.from_csv(tmp_path / "a.csv")


def test_a_mark_before_a_name_in_memory_is_said_to_go() -> None:
    t = np.arange(9.0) / 100
    with pytest.raises(ValueError, match=r"column '# time' begins with a mark of comments; call it 'time'"):
        Measurements.from_tables({"run": {"# time": t, "qpos.hinge": t}})


# --- other names ------------------------------------------------------------------------------------------------------

OWN = {"t": "time", "q1": "qpos.hinge", "dq1": "qvel.hinge", "cmd1": "ctrl.motor"}


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_columns_are_renamed(kind: str, tmp_path) -> None:
    rows, path = values(), tmp_path / f"run.{kind}"
    frame = pd.DataFrame(rows, columns=[*OWN])
    if kind == "csv":
        frame.to_csv(path, index=False)
    elif kind == "npz":
        np.savez(path, **{name: frame[name].to_numpy() for name in frame})
    else:
        pytest.importorskip("pyarrow")
        frame.to_parquet(path)
    read = getattr(Measurements, f"from_{kind}")
    (episode,) = read(path, rename=OWN).episodes
    np.testing.assert_array_equal(episode.qpos[:, 0], rows[:, 1])
    with pytest.raises(ValueError, match=r"rename: there is no column 'q2'; did you mean 'q1'"):
        read(path, rename={**OWN, "q2": "qpos.elbow"})
    with pytest.raises(ValueError, match=r"'dq1' would be 'qpos.hinge', which another|'q1' would be 'qpos.hinge', whi"):
        read(path, rename={**OWN, "dq1": "qpos.hinge"})
    with pytest.raises(TypeError, match="rename must be a dict"):
        read(path, rename="t=time")
    with pytest.raises(ValueError, match=r"unknown column 't'.*unknown, too: 'q1', 'dq1', 'cmd1'"):
        read(path)


def test_names_may_be_exchanged(tmp_path) -> None:
    (tmp_path / "a.csv").write_text(plain(values(), names=["time", "qvel.hinge", "qpos.hinge", "ctrl.motor"]))
    data = Measurements.from_csv(tmp_path / "a.csv", {"qvel.hinge": "qpos.hinge", "qpos.hinge": "qvel.hinge"})
    np.testing.assert_array_equal(data.episodes[0].qpos[:, 0], values()[:, 1])


def test_renaming_is_told_in_a_line() -> None:
    assert parse_rename(" t=time, q1=qpos.shoulder,") == {"t": "time", "q1": "qpos.shoulder"}
    assert parse_rename("a=b=qpos.c=d") == {"a=b": "qpos.c=d"}
    assert parse_rename("phase=qpos.=qpos.x") == {"phase": "qpos.=qpos.x"}
    for text, message in (("t", "is not OLD=NEW"), ("q1=shoulder", "begins with qpos."), ("t=time,t=episode", "twice")):
        with pytest.raises(ValueError, match=message):
            parse_rename(text)
