"""Every effect of the library: it vanishes at its null, follows its equation, and is recovered where it was planted."""

import re
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from sb3_rpto.effects import LIBRARY, Drive, Effect, Scales, Simulation, from_json
from sb3_rpto.effects.batch import MujocoBatch
from sb3_rpto.effects.sensors import ago
from sb3_rpto.effects.simulation import prepare

ARM = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.004" density="50" viscosity="0.02"/>
  <default><geom contype="0" conaffinity="0" density="1500"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.05 0 -0.4" size="0.03"/>
      <body name="lower" pos="0.05 0 -0.4">
        <joint name="elbow" axis="1 0.5 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" gear="12"/>
    <motor name="elbow_motor" joint="elbow" gear="4"/>
  </actuator>
</mujoco>""")

SLED = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.004" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" friction="0.1"/>
    <body name="sled" pos="0 0 0.0499">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="runner" type="box" size="0.2 0.1 0.05" friction="0.3" density="500"/>
    </body>
  </worldbody>
  <actuator><motor name="engine" joint="x" gear="60"/></actuator>
</mujoco>""")

#: Servos that hold an arm at commanded angles, and one that moves it at commanded speeds.
SERVOS = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="arm">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
      <body name="hand" pos="0 0 -0.4">
        <joint name="wrist" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shoulder" kp="20" kv="1" forcerange="-15 15"/>
    <velocity name="speed" joint="wrist" kv="0.5"/>
  </actuator>
</mujoco>""")

#: A ball that falls, bounces and is pushed.
BALL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1"/>
    <body name="ball" pos="0 0 0.12">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="rubber" size="0.1" density="500"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="z" gear="30"/></actuator>
</mujoco>""")

#: An arm that swings into both stops.
STOPPED = mujoco.MjModel.from_xml_string("""
<mujoco>
  <compiler autolimits="true" angle="radian"/><option timestep="0.004"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" range="-0.5 0.6" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="12"/></actuator>
</mujoco>""")

#: A body that nothing holds; its centre of mass is not where its joint is.
FLOATING = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>
    <body name="base">
      <freejoint name="free"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 -0.4" size="0.05"/>
      <body name="arm" pos="0.2 0 -0.4">
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>""")

#: One hinge of known inertia whose damping is integrated explicitly, so that a step shows the torque.
HINGE = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.001"><flag eulerdamp="disable"/></option>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -0.5" mass="1.2" diaginertia="0.02 0.02 0.01"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>""")
INERTIA = 1.2 * 0.5**2 + 0.02

Torque = Callable[..., np.ndarray]  # of q, v, motor torque and the parameters


class Row(NamedTuple):
    """How an effect is planted, and where the search for it starts."""

    on: str
    planted: dict[str, float]
    start: dict[str, float]
    torque: Torque | None = None  # what it adds to HINGE; None: another test below has its equation
    model: mujoco.MjModel = ARM


def dry(level: Callable[..., np.ndarray]) -> Torque:
    return lambda q, v, m, **x: -level(q, v, m, **x) * np.sign(v)


def motor_limit(q: np.ndarray, v: np.ndarray, m: np.ndarray, inverse_stall: float, inverse_speed: float) -> np.ndarray:
    stall = 1 / inverse_stall
    upper = np.clip(stall * (1 - np.maximum(v, 0) * inverse_speed), 0, None)
    lower = -np.clip(stall * (1 + np.minimum(v, 0) * inverse_speed), 0, None)
    return np.clip(m, lower, upper) - m


