"""Machines unlike one pendulum with a plain motor: recorded by MuJoCo's own fine steps, so that the truth is known."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, briefly, compiled, recorded, torques

from sb3_rpto.effects import LIBRARY, Simulation, declare
from sb3_rpto.effects.corrected_model_io import correct
from sb3_rpto.sysid import Measurements, trace
from sb3_rpto.sysid.data.signal_quality import align_quaternions
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.data_model_consistency import check_against
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, summary
from sb3_rpto.sysid.shooting.windows import discretised, is_stiff

RATE, FINE = 200, 50
MOTOR = '<motor name="motor" joint="hinge"/>'


def machine(
    actuator: str, joint: str = 'damping="0.05"', size: str = 'size=".02" mass="0.5"', length: float = 0.5
) -> str:
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="pole">
<joint name="hinge" axis="0 -1 0" {joint}/><geom type="capsule" fromto="0 0 0 0 0 -{length}" {size}/>
</body></worldbody><actuator>{actuator}</actuator></mujoco>"""


def steps(xml: str, episodes: int = 6, samples: int = 400, size: float = 1.5, **columns: float) -> Measurements:
    """Recordings of a machine by steps of 0.1 ms, 1 mrad of noise on the positions."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = 1 / RATE / FINE
    told, tables = torques(episodes, samples, 0, size), {}
    for e in range(episodes):
        data, rng = mujoco.MjData(model), np.random.default_rng(e)
        data.qpos[:], data.qvel[:] = rng.uniform(-1, 1, (2, 1))
        path = []
        for k in range(samples):
            path.append(data.qpos[0])
            data.ctrl[:] = told[e, k]
            mujoco.mj_step(model, data, FINE)
        table = {"time": np.arange(samples) / RATE, "qpos.hinge": path + 1e-3 * rng.standard_normal(samples)}
        if model.nu:
            table["ctrl.motor"] = told[e]
        tables[f"e{e}"] = table | {name: np.full(samples, value) for name, value in columns.items()}
    return Measurements.from_tables(tables)


def findings(report) -> set[str]:
    return {f.kind for f in report.findings}


@pytest.mark.slow
def test_of_joints_that_a_constraint_ties_no_missing_force_is_told(tmp_path) -> None:
    tied = machine(MOTOR).replace(
        "</worldbody>",
        '<body name="follower" pos="1 0 0"><joint name="tied" axis="0 -1 0"/><geom size=".05" mass=".3" pos="0 0 -.2"/>'
        '</body></worldbody><equality><joint joint1="tied" joint2="hinge" polycoef="0 -1.5 0 0 0"/></equality>',
    )
    model, told, tables = mujoco.MjModel.from_xml_string(tied), torques(5, 300, 0, 1.5), {}
    model.opt.timestep = 1 / RATE / FINE
    for e in range(5):
        data, rng, path = mujoco.MjData(model), np.random.default_rng(e), []
        for k in range(300):
            path.append(data.qpos.copy())
            data.ctrl[:] = told[e, k]
            mujoco.mj_step(model, data, FINE)
        hinge = np.array(path)[:, 0] + 1e-3 * rng.standard_normal(300)
        # Nobody measured the follower: its column follows from the other's.
        tables[f"e{e}"] = {
            "time": np.arange(300) / RATE,
            "qpos.hinge": hinge,
            "qpos.tied": -1.5 * hinge,
            "ctrl.motor": told[e],
        }
    report = briefly(tied, Measurements.from_tables(tables), ["hinge.damping"], candidates=["spring"])
    assert report.verdict == "complete"
    assert np.isnan(report.force_before).all()
    assert "missing force" not in str(report)
    report.save(tmp_path)
    assert "an equality constraint transmits" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_filters_time_constant_is_declared_and_found() -> None:
    slow = '<general name="motor" joint="hinge" dyntype="filter" dynprm="{}"/>'
    data = steps(machine(slow.format(0.09)))
    report = trace(machine(slow.format(0.03)), data, ["motor.timeconst"], candidates=["command_gain"], threads=1)
    assert report.verdict == "complete"
    assert report.declared[0].effect.values[0] == pytest.approx(0.09, rel=0.03)


@pytest.mark.slow
def test_a_machine_without_actuators_is_complete() -> None:
    report = briefly(machine(""), steps(machine("")), ["hinge.damping"], candidates=["coulomb_friction"])
    assert report.verdict == "complete"
    assert report.declared[0].effect.values[0] == pytest.approx(0.05, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("dynamics", ["filter", "filterexact"])
def test_an_actuators_own_filter_is_led_through_the_commands_before_a_window(dynamics: str) -> None:
    xml = machine(f'<general name="motor" joint="hinge" dyntype="{dynamics}" dynprm="0.1" gainprm="1"/>')
    report = briefly(xml, steps(xml), ["hinge.damping"], candidates=[])
    assert report.verdict == "complete"
    load, missing = (np.abs(r).max() for r in (report.residuals_before[0].load, report.force_before))
    assert missing < 0.1 * load


@pytest.mark.slow
@pytest.mark.parametrize("nsample", [402, 20])
def test_an_actuators_own_delay_is_led_too(nsample: int) -> None:
    data = steps(machine('<motor name="motor" joint="hinge" delay="0.04" nsample="402"/>'))
    xml = machine(f'<motor name="motor" joint="hinge" delay="0.04" nsample="{nsample}"/>')
    told = briefly(xml, data, ["hinge.damping"], candidates=[])
    untold = briefly(machine(MOTOR), data, ["hinge.damping"], candidates=[])
    assert told.adequacy_before.ratio < 1.2
    assert untold.adequacy_before.ratio > 5


@pytest.mark.parametrize(
    ("actuator", "message"),
    [
        (
            '<intvelocity name="motor" joint="hinge" kp="1" actrange="-1 1"/>',
            "state of its own.*integrat",
        ),
        (
            '<dcmotor name="motor" joint="hinge" motorconst=".3 .3" resistance="1" inductance=".01"/>',
            "own .its current",
        ),
        (
            '<dcmotor name="motor" joint="hinge" motorconst=".3 .3" resistance="1" thermal="1 1 1"/>',
            "current, temperat",
        ),
        ('<pid name="motor" joint="hinge" input="pos" kp="9" ki="1"/>', "state of its own .the integral"),
        ('<pid name="motor" joint="hinge" kp="9"/>', "'motor' takes 2 commands"),
    ],
)
def test_actuators_whose_state_no_column_tells_are_refused(actuator: str, message: str) -> None:
    names = ["ctrl.motor.0", "ctrl.motor.1"] if "2 commands" in message else ["ctrl.motor"]
    table = {"time": np.arange(50) / RATE, **{n: np.zeros(50) for n in ("qpos.hinge", *names)}}
    with pytest.raises(ValueError, match=message):
        trace(machine(actuator), Measurements.from_tables({"a": table}), threads=1)


@pytest.mark.parametrize(
    "actuator",
    [
        '<dcmotor name="motor" joint="hinge" motorconst=".3 .3" resistance="1"/>',
        '<dcmotor name="motor" joint="hinge" motorconst=".3 .3" resistance="1" input="pos" controller="9 0 .2"/>',
        '<pid name="motor" joint="hinge" input="pos" kp="9"/>',
    ],
)
def test_actuators_of_a_kind_that_may_have_a_state_and_have_none_are_traced(actuator: str) -> None:
    xml = machine(actuator)
    assert {f.kind for f in check_against(compiled(xml), steps(xml, episodes=2, samples=100))} <= {FindingKind.SAMPLING}


@pytest.mark.slow
def test_a_dc_motor_is_traced_with_its_back_emf() -> None:
    """Told apart from the joint's damping are the gain of the amplifier and a late command; a `motor` is not enough."""
    motor = '<dcmotor name="motor" joint="hinge" motorconst=".3 .3" resistance=".5"/>'
    nominal = machine(motor, 'damping="0.02"').replace('"0.002" integrator="implicitfast"', '"0.005" integrator="RK4"')
    (damping,) = declare(compiled(nominal), ["hinge.damping"])
    there = [damping.with_values(np.array([0.05])), LIBRARY["command_gain"]("motor", change=-0.2)]
    there.append(LIBRARY["command_delay"]("motor", delay=0.02))
    data = recorded(there, model=compiled(nominal), episodes=6)
    report = briefly(
        nominal, data, ["hinge.damping"], ["command_gain", "command_delay", "viscous_friction", "dc_motor"]
    )
    assert report.verdict == "explained"
    assert {t.label for t in report.effects} == {"command_gain(motor)", "command_delay(motor)"}
    values = {t.label: t.effect.values[0] for t in (*report.declared, *report.effects)}
    assert values["hinge.damping"] == pytest.approx(0.05, rel=0.05)
    assert values["command_gain(motor)"] == pytest.approx(-0.2, abs=0.01)
    assert values["command_delay(motor)"] == pytest.approx(0.02, abs=0.001)
    plain = briefly(machine(MOTOR.replace("/>", ' gear=".6"/>'), 'damping="0"'), data, [], ["command_delay"])
    assert plain.verdict != "explained"


