"""Columns that were exchanged, a sign, and commands that come late are told where nothing explains the recordings."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.hypotheses.column_errors import ColumnErrors, readings
from sb3_rpto.sysid.problem.problem import Inputs, prepare
from sb3_rpto.sysid.selection.search import SearchResult, SelectorPair
from sb3_rpto.sysid.selection.stepwise_selection import Selection

ARM = """
<mujoco><option timestep="0.004" gravity="0 0 -4"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1.2"/>
  <body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body>
</body></worldbody><actuator>
  <motor name="first" joint="shoulder" gear="4"/><motor name="second" joint="elbow" gear="1.2"/></actuator></mujoco>
"""


def recorded(late: int = 0) -> dict[str, dict[str, np.ndarray]]:
    """A machine with a spring at its elbow that nobody declared; rows hold the commands of so many rows before."""
    model, rng, tables = mujoco.MjModel.from_xml_string(ARM), np.random.default_rng(1), {}
    model.opt.timestep, model.jnt_stiffness[1] = 2e-4, 0.05
    for run in range(3):
        data, t = mujoco.MjData(model), np.arange(300) / 125
        frequencies, phases = rng.uniform(0.3, 2.0, (2, 4, 1)), rng.uniform(0, 6.28, (2, 4, 1))
        commands = 0.4 * np.sin(2 * np.pi * frequencies * t + phases).sum(axis=1)
        positions = []
        for now in commands.T:
            positions.append(data.qpos.copy())
            data.ctrl[:] = now
            mujoco.mj_step(model, data, 40)
        noisy = np.array(positions) + 1e-3 * rng.standard_normal((len(t), 2))
        told = np.roll(commands, late, axis=1)
        named = {"qpos.shoulder": noisy[:, 0], "qpos.elbow": noisy[:, 1], "ctrl.first": told[0], "ctrl.second": told[1]}
        tables[f"run{run}"] = {"time": t, **named}
    return tables


def misheard(tables: dict[str, dict[str, np.ndarray]], names: dict[str, str], signs: dict[str, float]) -> Measurements:
    return Measurements.from_tables(
        {
            run: {names.get(name, name): signs.get(name, 1.0) * column for name, column in table.items()}
            for run, table in tables.items()
        }
    )


def found_in(data: Measurements) -> list[Finding]:
    """Of the declared model, fitted; nothing else is looked for."""
    task = prepare(Inputs(ARM, data, ["fore.mass"], candidates=[], horizon=0.35, threads=1))
    on = SelectorPair.on(task, 0.35)
    fit = on.fine.train.fit(on.fine.simulation.null, on.fine.free(()), iterations=5)
    base = on.fine.fit_model((), fit)
    result = SearchResult(on, base, None, None, Selection(base), None)  # type: ignore[arg-type]
    return ColumnErrors().hints(task, result, None)  # type: ignore[arg-type]


EXCHANGED = {"qpos.shoulder": "qpos.elbow", "qpos.elbow": "qpos.shoulder"}
TOLD = {"ctrl.first": "ctrl.second", "ctrl.second": "ctrl.first"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "names", "signs", "said"),
    [
        (0, {}, {}, []),
        (1, {}, {}, [(FindingKind.EARLY_RESPONSE, {"all episodes", "ctrl"})]),
        (0, EXCHANGED, {}, [(FindingKind.EXCHANGED, {"qpos.shoulder", "qpos.elbow"})]),
        (0, TOLD, {}, [(FindingKind.EXCHANGED, {"ctrl.first", "ctrl.second"})]),
        (0, EXCHANGED | TOLD, {}, [(FindingKind.EXCHANGED, {*EXCHANGED, *TOLD})]),
        (0, {}, {"qpos.elbow": -1.0}, [(FindingKind.REVERSED, {"qpos.elbow"})]),
        (0, {}, {"qpos.elbow": -1.0, "ctrl.second": -1.0}, [(FindingKind.REVERSED, {"qpos.elbow", "ctrl.second"})]),
    ],
    ids=[
        "as it is",
        "late",
        "positions exchanged",
        "commands exchanged",
        "joints exchanged",
        "reversed",
        "axis reversed",
    ],
)
def test_what_was_logged_otherwise_is_told_though_something_is_missing_too(
    late: int, names: dict[str, str], signs: dict[str, float], said: list[tuple[str, set[str]]]
) -> None:
    data = misheard(recorded(late), names, signs)
    assert [(f.kind, set(f.where.split(", "))) for f in found_in(data)] == said


def test_an_exchange_and_a_sign_are_undone_by_themselves() -> None:
    model, data = mujoco.MjModel.from_xml_string(ARM), Measurements.from_tables(recorded())
    found = list(readings(model, data))
    assert [r.kind for r in found] == [
        FindingKind.EARLY_RESPONSE,
        *[FindingKind.EXCHANGED] * 3,
        *[FindingKind.REVERSED] * 4,
    ]
    episode = data.episodes[0]
    ways = []
    for reading in found[1:]:
        once, twice = reading.again(episode), reading.again(reading.again(episode))
        for name in ("qpos", "qvel", "ctrl", "enabled"):
            np.testing.assert_array_equal(getattr(twice, name), getattr(episode, name))
        ways.append([not np.array_equal(getattr(once, n), getattr(episode, n)) for n in ("qpos", "qvel", "ctrl")])
    moved, told, both = [True, True, False], [False, False, True], [True, True, True]
    assert ways == [moved, both, told, moved, both, moved, both]


def test_one_of_several_commands_of_an_actuator_is_not_a_joints() -> None:
    model, tables = mujoco.MjModel.from_xml_string(ARM), recorded()
    data = misheard(tables, {"ctrl.first": "ctrl.first.0"}, {})
    said = [reading.where for reading in readings(model, data) if reading.kind == FindingKind.REVERSED]
    assert said == ["qpos.shoulder", "qpos.elbow", "qpos.elbow, ctrl.second"]
