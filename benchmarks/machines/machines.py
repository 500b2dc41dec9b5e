"""Three real machines, measured by others: the recordings and, for each, the model that its makers declare.

The recordings are not part of this package; :func:`find_measured` looks for them. A declared model is what is known of
a machine before anything is traced: rigid bodies, gravity, viscous damping. Angles are in rad, 0 hanging down.
"""

import gzip
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_rpto.sysid import Measurements

FOLDER_VARIABLE = "RPTO_MEASURED"
GRAVITY = 9.81
"""m/s²."""
XL330_ERROR_GAIN = (4096 / (2 * np.pi)) / (256 * 885)
"""Duty for each unit of the firmware's gain and each rad of error: encoder counts per rad over its divisor."""
XL330_STALL_TORQUE = 0.4
"""Nominal kt·vin/R in N·m; a start for the fit, not a measurement."""
XL330_DAMPING = 0.03
"""Nominal kt²/R in N·m·s/rad; a start for the fit, not a measurement."""

_OPTION = f"""<option timestep="0.002" integrator="implicitfast" gravity="0 0 -{GRAVITY}">
    <flag contact="disable"/>
  </option>"""


@dataclass(frozen=True, eq=False)
class Machine:
    """A machine's declared model and its recordings.

    :param name: its key in :data:`MACHINES` and its folder
    :param xml: MJCF of the declared model at nominal values
    :param data: recordings whose column ``split`` says which runs are for training and which for the test
    :param declared: parameters of the model that are to be fitted, ``<object>.<parameter>``
    :param other: recordings from another distribution, None where there are none
    :param licence: SPDX name of the recordings' licence
    :param source: where the recordings come from
    """

    name: str
    xml: str
    data: Measurements
    declared: tuple[str, ...]
    other: Measurements | None
    licence: str
    source: str


def find_measured() -> Path | None:
    """Folder that holds one folder for each machine.

    :return: the folder that the environment variable ``RPTO_MEASURED`` names, without it ``../shared/measured`` beside
        the repository; None where there is no such folder
    """
    named = os.environ.get(FOLDER_VARIABLE)
    folder = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "measured"
    return folder if folder.is_dir() else None


def simple_pendulum(folder: str | os.PathLike[str]) -> Machine:
    """Torque-limited pendulum with one joint: J·qdd = tau - m·g·l·sin(q) - b·qd.

    J, m·l and b are those of the published identification, which was made on poorly excited runs; a fit to the training
    run ends several times higher. The command is the torque that the motor reports at its output.

    :param folder: as found by :func:`find_measured`
    :raises FileNotFoundError: a recording is not there
    """

    def table(method: str, **extra: str) -> dict[str, np.ndarray]:
        path = _file(folder, "simple_pendulum", f"control_method_{method}_data_measured.csv")
        names = {"time": "time", "position": "qpos.hinge", "velocity": "qvel.hinge", "torque": "ctrl.motor"}
        return _table(path, names, **extra)

    methods = {"ddp": "train", "direct_collocation": "test"}
    return Machine(
        name="simple_pendulum",
        xml=_simple_pendulum_xml(inertia=0.06259, mass_length=0.1022, damping=0.04707),
        data=Measurements.from_tables({name: table(name, split=part) for name, part in methods.items()}),
        declared=("arm.mass", "arm.inertia", "hinge.damping"),
        other=Measurements.from_tables({"ilqr": table("ilqr"), "pd": table("pd_system_identification")}),
        licence="BSD-3-Clause",
        source="github.com/dfki-ric-underactuated-lab/torque_limited_simple_pendulum, commit ed17ea2d",
    )


def double_pendulum(folder: str | os.PathLike[str]) -> Machine:
    """Double pendulum with two geared motors; the angle of the elbow is relative to the upper arm.

    Masses, centres of mass, inertias about the joints and damping are those of the published parameter file. Its rotor
    inertia and Coulomb friction are left out: the declared model has neither. The command is the commanded torque.

    :param folder: as found by :func:`find_measured`
    :raises FileNotFoundError: a recording is not there
    """

    def table(number: str, **extra: str) -> dict[str, np.ndarray]:
        path = _file(folder, "double_pendulum", f"A.0_20220815_trajectory_{number}.csv.gz")
        names = {"time": "time"}
        for i, joint in enumerate(("shoulder", "elbow"), start=1):
            names |= {f"pos_meas{i}": f"qpos.{joint}", f"vel_meas{i}": f"qvel.{joint}"}
            names |= {f"tau_con{i}": f"ctrl.{joint}_motor"}
        return _table(path, names, **extra)

    parts = {**dict.fromkeys(("00", "01", "02", "12"), "train"), **dict.fromkeys(("03", "13"), "test")}
    return Machine(
        name="double_pendulum",
        xml=_double_pendulum_xml(),
        data=Measurements.from_tables({f"trajectory_{n}": table(n, split=part) for n, part in parts.items()}),
        declared=(
            *("upper_arm.mass", "upper_arm.inertia", "shoulder.damping"),
            *("forearm.mass", "forearm.inertia", "elbow.damping"),
        ),
        other=Measurements.from_tables({f"trajectory_{n}": table(n) for n in ("04", "05")}),
        licence="BSD-3-Clause",
        source="github.com/dfki-ric-underactuated-lab/double_pendulum, commit 1e8544e6",
    )


