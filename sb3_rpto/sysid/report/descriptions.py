"""The words of a report: verdicts in plain language, names and units of a model's joints, equations with numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from sb3_rpto.effects import Effect, Parameter
from sb3_rpto.effects.names import SCALAR_JOINTS, object_id, object_names
from sb3_rpto.effects.units import joint_of
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.selection.adequacy import Adequacy

#: For each verdict what it means, and what it does not mean.
VERDICTS = {
    "complete": (
        "Nothing is missing: with its declared parameters fitted, the model predicts the data as well as the "
        "measurement noise allows.",
        "This holds for motion like the recorded one. Effects that these data cannot show may still be there.",
    ),
    "explained": (
        "The model lacked what is named below; with it, what is left is no more than the measurement noise.",
        "Effects of one class act alike in these data: any of them may be the true one.",
    ),
    "partly explained": (
        "What is named below takes away at least half of the excess error, but something remains that none of the "
        "effects looked for explains.",
        "It brings the model closer to the data and is not claimed as the explanation.",
    ),
    "unexplained": (
        "The model does not fit the data, and none of the effects looked for explains why.",
        "Effects that are listed all the same lower the error and are not claimed as the explanation.",
    ),
}


def rest(after: Adequacy) -> list[str]:
    """In a sentence how small what remains is; none where nothing does, or where it is not small."""
    if after.adequate or after.ratio >= after.settings.small:
        return []
    if after.ratio <= 1 + after.settings.tolerance:
        few = percent(after.strays)
        return [f"The typical window errs by no more than noise: what remains is in {few} of windows."]
    share = percent(after.ratio - 1)
    return [f"What remains is small: the typical window errs by {share} more than noise alone makes it."]


def verdict(verdict: str, searched: bool) -> tuple[str, str]:
    """What a verdict says, and what to keep in mind with it.

    :param verdict: of the report
    :param searched: whether there were candidates
    """
    says, caution = VERDICTS[verdict]
    if verdict == "unexplained" and not searched:
        return "The model does not fit the data; no effects were looked for.", caution
    return says, caution


def not_apart(runs: Mapping[str, Sequence[str]]) -> str:
    """Why windows that were fitted are judged.

    :param runs: those to train, to select and to test on
    """
    return "as those set apart show too little" if runs["select"] else "as no run is set apart to select on"


def means(data: Measurements) -> str:
    """How a missing force was found, see :func:`sb3_rpto.sysid.problem.missing_force.missing_forces`."""
    return "from one sample to the next" if data.exact else "by inverse dynamics"


def dofs_of(effect: Effect, model: mujoco.MjModel) -> list[int]:
    """Degrees of freedom of hinges and slides that an effect acts on: of its joint, of its body's chain, or all."""
    scalar = scalar_dofs(model)
    if effect.place in ("joint", "sensor", "actuator"):
        joint = joint_of(effect, model)
        return [d for d in scalar if d == (model.jnt_dofadr[joint] if joint >= 0 else d)]
    if effect.place not in ("body", "geom"):
        return scalar
    body = object_id(model, effect.place, effect.on)
    body = int(model.geom_bodyid[body]) if effect.place == "geom" else body
    chain = set()
    while body:
        chain.add(body)
        body = int(model.body_parentid[body])
    return [d for d in scalar if int(model.dof_bodyid[d]) in chain]


def scalar_dofs(model: mujoco.MjModel) -> list[int]:
    """Addresses in qvel of hinges and slides."""
    return [int(model.jnt_dofadr[j]) for j in range(model.njnt) if model.jnt_type[j] in SCALAR_JOINTS]


def dof_name(model: mujoco.MjModel, dof: int) -> str:
    """Name of the joint of a degree of freedom."""
    return object_names(model, "joint")[model.dof_jntid[dof]]


def dof_unit(model: mujoco.MjModel, dof: int) -> str:
    """rad or m."""
    joint = model.dof_jntid[dof]
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    travels = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE and dof - model.jnt_dofadr[joint] < 3
    return "m" if slides or travels else "rad"


def force_unit(model: mujoco.MjModel, dof: int) -> str:
    """N·m or N."""
    return "N" if dof_unit(model, dof) == "m" else "N·m"


def position_unit(model: mujoco.MjModel, column: str) -> str:
    """Unit of a position column; none for a coordinate of a quaternion."""
    joints = object_names(model, "joint")
    if column in joints:
        return dof_unit(model, int(model.jnt_dofadr[joints.index(column)]))
    joint, _, offset = column.rpartition(".")
    free = joint in joints and model.jnt_type[joints.index(joint)] == mujoco.mjtJoint.mjJNT_FREE
    return "m" if free and int(offset) < 3 else ""


def number(value: float, digits: int = 4) -> str:
    """A number for people; a dash where there is none."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"


def interval(low: float, high: float, digits: int = 4) -> str:
    """``[low, high]``; a dash where neither is known."""
    if not (np.isfinite(low) or np.isfinite(high)):
        return number(np.nan)
    return f"[{number(low, digits)}, {number(high, digits)}]"


def with_numbers(effect: Effect) -> str:
    """The effect's equation with its values in place of the parameters' names."""
    text = effect.equation
    if effect.place not in ("joint", "actuator", "sensor"):  # in words, whose words may be names of parameters
        return f"{text} with {', '.join(f'{p.name} {number(v)} {p.unit}'.rstrip() for p, v in _pairs(effect))}"
    for p, value in _pairs(effect):
        shown = number(value) if value >= 0 else f"({number(value)})"
        text = re.sub(rf"\b{re.escape(p.name)}\b", shown, text)
    return re.sub(r"^\((-[^() ]+)\)", r"\1", text)


def _pairs(effect: Effect) -> list[tuple[Parameter, float]]:
    return list(zip(effect.parameters, effect.values.tolist()))


def equation(effects: Sequence[Effect]) -> str:
    """The corrected model in a line: forces as terms of the equation of motion, all else after it."""
    terms = ["M(q) qdd + c(q, qd) = tau + passive(q, qd)"]
    others: list[str] = []
    for effect in effects:
        at = f"[{effect.on}] " if effect.on else ""
        (terms if effect.place == "joint" else others).append(f"{at}{with_numbers(effect)}")
    return "; ".join([" + ".join(terms), *others])


def percent(share: float) -> str:
    """A share in per cent."""
    return f"{100 * share:.0f} %" if np.isfinite(share) else "–"
