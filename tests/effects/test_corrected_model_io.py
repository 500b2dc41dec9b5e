"""Corrected simulators reload bit for bit, and models load from whatever holds one."""

import json
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv

from sb3_rpto.effects import LIBRARY, Declared, Drive, Effect, Parameter, Scales, Simulation, declare, mjcf, register
from sb3_rpto.effects.bodies import LinkLength
from sb3_rpto.effects.corrected_model_io import carried_by, correct, load_corrected, save_corrected
from sb3_rpto.effects.friction import CoulombFriction, StribeckFriction
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.model_numbers import differing, numbers
from sb3_rpto.effects.walker_reset import StandingEnv
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.corrected import apply_effects

POLE = "InvertedDoublePendulum-v5"
ARM = """
<mujoco model="arm">
  <compiler inertiafromgeom="true" settotalmass="3.3"/>
  <option timestep="0.002" integrator="implicitfast" density="1.2"/>
  <default><geom density="700" friction="0.8"/></default>
  <asset>%s</asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" pos="0 0 -.4"/>
    <body name="upper" pos="0 0 1" euler="10 20 30">
      <joint name="shoulder" axis="0 1 0" damping="0.1234567890123" range="-150 150"/>
      <geom name="upper" type="capsule" size=".04" fromto="0 0 0 .33333333333 0 0"/>
      <body name="fore" pos=".33333333333 0 0">
        <joint name="elbow" axis="0 1 0" armature="0.01"/>
        <geom name="fore" type="capsule" size=".03" fromto="0 0 0 .28571428571 0 0"/>
        %s
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" gear="3" ctrlrange="-1 1"/>
    <position name="servo" joint="elbow" kp="7" kv="0.5"/>
  </actuator>
</mujoco>
"""
PLAIN = ARM % ("", "")
LOOSE = PLAIN.replace(
    '<joint name="shoulder"', '<joint name="lift" type="slide" axis="0 0 1"/><joint name="shoulder"'
).replace("</actuator>", '<velocity name="drive" joint="lift" kv="2"/></actuator>')
TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
MESHED = (ARM % ('<mesh name="tip" file="tip.obj"/>', '<geom type="mesh" mesh="tip" pos=".3 0 0"/>')).replace(
    "<compiler ", '<compiler meshdir="parts" '
)
# MuJoCo says so of an attribute that gymnasium's HalfCheetah has
pytestmark = pytest.mark.filterwarnings("ignore:.*settotalmass")


class Hold(Effect):
    """What the library's own filters and delays look like here."""

    kind, place, equation = "test_hold", "actuator", "u of the step before"
    parameters = (Parameter("share", "", 0.1),)

    def command(self, u, x, memory, dt):
        last, memory["u"] = memory.get("u", u), u
        return (1 - x[:, 0]) * u + x[:, 0] * last


@pytest.fixture(scope="module", autouse=True)
def _registered():
    """Here alone: other modules are parametrised over the library."""
    register(Hold)
    yield
    del LIBRARY["test_hold"]


def effects(model):
    values = {
        "shoulder.damping": 1 / 3,
        "elbow.armature": 0.0271828182845904,
        "fore.mass": np.pi / 2,
        "option.gravity": 9.7 + 1e-9,
        "option.viscosity": 1e-4 / 3,
        "motor.gear": 3.3,
        "servo.strength": 1.07,
        "floor.friction": 0.7,
    }
    declared = [Declared(model, name).with_values(np.array([value])) for name, value in values.items()]
    return [
        *declared,
        CoulombFriction("elbow", level=0.1 / 3),
        StribeckFriction("shoulder", extra=0.07, level=0.021, speed=0.35),
        Hold("motor", share=0.6),
    ]


def rollout(simulation, seed=0, steps=200):
    model, rng = simulation.model, np.random.default_rng(seed)
    commands = rng.normal(size=(2, steps, model.nu))
    qpos, qvel = rng.normal(size=(2, model.nq)), rng.normal(size=(2, model.nv))
    return simulation.rollout(np.tile(simulation.values(), (2, 1)), qpos, qvel, Drive(commands))


