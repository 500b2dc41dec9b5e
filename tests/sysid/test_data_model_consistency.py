import mujoco
import numpy as np
import pytest

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.problem.data_model_consistency import _correlate, _Force, check_against, unlikely_columns

ARM = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.2" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator>ACTUATORS</actuator>
</mujoco>"""
KINDS = {
    "motor": '<motor name="first" joint="shoulder" gear="2"/><motor name="second" joint="elbow"/>',
    "servo": '<position name="first" joint="shoulder" kp="8" kv="0.3"/><position name="second" joint="elbow" kp="2"/>',
    "lag": "".join(
        f'<general name="{name}" joint="{joint}" gainprm="2" dyntype="filterexact" dynprm="0.05" actearly="true"/>'
        for name, joint in (("first", "shoulder"), ("second", "elbow"))
    ),
}


def model_of(kind="motor", **options):
    xml = ARM.replace("ACTUATORS", KINDS[kind])
    for name, value in options.items():
        xml = xml.replace('timestep="0.002"', f'timestep="0.002" {name}="{value}"')
    return mujoco.MjModel.from_xml_string(xml)


def simulate(model, run, n=400, substeps=5, delay=0, noise=1e-3, hold=4):
    """Held random commands; the machine receives them ``delay`` samples late."""
    rng = np.random.default_rng(run)
    ctrl = np.repeat(rng.uniform(-0.6, 0.6, (n // hold, model.nu)), hold, axis=0)
    data = mujoco.MjData(model)
    rows = []
    for k in range(n):
        # The last step's force, as a torque sensor would show it.
        rows.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = ctrl[k - delay] if k >= delay else 0
        mujoco.mj_step(model, data, substeps)
    qpos, qvel = (np.array(x) for x in zip(*rows))
    qpos, qvel = qpos + noise * rng.normal(size=qpos.shape), qvel + 5 * noise * rng.normal(size=qvel.shape)
    table = {"time": substeps * model.opt.timestep * np.arange(n)}
    for i, joint in ((1, "elbow"), (0, "shoulder")):  # not in the model's order
        table |= {f"qpos.{joint}": qpos[:, i], f"qvel.{joint}": qvel[:, i]}
    return table | {"ctrl.second": ctrl[:, 1], "ctrl.first": ctrl[:, 0]}


def measured(model, runs=3, **kwargs):
    return {f"run{i}": simulate(model, i, **kwargs) for i in range(runs)}


def found(model, tables):
    return [(f.kind, f.where) for f in check_against(model, Measurements.from_tables(tables))]


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 5e-3])
@pytest.mark.parametrize("kind", KINDS)
def test_clean_recordings_have_no_findings(kind, noise):
    model = model_of(kind)
    assert found(model, measured(model, noise=noise)) == []


def test_recordings_of_a_heavier_and_rougher_machine_have_none():
    machine = model_of()
    machine.body_mass[1:] *= 1.5
    machine.body_inertia[1:] *= 1.5
    machine.dof_frictionloss[:] = 0.1
    assert found(model_of(), measured(machine)) == []


def test_a_spring_that_the_model_lacks_is_no_flipped_sign():
    machine = model_of()  # below its resonance the acceleration goes against the command
    machine.jnt_stiffness.reshape(machine.njnt, -1)[:, 0] = 3.0
    assert found(model_of(), measured(machine)) == []


@pytest.mark.parametrize("kind", ["motor", "servo", "lag"])
def test_a_command_flipped_in_one_run(kind):
    model = model_of(kind)
    tables = measured(model)
    tables["run1"]["ctrl.second"] *= -1
    assert found(model, tables) == [(FindingKind.FLIPPED_SIGN, "run1, ctrl.second")]


def test_a_motor_that_turns_the_other_way_in_runs_that_say_so_is_not_flipped():
    model, machine = model_of(), model_of()
    machine.actuator_gear[machine.actuator("second").id, 0] *= -1
    tables = measured(model) | {f"turned {name}": table for name, table in measured(machine).items()}
    gear = float(model.actuator("second").gear[0])
    for name, table in tables.items():
        table["param.second.gear"] = np.full(len(table["time"]), -gear if name.startswith("turned") else gear)
    assert found(model, tables) == []
    for table in tables.values():
        table["param.second.gear"][:] = gear
    assert {(kind, where.split(",")[1]) for kind, where in found(model, tables)} == {
        (FindingKind.FLIPPED_SIGN, " ctrl.second")
    }


def test_a_command_flipped_in_all_runs():
    model = model_of()
    tables = measured(model)
    for table in tables.values():
        table["ctrl.first"] *= -1
    data = Measurements.from_tables(tables)
    (finding,) = check_against(model, data)
    assert (finding.kind, finding.where) == (FindingKind.FLIPPED_SIGN, "all episodes, ctrl.first")
    assert "in every run" in finding.message


PLUGIN = """<mujoco><extension><plugin plugin="mujoco.pid"><instance name="pid">
  <config key="kp" value="20"/><config key="ki" value="60"/></instance></plugin></extension>
  <worldbody><body><joint name="h" axis="0 1 0"/><geom size=".1" pos="0 0 -.1"/></body></worldbody>
  <actuator><plugin name="p" joint="h" plugin="mujoco.pid" instance="pid" actdim="1"/></actuator></mujoco>"""


def test_a_plugin_that_integrates_is_refused():
    time = np.arange(50) * 0.01
    data = Measurements.from_tables({"a": {"time": time, "qpos.h": np.sin(time), "ctrl.p": np.cos(time)}})
    with pytest.raises(ValueError, match=r"actuator 'p' has a state of its own \(of a plugin\) that no column holds"):
        check_against(mujoco.MjModel.from_xml_string(PLUGIN), data)


def with_torque(tables):
    for table in tables.values():
        table["qfrc.elbow"] = table["ctrl.second"].copy()
    return tables


def test_a_measured_torque():
    model = model_of()
    tables = with_torque(measured(model))
    assert found(model, tables) == []
    tables["run2"]["qfrc.elbow"] *= -1
    assert found(model, tables) == [(FindingKind.FLIPPED_SIGN, "run2, qfrc.elbow")]


@pytest.mark.parametrize("delay", [5, 9])
def test_a_late_response_is_measured_in_samples(delay):
    model = model_of()
    findings = check_against(model, Measurements.from_tables(measured(model, delay=delay)))
    assert sorted((f.kind, f.where) for f in findings) == [
        (FindingKind.LATE_RESPONSE, "all episodes, ctrl.first"),
        (FindingKind.LATE_RESPONSE, "all episodes, ctrl.second"),
    ]
    assert all(f"about {delay} samples ({delay * 0.01:.3g} s)" in f.message for f in findings)


def test_a_late_and_flipped_command():
    model = model_of()
    tables = measured(model, delay=6)
    tables["run0"]["ctrl.first"] *= -1
    assert (FindingKind.FLIPPED_SIGN, "run0, ctrl.first") in found(model, tables)


def test_samples_that_are_switched_off_or_not_usable_do_not_count():
    model = model_of()
    tables = measured(model, n=800)
    off = np.arange(800) < 750
    for table in tables.values():
        table["ctrl.first"] = np.where(off, -table["ctrl.first"], table["ctrl.first"])
        table["enabled.first"] = (~off).astype(float)
    assert found(model, tables) == []
    for table in tables.values():
        del table["enabled.first"]
    data = Measurements.from_tables(tables)
    assert [f.kind for f in check_against(model, data)] == [FindingKind.FLIPPED_SIGN]
    for episode in data.episodes:
        episode.usable[:] = ~off
    assert check_against(model, data) == []


def test_the_step_must_be_a_multiple_of_the_timestep():
    model = model_of()
    tables = measured(model)
    coarse = model_of()
    coarse.opt.timestep = 0.003
    (finding,) = check_against(coarse, Measurements.from_tables(tables))
    assert (finding.kind, finding.where) == (FindingKind.SAMPLING, "all episodes, time")
    assert "0.0025 s" in finding.message
    coarse.opt.timestep = 0.02  # a timestep longer than the step is no multiple either
    assert (FindingKind.SAMPLING, "all episodes, time") in found(coarse, tables)


def test_a_machine_that_is_sampled_slowly():
    model = model_of()
    tables = measured(model, substeps=20, hold=8)
    assert found(model, tables) == [(FindingKind.SLOW_SAMPLING, "all episodes, time")]


def test_times_in_milliseconds_are_refused():
    tables = {run: table | {"time": 1e3 * table["time"]} for run, table in measured(model_of()).items()}
    with pytest.raises(ValueError, match=r"median step of column 'time' is 10 s.*give times in seconds"):
        found(model_of(), tables)


def test_milliseconds_of_a_fast_clock_are_refused_too():
    tables = {run: table | {"time": 1e2 * table["time"]} for run, table in measured(model_of()).items()}
    with pytest.raises(ValueError, match=r"is 1 s.*are these milliseconds\?"):
        found(model_of(), tables)


def test_times_in_kiloseconds_are_refused_too():
    tables = {run: table | {"time": 1e-3 * table["time"]} for run, table in measured(model_of()).items()}
    with pytest.raises(ValueError, match=r"is 1e-05 s, the model's 0.002 s; give times in seconds"):
        found(model_of(), tables)


def test_angles_that_may_be_degrees_and_commands_that_never_change():
    tables = measured(model_of())
    for table in tables.values():
        table["qpos.elbow"], table["qvel.elbow"] = (np.degrees(table[f"{q}.elbow"]) for q in ("qpos", "qvel"))
        table["ctrl.second"] = 0 * table["ctrl.second"]
    said = [(f.kind, f.where) for f in unlikely_columns(model_of(), Measurements.from_tables(tables))]
    assert said == [
        (FindingKind.LARGE_ANGLE, "all episodes, qpos.elbow"),
        (FindingKind.CONSTANT_COMMAND, "all episodes, ctrl.second"),
    ]


@pytest.mark.parametrize(("most", "told"), [(0.3, True), (0.7, False)])
def test_motors_whose_force_the_model_limits(most, told):
    model = model_of()
    model.actuator_forcelimited[1], model.actuator_forcerange[1] = 1, (-most, most)
    found = unlikely_columns(model, Measurements.from_tables(measured(model_of())))  # commands of up to 0.6
    assert [(f.kind, f.where) for f in found] == [("limited force", "all episodes, ctrl.second")] * told


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("option.gravity", -9.81, "above 0, such as the model's 9.81"), ("shoulder.damping", -0.1, "at least 0")],
)
def test_settings_that_a_number_cannot_have_are_refused(name, value, said):
    tables = {run: table | {f"param.{name}": np.full(400, value)} for run, table in measured(model_of()).items()}
    with pytest.raises(ValueError, match=f"column 'param.{name}' holds {value:g}; it must be {said}"):
        found(model_of(), tables)


def test_names_that_the_model_has_not():
    model = model_of()
    table = simulate(model, 0)

    def check(rename, match):
        renamed = {rename.get(name, name): values for name, values in table.items() if rename.get(name, name)}
        with pytest.raises(ValueError, match=match):
            check_against(model, Measurements.from_tables({"run": renamed}))

    check({"qpos.elbow": "qpos.elbo", "qvel.elbow": "qvel.elbo"}, r"no joint 'elbo'; did you mean 'elbow'")
    check({"ctrl.first": "ctrl.fist"}, r"no actuator 'fist'; did you mean 'first'")
    check({"ctrl.first": "ctrl.zz"}, r"no actuator 'zz'; known: first, second")
    check({"qpos.elbow": "", "qvel.elbow": ""}, r"joint 'elbow' has no column 'qpos.elbow'; record it")
    check({"ctrl.first": ""}, r"actuator 'first' has no column 'ctrl.first'; record the command")


def test_a_ball_joint_is_no_hinge():
    ball = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="elbow" type="ball"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    time = np.arange(10) * 0.01
    data = Measurements.from_tables({"run": {"time": time, "qpos.elbow": np.sin(time)}})
    with pytest.raises(ValueError, match=r"has the columns elbow, the model needs elbow.0, elbow.1"):
        check_against(ball, data)


def test_commands_that_the_model_clips():
    told = simulate(model_of(), 0)
    limited = KINDS["motor"].replace('gear="2"', 'gear="2" ctrlrange="-0.5 0.5" ctrllimited="true"')
    model = mujoco.MjModel.from_xml_string(ARM.replace("ACTUATORS", limited))
    data = Measurements.from_tables({"run": told})
    (finding,) = (f for f in check_against(model, data) if f.kind == FindingKind.CLIPPED_COMMAND)
    assert finding.where == "all episodes, ctrl.first"
    share = np.mean(np.abs(told["ctrl.first"]) > 0.501)
    assert finding.message.startswith(f"{share:.1%} of the samples are outside the model's ctrlrange [-0.5, 0.5]")
    told["ctrl.first"] = 4.0 * told["ctrl.first"]  # N·m in place of shares
    with pytest.raises(ValueError, match=r"'ctrl.first': \d\d% of the samples.*gear times ctrl"):
        check_against(model, Measurements.from_tables({"run": told}))


@pytest.mark.parametrize("still", ["needed", "given"])
def test_a_force_that_is_constant_but_for_rounding_agrees_with_nothing(still):
    forces = {"needed": np.sin(np.arange(600) / 9), "given": np.cos(np.arange(600) / 9)}
    forces[still] = 0.1 * (1 + 1e-15 * forces[still])
    assert np.std(forces[still]) > 0
    assert _correlate([_Force("run", "elbow", **forces, clear=np.ones(600, dtype=bool))]) is None