@pytest.mark.slow
def test_a_stiff_finger_is_integrated_implicitly_and_it_says_so() -> None:
    xml = machine('<position name="motor" joint="hinge" kp="1"/>', 'damping="0.1"', 'size=".005" mass="0.02"', 0.05)
    data = steps(xml, size=0.5)
    report = briefly(xml, data, ["hinge.damping"], candidates=[])
    assert FindingKind.STIFF_MODEL in findings(report)
    assert report.adequacy_before.ratio < 1.5
    assert FindingKind.STIFF_MODEL not in findings(briefly(machine(MOTOR), steps(machine(MOTOR), 4), [], candidates=[]))


def test_the_fastest_rate_of_a_damped_joint_decides_whether_a_model_is_stiff() -> None:
    model = compiled()
    inertia = 0.5 * 0.5**2 / 3 + 1e-4  # of a thin rod about its end, nearly
    for factor, expected in ((0.7, False), (1.4, True)):
        model.dof_damping[0] = factor * 2.0 * inertia / model.opt.timestep
        assert is_stiff(model) == expected


def test_a_servo_that_is_off_leaves_no_missing_force() -> None:
    servo, free = machine('<position name="motor" joint="hinge" kp="5" kv="0.2"/>'), machine("")
    data = steps(free)
    told = [replace(e, ctrl=np.zeros((len(e), 1)), enabled=np.zeros((len(e), 1), dtype=bool)) for e in data.episodes]
    columns = replace(data.columns, ctrl=("motor",))
    model = discretised(mujoco.MjModel.from_xml_string(servo), data, fine=True)
    off = summary(force_residuals(Simulation(model, [], 1), np.empty(0), replace(data, episodes=told, columns=columns)))
    assert off[0] < 0.1  # of a gravity of 1.2 N·m