def assert_equal_models(one, other):
    theirs = numbers(other)
    for name, value in numbers(one).items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)


def assert_equal_rollouts(one, other):
    for a, b in zip(rollout(one), rollout(other), strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_array_equal(a, b)


def test_a_joint_whose_friction_is_fitted_away_reloads_with_its_own_constraint(tmp_path):
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="0.05" frictionloss="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.5" size="0.03"/></body></worldbody></mujoco>""")
    model, start, free = spec.copy().compile(), np.array([[1.0]]), Drive(np.zeros((1, 500, 0)))
    gone = declare(model, ["hinge.frictionloss"])[0].with_values(np.array([0.0]))
    lacks = [gone, StribeckFriction("hinge", extra=0.02, level=0.02, speed=0.3)]
    traced = Simulation(model, lacks, 1)
    save_corrected(tmp_path, spec, lacks)
    saved = load_corrected(tmp_path).simulation(1)
    ours, theirs = (s.rollout(s.values()[None], start, np.zeros((1, 1)), free)[0] for s in (traced, saved))
    np.testing.assert_array_equal(ours, theirs)


def test_a_saved_simulator_reloads_bit_for_bit(tmp_path):
    nominal = load_model(PLAIN)[1]
    chosen = effects(nominal)
    save_corrected(tmp_path, PLAIN, chosen)
    loaded = load_corrected(tmp_path)
    assert_equal_models(loaded.model, correct(nominal, chosen))
    # ... and to what acts before anything is saved, declared parameters and all
    assert_equal_rollouts(loaded.simulation(1), Simulation(nominal, chosen, 1))
    for one, other in zip(loaded.effects, chosen, strict=True):
        assert (one.kind, one.label) == (other.kind, other.label)
        np.testing.assert_array_equal(one.values, other.values)


@pytest.mark.parametrize("kind", sorted(LIBRARY))
def test_every_effect_of_the_library_reloads(tmp_path, kind):
    cls = LIBRARY[kind]
    model = PLAIN if cls.places(load_model(PLAIN)[1]) else LOOSE
    nominal = load_model(model)[1]
    values = {p.name: np.clip(p.null + p.size_for(Scales()) / 3, p.lower, p.upper) for p in cls.parameters}
    chosen = [cls(cls.places(nominal)[-1], **values)]
    save_corrected(tmp_path, model, chosen)
    loaded = load_corrected(tmp_path)
    np.testing.assert_array_equal(loaded.effects[0].values, chosen[0].values)
    assert_equal_models(loaded.model, correct(nominal, chosen))
    assert_equal_rollouts(loaded.simulation(1), Simulation(nominal, chosen, 1))


def test_every_declared_parameter_reloads(tmp_path):
    nominal = load_model(PLAIN)[1]
    chosen = [d.with_values(d.values * (1 + 1 / 7) + 1e-3 / 3) for d in declare(nominal, ["*"])]
    save_corrected(tmp_path, PLAIN, chosen)
    loaded = load_corrected(tmp_path)
    assert_equal_models(loaded.model, correct(nominal, chosen))
    assert_equal_rollouts(loaded.simulation(1), Simulation(nominal, chosen, 1))


@pytest.mark.parametrize("names", [["servo.kp", "servo.kv"], ["servo.gain", "servo.kv"]])
def test_a_servo_that_is_none_once_corrected_reloads(tmp_path, names):
    nominal = load_model(PLAIN)[1]
    chosen = [d.with_values(1.2 * d.values) for d in declare(nominal, names)]
    chosen += [LIBRARY["command_gain"]("servo", change=0.1)] if "servo.kp" in names else []
    save_corrected(tmp_path, PLAIN, chosen)
    loaded = load_corrected(tmp_path)
    assert [repr(e) for e in loaded.effects] == [repr(e) for e in chosen]
    assert [d.nominal for d in loaded.effects[:2]] == [7.0, 0.5]
    assert_equal_models(loaded.model, correct(nominal, chosen))


def test_saving_what_was_loaded_gives_the_same_files(tmp_path):
    save_corrected(tmp_path / "one", PLAIN, effects(load_model(PLAIN)[1]))
    save_corrected(tmp_path / "two", PLAIN, load_corrected(tmp_path / "one").effects)
    for name in ("model.xml", "effects.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert_equal_models(load_corrected(tmp_path / "one").model, load_corrected(tmp_path / "two").model)


def test_the_mjcf_alone_is_the_corrected_model_up_to_its_digits(tmp_path):
    nominal = load_model(PLAIN)[1]
    chosen = effects(nominal)
    save_corrected(tmp_path, PLAIN, chosen)
    plain, exact = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), numbers(correct(nominal, chosen))
    for name, value in numbers(plain).items():
        if not name.startswith("stat."):
            np.testing.assert_allclose(value, exact[name], rtol=2e-5, atol=2e-5, err_msg=name)
    assert plain.dof_frictionloss[1] == pytest.approx(0.1 / 3, rel=1e-5)


DERIVED = {
    "dampratio": ("", 'name="servo" joint="knee" kp="10" dampratio="1"', "payload(c)"),
    "inheritrange": ("", 'name="servo" joint="knee" kp="10" inheritrange="1"', "end_stop(knee)"),
    "stops that meet": ("", 'name="servo" joint="knee" kp="10"', "end_stop(knee), crossing"),
    "springdamper": ('springdamper="0.1 1"', "", "b.mass"),
    "boundmass": ("", "", "c.mass"),
    "springlength": ("", "", "link_length(b)"),
    "springlength of a spring": ("", "", "spring(hip)"),
}


@pytest.mark.parametrize("what", DERIVED)
def test_what_mujoco_derives_stays_as_it_was_derived_for_the_nominal_model(what, tmp_path):
    joint, servo, changed = DERIVED[what]
    joints = f"""<joint name="hip" axis="0 1 0" {joint}/>""", '<joint name="knee" axis="0 1 0" range="-1 1"/>'
    xml = f"""<mujoco><compiler angle="radian" boundmass="0.1"/><worldbody><site name="wall" pos=".3 0 0"/>
      <body name="b">{joints[0]}<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/><site name="end" pos="0 0 -.5"/>
      <body name="c" pos="0 0 -.5">{joints[1]}<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3"/></body></body>
      </worldbody><tendon><spatial stiffness="200"><site site="wall"/><site site="end"/></spatial></tendon>
      <actuator>{f"<position {servo}/>" if servo else ""}<motor name="motor" joint="hip"/></actuator></mujoco>"""
    (tmp_path / "machine.xml").write_text(xml)
    nominal = mujoco.MjModel.from_xml_string(xml)
    effect = {
        "payload(c)": lambda: LIBRARY["payload"]("c", mass=0.5),
        "end_stop(knee)": lambda: LIBRARY["end_stop"]("knee", lower=0.2, upper=-0.2),
        "end_stop(knee), crossing": lambda: LIBRARY["end_stop"]("knee", lower=1.2, upper=-1.3),
        "b.mass": lambda: declare(nominal, ["b.mass"])[0].with_values(np.array([2.0])),
        "c.mass": lambda: declare(nominal, ["c.mass"])[0].with_values(np.array([0.05])),
        "link_length(b)": lambda: LIBRARY["link_length"]("b", change=0.2),
        "spring(hip)": lambda: LIBRARY["spring"]("hip", stiffness=1.0, reference=0.5),
    }[changed]()
    save_corrected(tmp_path / "saved", tmp_path / "machine.xml", [effect])
    plain, exact = mujoco.MjModel.from_xml_path(str(tmp_path / "saved/model.xml")), load_corrected(tmp_path / "saved")
    assert differing(plain, exact.model, rounded=True) == []
    assert differing(nominal, exact.model, rounded=True) != []


def test_the_json_says_what_carries_an_effect(tmp_path):
    save_corrected(tmp_path, PLAIN, effects(load_model(PLAIN)[1]))
    stored = json.loads((tmp_path / "effects.json").read_text())
    entries = {entry["kind"]: entry for entry in stored["effects"]}
    assert {kind: entry["carried_by"] for kind, entry in entries.items()} == {
        "declared": "mjcf",
        "coulomb_friction": "mjcf",
        "stribeck_friction": "wrapper",
        "test_hold": "wrapper",
    }
    assert entries["stribeck_friction"]["unit"] == {"extra": "N·m", "level": "N·m", "speed": "rad/s"}
    assert entries["stribeck_friction"]["equation"] == StribeckFriction.equation
    assert stored["effects"][0] == {
        "kind": "declared",
        "on": "",
        "values": {"shoulder.damping": 1 / 3},
        "unit": {"shoulder.damping": "N·m·s/rad"},
        "equation": Declared.equation,
        "carried_by": "mjcf",
        "nominal": {"shoulder.damping": 0.1234567890123},
    }
    assert carried_by(Hold("motor")) == "wrapper"


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Hopper-v5", "Humanoid-v5"])
def test_an_environment_reloads_with_what_was_changed_in_it(tmp_path, name):
    env = gym.make(name)
    model = env.unwrapped.model
    model.dof_damping[-1] += 1e-7 / 3  # a shift of the task itself, too small for the MJCF's digits
    model.qpos_spring[-1] = 0.1
    model.opt.wind[:] = (1 / 3, 0, 0)
    before = {field: value.copy() for field, value in numbers(model).items()}
    joint = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt - 1)
    body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, 2)
    chosen = [
        Declared(model, f"{body}.mass").with_values(np.array([3.3])),
        CoulombFriction(joint, level=0.7),
        StribeckFriction(joint, extra=1.0, level=0.3),
    ]
    save_corrected(tmp_path, env, chosen)
    np.testing.assert_equal(numbers(model), before)
    loaded = load_corrected(tmp_path)
    assert_equal_models(loaded.model, correct(model, chosen))
    assert loaded.model.dof_damping[-1] == model.dof_damping[-1]
    applied = loaded.apply(env)
    assert isinstance(applied, CorrectedEnv)
    for field in ("body_mass", "body_inertia", "dof_invweight0", "dof_frictionloss", "opt.wind"):
        np.testing.assert_array_equal(numbers(applied.unwrapped.model)[field], numbers(loaded.model)[field])
    with pytest.raises(ValueError, match=r"no numbers of its model \(stribeck_friction"):
        save_corrected(tmp_path, applied, [])
    applied.set_effects(chosen[:2])  # numbers, which its model holds
    save_corrected(tmp_path, applied, [])
    assert_equal_models(load_corrected(tmp_path).model, correct(model, []))


def test_a_walker_that_is_loaded_stands_as_the_one_that_was_saved(tmp_path):
    chosen = [LinkLength("leg", change=0.4)]
    one = apply_effects(gym.make("Hopper-v5"), chosen)
    save_corrected(tmp_path, gym.make("Hopper-v5"), chosen)
    corrected = load_corrected(tmp_path)
    of_the_file = gym.make("Hopper-v5", xml_file=str(tmp_path / "model.xml"))  # its numbers are there, its pose is not
    for env in (corrected.apply(gym.make("Hopper-v5")), corrected.apply(of_the_file)):
        again = pickle.loads(pickle.dumps(env))
        start = one.reset(seed=0)[0]
        for twin in (env, again):
            np.testing.assert_allclose(twin.reset(seed=0)[0], start, atol=1e-12)
            assert twin.unwrapped.data.ncon == 0
            np.testing.assert_allclose(twin.unwrapped._healthy_z_range, one.unwrapped._healthy_z_range)
        for _ in range(20):
            action = one.action_space.sample()
            for mine, theirs in zip(one.step(action)[:3], env.step(action)[:3]):
                np.testing.assert_allclose(mine, theirs, atol=1e-4)  # the file has six digits


WORLD = """<mujoco><worldbody>{wall}
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="arm" pos="0 0 .5"><joint name="h"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/></body>
  <body name="box" pos="1 0 .2"><freejoint/><geom type="box" size=".1 .1 .1"/>
    <body name="foot" pos=".1 0 0"><joint name="ankle"/><geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02"/></body>
  </body></worldbody><actuator><motor joint="h"/></actuator></mujoco>"""
WALL = '<geom name="wall" type="plane" pos="3 0 0" zaxis="-1 0 0" size="5 5 .1"/>'


class Standing(MujocoEnv):
    metadata = MujocoEnv.metadata | {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, xml):
        super().__init__(xml, 4, gym.spaces.Box(-np.inf, np.inf, (1,)))


@pytest.mark.parametrize("wall", ["", WALL])
def test_what_stands_does_so_by_its_own_lowest_point_over_the_floor(wall, tmp_path):
    (tmp_path / "world.xml").write_text(WORLD.format(wall=wall))
    heights = []
    for effects in ([], [LinkLength("arm", change=0.5)], [LinkLength("foot", change=0.2)]):
        env = StandingEnv(Standing(str(tmp_path / "world.xml")), effects)
        heights.append(env.unwrapped.init_qpos[3])
    assert heights == pytest.approx([0.2, 0.2, 0.2 + 0.2 * 0.15])


BALL = '<body name="ball" pos="2 0 .1"><freejoint/><geom type="sphere" size=".1"/></body>'


def test_the_machine_stands_whatever_lies_beside_it_and_what_hangs_is_left_there(tmp_path):
    batch = WORLD.format(wall="").replace('<body name="arm"', BALL + '<body name="arm"')
    hanging = WORLD.format(wall="").replace("1 0 .2", "1 0 .9")
    for xml, start in ((batch, 0.2 + 0.2 * 0.15), (hanging, 0.9)):
        (tmp_path / "world.xml").write_text(xml)
        base = StandingEnv(Standing(str(tmp_path / "world.xml")), [LinkLength("foot", change=0.2)]).unwrapped
        assert base.init_qpos[base.model.joint(base.model.body("box").jntadr[0]).qposadr[0] + 2] == pytest.approx(start)


def test_a_walker_that_begins_in_a_pose_of_its_own_is_left_there(tmp_path):
    from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

    def crouched(**kwargs):
        env = HopperEnv(**kwargs)
        env.init_qpos = env.init_qpos.copy()
        env.init_qpos[[1, 3, 4, 5]] = 0.95, -0.8, -1.2, 0.4
        return env

    save_corrected(tmp_path, crouched(), [CoulombFriction("leg_joint", level=1.0)])
    for env in (crouched(), crouched(xml_file=str(tmp_path / "model.xml"))):
        base = load_corrected(tmp_path).apply(env).unwrapped
        assert base.init_qpos[1] == pytest.approx(0.95)
        assert base._healthy_z_range[0] == pytest.approx(0.7)


def test_the_applied_one_steps_as_the_saved_one(tmp_path):
    env, twin = gym.make(POLE), gym.make(POLE)
    chosen = [
        Declared(env.unwrapped.model, "pole.mass").with_values(np.array([5.1])),
        CoulombFriction("hinge", level=0.02),
        StribeckFriction("slider", extra=0.3, level=0.2, speed=0.2),
        Hold("slide", share=0.4),
    ]
    save_corrected(tmp_path, env, chosen)
    one, two = CorrectedEnv(env, chosen), load_corrected(tmp_path).apply(twin)
    np.testing.assert_array_equal(one.reset(seed=0)[0], two.reset(seed=0)[0])
    for action in np.random.default_rng(0).uniform(-1, 1, size=(50, 1)):
        np.testing.assert_equal(one.step(action), two.step(action))


def test_meshes_travel_with_the_model(tmp_path):
    (tmp_path / "here" / "parts").mkdir(parents=True)
    (tmp_path / "here" / "arm.xml").write_text(MESHED)
    (tmp_path / "here" / "parts" / "tip.obj").write_text(TETRAHEDRON)
    nominal = load_model(tmp_path / "here" / "arm.xml")[1]
    chosen = effects(nominal)
    save_corrected(tmp_path / "there", tmp_path / "here" / "arm.xml", chosen)
    spec = mujoco.MjSpec.from_string(MESHED, assets={"parts/tip.obj": TETRAHEDRON.encode()})
    save_corrected(tmp_path / "from_memory", spec, chosen)
    (tmp_path / "here" / "parts" / "tip.obj").unlink()
    (tmp_path / "there").rename(tmp_path / "moved")
    for folder in ("moved", "from_memory"):
        assert_equal_models(load_corrected(tmp_path / folder).model, correct(nominal, chosen))
    with pytest.raises((ValueError, FileNotFoundError), match=r"tip\.obj"):
        save_corrected(tmp_path / "again", tmp_path / "here" / "arm.xml", chosen)
    assert not (tmp_path / "again").exists()


def attached(folder, main, part):
    """The file of a model with a mesh and, attached, one from another folder, each with its own meshdir."""
    (folder / "parts").mkdir()
    (folder / "sub" / "meshes").mkdir(parents=True)
    (folder / "parts" / main).write_text(TETRAHEDRON)
    (folder / "sub" / "meshes" / part).write_text(TETRAHEDRON.replace(".1", ".2"))
    (folder / "sub" / "part.xml").write_text(f"""<mujoco><compiler meshdir="meshes"/><asset>
        <mesh name="m" file="{part}"/></asset><worldbody><body name="p"><joint/>
        <geom type="mesh" mesh="m"/></body></worldbody></mujoco>""")
    (folder / "arm.xml").write_text(f"""<mujoco><compiler meshdir="parts"/><asset><mesh name="m" file="{main}"/>
        <model name="part" file="sub/part.xml"/></asset><worldbody><body><joint name="elbow"/>
        <geom type="mesh" mesh="m"/><attach model="part" body="p" prefix="x_"/></body></worldbody></mujoco>""")
    return folder / "arm.xml"


@pytest.mark.parametrize("names", [("tip.obj", "tip.obj"), ("tip.obj", "tool.obj")])
def test_the_mesh_of_an_attached_model_is_its_own(tmp_path, names):
    path = attached(tmp_path, *names)
    save_corrected(tmp_path / "out", path, [CoulombFriction("elbow", level=0.1)])
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    np.testing.assert_array_equal(plain.mesh_vert, load_model(path)[1].mesh_vert)


def test_stripped_paths_are_those_of_mujoco(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "tip.obj").write_text(TETRAHEDRON)
    text = MESHED.replace("<compiler ", '<compiler strippath="true" ').replace('"tip.obj"', '"robot/meshes/tip.obj"')
    (tmp_path / "arm.xml").write_text(text)
    save_corrected(tmp_path / "out", tmp_path / "arm.xml", [])
    assert_equal_models(load_corrected(tmp_path / "out").model, load_model(tmp_path / "arm.xml")[1])


def test_files_that_mujoco_does_not_read_are_refused(tmp_path, monkeypatch):
    path = attached(tmp_path, "tip.obj", "tool.obj")
    monkeypatch.setattr(mjcf, "_path", lambda compiled, address: str(tmp_path / "parts" / "tip.obj"))
    with pytest.raises(ValueError, match="mesh_vert changes when the model's files are copied"):
        save_corrected(tmp_path / "out", path, [])


def save_pole(folder):
    save_corrected(folder, gym.make("InvertedPendulum-v5"), [])
    return folder / "model.xml"


def test_the_nominal_model_is_not_overwritten(tmp_path):
    (tmp_path / "model.xml").write_text(PLAIN)
    for source in (tmp_path / "model.xml", mujoco.MjSpec.from_file(str(tmp_path / "model.xml"))):
        with pytest.raises(
            ValueError, match=r"is the nominal model, or was not saved here by an earlier trace.*elsewhere"
        ):
            save_corrected(tmp_path, source, [])
    assert (tmp_path / "model.xml").read_text() == PLAIN
    save_corrected(tmp_path / "out", PLAIN, [])
    save_corrected(tmp_path / "out", PLAIN, [])  # what an earlier save left is another matter
    of_it = gym.make("InvertedPendulum-v5", xml_file=str(save_pole(tmp_path / "pole")))
    for folder, source in (("out", tmp_path / "out" / "model.xml"), ("pole", of_it)):
        with pytest.raises(ValueError, match="elsewhere"):
            save_corrected(tmp_path / folder, source, [])


def test_torn_folders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"effects\.json is missing"):
        load_corrected(tmp_path)
    save_corrected(tmp_path, PLAIN, [CoulombFriction("elbow", level=0.1), Hold("motor", share=0.5)])
    xml, path = tmp_path / "model.xml", tmp_path / "effects.json"
    text, stored = xml.read_text(), json.loads(path.read_text())
    xml.write_text(text.replace("shoulder", "shudder"))
    with pytest.raises(ValueError, match="is not the file that"):
        load_corrected(tmp_path)
    xml.unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.xml is missing"):
        load_corrected(tmp_path)
    xml.write_text(text)
    path.write_text(json.dumps(stored | {"format": 99}))
    with pytest.raises(ValueError, match="format 99"):
        load_corrected(tmp_path)
    effect = stored["effects"][0]
    for damaged in (
        {key: value for key, value in stored.items() if key != "exact"},
        {key: value for key, value in stored.items() if key != "effects"},
        {key: value for key, value in stored.items() if key != "mujoco"},
        stored | {"effects": [{key: value for key, value in effect.items() if key != "values"}]},
        stored | {"effects": [{key: value for key, value in effect.items() if key != "kind"}]},
        stored | {"heights": [1.0]},
        [stored],
    ):
        path.write_text(json.dumps(damaged))
        with pytest.raises(ValueError, match="does not describe a corrected simulator"):
            load_corrected(tmp_path)
    path.write_text(json.dumps(stored)[:100])
    with pytest.raises(ValueError, match="does not describe a corrected simulator"):
        load_corrected(tmp_path)
    path.write_text(json.dumps(stored | {"exact": {"dof_damping": {"index": [7], "value": [1.0]}}}))
    with pytest.raises(ValueError, match="no entry 7 of 'dof_damping'"):
        load_corrected(tmp_path)
    path.write_text(json.dumps(stored | {"mujoco": "3.0.0"}))
    with pytest.warns(UserWarning, match=r"saved with MuJoCo 3\.0\.0"):
        load_corrected(tmp_path)
    path.write_text(json.dumps(stored).replace("test_hold", "test_held"))
    with pytest.raises(ValueError, match=r"'test_held' is registered.*'test_hold'.*@sb3_rpto\.effects\.register"):
        load_corrected(tmp_path)


def test_a_failed_save_leaves_the_last_one(tmp_path):
    save_corrected(tmp_path, PLAIN, [CoulombFriction("elbow", level=0.1)])
    with pytest.raises(ValueError, match="no joint 'knee'"):
        save_corrected(tmp_path, PLAIN, [CoulombFriction("knee", level=0.2)])
    assert load_corrected(tmp_path).effects[0].values == 0.1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["effects.json", "model.xml"]


def test_what_mjcf_cannot_say_is_kept_by_the_json(tmp_path):
    env = gym.make(POLE)
    env.unwrapped.model.body_subtreemass[0] = 123.0  # derived, so no MJCF attribute sets it
    env.unwrapped.model.dof_damping[0] = 0.75
    save_corrected(tmp_path, env, [])
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")).dof_damping[0] == 0.75
    assert load_corrected(tmp_path).model.body_subtreemass[0] == 123.0


# --- models -----------------------------------------------------------------------------------------------------


def test_models_load_from_every_source(tmp_path):
    (tmp_path / "arm.xml").write_text(PLAIN)
    spec = mujoco.MjSpec.from_string(PLAIN)
    compiled = spec.compile()
    for source in (PLAIN, "\n " + PLAIN, tmp_path / "arm.xml", str(tmp_path / "arm.xml"), spec):
        found, model = load_model(source)
        assert found is not None
        assert found is not source
        assert_equal_models(model, compiled)
    found, model = load_model(compiled)
    assert found is None
    assert model is not compiled
    assert_equal_models(model, compiled)
    assert load_model((found, model))[0] is None, "as the pair that it returned"
    env = gym.make("Hopper-v5")
    env.unwrapped.model.dof_damping[3] = 0.125
    found, model = load_model(env)
    assert found is not None
    assert model.dof_damping[3] == 0.125
    assert model is not env.unwrapped.model


def test_an_environment_that_was_corrected_meanwhile_is_saved_as_it_was(tmp_path):
    env = gym.make("InvertedPendulum-v5")
    pair = load_model(env)
    lacks = [LIBRARY["coulomb_friction"]("slider", level=0.5), LIBRARY["payload"]("pole", mass=1.0)]
    save_corrected(tmp_path / "first", pair, lacks)
    CorrectedEnv(env, lacks)
    save_corrected(tmp_path / "second", pair, lacks)
    for name in ("model.xml", "effects.json"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_an_environment_without_mujoco_takes_no_correction(tmp_path):
    save_corrected(tmp_path, gym.make(POLE), [])
    with pytest.raises(ValueError, match="PendulumEnv is no gymnasium MuJoCo environment"):
        load_corrected(tmp_path).apply(gym.make("Pendulum-v1"))


def test_bad_sources_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no MJCF file"):
        load_model(tmp_path / "missing.xml")
    with pytest.raises(ValueError, match="cannot compile the MJCF text"):
        load_model("<mujoco><oops/></mujoco>")
    (tmp_path / "bad.xml").write_text("<mujoco>")
    with pytest.raises(ValueError, match=r"cannot compile .*bad\.xml"):
        load_model(tmp_path / "bad.xml")
    with pytest.raises(TypeError, match="not int"):
        load_model(3)
    with pytest.raises(ValueError, match="PendulumEnv has no MuJoCo model"):
        load_model(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="nothing tells the MJCF of this MjModel"):
        save_corrected(tmp_path, mujoco.MjModel.from_xml_string(PLAIN), [])


@pytest.mark.parametrize(
    ("task", "joint", "body", "motor"),
    [
        ("InvertedPendulum", "hinge", "pole", "slide"),
        ("InvertedDoublePendulum", "hinge2", "pole2", "slide"),  # whose site has a size too many
        ("Pusher", "r_shoulder_pan_joint", "r_forearm_link", "actuator0"),  # and whose geoms have
    ],
)
def test_effects_that_the_loaded_model_has_already_are_not_put_in_twice(task, joint, body, motor, tmp_path):
    effects = [LIBRARY["coulomb_friction"](joint, level=0.5), LIBRARY["payload"](body, mass=1.0)]
    effects.append(LIBRARY["command_delay"](motor, delay=0.04))
    env = gym.make(f"{task}-v5")
    save_corrected(tmp_path, env, effects)
    again = gym.make(f"{task}-v5", xml_file=str(tmp_path / "model.xml"))
    trajectories = []
    for start in (env, again):
        corrected = load_corrected(tmp_path).apply(start)
        corrected.reset(seed=0)
        trajectories.append([corrected.step(np.full(env.action_space.shape, 0.3))[0] for _ in range(5)])
    np.testing.assert_allclose(*trajectories, rtol=1e-4, atol=1e-5)


def test_without_an_environment_a_correction_is_simulated(tmp_path) -> None:
    save_corrected(tmp_path, ARM % ("", ""), [StribeckFriction("elbow", extra=0.1, level=0.2, speed=0.3)])
    corrected = load_corrected(tmp_path)
    with pytest.raises(TypeError, match=r"not str; without one, simulation\(\)\.rollout"):
        corrected.apply("arm.xml")  # type: ignore[arg-type]
    simulation = corrected.simulation(1)
    start = np.full((1, 2), 0.3), np.full((1, 2), 0.5)
    drive = Drive(np.zeros((1, 100, corrected.model.nu)))
    slowed = simulation.rollout(simulation.values()[None], *start, drive)[1][0, -1, 1]
    free = simulation.rollout(simulation.null[None], *start, drive)[1][0, -1, 1]
    assert abs(slowed) < abs(free)


@pytest.mark.parametrize("name", ["Hopper-v5", "Ant-v5"])
def test_a_plain_model_is_written_as_the_model_was(name):
    spec, model = load_model(gym.make(name))
    plain = mjcf.PlainModel.of(spec, model)
    text, _ = mjcf.write_mjcf(mujoco.MjSpec.from_string(plain.text, assets=plain.assets), plain.compile())
    assert text == plain.text
    assert "meaninertia" not in text
