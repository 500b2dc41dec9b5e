"""What happens to a command on its way to the actuator: offset, smoothing, delay, deadband, saturation, play, lag.

A wrong gain comes last of all, in the actuator itself.
"""

from typing import Any, ClassVar

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import GAINS, on_voltage, servo_of
from sb3_rpto.effects.batch import SimulationBatch
from sb3_rpto.effects.effect import Effect, Parameter, register
from sb3_rpto.effects.names import object_id, object_names

LONGEST_DELAY = 0.2  # s; a longer delay is a fault of the log
_SLOWEST = 0.25  # s; of a slower lag the past that windows keep says too little


@register
class CommandOffset(Effect):
    r"""A constant on top of every command, :math:`u + c`, within the actuator's ``ctrlrange``, where MuJoCo clips it.

    Where nothing is clipped it is a ``torque_offset`` of the joint, which a noisy log hardly tells from it.
    """

    kind = "command_offset"
    place = "actuator"
    parameters = (Parameter("offset", "command", lambda s: 0.03 * s.command),)
    equation = "u + offset"
    excite = "small commands, and the largest ones"
    offered = False
    order = -2

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Add."""
        return u + x[:, 0]


@register
class CommandSmoothing(Effect):
    r"""Exponential smoothing of what is sent, :math:`y_k = s\,y_{k-1} + (1 - s)\,u_k` (Brown 1956), held in between.

    A command is new where it changes, and where it stays the same for as long as the shortest one so far. That needs
    commands as they were sent: measured ones change between two steps of the simulation, too.
    """

    kind = "command_smoothing"
    place = "actuator"
    parameters = (Parameter("share", "", 0.05, lower=0.0, upper=0.99),)
    equation = "y[k] = share y[k-1] + (1 - share) u[k]"
    excite = "commands that change quickly"
    offered = False
    order = -1

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Smooth."""
        if not memory:
            count = len(u)
            memory.update(y=u.copy(), u=u.copy(), age=np.zeros(count, int), shortest=np.full(count, np.iinfo(int).max))
            memory["changed"] = np.zeros(count, dtype=bool)  # before the first change nothing tells how long they last
            return u
        age, changes = memory["age"] + 1, u != memory["u"]
        new = changes | (age >= memory["shortest"])
        memory["shortest"] = np.where(
            changes & memory["changed"], np.minimum(age, memory["shortest"]), memory["shortest"]
        )
        memory["y"] = np.where(new, x[:, 0] * memory["y"] + (1 - x[:, 0]) * u, memory["y"])
        memory.update(u=u.copy(), age=np.where(new, 0, age), changed=memory["changed"] | changes)
        return np.asarray(memory["y"])


@register
class CommandDelay(Effect):
    r"""The actuator receives :math:`u(t - d)`.

    A command is constant between two grid points, so the mean over a step of the delayed one is exactly the linear
    interpolation between two past samples (sampled systems with a delay, Åström & Wittenmark 1997). Before the first
    sample its command is held.
    """

    kind = "command_delay"
    place = "actuator"
    parameters = (Parameter("delay", "s", 0.01, lower=0.0, upper=LONGEST_DELAY),)
    equation = "u(t - delay)"
    excite = "commands that change quickly"
    order = 0

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Read the past at the delay."""
        if not memory:
            depth = int(np.ceil(LONGEST_DELAY / dt)) + 2
            memory["past"], memory["k"] = np.repeat(u[:, None], depth, axis=1), -1
        past = memory["past"]
        depth = past.shape[1]
        k = memory["k"] = (memory["k"] + 1) % depth
        past[:, k] = u
        steps = x[:, 0] / dt
        whole = np.floor(steps).astype(int)
        rows, part = np.arange(len(u)), steps - whole
        return (1 - part) * past[rows, (k - whole) % depth] + part * past[rows, (k - whole - 1) % depth]


@register
class CommandDeadband(Effect):
    r"""A dead zone, :math:`u - \mathrm{clip}(u, -w, w)`: nothing below :math:`w`, and all above is less by it.

    The symmetric one of unit slope (Tao & Kokotović 1996).
    """

    kind = "command_deadband"
    place = "actuator"
    parameters = (Parameter("width", "command", lambda s: 0.05 * s.command, lower=0.0),)
    equation = "u - clip(u, -width, width)"
    excite = "small commands"
    order = 1

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Take the dead zone away."""
        return u - np.clip(u, -x[:, 0], x[:, 0])


@register
class CommandGain(Effect):
    r"""A wrong gain of the amplifier: :math:`(1 + g)\,u`, after the controller's own limits; MuJoCo's ``gainprm``.

    Of a ``dcmotor`` it is one on the voltage alone: its back-EMF stays, with the motor constant :math:`K / (1 + g)` and
    the resistance :math:`R / (1 + g)^2`.
    """

    kind = "command_gain"
    place = "actuator"
    parameters = (Parameter("change", "", 0.03, lower=-0.9, upper=9.0),)
    equation = "(1 + change) u"
    native = "gainprm"
    excite = "large commands"
    same = ("gain", "gear", "strength")

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Actuators whose force is linear in their gain parameters, and motors of a voltage."""
        ids = {name: i for i, name in enumerate(object_names(model, "actuator"))}
        every = super().places(model)
        return [n for n in every if model.actuator_gaintype[ids[n]] in GAINS or on_voltage(model, ids[n])]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the gain."""
        gain = batch.field("actuator_gainprm")[:, self.index]
        if on_voltage(batch.model, self.index):
            gain[:, :2] /= (1 + x) ** [2, 1]  # resistance, motor constant
        else:
            gain[:, :3] *= 1 + x