def test_quaternions_of_one_orientation_are_given_one_sign() -> None:
    angle = np.linspace(0, 12, 100)
    smooth = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], axis=1)
    shown = smooth * np.sign(smooth[:, :1])
    assert align_quaternions(shown) == 2
    np.testing.assert_allclose(shown, smooth)
    columns = {f"qpos.ball.{i}": (smooth * np.sign(smooth[:, :1]))[:, i] for i in range(4)}
    columns |= {f"qvel.ball.{i}": np.full(100, float(i == 0)) for i in range(3)}
    data = Measurements.from_tables({"a": {"time": angle, **columns}})
    np.testing.assert_allclose(data.episodes[0].qpos, smooth)
    assert [f.kind for f in data.findings] == [FindingKind.QUATERNION_SIGN]


@pytest.mark.slow
def test_narrow_bounds_hold_the_fit_and_the_report() -> None:
    data = recorded(model=compiled(PENDULUM.replace('mass="0.5"', 'mass="0.4"')), episodes=6, noise=0.0, exact=True)
    report = trace(PENDULUM, data, ["pole.mass=0.49:0.51"], candidates=[], threads=1)
    assert report.values_before[0] == report.values_after[0] == report.declared[0].effect.values[0] == 0.49


@pytest.mark.parametrize("names", [["pole.mass", "pole.inertia"], ["pole.inertia", "pole.mass"]])
def test_declared_mass_and_inertia_are_those_of_the_corrected_model(names: list[str]) -> None:
    model = compiled()
    values = {"pole.mass": 1.0, "pole.inertia": 0.02}
    found = correct(model, [d.with_values(np.array([values[d.label]])) for d in declare(model, names)])
    assert found.body_mass[1] == pytest.approx(1.0)
    np.testing.assert_allclose(found.body_inertia[1], model.body_inertia[1] * 0.02 / model.body_inertia[1, 0])


