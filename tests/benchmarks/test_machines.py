import mujoco
import numpy as np
import pytest

from benchmarks.machines.machines import (
    FOLDER_VARIABLE,
    MACHINES,
    XL330_STALL_TORQUE,
    find_measured,
    simple_pendulum,
)
from sb3_rpto.sysid.findings import FindingKind

FOLDER = find_measured()
measured = pytest.mark.skipif(
    FOLDER is None, reason=f"no recordings: neither ${FOLDER_VARIABLE} nor ../shared/measured is a folder"
)


@pytest.fixture(scope="module")
def machines():
    return {name: load(FOLDER) for name, load in MACHINES.items()}


def compiled(machine):
    model = mujoco.MjModel.from_xml_string(machine.xml)
    return model, mujoco.MjData(model)


def inertia_and_bias(machine, qpos, qvel=0.0):
    """Joint-space inertia matrix, and gravity plus Coriolis torques, at a state."""
    model, data = compiled(machine)
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return inertia, data.qfrc_bias.copy()


def runs(data, part=None):
    return {e.run for e in data.episodes if e.part == part}


def test_the_variable_names_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    assert find_measured() == tmp_path
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "absent"))
    assert find_measured() is None


@pytest.mark.parametrize("name", MACHINES)
def test_absent_recordings_are_an_error_with_a_remedy(name, tmp_path):
    with pytest.raises(FileNotFoundError, match=FOLDER_VARIABLE):
        MACHINES[name](tmp_path)


@measured
@pytest.mark.parametrize("name", MACHINES)
def test_names_of_model_and_data_agree(machines, name):
    machine = machines[name]
    model, _ = compiled(machine)
    assert machine.name == name
    assert machine.data.joints == tuple(model.joint(i).name for i in range(model.njnt))
    assert machine.data.actuators == tuple(model.actuator(i).name for i in range(model.nu))
    kinds = {
        "mass": mujoco.mjtObj.mjOBJ_BODY,
        "inertia": mujoco.mjtObj.mjOBJ_BODY,
        "damping": mujoco.mjtObj.mjOBJ_JOINT,
    }
    for parameter in machine.declared:
        thing, _, kind = parameter.partition(".")
        obj = mujoco.mjtObj.mjOBJ_ACTUATOR if thing == "servo" else kinds[kind]
        assert mujoco.mj_name2id(model, obj, thing) >= 0, parameter
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


@measured
@pytest.mark.parametrize("name", MACHINES)
def test_no_run_is_lost_or_cut(machines, name):
    machine = machines[name]
    cut = {FindingKind.DUPLICATE, FindingKind.GAP, FindingKind.SHORT}
    bad = {*cut, FindingKind.WRAPPED_ANGLE, FindingKind.FLIPPED_VELOCITY, FindingKind.VELOCITY_SLOPE}
    for data in filter(None, (machine.data, machine.other)):
        assert not bad & {f.kind for f in data.findings}
        for e in data.episodes:
            model, _ = compiled(machine)
            assert e.qpos.shape == (len(e), model.nq)
            assert e.qvel.shape == (len(e), model.nv)
            assert e.ctrl.shape == e.enabled.shape == (len(e), model.nu)


@measured
def test_splits(machines):
    simple, double, servo = machines["simple_pendulum"], machines["double_pendulum"], machines["servo_xl330"]
    assert (runs(simple.data, "train"), runs(simple.data, "test")) == ({"ddp"}, {"direct_collocation"})
    assert runs(simple.other) == {"ilqr", "pd"}
    assert {r[-2:] for r in runs(double.data, "train")} == {"00", "01", "02", "12"}
    assert {r[-2:] for r in runs(double.data, "test")} == {"03", "13"}
    assert {r[-2:] for r in runs(double.other)} == {"04", "05"}
    assert {r.split("_")[0] for r in runs(servo.data, "train")} == {"kp100", "kp400"}
    assert {r.split("_")[0] for r in runs(servo.data, "test")} == {"kp200", "kp800"}
    assert (len(servo.data.episodes), servo.other) == (16, None)


@measured
def test_simple_pendulum_is_the_published_identification(machines):
    text = (FOLDER / "simple_pendulum" / "system_identification.txt").read_text()
    known = {k.strip(): float(v) for k, v in (line.split("=")[:2] for line in text.splitlines()[1:5])}
    q = 0.7
    inertia, bias = inertia_and_bias(machines["simple_pendulum"], q)
    np.testing.assert_allclose(inertia, known["J"], rtol=1e-12)
    np.testing.assert_allclose(bias, known["m*cx"] * 9.81 * np.sin(q), rtol=1e-12)
    model, _ = compiled(machines["simple_pendulum"])
    assert model.dof_damping[0] == known["Fv"]