@register
class ServoGain(Effect):
    r"""A position servo of another stiffness, :math:`(1 + g)\,k_p\,(u - q)`: MuJoCo's ``kp``; its damping stays."""

    kind = "servo_gain"
    place = "actuator"
    parameters = (Parameter("change", "", 0.03, lower=-0.9, upper=9.0),)
    equation = "(1 + change) kp (u - q)"
    native = "kp"
    excite = "commands that jump, and loads that the servo gives way to"
    same = ("kp", "strength")
    #: what such a servo regulates, and where in its bias it takes the gain back
    regulates: ClassVar[str] = "position"
    takes_back: ClassVar[int] = 1

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Servos of that kind."""
        every = super().places(model)
        return [name for name in every if servo_of(model, object_id(model, "actuator", name)) == cls.regulates]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the gain and what it takes back."""
        batch.field("actuator_gainprm")[:, self.index, 0] *= 1 + x[:, 0]
        batch.field("actuator_biasprm")[:, self.index, self.takes_back] *= 1 + x[:, 0]


@register
class ServoDamping(Effect):
    r"""A position servo that damps its joint otherwise, :math:`-(1 + c)\,k_v\,\dot q`: MuJoCo's ``kv``.

    More of it is a ``viscous_friction`` to the data, and so is less, as far as the joint has damping of its own.
    """

    kind = "servo_damping"
    place = "actuator"
    parameters = (Parameter("change", "", 0.1, lower=-1.0, upper=9.0),)
    equation = "-(1 + change) kv qd"
    native = "kv"
    excite = "motion at several speeds"
    same = ("kv",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Position servos that damp."""
        servos = ServoGain.places(model)
        return [name for name in servos if model.actuator_biasprm[object_id(model, "actuator", name), 2]]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Scale the feedback of the speed."""
        batch.field("actuator_biasprm")[:, self.index, 2] *= 1 + x[:, 0]


@register
class VelocityServoGain(ServoGain):
    r"""A velocity servo of another gain, :math:`(1 + g)\,k_v\,(u - \dot q)`: MuJoCo's ``kv``.

    A ``command_gain`` changes what is commanded alone, not how hard the servo holds against a load.
    """

    kind = "velocity_servo_gain"
    equation = "(1 + change) kv (u - qd)"
    native = "kv"
    excite = "commands that jump, and loads that slow the servo"
    same = ("kv", "strength")
    regulates = "velocity"
    takes_back = 2


@register
class CommandSaturation(Effect):
    r"""A limit of the amplifier, :math:`\mathrm{clip}(u, -1/s, 1/s)`, by its inverse: 0 is no limit.

    What a ``ctrlrange`` of MuJoCo does to a command, here before play and lag.
    """

    kind = "command_saturation"
    place = "actuator"
    parameters = (
        Parameter("inverse_limit", "1/command", lambda s: 1.2 / s.command, lower=0.0, starts=(0.6, 1.5, 3.0)),
    )
    equation = "clip(u, -1/inverse_limit, 1/inverse_limit)"
    excite = "the largest commands"
    order = 3

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Clip."""
        limit = np.divide(1.0, x[:, 0], out=np.full(len(u), np.inf), where=x[:, 0] > 0)
        return np.clip(u, -limit, limit)


@register
class Backlash(Effect):
    r"""Play between command and actuator, of half-width h: :math:`y = \mathrm{clip}(y^-, u - h, u + h)`.

    The play operator (Krasnosel'skii & Pokrovskii 1989), which starts at the first command. It is that of a stiff
    drive that moves a servo's target; the impacts of gears on their teeth are not in it.
    """

    kind = "backlash"
    place = "actuator"
    parameters = (Parameter("half_width", "command", lambda s: 0.05 * s.command, lower=0.0),)
    equation = "y = clip(y, u - half_width, u + half_width)"
    excite = "commands that often reverse"
    order = 4

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Follow the command at the edge of the play."""
        memory["y"] = np.clip(memory.get("y", u), u - x[:, 0], u + x[:, 0])
        return memory["y"]


@register
class ActuatorLag(Effect):
    r"""First-order lag :math:`T \dot y = u - y` of a command held over each step, starting at the first command.

    What acts in a step is the mean of :math:`y` over it, which is exact: the value at the step's end, MuJoCo's
    ``dyntype="filterexact"`` with ``actearly``, comes half a step too early.
    """

    kind = "actuator_lag"
    place = "actuator"
    parameters = (Parameter("time_constant", "s", 0.01, lower=0.0, upper=_SLOWEST),)
    equation = "time_constant dy/dt = u - y"
    excite = "commands that change quickly"
    order = 5

    def command(self, u: np.ndarray, x: np.ndarray, memory: dict[str, Any], dt: float) -> np.ndarray:
        """Filter."""
        # Written this way the null, where the past has no weight, gives u without rounding.
        behind, gone = memory.get("y", u) - u, -np.expm1(-dt / np.maximum(x[:, 0], 1e-12))
        memory["y"] = u + behind * (1 - gone)
        return u + behind * gone * x[:, 0] / dt