ROWS = {
    "coulomb_friction": Row("shoulder", {"level": 0.6}, {"level": 0.1}, dry(lambda q, v, m, level: level)),
    "soft_friction": Row("elbow", {"level": 0.3}, {"level": 0.1}),
    "stribeck_friction": Row(
        "elbow",
        {"extra": 0.3, "level": 0.2, "speed": 0.5},
        {"extra": 0.1, "level": 0.1, "speed": 0.3},
        dry(lambda q, v, m, extra, level, speed: level + extra * np.exp(-((v / speed) ** 2))),
    ),
    "viscous_friction": Row(
        "shoulder", {"coefficient": 0.2}, {"coefficient": 0.05}, lambda q, v, m, coefficient: -coefficient * v
    ),
    "quadratic_drag": Row(
        "elbow", {"coefficient": 0.05}, {"coefficient": 0.01}, lambda q, v, m, coefficient: -coefficient * v * abs(v)
    ),
    "asymmetric_damping": Row(
        "shoulder",
        {"forward": 0.3, "backward": 0.1},
        {"forward": 0.05, "backward": 0.05},
        lambda q, v, m, forward, backward: np.where(v > 0, -forward * v, -backward * v),
    ),
    "load_friction": Row("elbow", {"mu": 0.15}, {"mu": 0.05}, dry(lambda q, v, m, mu: mu * abs(m))),
    "directional_load_friction": Row(
        "elbow",
        {"mu_driving": 0.1, "mu_driven": 0.2},
        {"mu_driving": 0.05, "mu_driven": 0.05},
        dry(lambda q, v, m, mu_driving, mu_driven: np.where(m * v > 0, mu_driving, mu_driven) * abs(m)),
    ),
    "position_friction": Row(
        "shoulder",
        {"amplitude": 0.8, "phase": 0.7},
        {"amplitude": 0.3, "phase": 0.0},
        dry(lambda q, v, m, amplitude, phase: amplitude * np.cos((q - phase) / 2) ** 2),
    ),
    "held_friction": Row("shoulder", {"level": 0.6}, {"level": 0.1}, dry(lambda q, v, m, level: level)),
    "held_damping": Row(
        "shoulder", {"coefficient": 0.2}, {"coefficient": 0.05}, lambda q, v, m, coefficient: -coefficient * v
    ),
    "held_drag": Row(
        "elbow", {"coefficient": 0.05}, {"coefficient": 0.01}, lambda q, v, m, coefficient: -coefficient * v * abs(v)
    ),
    "torque_ripple": Row(
        "shoulder",
        {"cosine": 0.4, "sine": -0.3, "turns": 7.0},
        {"cosine": 0.1, "sine": 0.0, "turns": 6.6},
        lambda q, v, m, cosine, sine, turns: cosine * np.cos(turns * q) + sine * np.sin(turns * q),
    ),
    "torque_offset": Row("elbow", {"offset": -0.2}, {"offset": 0.0}, lambda q, v, m, offset: offset + 0 * q),
    "spring": Row(
        "shoulder",
        {"stiffness": 1.5, "reference": 0.4},
        {"stiffness": 0.2, "reference": 0.0},
        lambda q, v, m, stiffness, reference: -stiffness * (q - reference),
    ),
    "end_stop": Row("hinge", {"lower": 0.1, "upper": -0.15}, {"lower": 0.02, "upper": -0.05}, model=STOPPED),
    "dc_motor": Row(
        "shoulder_motor",
        {"inverse_stall": 0.14, "inverse_speed": 0.1},
        {"inverse_stall": 0.1, "inverse_speed": 0.05},
        motor_limit,
    ),
    "command_offset": Row("elbow_motor", {"offset": 0.2}, {"offset": 0.0}),
    "command_smoothing": Row("shoulder_motor", {"share": 0.6}, {"share": 0.2}),
    "command_delay": Row("shoulder_motor", {"delay": 0.026}, {"delay": 0.01}),
    "command_deadband": Row("elbow_motor", {"width": 0.1}, {"width": 0.02}),
    "command_gain": Row("shoulder_motor", {"change": -0.15}, {"change": 0.0}),
    "servo_gain": Row("servo", {"change": -0.2}, {"change": 0.1}, model=SERVOS),
    "servo_damping": Row("servo", {"change": -0.4}, {"change": 0.1}, model=SERVOS),
    "velocity_servo_gain": Row("speed", {"change": -0.3}, {"change": 0.1}, model=SERVOS),
    "command_saturation": Row("shoulder_motor", {"inverse_limit": 1.6}, {"inverse_limit": 1.2}),
    "backlash": Row("elbow_motor", {"half_width": 0.15}, {"half_width": 0.05}),
    "actuator_lag": Row("shoulder_motor", {"time_constant": 0.05}, {"time_constant": 0.01}),
    "sensor_delay": Row("elbow", {"delay": 0.026}, {"delay": 0.01}),
    "sensor_bias": Row("elbow", {"offset": 0.05}, {"offset": 0.0}),
    "sensor_gain": Row("shoulder", {"change": 0.04}, {"change": 0.0}),
    "mass_scale": Row("lower", {"change": -0.25}, {"change": 0.0}),
    "inertia_scale": Row("lower", {"change": -0.3}, {"change": 0.0}),
    "payload": Row("lower", {"mass": 0.3, "along": 1.6}, {"mass": 0.1, "along": 1.0}),
    "com_offset": Row("base", {"x": 0.03, "y": -0.02, "z": 0.05}, {"x": 0.0, "y": 0.0, "z": 0.0}, model=FLOATING),
    "external_force": Row("base", {"x": 3.0, "y": -2.0, "z": 5.0}, {"x": 0.0, "y": 0.0, "z": 0.0}, model=FLOATING),
    "armature": Row("elbow", {"inertia": 0.02}, {"inertia": 0.005}),
    "link_length": Row("lower", {"change": 0.12}, {"change": 0.0}),
    "gravity_scale": Row("", {"change": -0.3}, {"change": 0.0}),
    "gravity_tilt": Row("", {"x": 0.08, "y": -0.05}, {"x": 0.0, "y": 0.0}),
    "wind": Row("", {"x": 2.0, "y": -1.5, "z": 1.0}, {"x": 0.0, "y": 0.0, "z": 0.0}),
    "fluid": Row("", {"density": 150.0, "viscosity": 0.5}, {"density": 30.0, "viscosity": 0.1}),
    "geom_friction": Row("runner", {"change": 0.2}, {"change": 0.05}, model=SLED),
    "contact_softness": Row("floor", {"softness": 0.5, "damping": -0.3}, {"softness": 0.1, "damping": 0.0}, model=BALL),
}
FORCES = [kind for kind, row in ROWS.items() if row.torque is not None]


def shipped(kind: type[Effect]) -> bool:
    return kind.__module__.startswith("sb3_rpto.")


def test_table_is_whole() -> None:
    assert set(ROWS) == {name for name, kind in LIBRARY.items() if shipped(kind)}, "every effect needs a row"


