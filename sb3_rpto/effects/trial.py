"""Try an effect for some steps: what its hooks get wrong is said before a search, not in the middle of one."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.effects.effect import HOOKS, Effect, Scales
from sb3_rpto.effects.simulation import Drive, Simulation

#: Simulations at once, of different parameters, and steps of each.
N, STEPS = 3, 4


def try_out(model: mujoco.MjModel, effect: Effect) -> None:
    """Require that an effect's hooks work on several simulations at once.

    :param model: that it is an effect of
    :param effect: of a class of the user's own
    :raises ValueError: a hook raises an error; the message names the effect and its hooks
    """
    sizes = np.array([p.null + p.size_for(Scales()) for p in effect.parameters])
    low, high = np.array([(p.lower, p.upper) for p in effect.parameters]).T
    values = np.clip(np.linspace(0.5, 1.0, N)[:, None] * sizes, low, high)
    qpos, qvel = np.tile(model.qpos0, (N, 1)), np.zeros((N, model.nv))
    drive = Drive(np.zeros((N, STEPS, model.nu)), 0, None, {})
    try:
        simulation = Simulation(model, [effect], 1)
        simulation.rollout(values, qpos, qvel, drive)
        effect.late(values)
        q, v = np.zeros((2, N, STEPS))
        effect.unobserve(*effect.observe(q, v, values[:, None]), values[:, None])
    except Exception as error:  # whatever somebody's code raises
        hooks = " or ".join(hook for hook in HOOKS if effect.overrides(hook))
        raise ValueError(
            f"{effect.label}: {hooks} of {type(effect).__name__} fails on {N} simulations at once "
            f"({type(error).__name__}: {error}); x has one row for each simulation and one column for each parameter"
        ) from error
