"""Real recordings, traced with a few candidates, and the committed traces; skipped where they are absent."""

import csv
import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks import RESULTS
from benchmarks.machines.machines import MACHINES, find_measured
from sb3_rpto.effects import LIBRARY, Simulation, declare
from sb3_rpto.effects.model import load_model
from sb3_rpto.sysid import Measurements, Report, trace
from sb3_rpto.sysid.shooting.prediction_errors import horizon_errors
from sb3_rpto.sysid.shooting.windows import discretised, noise_levels

#: What a first attempt elsewhere reached, in rad: RMSE at 0.5 s on test and other runs, mean error of whole runs.
FIRST_ATTEMPT = {
    ("simple_pendulum", "test", "0.5", "rmse"): [0.038],
    ("double_pendulum", "test", "0.5", "rmse"): [0.021, 0.075],
    ("double_pendulum", "other", "0.5", "rmse"): [0.043, 0.136],
    ("servo_xl330", "test", "whole run", "mae"): [0.057],
}
FOLDER = find_measured()
pytestmark = pytest.mark.skipif(FOLDER is None, reason="the recordings are absent; docs/real-machines.md tells of them")


def traced(name: str, kinds: list[str]) -> Report:
    machine = MACHINES[name](FOLDER)
    return trace(machine.xml, machine.data, machine.declared, seed=0, candidates=kinds)


@pytest.mark.slow
def test_a_real_pendulum_lacks_dry_friction() -> None:
    report = traced("simple_pendulum", ["coulomb_friction", "torque_offset", "command_delay"])
    assert [t.effect.kind for t in report.effects] == ["coulomb_friction"]
    # An identification on other runs of this machine, published with them, says 0.18 N·m.
    assert report.effects[0].effect.values[0] == pytest.approx(0.18, rel=0.3)
    before, after = ({e.horizon: e.rmse[0] for e in errors} for errors in (report.before, report.after))
    assert after[0.5] < 0.4 * before[0.5]
    # Its recordings hold more than that: friction is no full explanation.
    assert report.verdict in ("partly explained", "unexplained")


def committed(name: str) -> tuple[dict, list[dict[str, str]]]:
    found = json.loads((RESULTS / "machines.json").read_text(encoding="utf-8"))["found"][f"{name}_0"]
    with (RESULTS / "machines.csv").open(newline="", encoding="utf-8") as stream:
        return found, [row for row in csv.DictReader(stream) if row["machine"] == name]


def corrected(found: dict, model) -> Simulation:
    """The simulation with the values that were committed."""
    kinds = [(e["label"].rstrip(")").split("("), e["parameters"]) for e in found["effects"]]
    effects = [LIBRARY[kind](on, **{n: p["value"] for n, p in values.items()}) for (kind, on), values in kinds]
    declared = declare(model, [e["label"] for e in found["declared"]])
    values = [e["parameters"][e["label"]]["value"] for e in found["declared"]]
    return Simulation(model, [*(d.with_values([v]) for d, v in zip(declared, values)), *effects], 1)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "servo_xl330" else ()) for name in MACHINES]
)
def test_committed_errors_are_those_of_the_committed_values(name: str) -> None:
    machine, (found, rows) = MACHINES[name](FOLDER), committed(name)
    model = discretised(load_model(machine.xml)[1], machine.data, fine=True)
    simulation = corrected(found, model)
    train, select, test = machine.data.split(0)
    sigma = noise_levels(replace(machine.data, episodes=train.episodes + select.episodes))

    def check(data: Measurements, what: str) -> None:
        for e in horizon_errors(simulation, simulation.values(), data, sigma, 0):
            said = [r for r in rows if (r["data"], r["model"], r["horizon"]) == (what, "corrected", str(e.horizon))]
            assert [r["joint"] for r in said] == list(e.joints)
            # Where a machine turns over, any rounding grows.
            over = {
                ("simple_pendulum", "other"): 1.0,
                ("double_pendulum", "test"): 1.0,
                ("double_pendulum", "other"): 0.5,
            }
            if (np.inf if e.horizon == "whole run" else e.horizon) <= over.get((name, what), np.inf):
                np.testing.assert_allclose([float(r["rmse"]) for r in said], e.rmse, rtol=0.02)

    check(test, "test")
    if machine.other is not None:
        check(machine.other, "other")


def declared_and_corrected(name: str, what: str, horizon: str, joint: int) -> list[dict[str, str]]:
    rows = [r for r in committed(name)[1] if (r["data"], r["horizon"]) == (what, horizon)]
    return [[r for r in rows if r["model"] == model][joint] for model in ("declared", "corrected")]


@pytest.mark.parametrize(
    ("name", "what", "horizon", "measure", "joint"),
    [(*place, joint) for place, reached in FIRST_ATTEMPT.items() for joint in range(len(reached))],
)
def test_a_first_attempt_is_reached_or_within_the_interval(
    name: str, what: str, horizon: str, measure: str, joint: int
) -> None:
    _, new = declared_and_corrected(name, what, horizon, joint)
    assert min(float(new["low"]), float(new[measure])) <= FIRST_ATTEMPT[name, what, horizon, measure][joint]


@pytest.mark.parametrize(("name", "what", "horizon", "measure"), FIRST_ATTEMPT)
def test_a_quarter_of_every_joints_error_is_taken_away(name: str, what: str, horizon: str, measure: str) -> None:
    for joint in range(len(FIRST_ATTEMPT[name, what, horizon, measure])):
        old, new = declared_and_corrected(name, what, horizon, joint)
        assert float(new[measure]) < 0.75 * float(old[measure])


@pytest.mark.parametrize("what", ["test", "other"])
def test_runs_whose_first_half_tells_their_zeros_are_predicted_far_better(what: str) -> None:
    half = [r for r in committed("double_pendulum")[1] if r["data"] == f"{what}, second half" and r["horizon"] == "0.5"]
    error = {(r["model"], r["joint"]): float(r["rmse"]) for r in half}
    for joint in ("shoulder", "elbow"):
        assert error["corrected, homed", joint] < 0.5 * error["corrected", joint]
        assert error["corrected, homed", joint] < 0.35 * error["declared", joint]


def test_the_zeros_are_what_friction_can_hold_against_gravity() -> None:
    found, _ = committed("double_pendulum")
    level = {e["label"]: e["parameters"]["level"]["value"] for e in found["effects"] if "level" in e["parameters"]}
    machine = MACHINES["double_pendulum"](FOLDER)
    model = load_model(machine.xml)[1]
    # The stiffness of gravity at rest by differences of the static torque.
    data = mujoco.MjData(model)
    for joint, name in enumerate(("shoulder", "elbow")):
        data.qpos[:] = 0
        data.qpos[joint] = 1e-4
        mujoco.mj_forward(model, data)
        held = level[f"coulomb_friction({name})"] / (data.qfrc_bias[joint] / 1e-4)
        offsets = np.array(list(found["zeros"]["offsets"][name].values()))
        assert np.abs(offsets).max() < 1.5 * held
