"""The torque that motors put on a joint, now: what depends on load needs it before the substep."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.effects.batch import SimulationBatch

#: Actuators whose force follows the command with a time constant, ``dynprm[0]``, and all that have a state of their own
#: which does.
LAGS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
FILTERS = (*LAGS, int(mujoco.mjtDyn.mjDYN_MUSCLE))
# Plain numbers: NumPy's integers are not found among MuJoCo's enumerators.
GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def command_limits(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest of each command, in its unit, (nu,) each; infinite where it is not limited."""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited[:, None], model.actuator_ctrlrange, (-np.inf, np.inf)).T
    return low, high


def servo_of(model: mujoco.MjModel, actuator: int) -> str:
    """What an actuator regulates: its bias takes back its gain on the position, ``kp (u - q)``, or on the velocity."""
    gain, (_, on_position, on_velocity) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and gain:
        if on_position == -gain:
            return "position"
        if on_velocity == -gain and not on_position:
            return "velocity"
    return ""


def memoryless(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force follows from its command and its joint alone: no activation, delay or tendon."""
    return bool(
        model.actuator_trntype[actuator] in JOINTS
        and model.actuator_ctrlnum[actuator] == 1
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
        and model.actuator_gaintype[actuator] in GAINS
        and model.actuator_biastype[actuator] in BIASES
        and not np.any(model.actuator_delay[actuator])
    )


def on_voltage(model: mujoco.MjModel, actuator: int) -> bool:
    r"""Whether an actuator is a ``dcmotor`` of a voltage and without a state: its torque is :math:`K (u - K w) / R`."""
    return bool(
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_DCMOTOR
        and model.actuator_ctrlspec[actuator] == mujoco.mjtCtrlInput.mjINPUT_VOLTAGE
        and not model.actuator_actnum[actuator]
    )


def drivers(model: mujoco.MjModel, joint: int) -> list[int]:
    """The actuators that act on a joint itself, not through a tendon or a site."""
    actuators = range(model.nactuator)
    return [a for a in actuators if model.actuator_trntype[a] in JOINTS and model.actuator_trnid[a, 0] == joint]


def motors(model: mujoco.MjModel, joint: int) -> list[int] | None:
    """The actuators on a joint; None where what they do is not told by :func:`motor_torque`."""
    on = drivers(model, joint)
    others = any(_moves_otherwise(model, a, joint) for a in range(model.nactuator))
    balanced = bool(model.jnt_actgravcomp[joint]) and bool(model.body_gravcomp.any())
    return None if others or balanced or not all(memoryless(model, a) for a in on) else on


def _moves_otherwise(model: mujoco.MjModel, actuator: int, joint: int) -> bool:
    """Whether an actuator may move a joint by other ways than as its own: a tendon, a site, a body."""
    if model.actuator_trntype[actuator] in JOINTS:
        return False
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
        return True
    joints = joints_of_tendon(model, actuator)
    return joints is None or joint in joints


def joints_of_tendon(model: mujoco.MjModel, actuator: int) -> dict[int, float] | None:
    """The joints of an actuator's fixed tendon, with their coefficients; None of a spatial one, which may move any."""
    tendon = model.actuator_trnid[actuator, 0]
    wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if (model.wrap_type[wraps] != mujoco.mjtWrap.mjWRAP_JOINT).any():
        return None
    return dict(zip(model.wrap_objid[wraps].tolist(), model.wrap_prm[wraps].tolist()))


def driven(model: mujoco.MjModel) -> set[int]:
    """The joints that an actuator drives, by itself or through a fixed tendon."""
    tendons = [a for a in range(model.nactuator) if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON]
    on = {joint for joint in range(model.njnt) if drivers(model, joint)}
    return on.union(*(joints_of_tendon(model, a) or () for a in tendons))


def motor_torque(batch: SimulationBatch, actuator: int, dof: int, adr: int) -> np.ndarray:
    r"""Generalised force of a memoryless actuator at its joint, N·m or N, (n,).

    :math:`\tau = G\,\mathrm{clip}(g\,\mathrm{clip}(u) + b_0 + b_1 l + b_2 \dot l)` with gear :math:`G`, length
    :math:`l = G q` and gain :math:`g = g_0 + g_1 l + g_2 \dot l` (MuJoCo documentation, *Actuation model*).

    :param batch: commands and state of the substep to come
    :param actuator: id of the actuator, see :func:`memoryless`
    :param dof: the joint's address in qvel
    :param adr: its address in qpos
    """
    model = batch.model
    if _is_off(model, actuator):
        return np.zeros(batch.n)
    gear = batch.field("actuator_gear")[:, actuator, 0]
    length, speed = gear * batch.qpos[:, adr], gear * batch.qvel[:, dof]
    ctrl = int(model.actuator_ctrladr[actuator])
    u = batch.ctrl[:, ctrl]
    if model.actuator_ctrllimited[ctrl] and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        limits = batch.field("actuator_ctrlrange")[:, ctrl]
        u = np.clip(u, limits[:, 0], limits[:, 1])
    gain = batch.field("actuator_gainprm")[:, actuator]
    affine = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_AFFINE
    force = (_affine(gain, length, speed) if affine else gain[:, 0]) * u
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
        force = force + _affine(batch.field("actuator_biasprm")[:, actuator], length, speed)
    if model.actuator_forcelimited[actuator]:
        limits = batch.force_range(actuator)
        force = np.clip(force, limits[:, 0], limits[:, 1])
    return gear * force


def joint_torque(batch: SimulationBatch, actuators: list[int] | None, dof: int, adr: int) -> np.ndarray:
    """Sum of the actuators' generalised forces at a joint, (n,), within what its ``actuatorfrcrange`` lets through.

    :param actuators: from :func:`motors`; None: MuJoCo's own sum, of the last :meth:`SimulationBatch.evaluate`
    """
    if actuators is None:
        return batch.actuation[:, dof] - batch.loss[:, dof]
    return _through(batch, _sum(batch, actuators, dof, adr) - batch.loss[:, dof], dof)


def count_loss(batch: SimulationBatch, actuators: list[int], dof: int, adr: int, loss: np.ndarray) -> None:
    """Count as lost in this substep (``world.loss``, (n,)) what one of a joint's actuators does not give.

    The joint misses it (``world.missed``), but for what its limit takes anyway.

    :param actuators: all that act on the joint
    """
    before = batch.loss[:, dof].copy()
    batch.loss[:, dof] += loss
    if batch.model.jnt_actfrclimited[batch.model.dof_jntid[dof]]:
        total = _sum(batch, actuators, dof, adr) - before
        loss = _through(batch, total, dof) - _through(batch, total - loss, dof)
    batch.missed[:, dof] += loss


def _sum(batch: SimulationBatch, actuators: list[int], dof: int, adr: int) -> np.ndarray:
    return sum((motor_torque(batch, a, dof, adr) for a in actuators), np.zeros(batch.n))


def _through(batch: SimulationBatch, torque: np.ndarray, dof: int) -> np.ndarray:
    """What reaches a joint of its actuators' sum: MuJoCo clips it to the joint's ``actuatorfrcrange``."""
    joint = batch.model.dof_jntid[dof]
    if not batch.model.jnt_actfrclimited[joint]:
        return torque
    limits = batch.field("jnt_actfrcrange")[:, joint]
    return np.clip(torque, limits[:, 0], limits[:, 1])


def _is_off(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the model's options switch an actuator off."""
    group = int(model.actuator_group[actuator])
    all_off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return bool(all_off or (0 <= group <= 30 and model.opt.disableactuator >> group & 1))


def _affine(parameters: np.ndarray, length: np.ndarray, speed: np.ndarray) -> np.ndarray:
    return parameters[:, 0] + parameters[:, 1] * length + parameters[:, 2] * speed
