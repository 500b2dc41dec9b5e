"""Torques at a joint that no friction makes: springs, end stops and motors."""

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import count_loss, memoryless, motor_torque, motors
from sb3_rpto.effects.batch import SimulationBatch, add
from sb3_rpto.effects.effect import Effect, Parameter, register
from sb3_rpto.effects.names import SCALAR_JOINTS, hinges, object_names

#: Half of what is left between stops that meet, for one unit of their place: six digits, as MJCF has, tell them apart.
GAP = 1e-5
#: Every count of periods that a motor's poles and slots, or a gear's teeth, may make in a turn, from 6.
COUNTS = tuple(float(count - 6) for count in range(1, 49) if count != 6)


@register
class TorqueRipple(Effect):
    r"""Cogging with :math:`n` periods a turn, :math:`a \cos(n q) + b \sin(n q)` (Holtz & Springob 1996)."""

    kind = "torque_ripple"
    place = "joint"
    parameters = (
        Parameter("cosine", "N·m", lambda s: 0.03 * s.torque),
        Parameter("sine", "N·m", lambda s: 0.03 * s.torque),
        Parameter("turns", "1/rev", 1.0, lower=1.0, upper=48.0, null=6.0, shape=True, starts=COUNTS),
    )
    equation = "cosine cos(turns q) + sine sin(turns q)"
    excite = "slow motion over a whole turn, in both directions"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Hinges."""
        return hinges(model)

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the torque."""
        angle = x[:, 2] * batch.qpos[:, self.adr]
        batch.force[:, self.dof] += x[:, 0] * np.cos(angle) + x[:, 1] * np.sin(angle)


@register
class TorqueOffset(Effect):
    r"""A constant torque :math:`c`, as of a biased amplifier or a cable that pulls: the same in both directions.

    The offset of a joint's torque in the identification of robots (Gautier, Janot & Vandanjon 2013).
    """

    kind = "torque_offset"
    place = "joint"
    parameters = (Parameter("offset", "N·m", lambda s: 0.03 * s.torque),)
    equation = "offset"
    excite = "rest or slow motion at several poses"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add the torque."""
        batch.force[:, self.dof] += x[:, 0]


@register
class Spring(Effect):
    r"""A linear spring (Hooke 1678), :math:`-k\,(q - q_0)`: MuJoCo's ``stiffness`` and ``springref``.

    Beside the model's own spring :math:`(k_1, r_1)` it is held exactly by :math:`k_1 + k` about
    :math:`(k_1 r_1 + k q_0) / (k_1 + k)`.
    """

    kind = "spring"
    place = "joint"
    parameters = (
        Parameter("stiffness", "N·m/rad", lambda s: 0.03 * s.torque / s.span, lower=0.0, own="jnt_stiffness"),
        Parameter("reference", "rad", lambda s: 0.3 * s.span, shape=True),
    )
    equation = "-stiffness (q - reference)"
    native = "stiffness"
    excite = "positions far from each other, held or slowly passed"
    same = ("stiffness",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Hinges and slides whose own spring, if any, is linear."""
        names = object_names(model, "joint")
        return [n for n in super().places(model) if not model.jnt_stiffnesspoly[names.index(n)].any()]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Add to the joint's own spring."""
        stiffness = batch.field("jnt_stiffness")[:, self.index]
        reference = batch.field("qpos_spring")[:, self.adr]
        total = np.maximum(stiffness + x[:, 0], 0.0)
        # With no stiffness at all the reference means nothing and stays.
        share = np.divide(x[:, 0], total, out=np.zeros_like(total), where=total > 0)
        reference += share * (x[:, 1] - reference)
        add(stiffness, x[:, 0])