def test_a_number_that_is_both_a_column_and_declared_is_refused() -> None:
    data = steps(machine(MOTOR), 4, **{"param.pole.mass": 0.5})
    with pytest.raises(ValueError, match=r"'pole.mass' is the column 'param.pole.mass'"):
        trace(machine(MOTOR), data, ["pole.mass"], threads=1)


@pytest.mark.slow
def test_a_select_run_shorter_than_a_window_joins_the_training_runs() -> None:
    data = steps(machine(MOTOR), 6, 600)
    parts = ["train", "train", "train", "train", "select", "test"]
    episodes = [replace(e, part=part) for e, part in zip(data.episodes, parts)]
    short = {
        n: getattr(episodes[4], n)[:80] for n in ("time", "qpos", "qvel", "ctrl", "qfrc", "enabled", "usable", "placed")
    }
    episodes[4] = replace(episodes[4], **short)
    report = briefly(machine(MOTOR), replace(data, episodes=episodes), ["hinge.damping"], candidates=[])
    assert report.verdict == "complete"
    assert not report.judged_apart
    assert "on fitted windows" in str(report)


def test_a_test_run_too_short_for_inverse_dynamics_is_reported_without_a_missing_force(tmp_path) -> None:
    data = recorded(episodes=6, noise=0.0, exact=True)
    episodes = [replace(e, part="train" if i < 5 else "test") for i, e in enumerate(data.episodes)]
    short = {
        n: getattr(episodes[5], n)[:4] for n in ("time", "qpos", "qvel", "ctrl", "qfrc", "enabled", "usable", "placed")
    }
    episodes[5] = replace(episodes[5], **short)
    report = briefly(PENDULUM, replace(data, episodes=episodes), [], candidates=[])
    assert report.verdict == "complete"
    assert np.isnan(report.force_before).all()
    assert "missing force" not in str(report)
    report.save(tmp_path)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"horizon": 0.0}, "horizon is 0"),
        ({"horizon": float("nan")}, "horizon is nan"),
        ({"horizon": True}, "horizon is True"),
        ({"seed": -1}, "seed must be an? .* got -1"),
        ({"calibrate": -1}, "calibrate must be an? .* got -1"),
        ({"threads": -1}, "threads must be an? .* got -1"),
        ({"candidates": "spring"}, r"write \['spring'\]"),
    ],
)
def test_arguments_out_of_range_are_refused_by_name(argument: dict, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        trace(PENDULUM, recorded(), **argument)


@pytest.mark.slow
def test_a_velocity_servo_of_another_gain_is_no_payload() -> None:
    xml = machine('<velocity name="motor" joint="hinge" kv="{}"/>', 'damping="0.02"')
    kinds = ("velocity_servo_gain", "command_gain", "viscous_friction", "coulomb_friction", "actuator_lag", "payload")
    report = trace(xml.format(1), steps(xml.format(0.7), size=4.0), candidates=kinds, threads=1)
    assert report.verdict == "explained"
    (found,) = report.effects
    assert found.label == "velocity_servo_gain(motor)"
    assert found.effect.values == pytest.approx([-0.3], abs=0.003)
