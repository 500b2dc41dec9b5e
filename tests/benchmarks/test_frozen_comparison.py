"""What a change of structure must not change: the comparison tells what did."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.frozen import compare_traces
from benchmarks.runner import write_table


def traced(verdict: str, level: float, mass: float) -> dict:
    effect = {"label": "coulomb_friction(hinge)", "parameters": {"level": {"value": level}}}
    number = {"label": "pole.mass", "parameters": {"pole.mass": {"value": mass}}}
    return {"id": "one", "verdict": verdict, "effects": [effect], "declared": [number]}


@pytest.fixture
def then(tmp_path: Path) -> Path:
    values = {"pole.mass": 0.5, "coulomb_friction(hinge).level": 0.25}
    row = {"set": "one", "verdict": "explained", "effects": "coulomb_friction(hinge)", "values": values}
    path = tmp_path / "frozen.csv"
    write_table(path, [row], digits=None)
    return path


@pytest.mark.parametrize(
    ("now", "same"),
    [
        (traced("explained", 0.25, 0.5), True),
        (traced("explained", 0.250001, 0.5), True),
        (traced("explained", 0.26, 0.5), False),
        (traced("unexplained", 0.25, 0.5), False),
    ],
)
def test_verdicts_effects_and_values_are_compared(now: dict, same: bool, then: Path, tmp_path: Path) -> None:
    write_table(tmp_path / "now.csv", [now], digits=None)
    (row,) = compare_traces(tmp_path / "now.csv", then).to_dict("records")
    assert row["same"] == same


def test_tables_without_a_common_set_are_refused(then: Path, tmp_path: Path) -> None:
    write_table(tmp_path / "now.csv", [{**traced("explained", 0.25, 0.5), "id": "two"}], digits=None)
    with pytest.raises(ValueError, match="has none of the sets"):
        compare_traces(tmp_path / "now.csv", then)