@register
class EndStop(Effect):
    r"""Stops of a joint elsewhere, :math:`q_- + a \le q \le q_+ + b`, as soft as the model's: MuJoCo's ``range``."""

    kind = "end_stop"
    place = "joint"
    parameters = (
        Parameter("lower", "rad", lambda s: 0.03 * s.span),
        Parameter("upper", "rad", lambda s: 0.03 * s.span),
    )
    equation = "q_min + lower <= q <= q_max + upper"
    native = "range"
    excite = "motion into both stops"
    same = ("range",)

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Hinges and slides that have limits."""
        names = object_names(model, "joint")
        return [n for n in super().places(model) if model.jnt_limited[names.index(n)]]

    def write(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Move the limits; those that would cross meet half-way, but for the gap that an MJCF must leave."""
        limits = batch.field("jnt_range")[:, self.index]
        limits += x
        middle = limits.mean(axis=1, keepdims=True)
        met = middle + GAP * np.maximum(1.0, np.abs(middle)) * [-1, 1]
        limits[:] = np.where(limits[:, :1] > limits[:, 1:], met, limits)


@register
class DCMotor(Effect):
    r"""Torque-speed limit of a motor: at its voltage limit back-EMF takes away torque in proportion to the speed.

    :math:`|\tau| \le \tau_s (1 - |\dot q| / \omega_0)` while driving (:math:`\tau \dot q > 0`), and
    :math:`|\tau| \le \tau_s` while braking, with the stall torque :math:`\tau_s = 1 /` ``inverse_stall`` and the
    no-load speed :math:`\omega_0 = 1 /` ``inverse_speed``, both at the joint: the torque-speed line of a DC motor
    (Hughes & Drury 2013) with its current limit. Zero stands for no limit.
    """

    kind = "dc_motor"
    place = "actuator"
    parameters = (
        Parameter("inverse_stall", "1/(N·m)", lambda s: 1.2 / s.torque, lower=0.0),
        Parameter("inverse_speed", "s/rad", lambda s: 1.2 / s.velocity, lower=0.0),
    )
    equation = "|tau| <= (1 - inverse_speed |qd| [tau qd > 0]) / inverse_stall"
    order = -1  # before what depends on the torque that is left
    excite = "full torque at high speed"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Actuators on a hinge or slide without activation, delay or tendon."""
        names = object_names(model, "actuator")
        return [
            names[a]
            for a in range(model.nactuator)
            if memoryless(model, a) and model.jnt_type[model.actuator_trnid[a, 0]] in SCALAR_JOINTS
        ]

    def bind(self, model: mujoco.MjModel) -> None:
        """As in :class:`Effect`; looks up the joint too."""
        super().bind(model)
        joint = model.actuator_trnid[self.index, 0]
        self.dof, self.adr = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        # Where those beside it have memory, what they do is not known now: the joint's limit is then of this one alone.
        self.beside = motors(model, int(joint)) or [self.index]

    def why_not(self, model: mujoco.MjModel) -> str:
        """As in :class:`Effect`."""
        return "it needs a motor on a hinge or slide, without memory"

    def act(self, batch: SimulationBatch, x: np.ndarray) -> None:
        """Take away what the motor cannot give."""
        torque = motor_torque(batch, self.index, self.dof, self.adr)
        speed = batch.qvel[:, self.dof]
        room = np.maximum(1 - x[:, 1:] * np.maximum(np.stack([-speed, speed], axis=1), 0.0), 0.0)
        most = np.divide(room, x[:, :1], out=np.where(room > 0, np.inf, 0.0), where=x[:, :1] > 0)
        limits = most * [-1, 1]  # of the torque that pulls the joint back, and of that which drives it on
        count_loss(batch, self.beside, self.dof, self.adr, torque - np.clip(torque, limits[:, 0], limits[:, 1]))
        gear = batch.field("actuator_gear")[:, self.index, :1]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.sort(np.where(gear == 0, [-np.inf, np.inf], limits / gear), axis=1)
        batch.room[:, self.index] = np.clip(ends, batch.room[:, self.index, :1], batch.room[:, self.index, 1:])