def vector(kind: str, values: dict[str, float]) -> np.ndarray:
    parameters = LIBRARY[kind].parameters
    assert {p.name for p in parameters} == set(values)
    return np.array([values[p.name] for p in parameters])


def excitation(model: mujoco.MjModel, n: int, steps: int = 150) -> tuple[np.ndarray, np.ndarray, Drive]:
    """Rest and motion at the start, then sums of sines and jumps that reverse often."""
    rng = np.random.default_rng(3)
    t = np.arange(steps) * model.opt.timestep
    shape = (n, 1, model.nu)
    commands = 0.6 * np.sin(2 * np.pi * (rng.uniform(0.5, 3, shape) * t[:, None] + rng.uniform(size=shape)))
    commands += 0.4 * np.repeat(rng.uniform(-1, 1, (n, -(-steps // 25), model.nu)), 25, axis=1)[:, :steps]
    moving = (np.arange(n) > 0)[:, None] * (model is ARM)
    qpos = model.qpos0 + rng.uniform(-0.5, 0.5, (n, model.nq)) * moving
    qvel = rng.uniform(-2, 2, (n, model.nv)) * moving
    return qpos, qvel, Drive(commands, hold=5)


def shown(sim: Simulation, values: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, drive: Drive) -> np.ndarray:
    """Positions as the sensors show them."""
    q, v = sim.rollout(values, qpos, qvel, drive)
    (effect,) = sim.effects
    if effect.place == "sensor":
        time = np.arange(q.shape[1]) * sim.model.opt.timestep
        for i in np.flatnonzero(effect.late(values)):
            for series in (q[i, :, effect.adr], v[i, :, effect.dof]):
                series[:] = np.interp(time - effect.late(values)[i], time, series.copy())
        q[..., effect.adr], v[..., effect.dof] = effect.observe(q[..., effect.adr], v[..., effect.dof], values)
    return q


@pytest.mark.parametrize("kind", ROWS)
def test_null_is_nothing_bit_for_bit(kind: str) -> None:
    row = ROWS[kind]
    sim = Simulation(row.model, [LIBRARY[kind](row.on)], 1)
    start = excitation(row.model, 4)
    plain = Simulation(row.model, [], 1).rollout(np.empty((4, 0)), *start)[0]
    planted = vector(kind, row.planted)
    values = np.tile(sim.null, (4, 1))
    assert np.array_equal(shown(sim, values, *start), plain)
    # Beside simulations where the effect acts, and whatever its shape would be.
    values[0], values[1] = planted, np.where(sim.strength, sim.null, planted)
    mixed = shown(sim, values, *start)
    assert not np.allclose(mixed[0], plain[0], rtol=0, atol=1e-5)
    assert np.array_equal(mixed[1:], plain[1:])
    values[:] = sim.null
    assert np.array_equal(shown(sim, values, *start), plain), "something stayed from the rollout before"


@pytest.mark.parametrize("kind", ROWS)
def test_planted_is_recovered(kind: str) -> None:
    row, n = ROWS[kind], 8
    sim = Simulation(row.model, [LIBRARY[kind](row.on)], 1)
    qpos, qvel, drive = excitation(row.model, n)
    truth, start = vector(kind, row.planted), vector(kind, row.start)
    data = shown(sim, np.tile(truth, (n, 1)), qpos, qvel, drive)
    low, high = ([getattr(p, bound) for p in LIBRARY[kind].parameters] for bound in ("lower", "upper"))

    def many(points: np.ndarray) -> np.ndarray:
        """Residuals (k, ...) at k points side by side."""
        k = len(points)
        rows = np.tile(np.arange(n), k)
        return (
            shown(sim, np.repeat(points, n, axis=0), qpos[rows], qvel[rows], drive.take(rows)) - data[rows]
        ).reshape(k, -1)

    def jacobian(point: np.ndarray) -> np.ndarray:
        step = 1e-4 * np.maximum(np.abs(truth), 1e-3)
        points = many(np.concatenate([point + np.diag(step), point[None]]))
        return ((points[:-1] - points[-1]) / step[:, None]).T

    fit = least_squares(lambda x: many(x[None])[0], start, jacobian, (low, high), x_scale=np.abs(truth), xtol=1e-10)
    np.testing.assert_allclose(fit.x, truth, rtol=0.01)


@pytest.mark.parametrize("kind", FORCES)
def test_torque_follows_equation(kind: str) -> None:
    row, n = ROWS[kind], 64
    on = "motor" if LIBRARY[kind].place == "actuator" else "hinge"
    effect = LIBRARY[kind](on)
    rng = np.random.default_rng(5)
    q = rng.uniform(-3, 3, (n, 1))
    v = rng.uniform(0.2, 4, (n, 1)) * rng.choice([-1, 1], (n, 1))
    commands = rng.uniform(-1.3, 1.3, (n, 1, 1))
    sim = Simulation(HINGE, [effect], 1)
    values = dict(row.planted)
    if kind == "dc_motor":
        values = {"inverse_stall": 0.8, "inverse_speed": 0.3}
    x = np.tile(vector(kind, values), (n, 1))
    with_effect, without = (
        s.rollout(y, q, v, Drive(commands))[1][:, 1, 0]
        for s, y in ((sim, x), (Simulation(HINGE, [], 1), np.empty((n, 0))))
    )
    measured = INERTIA * (with_effect - without) / HINGE.opt.timestep
    motor = 2 * np.clip(commands[:, 0, 0], -1, 1)
    expected = row.torque(q[:, 0], v[:, 0], motor, **values)
    np.testing.assert_allclose(measured, expected, rtol=1e-6, atol=1e-7)


def sent(kind: str, commands: np.ndarray, dt: float = 0.01, **values: float) -> np.ndarray:
    """A command (steps,) after the effect."""
    effect, memory = LIBRARY[kind]("", **values), {}
    return np.array([effect.command(np.array([u]), effect.values[None], memory, dt)[0] for u in commands])


RAMP = np.array([0.5, 1.0, 2.0, 1.5, -1.0, -3.0, 0.2])


def test_delay_equation() -> None:
    held = np.concatenate([np.full(3, RAMP[0]), RAMP])
    np.testing.assert_allclose(sent("command_delay", RAMP, delay=0.02), held[1:-2])
    np.testing.assert_allclose(sent("command_delay", RAMP, delay=0.025), (held[1:-2] + held[:-3]) / 2)
    assert sent("command_delay", RAMP, delay=0.2)[-1] == RAMP[0]


def test_smoothing_equation() -> None:
    """Each command lasts three steps; the fourth is the third once more, as at the limit of what may be sent."""
    once = np.array([0.5, 1.0, -1.0, -1.0, 2.0, 2.0, 0.3])
    expected = [once[0]]
    for u in once[1:]:
        expected.append(0.6 * expected[-1] + 0.4 * u)
    got = sent("command_smoothing", np.repeat(once, 3), share=0.6)
    np.testing.assert_allclose(got, np.repeat(expected, 3), rtol=1e-12)
    assert np.array_equal(sent("command_smoothing", np.repeat(once, 3)), np.repeat(once, 3))


def test_delay_is_mujocos_own_from_a_step_on() -> None:
    """After the first commands; MuJoCo has zero before them, and a whole step in place of a shorter delay."""
    xml = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
    <actuator><motor joint="j" delay="DELAY" nsample="8" interp="linear"/></actuator></mujoco>"""
    for delay, same in ((0.01, 0.01), (0.02, 0.02), (0.025, 0.025), (0.005, 0.01)):
        model = mujoco.MjModel.from_xml_string(xml.replace("DELAY", str(delay)))
        data, native = mujoco.MjData(model), []
        for u in RAMP:
            data.ctrl[:] = u
            mujoco.mj_step(model, data)
            native.append(data.actuator_force[0])
        np.testing.assert_allclose(native[3:], sent("command_delay", RAMP, delay=same)[3:], atol=1e-12)
        assert native[0] == 0.0


def test_other_command_equations() -> None:
    np.testing.assert_allclose(sent("command_deadband", RAMP, width=0.8), [0, 0.2, 1.2, 0.7, -0.2, -2.2, 0])
    np.testing.assert_allclose(sent("command_saturation", RAMP, inverse_limit=0.8), np.clip(RAMP, -1.25, 1.25))
    np.testing.assert_allclose(sent("backlash", RAMP, half_width=0.6), [0.5, 0.5, 1.4, 1.4, -0.4, -2.4, -0.4])


def test_gain_is_of_the_command_after_its_limits() -> None:
    """The same as larger commands, whatever the force is of a command; a limit of the controller comes before it."""
    xml = """<mujoco><option timestep="0.004"/><worldbody><body><joint name="j" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/></body></worldbody><actuator>ACTUATOR</actuator></mujoco>"""
    commands = np.random.default_rng(1).uniform(-2, 2, (2, 80, 1))
    start = np.array([[0.3], [-0.5]]), np.array([[1.0], [-2.0]])
    for actuator in (
        '<motor name="m" joint="j" gear="3"/>',
        '<motor name="m" joint="j" ctrlrange="-1 1"/>',
        '<position name="m" joint="j" kp="8" kv="0.3" forcerange="-6 6"/>',
        '<general name="m" joint="j" gaintype="affine" gainprm="2 .5 -.3" biastype="affine" biasprm=".1 -2 .2"/>',
        '<general name="m" joint="j" gainprm="2" dyntype="filterexact" dynprm="0.05" actearly="true"/>',
        '<dcmotor name="m" joint="j" gear="3" motorconst=".3 .2" resistance=".4" cogging=".1 6 .3" damping=".02"/>',
        '<dcmotor name="m" joint="j" motorconst=".3 .3" resistance=".4" ctrlrange="-1 1"/>',
    ):
        model = mujoco.MjModel.from_xml_string(xml.replace("ACTUATOR", actuator))
        sim = Simulation(model, [LIBRARY["command_gain"]("m")], 1)
        got = sim.rollout(np.array([[0.25], [-0.4]]), *start, Drive(commands))[0]
        limit = np.inf
        if model.actuator_ctrllimited[0]:
            limit, model.actuator_ctrllimited[0] = 1.0, False
        larger = np.clip(commands, -limit, limit) * np.array([1.25, 0.6])[:, None, None]
        plain = Simulation(model, [], 1).rollout(np.empty((2, 0)), *start, Drive(larger))[0]
        np.testing.assert_allclose(got, plain, rtol=1e-9, atol=1e-12)


def test_gain_sits_where_the_force_is_linear_in_it() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body>
    </worldbody><actuator><motor name="plain" joint="j"/><muscle name="pull" joint="j" lengthrange="0 1"/>
    <general name="affine" joint="j" gaintype="affine" gainprm="2 .5 0"/>
    <dcmotor name="volts" joint="j" motorconst=".3 .3" resistance="1"/>
    <dcmotor name="heats" joint="j" motorconst=".3 .3" resistance="1" thermal="1 1 1"/>
    <dcmotor name="regulated" joint="j" motorconst=".3 .3" resistance="1" input="pos" controller="10"/>
    </actuator></mujoco>""")
    assert LIBRARY["command_gain"].places(model) == ["plain", "affine", "volts"]


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("gear", [1, -2])
def test_a_motors_limit_is_its_forcerange_whatever_its_joint_lets_through(integrator: str, gear: int) -> None:
    text = """<mujoco><option timestep="0.002" integrator="INT"/><worldbody><body>
    <joint name="j" axis="0 1 0" actuatorfrcrange="-5 4"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></worldbody><actuator>
    <position name="a" joint="j" kp="200" kv="8" gear="GEAR" %s/><motor joint="j" gear="3"/></actuator></mujoco>"""
    text = text.replace("INT", integrator).replace("GEAR", str(gear))
    ends = f'forcerange="-{6 / abs(gear)} {6 / abs(gear)}"'
    limited, model = (mujoco.MjModel.from_xml_string(text % s) for s in (ends, ""))
    commands = 2 * np.sin(np.arange(300) / 20)[None, :, None] * np.array([1.0, -0.7])
    found = []
    for one, effects in ((limited, []), (model, [LIBRARY["dc_motor"]("a", inverse_stall=1 / 6)]), (model, [])):
        sim = Simulation(one, effects, 1)
        found.append(sim.rollout(sim.values()[None], np.zeros((1, 1)), np.zeros((1, 1)), Drive(commands))[0])
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    assert np.abs(found[2] - found[0]).max() > 0.01


def test_a_servo_on_a_tendon_regulates_what_its_joints_sensors_show() -> None:
    text = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/><body pos=".3 0 0"><joint name="k" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/></body></body></worldbody>
    <tendon><fixed name="one"><joint joint="j" coef="2"/></fixed>
    <fixed name="both"><joint joint="j" coef="1"/><joint joint="k" coef="-1"/></fixed></tendon><actuator>
    <position tendon="%s" kp="50" gear="1.5"/></actuator></mujoco>"""

    def biases(tendon: str, *effects: Effect) -> list[float]:
        model = mujoco.MjModel.from_xml_string(text % tendon)
        batch = MujocoBatch(model, 1, 1)
        sim = Simulation(model, list(effects), 1)
        prepare(batch, sim.active(sim.values()[None]))
        return batch.engine.get_model(0).actuator_biasprm[0, :2].tolist()

    offset, gain = LIBRARY["sensor_bias"], LIBRARY["sensor_gain"]
    assert biases("one", offset("j", offset=0.1)) == pytest.approx([-50 * 1.5 * 2 * 0.1, -50])
    assert biases("both", offset("k", offset=0.1)) == pytest.approx([50 * 1.5 * 0.1, -50])
    assert biases("one", offset("k", offset=0.1)) == pytest.approx([0, -50])
    assert biases("one", gain("j", change=0.2)) == pytest.approx([0, -60])
    assert biases("both", gain("j", change=0.2)) == pytest.approx([0, -50])
    text = text.replace("</body></body>", '<site name="s"/></body></body>').replace('tendon="%s"', 'site="s" name="%s"')
    assert biases("at a site", offset("j", offset=0.1)) == pytest.approx([0, -50])


def test_lag_is_the_mean_of_filterexact() -> None:
    """Ten steps of MuJoCo's own filter, started at the first command; T dy/dt = u - y tells its mean over each."""
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><option timestep="0.01"/><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
    <actuator><general joint="j" dyntype="filterexact" dynprm="0.03" actearly="true"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.act[:] = RAMP[0]
    ends = [RAMP[0]]
    for u in RAMP:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        ends.append(data.actuator_force[0])
    expected = RAMP - 0.03 * np.diff(ends) / 0.01
    np.testing.assert_allclose(sent("actuator_lag", RAMP, time_constant=0.03), expected, rtol=1e-12)


def test_sensor_equations() -> None:
    q, v = np.random.default_rng(0).normal(size=(2, 3, 5))
    x = np.array([[0.1], [0.0], [-0.2]])
    for kind, shown_q, shown_v in (("sensor_bias", q + x, v), ("sensor_gain", q * (1 + x), v * (1 + x))):
        effect = LIBRARY[kind]("j")
        seen = effect.observe(q, v, x)
        np.testing.assert_array_equal(seen[0], shown_q)
        np.testing.assert_array_equal(seen[1], shown_v)
        np.testing.assert_allclose(effect.unobserve(*seen, x), (q, v), rtol=1e-14)


def test_a_late_sensor_shows_the_state_between_two_steps_and_at_first_the_first() -> None:
    q, v = np.array([[0.0, 1.0, 4.0]] * 4), np.array([[2.0, 3.0, 5.0]] * 4)
    seen = ago(np.array([0.0, 0.25, 2.0, 9.0]), q, v)
    np.testing.assert_allclose(seen, [[4.0, 3.25, 0.0, 0.0], [5.0, 4.5, 2.0, 2.0]])
    np.testing.assert_allclose(ago(np.array([0.5]), q[:1, :1], v[:1, :1]), [[0.0], [2.0]])


def one_step(model: mujoco.MjModel, effects: list[Effect], n: int = 1) -> np.ndarray:
    """Velocities after a step from a state in motion."""
    sim = Simulation(model, effects, 1)
    qpos = np.tile(model.qpos0 + 0.3 * (model.nq < 3), (n, 1))
    drive = Drive(np.full((n, 1, model.nu), 0.5))
    return sim.rollout(sim.values()[None].repeat(n, 0), qpos, np.full((n, model.nv), 1.5), drive)[1][:, -1]


def test_payload_is_a_point_mass() -> None:
    """The same as a tiny ball in the MJCF, also where the nominal inertia lies in the body's own frame."""
    for end in ("0 0 -0.5", "0.2 0.1 -0.5"):
        xml = f"""<mujoco><worldbody><body name="b"><joint axis="0 1 0"/><joint axis="1 0 0"/>
        <geom type="capsule" fromto="0 0 0 {end}" size="0.04"/>BALL</body></worldbody></mujoco>"""
        ball = f'<geom type="sphere" size="0.001" mass="0.3" pos="{end}"/>'
        nominal, heavier = (mujoco.MjModel.from_xml_string(xml.replace("BALL", with_)) for with_ in ("", ball))
        got = one_step(nominal, [LIBRARY["payload"]("b", mass=0.3, along=2.0)])
        np.testing.assert_allclose(got, one_step(heavier, []), rtol=1e-6)


def edited(model: mujoco.MjModel, change: Callable[[mujoco.MjModel], None]) -> mujoco.MjModel:
    model = model.__copy__()
    change(model)
    return model


def test_world_effects_are_mujocos_own() -> None:
    def armature(m: mujoco.MjModel) -> None:
        m.dof_armature[1] += 0.02

    def wind(m: mujoco.MjModel) -> None:
        m.opt.wind[:] += (2.0, -1.0, 0.5)

    def fluid(m: mujoco.MjModel) -> None:
        m.opt.density, m.opt.viscosity = m.opt.density + 100, m.opt.viscosity + 0.3

    def centre(m: mujoco.MjModel) -> None:
        m.body_ipos[2] += (0.02, 0.0, -0.1)
        mujoco.mj_setConst(m, mujoco.MjData(m))

    for effect, change in (
        (LIBRARY["com_offset"]("lower", x=0.02, z=-0.1), centre),
        (LIBRARY["armature"]("elbow", inertia=0.02), armature),
        (LIBRARY["wind"](x=2.0, y=-1.0, z=0.5), wind),
        (LIBRARY["fluid"](density=100, viscosity=0.3), fluid),
    ):
        np.testing.assert_array_equal(one_step(ARM, [effect]), one_step(edited(ARM, change), []))


def test_fluid_and_wind_drag_the_inertia_box() -> None:
    """The docstring's equations, on a box whose inertia box is itself."""
    box = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.001" density="1" gravity="0 0 0">
    <flag eulerdamp="disable"/></option><worldbody><body><freejoint/><geom type="box" size=".1 .2 .3" mass="2"/>
    </body></worldbody></mujoco>""")
    rho, beta, wind = 1 + 3.0, 0.4, np.array([0.5, -1.0, 2.0])
    sim = Simulation(box, [LIBRARY["fluid"](density=3.0, viscosity=beta), LIBRARY["wind"](x=0.5, y=-1.0, z=2.0)], 1)
    qvel = np.array([1.0, -2.0, 0.5, 0.0, 0.0, 1.1])
    got = sim.rollout(sim.values()[None], box.qpos0[None], qvel[None], Drive(np.zeros((1, 1, 0))))[1][0, 1]
    v, w, inertia = qvel[:3] - wind, qvel[3:], np.sort(box.body_inertia[1])[::-1]  # of the x, y and z axis
    r = np.sqrt(1.5 / 2 * (inertia.sum() - 2 * inertia))
    np.testing.assert_allclose(r, [0.1, 0.2, 0.3])
    rj, rk = np.roll(r, -1), np.roll(r, -2)
    f = -2 * rho * rj * rk * abs(v) * v - 6 * np.pi * beta * r.mean() * v
    g = -0.5 * rho * r * (rj**4 + rk**4) * abs(w) * w - 8 * np.pi * beta * r.mean() ** 3 * w
    np.testing.assert_allclose((got - qvel) / 0.001, np.concatenate([f / 2, g / inertia]), rtol=1e-9, atol=1e-9)


def test_another_gravity_is_the_options() -> None:
    def halve(m: mujoco.MjModel) -> None:
        m.opt.gravity[:] *= 0.5

    got = one_step(ARM, [LIBRARY["gravity_scale"](change=-0.5)])
    np.testing.assert_array_equal(got, one_step(edited(ARM, halve), []))


def test_a_servos_gains_are_its_kp_and_kv() -> None:
    def softer(m: mujoco.MjModel) -> None:
        m.actuator_gainprm[0, 0], m.actuator_biasprm[0, 1:3] = 15, (-15, -0.5)

    names = ("servo_gain", "servo_damping")
    assert [LIBRARY[name].places(SERVOS) for name in names] == [["servo"]] * 2
    got = one_step(SERVOS, [LIBRARY[name]("servo", change=change) for name, change in zip(names, (-0.25, -0.5))])
    np.testing.assert_array_equal(got, one_step(edited(SERVOS, softer), []))
    assert not np.allclose(got, one_step(SERVOS, []))


def test_a_velocity_servos_gain_is_its_kv() -> None:
    def weaker(m: mujoco.MjModel) -> None:
        m.actuator_gainprm[1, 0], m.actuator_biasprm[1, 2] = 0.25, -0.25

    assert LIBRARY["velocity_servo_gain"].places(SERVOS) == ["speed"]
    got = one_step(SERVOS, [LIBRARY["velocity_servo_gain"]("speed", change=-0.5)])
    np.testing.assert_array_equal(got, one_step(edited(SERVOS, weaker), []))


def test_tilt_turns_gravity() -> None:
    """About y by b, then about x by a: g (-sin b, sin a cos b, -cos a cos b)."""
    a, b = 0.1, -0.2

    def tilted(m: mujoco.MjModel) -> None:
        m.opt.gravity[:] = 9.81 * np.array([-np.sin(b), np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b)])

    got = one_step(ARM, [LIBRARY["gravity_tilt"](x=a, y=b)])
    np.testing.assert_allclose(got, one_step(edited(ARM, tilted), []), rtol=1e-12)


def test_geom_friction_is_the_contacts() -> None:
    """A sled that slides without an engine: the larger coefficient of the two decides, and none is negative."""
    sim = Simulation(SLED, [LIBRARY["geom_friction"]("runner")], 1)
    qpos, qvel = np.zeros((3, 2)), np.tile([2.0, 0.0], (3, 1))
    drive = Drive(np.zeros((3, 50, 1)))
    change = np.array([[0.2], [-0.25], [-0.7]])
    v = sim.rollout(change, qpos, qvel, drive)[1]
    for row, friction in zip(v, (0.5, 0.1, 0.1)):

        def slide(m: mujoco.MjModel, friction: float = friction) -> None:
            m.geom_friction[:, 0] = friction

        expected = Simulation(edited(SLED, slide), [], 1).rollout(np.empty((3, 0)), qpos, qvel, drive)[1][0]
        np.testing.assert_array_equal(row, expected)


@pytest.mark.parametrize("geom", ["floor", "rubber"])
def test_a_softer_ground_has_the_contacts_of_softer_bodies(geom: str) -> None:
    """A contact has the mean of its two geoms' numbers, and so half of one's change."""
    sim = Simulation(BALL, [LIBRARY["contact_softness"]("floor")], 1)
    start, drive = (np.zeros((2, 1)), np.zeros((2, 1))), Drive(np.zeros((2, 80, 1)))
    got = sim.rollout(np.array([[0.0, 0.0], [1.5, -0.5]]), *start, drive)[0]

    def soften(m: mujoco.MjModel) -> None:
        m.geom(geom).solref *= (2.5, 0.5)

    for row, model in zip(got, (BALL, edited(BALL, soften))):
        expected = Simulation(model, [], 1).rollout(np.empty((2, 0)), *start, drive)[0][0]
        np.testing.assert_allclose(row, expected, rtol=1e-12)
    assert got[1].min() < got[0].min() - 1e-3  # it gives way


DIMENSIONLESS = {"share", "mu", "mu_driving", "mu_driven", "change", "along", "softness", "damping"}


@pytest.mark.parametrize("kind", ROWS)
def test_statements(kind: str) -> None:
    """Units, bounds, sizes, the texts that reports show, and a docstring with the equation and where it is from."""
    effect = LIBRARY[kind]
    assert effect.__doc__
    assert re.search(r":math:`[^`]+`", effect.__doc__), "the docstring lacks its equation"
    source = r"\([^()]*\b(1[6-9]|20)\d\d\)|MuJoCo"  # a year in parentheses, or what it mirrors
    assert re.search(source, effect.__doc__), "the docstring lacks its source"
    assert effect.equation
    assert effect.excite
    assert not all(p.shape for p in effect.parameters)
    for p in effect.parameters:
        assert bool(p.unit) != (p.name in DIMENSIONLESS)
        assert p.lower <= p.null <= p.upper
        assert p.name in effect.equation or kind == "payload"
        size = p.size_for(Scales())
        assert size > 0
        assert p.shape or p.lower <= p.null + size <= p.upper
    # What only writes fields of the model can be kept in an MJCF, all else is carried around it.
    carried = any(effect("x").overrides(hook) for hook in ("act", "command", "observe", "late"))
    assert bool(effect.native) != carried
    assert effect.places(mujoco.MjModel.from_xml_string("<mujoco/>")) in ([], [""])


@pytest.mark.parametrize("kind", ROWS)
def test_json_round_trip(kind: str) -> None:
    row = ROWS[kind]
    effect = LIBRARY[kind](row.on, **row.planted)
    again = from_json(effect.to_json())
    assert again.label == effect.label
    np.testing.assert_array_equal(again.values, effect.values)
    assert effect.with_values(np.full(len(effect.values), -1e9)).values.tolist() == [
        p.lower if np.isfinite(p.lower) and not p.own else -1e9 for p in effect.parameters
    ]


#: A joint that has some of everything.
HAVING = mujoco.MjModel.from_xml_string("""<mujoco><compiler angle="radian"/>
<option timestep="0.002" density="40" viscosity="0.4"/><worldbody><body><joint name="hinge" axis="0 1 0"
damping="0.2" frictionloss="0.3" armature="0.05" stiffness="1.5" springref="0.4"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05" mass="1"/></body></worldbody></mujoco>""")
OWN = {
    "coulomb_friction": ("level", "dof_frictionloss", 0.3),
    "soft_friction": ("level", "dof_frictionloss", 0.3),
    "viscous_friction": ("coefficient", "dof_damping", 0.2),
    "armature": ("inertia", "dof_armature", 0.05),
    "spring": ("stiffness", "jnt_stiffness", 1.5),
    "fluid": ("density", "opt.density", 40.0),
}


def test_effects_that_take_away_are_those_of_numbers_of_the_model() -> None:
    taking = {name for name, kind in LIBRARY.items() if shipped(kind) and any(p.own for p in kind.parameters)}
    assert taking == set(OWN)


@pytest.mark.parametrize("kind", OWN)
@pytest.mark.parametrize("share", [0.6, 1.0])
def test_an_effect_takes_away_what_the_model_has_bit_for_bit(kind: str, share: float) -> None:
    name, field, own = OWN[kind]
    more = {"reference": 0.4} if kind == "spring" else {}
    on = "" if kind == "fluid" else "hinge"
    effect = LIBRARY[kind](on, **{name: -share * own}, **more)

    def less(m: mujoco.MjModel) -> None:
        if field.startswith("opt."):
            m.opt.density = own + -share * own
        else:
            getattr(m, field)[0] = own + -share * own

    start = np.array([[0.7], [0.0]]), np.array([[-3.0], [2.0]]), Drive(np.zeros((2, 50, 0)))
    got = Simulation(HAVING, [effect], 1)
    expected = Simulation(edited(HAVING, less), [], 1).rollout(np.empty((2, 0)), *start)[0]
    np.testing.assert_allclose(got.rollout(np.tile(effect.values, (2, 1)), *start)[0], expected, rtol=1e-12)
    index = [p.name for p in effect.parameters].index(name)
    assert got.lower[index] == -own


@pytest.mark.parametrize("kind", OWN)
def test_no_effect_takes_away_more_than_there_is(kind: str) -> None:
    name, _, own = OWN[kind]
    on = "" if kind == "fluid" else "hinge"
    effect = LIBRARY[kind](on, **{name: -1.1 * own})
    assert effect.values.tolist() == from_json(effect.to_json()).values.tolist()
    message = rf"{name}=-{1.1 * own:g} .* takes away more than the model has; give -{own:g} or more"
    with pytest.raises(ValueError, match=message):
        Simulation(HAVING, [effect], 1)
    none = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1"/></body>
    </worldbody></mujoco>""")
    with pytest.raises(ValueError, match="takes away more than the model has; give 0 or more"):
        LIBRARY[kind](on, **{name: -0.01}).bind(none)
    assert Simulation(none, [LIBRARY[kind](on)], 1).lower[0] == 0


def test_a_lighter_body_is_one_of_another_density() -> None:
    def lighter(m: mujoco.MjModel) -> None:
        m.body_mass[2] *= 0.7
        m.body_inertia[2] *= 0.7

    name = ARM.body(2).name
    got = one_step(ARM, [LIBRARY["mass_scale"](name, change=-0.3)])
    np.testing.assert_allclose(got, one_step(edited(ARM, lighter), []), rtol=1e-12)


def test_an_inertia_that_did_not_follow_its_mass() -> None:
    def heavier(m: mujoco.MjModel) -> None:
        m.body_mass[2] *= 1.3

    name = ARM.body(2).name
    there = [LIBRARY["mass_scale"](name, change=0.3), LIBRARY["inertia_scale"](name, change=1 / 1.3 - 1)]
    np.testing.assert_allclose(one_step(ARM, there), one_step(edited(ARM, heavier), []), rtol=1e-12)


def test_bounds_and_names_are_checked() -> None:
    with pytest.raises(ValueError, match=r"mu=-0.1  is outside \[0, 1\]"):
        LIBRARY["load_friction"]("hinge", mu=-0.1)
    with pytest.raises(ValueError, match=r"mu_driven=2  is outside"):
        LIBRARY["directional_load_friction"]("hinge", mu_driven=2.0)
    with pytest.raises(ValueError, match="has no parameter 'leve'; did you mean 'level'"):
        LIBRARY["coulomb_friction"]("hinge", leve=1.0)
    tendon = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
    <tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
    <actuator><motor name="m" tendon="t"/></actuator></mujoco>""")
    with pytest.raises(ValueError, match="dc_motor cannot sit on"):
        LIBRARY["dc_motor"]("m").bind(tendon)