def servo_xl330(folder: str | os.PathLike[str]) -> Machine:
    """Hobby servo that holds a load of 0.49 kg at 0.10 m: a pendulum and a DC motor under proportional control.

    The torque is (kt·vin/R)·clip(kp·e·(goal - q), -1, 1) - (kt²/R)·qd while the servo is enabled, with e the
    :data:`XL330_ERROR_GAIN`, and -b·qd always: where the arm falls freely, b alone brakes it. The firmware's gain kp
    differs by run, so ``param.servo.kp`` carries each run's gain at nominal strength in N·m/rad. The servo's own speed
    lags its position by about 20 ms and is left out: what :class:`Measurements` estimates from the position is better.

    :param folder: as found by :func:`find_measured`
    :raises FileNotFoundError: no recording is there
    """
    paths = sorted((Path(folder) / "servo_xl330").glob("*.json.gz"))
    if not paths:
        raise FileNotFoundError(f"no recording in {Path(folder) / 'servo_xl330'}; {_REMEDY}")
    return Machine(
        name="servo_xl330",
        xml=_servo_xml(mass=0.49, length=0.10, gain=_servo_gain(400)),
        data=Measurements.from_tables(dict(map(_servo_run, paths))),
        declared=("servo.strength", "servo.damping", "hinge.damping"),
        other=None,
        licence="Apache-2.0",
        source="github.com/Rhoban/bam, commit af226042",
    )


MACHINES: dict[str, Callable[[str | os.PathLike[str]], Machine]] = {
    "simple_pendulum": simple_pendulum,
    "double_pendulum": double_pendulum,
    "servo_xl330": servo_xl330,
}
"""Loader of each machine; it takes the folder that :func:`find_measured` finds."""

_REMEDY = f"give the folder that holds the machines' folders, e.g. by the environment variable {FOLDER_VARIABLE}"


def _file(folder: str | os.PathLike[str], machine: str, name: str) -> Path:
    path = Path(folder) / machine / name
    if not path.is_file():
        raise FileNotFoundError(f"no recording {path}; {_REMEDY}")
    return path


def _table(path: Path, names: dict[str, str], **extra: str) -> dict[str, np.ndarray]:
    """Columns of a (gzipped) CSV file under the names of the file format, with constant columns added."""
    columns = np.genfromtxt(path, delimiter=",", names=True)
    table = {new: columns[old] for old, new in names.items()}
    return table | {name: np.full(len(columns), value) for name, value in extra.items()}


def _servo_run(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    with gzip.open(path, "rt", encoding="utf-8") as stream:
        run = json.load(stream)
    entries: Iterable[dict[str, Any]] = run["entries"]
    names = {
        "timestamp": "time",
        "position": "qpos.hinge",
        "goal_position": "ctrl.servo",
        "torque_enable": "enabled.servo",
    }
    table = {new: np.array([entry[old] for entry in entries], dtype=float) for old, new in names.items()}
    rows = len(table["time"])
    table["param.servo.kp"] = np.full(rows, _servo_gain(run["kp"]))
    table["split"] = np.full(rows, "train" if run["kp"] in (100, 400) else "test")
    return f"kp{run['kp']}_{run['trajectory']}", table


def _servo_gain(kp: float) -> float:
    """Stiffness in N·m/rad, at nominal strength, that the firmware's gain amounts to."""
    return XL330_STALL_TORQUE * kp * XL330_ERROR_GAIN


def _inertial(mass: float, centre: float, inertia: float) -> str:
    """A slender body hanging from its joint.

    :param mass: in kg
    :param centre: distance of the centre of mass from the joint in m
    :param inertia: about the centre of mass in kg·m², across the body; that along it is set small and does not act
    """
    return f'<inertial pos="0 0 {-centre!r}" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia / 100!r}"/>'


def _simple_pendulum_xml(inertia: float, mass_length: float, damping: float) -> str:
    # The identification gives J and m·l; a centre nearer than J/(m·l) leaves inertia for the parameter of that name.
    centre = 0.4
    mass = mass_length / centre
    return f"""<mujoco model="simple_pendulum">
  {_OPTION}
  <worldbody>
    <body name="arm">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
      {_inertial(mass, centre, inertia - mass * centre**2)}
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge"/>
  </actuator>
</mujoco>
"""


def _double_pendulum_xml() -> str:
    # design_A.0_model_2.0_parameters.yml: m, r, I of each link, with I about the link's joint, and the length l1.
    mass1, centre1, inertia1 = 0.5593806151425046, 0.3, 0.053470810264216295
    mass2, centre2, inertia2 = 0.6043459469186889, 0.18377686083653508, 0.02392374528789766
    return f"""<mujoco model="double_pendulum">
  {_OPTION}
  <worldbody>
    <body name="upper_arm">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.001"/>
      {_inertial(mass1, centre1, inertia1 - mass1 * centre1**2)}
      <body name="forearm" pos="0 0 -0.3">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.001"/>
        {_inertial(mass2, centre2, inertia2 - mass2 * centre2**2)}
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
</mujoco>
"""


def _servo_xml(mass: float, length: float, gain: float) -> str:
    # A point mass; MuJoCo wants some inertia, 0.02 % of what the mass has about the joint. The force range clips the
    # duty alone: MuJoCo adds an actuator's damping to the passive forces, after the clip, as the back-EMF acts.
    return f"""<mujoco model="servo_xl330">
  {_OPTION}
  <worldbody>
    <body name="arm">
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      {_inertial(mass, length, 1e-6)}
    </body>
  </worldbody>
  <actuator>
    <general name="servo" joint="hinge" gaintype="fixed" biastype="affine" gainprm="{gain!r}" biasprm="0 {-gain!r} 0"
             forcelimited="true" forcerange="{-XL330_STALL_TORQUE} {XL330_STALL_TORQUE}" damping="{XL330_DAMPING}"/>
  </actuator>
</mujoco>
"""