@measured
def test_double_pendulum_is_the_published_one(machines):
    lines = (FOLDER / "double_pendulum" / "design_A.0_model_2.0_parameters.yml").read_text().splitlines()
    p = {k: float(v) for k, v in (line.split(":") for line in lines)}
    (q1, q2), (v1, v2) = (0.4, -1.1), (0.8, -2.0)
    inertia, bias = inertia_and_bias(machines["double_pendulum"], (q1, q2), (v1, v2))
    # Point-to-point Lagrangian of two links, the second angle relative, inertias about the joints.
    h = p["l1"] * p["m2"] * p["r2"]
    m12 = p["I2"] + h * np.cos(q2)
    m11 = p["I1"] + p["I2"] + p["m2"] * p["l1"] ** 2 + 2 * h * np.cos(q2)
    np.testing.assert_allclose(inertia, [[m11, m12], [m12, p["I2"]]], rtol=1e-12)
    g2 = p["m2"] * p["g"] * p["r2"] * np.sin(q1 + q2)
    g1 = p["g"] * (p["m1"] * p["r1"] + p["m2"] * p["l1"]) * np.sin(q1) + g2
    coriolis = [-h * np.sin(q2) * (2 * v1 * v2 + v2**2), h * np.sin(q2) * v1**2]
    np.testing.assert_allclose(bias, np.add([g1, g2], coriolis), rtol=1e-12)
    model, _ = compiled(machines["double_pendulum"])
    np.testing.assert_array_equal(model.dof_damping, [p["b1"], p["b2"]])


@measured
def test_servo_holds_a_point_mass(machines):
    inertia, bias = inertia_and_bias(machines["servo_xl330"], 0.7)
    np.testing.assert_allclose(inertia, 0.49 * 0.10**2, rtol=3e-4)
    np.testing.assert_allclose(bias, 0.49 * 9.81 * 0.10 * np.sin(0.7), rtol=1e-12)


@measured
@pytest.mark.parametrize("kp", [100, 200, 400, 800])
def test_servo_torque_is_that_of_the_firmware(machines, kp):
    machine = machines["servo_xl330"]
    (gain,) = {e.params["servo.kp"] for e in machine.data.episodes if e.run.startswith(f"kp{kp}_")}
    model, data = compiled(machine)
    model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = gain, -gain
    for goal, q, v in [(0.3, 0.1, 2.0), (1.0, -1.0, 5.0), (-3.0, 1.0, -8.0)]:
        data.ctrl[0], data.qpos[0], data.qvel[0] = goal, q, v
        mujoco.mj_forward(model, data)
        duty = np.clip(kp * (4096 / (2 * np.pi)) / (256 * 885) * (goal - q), -1, 1)
        np.testing.assert_allclose(data.qfrc_actuator[0], XL330_STALL_TORQUE * duty, rtol=1e-12)
        # The back-EMF acts beside the clipped torque, so that a stalled duty does not hide it.
        np.testing.assert_allclose(data.qfrc_passive[0], -model.actuator_damping[0] * v, rtol=1e-12)


@measured
def test_servo_is_off_where_the_arm_falls(machines):
    off = {e.run: 1 - e.enabled.mean() for e in machines["servo_xl330"].data.episodes}
    assert all((0.7 < share < 0.8) if "drop" in run else share == 0 for run, share in off.items())


@measured
def test_commands_are_those_the_source_names():
    header = (FOLDER / "simple_pendulum" / "control_method_ddp_data_measured.csv").read_text().splitlines()[1]
    first = simple_pendulum(FOLDER).data.episodes[0]
    time, position, velocity, torque = map(float, header.split(","))
    assert (first.time[0], first.qpos[0, 0], first.qvel[0, 0], first.ctrl[0, 0]) == (time, position, velocity, torque)


@measured
def test_double_pendulum_is_driven_by_the_command(machines):
    first = machines["double_pendulum"].data.episodes[0]
    assert first.run == "trajectory_00"
    # The reported torques of this row are 0.0088 and 0.0029 N·m.
    np.testing.assert_allclose(first.ctrl[1], [-0.007354565, 0.7927749], rtol=1e-6)
