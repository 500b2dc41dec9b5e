"""Tables against hand-computed numbers, and the report of a folder whose results are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.__main__ import main
from benchmarks.transfer import plan, statistics, tables
from benchmarks.transfer.plots import learning_curves

# --- a folder -------------------------------------------------------------------------------------------------------

REFERENCES = {
    "Hopper_target0": {"zero_shot": 100.0, "oracle": 300.0, "steps": 50, "agent": "abc"},
    "Ant_target1": {"zero_shot": -200.0, "oracle": -100.0, "steps": 50, "agent": "abc"},
}
#: task, target, label, returns at 0, 10 and 20 of each seed
RUNS: list[tuple[str, str, str, str, list[list[float]]]] = [
    ("Hopper", "target0", "rpto-x", "rpto", [[100, 280, 300], [100, 150, 280], [100, 200, 260]]),
    ("Hopper", "target0", "sac-warm", "sac-warm", [[100, 100, 260], [100, 100, 290]]),
    ("Hopper", "target0", "zero-shot", "zero-shot", [[100]]),
    ("Ant", "target1", "rpto-x", "rpto", [[-200, -150, -150]]),
    ("Ant", "target1", "sac-warm", "sac-warm", [[-200, -150, -110]]),
]


def result(task: str, target: str, label: str, method: str, seed: int, returns: list[float]) -> dict[str, Any]:
    job = {"task": task, "target": target, "label": label, "method": method, "seed": seed, "points": [10, 20]}
    spent = {"updates": 5, "source_steps": 2, "seconds": 0.25}
    rows = [
        {"steps": 10 * i, "return": value, **{name: 10 * i * each for name, each in spent.items()}}
        for i, value in enumerate(returns)
    ]
    if method == "rpto":
        rows = [{**row, "model_error": 0.1 * (1 + seed) + row["steps"]} for row in rows]
    made = {"name": f"{task}_{target}_{label}_{seed}", "job": {**job, "factors": {}}, "commit": "c0ffee"}
    made |= {"versions": {}, "python": "3", "machine": "any"}
    return {**made, "source": {"sha256": "abc"}, "seconds": 9.0, "rows": rows}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    manifest = {"suite": "quick", "about": "by hand", "interactions": [], "planned": 10, "references": REFERENCES}
    manifest["labels"] = ["zero-shot", "never-run", "sac-warm", "rpto-x"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "runs").mkdir()
    for task, target, label, method, seeds in RUNS:
        for seed, returns in enumerate(seeds):
            made = result(task, target, label, method, seed, returns)
            (tmp_path / "runs" / f"{made['name']}.json").write_text(json.dumps(made))
    return tmp_path


def test_scores_are_between_the_source_policy_and_the_oracle(folder: Path) -> None:
    rows = tables.load(folder).rows
    ant = rows[(rows.task == "Ant") & (rows.label == "sac-warm")].set_index("steps")
    assert ant.score.round(9).to_dict() == {0: 0.0, 10: 0.5, 20: 0.9}
    flat = {"Ant_target1": {"zero_shot": 1.0, "oracle": 1.0}}
    assert statistics.scored(rows, flat).score.isna().all()


def test_zero_shot_holds_at_all_steps(folder: Path) -> None:
    rows = tables.load(folder).rows
    zero_shot = rows[rows.label == "zero-shot"]
    assert zero_shot[["steps", "return"]].to_numpy().tolist() == [[0, 100], [10, 100], [20, 100]]


def test_curves_and_overall(folder: Path) -> None:
    rows = tables.load(folder).rows
    line = statistics.curves(rows).set_index(["task", "label", "steps"]).loc[("Hopper", "rpto-x", 20)]
    assert (line["runs"], line["return"], line["score"]) == (3, 280.0, pytest.approx(0.9))
    assert 260 <= line.return_low < 280 < line.return_high <= 300
    both = statistics.overall(rows).set_index(["label", "steps"]).loc[("rpto-x", 20)]
    # Scores 0.8, 0.9, 1.0 on one target, 0.5 on the other; a quarter of four is one.
    assert (both["runs"], both["places"], both["score"]) == (4, 2, pytest.approx(0.85))


def test_improvement_over_each_method(folder: Path) -> None:
    table = statistics.improvements(tables.load(folder).rows, ["rpto-x"]).set_index(["task", "steps", "other"])
    assert table.loc[("Hopper", 20, "sac-warm"), "probability"] == pytest.approx(3.5 / 6)  # 2, 1, a tie
    assert table.loc[("Hopper", 10, "sac-warm"), "probability"] == 1.0
    assert table.loc[("Ant", 20, "sac-warm"), "probability"] == 0.0
    assert table.loc[("all", 20, "sac-warm"), "probability"] == pytest.approx(3.5 / 12)
    assert table.loc[("all", 20, "zero-shot"), "probability"] == 1.0


def test_costs_and_the_first_step_at_ninety_percent(folder: Path) -> None:
    table = statistics.costs(tables.load(folder).rows, REFERENCES).set_index(["task", "label"])
    ours, theirs = table.loc[("Hopper", "rpto-x")], table.loc[("Hopper", "sac-warm")]
    assert (ours.updates, ours.source_steps, ours.seconds) == (5, 2, 0.25)
    assert (ours.model_error, theirs.model_error) == (pytest.approx(20.2), pytest.approx(np.nan, nan_ok=True))
    assert (ours.reached, ours.steps_to) == (2, 20)  # 270 at 10, at 20, never
    assert (theirs.reached, theirs.steps_to) == (1, np.inf)
    # Returns below zero: within a tenth of the oracle's is -110.
    assert table.loc[("Ant", "sac-warm"), "steps_to"] == 20
    assert table.loc[("Ant", "rpto-x"), "reached"] == 0


def test_what_came_before_the_first_target_step_is_no_cost_of_one(folder: Path) -> None:
    for file in (folder / "runs").glob("*rpto-x*"):
        made = json.loads(file.read_text())
        for row in made["rows"]:
            row["source_steps"] += 5_000  # phi_0's
        file.write_text(json.dumps(made))
    table = statistics.costs(tables.load(folder).rows, REFERENCES).set_index(["task", "label"])
    assert table.loc[("Hopper", "rpto-x"), "source_steps"] == 2


@pytest.mark.parametrize("torn", ["null", "[]", "{", "{}"])
def test_torn_files_are_told(folder: Path, torn: str) -> None:
    (folder / "runs" / "torn.json").write_text(torn)
    assert tables.load(folder).failed == {"torn": "torn file"}
    (folder / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest.json is torn .*; run 'python -m benchmarks transfer'"):
        tables.load(folder)


def test_first_on_how_many_targets(folder: Path) -> None:
    table = statistics.firsts(statistics.curves(tables.load(folder).rows)).set_index(["label", "steps"])
    assert table["first"].to_dict() == {
        **{("rpto-x", 10): 2, ("rpto-x", 20): 1},
        **{("sac-warm", 10): 1, ("sac-warm", 20): 1},  # a tie at 10
        **{("zero-shot", 10): 0, ("zero-shot", 20): 0},
    }
    assert table.loc[("sac-warm", 20), "where"] == "Ant target1"
    assert table.loc[("zero-shot", 20), "places"] == 1


def test_everything_is_written_beside_the_manifest(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["transfer", "report", str(folder)]) == 0
    text = (folder / "table.md").read_text()
    assert capsys.readouterr().out.strip() == text.strip()
    assert "8 of 10 runs are done" in text
    assert "| sac-warm | 2 |" in text
    assert "> 20 (1/2)" in text
    assert "First: at 10 rpto-x, sac-warm; at 20 sac-warm." in text
    assert "never-run" not in text
    found = json.loads((folder / "table.json").read_text(), parse_constant=pytest.fail)
    assert found["commits"] == ["c0ffee"]
    assert (folder / "table.png").read_bytes().startswith(b"\x89PNG")


def test_a_table_reports_what_its_folder_reports(folder: Path, tmp_path: Path) -> None:
    text = tables.write(folder, tmp_path / "quick")
    assert tables.write(tmp_path / "quick.csv") == text
    assert tables.load(tmp_path / "quick.csv").results == tables.load(folder).results


def test_the_figure_shows_the_table(folder: Path) -> None:
    lines = statistics.curves(tables.load(folder).rows)
    labels = ["zero-shot", "sac-warm", "rpto-x"]
    figure = learning_curves(lines, REFERENCES, labels, ["rpto-x"], folder / "figure.pdf")
    panels = {axis.get_title(): axis for axis in figure.axes if axis.get_visible()}
    assert list(panels) == ["Ant, target1", "Hopper, target0"]
    drawn = {line.get_label(): line for line in panels["Hopper, target0"].get_lines()}
    assert list(drawn["rpto-x"].get_ydata()) == [100, 210, 280]
    assert set(drawn["oracle"].get_ydata()) == {300}
    assert drawn["rpto-x"].get_linewidth() > drawn["sac-warm"].get_linewidth()
    assert len(panels["Hopper, target0"].collections) == 3
    assert (folder / "figure.pdf").stat().st_size > 0


def test_what_does_not_count_is_said(folder: Path) -> None:
    other = result("Hopper", "target0", "sac-warm", "sac-warm", 5, [100.0, 1e6, 1e6])
    other["source"]["sha256"] = "of another agent"
    broken = {**result("Ant", "target1", "sac-warm", "sac-warm", 6, []), "error": "Traceback\nValueError: NaN"}
    for made in (other, broken):
        (folder / "runs" / f"{made['name']}.json").write_text(json.dumps(made))
    (folder / "runs" / "Ant_target1_sac-warm_7.json").write_text('{"name": "torn')
    text = tables.write(folder)
    assert "8 of 10 runs are done" in text
    assert "Ant_target1_sac-warm_6 (ValueError: NaN); Ant_target1_sac-warm_7 (torn file)" in text
    assert "Left out: Hopper_target0_sac-warm_5 (of another source agent)." in text


def test_runs_of_settings_that_the_suite_had_before_are_left_out(folder: Path) -> None:
    made = {file: json.loads(file.read_text()) for file in (folder / "runs").glob("*.json")}
    assert len(tables.load(folder).left_out) == 0
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["variants"] = [plan.variant_of(result["job"]) for result in made.values()]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert len(tables.load(folder).left_out) == 0
    file = next(file for file in made if made[file]["job"]["seed"] == 0 and made[file]["job"]["method"] == "sac-warm")
    made[file]["job"]["settings"] = {"learning_rate": 0.01}
    file.write_text(json.dumps(made[file]))
    assert tables.load(folder).left_out == {made[file]["name"]: "of other settings than the suite's"}


def test_a_single_run_has_no_interval(folder: Path) -> None:
    together, ant, hopper = tables.write(folder).split("\n## ")[2:5]
    assert (hopper.split("\n")[0], ant.split("\n")[0]) == ("Hopper target0", "Ant target1")
    assert "[" in next(line for line in hopper.splitlines() if line.startswith("| sac-warm"))
    assert "[" not in next(line for line in ant.splitlines() if line.startswith("| sac-warm"))
    assert "[" in next(line for line in together.splitlines() if line.startswith("| sac-warm"))


def test_small_gaps_are_pointed_out(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["references"]["Hopper_target0"] |= {"zero_shot": 299.0}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert "| Hopper_target0 | 299 | 300 | 50 | hardly any" in tables.write(folder)


def test_factors_are_averaged_over_cells(folder: Path) -> None:
    rows = pd.DataFrame(
        [
            {"task": "Hopper", "target": "target0", "label": f"{a}{b}", "seed": 0, "steps": 20, "score": score}
            | {"factors": {"A": a, "B": b}}
            for a, b, score in (("on", "x", 1.0), ("on", "y", 0.6), ("off", "x", 0.2), ("off", "y", 0.0))
        ]
    )
    table = statistics.effects(rows, [("A", "B")]).set_index(["factor", "level", "task"])["score"]
    assert table.loc[("A", "on", "all")] == pytest.approx(0.8)
    assert table.loc[("A", "off", "Hopper")] == pytest.approx(0.1)
    assert table.loc[("B", "x", "all")] == pytest.approx(0.6)
    assert table.loc[("A x B", "off, y", "all")] == 0.0


def test_a_factorial_suite_reports_its_factors(folder: Path) -> None:
    labels = []
    for file in (folder / "runs").glob("*.json"):
        made = json.loads(file.read_text())
        labels.append(made["job"]["label"])
        made["job"]["factors"] = {"kind": str(20 if labels[0] == labels[-1] else 5)}
        file.write_text(json.dumps(made))
    text = tables.write(folder)
    assert text.index("| 5 | ") < text.index("| 20 | "), "levels in order, numbers by their size"
    assert "| kind | runs | score, Ant | score, Hopper | score, all |" in text


def test_no_results_are_bad_input(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (folder / "runs").glob("*.json"):
        file.unlink()
    assert main(["transfer", "report", str(folder)]) == 2
    assert "no run is done" in capsys.readouterr().err
    assert main(["transfer", "report", str(folder / "absent")]) == 2
    assert "benchmarks transfer" in capsys.readouterr().err
