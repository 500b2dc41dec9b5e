"""Try an effect for some steps: what its hooks get wrong is said before a search, not in the middle of one."""

from __future__ import annotations

import mujoco
import numpy as np

from sb3_rpto.effects.effect import HOOKS, Effect, Scales
from sb3_rpto.effects.simulation import Drive, Simulation

#: Simulations at once, of different parameters, and steps of each; the middle one begins at rest, those beside it at
#: this speed in rad/s or m/s.
N, STEPS, SPEED = 3, 4, 0.1
#: An inverse may be off by this share of what it takes back.
UNDONE = 0.1


def try_out(model: mujoco.MjModel, effect: Effect) -> None:
    """Require that an effect's hooks work on several simulations at once, at rest and in motion.

    :param model: that it is an effect of
    :param effect: of a class of the user's own
    :raises ValueError: a hook raises an error, mixes simulations, or what comes of it is not finite, or ``unobserve``
        is not the inverse of ``observe``; the message names effect and hooks
    """
    sizes = np.array([p.null + p.size_for(Scales()) for p in effect.parameters])
    low, high = np.array([(p.lower, p.upper) for p in effect.parameters]).T
    values = np.clip(np.linspace(0.5, 1.0, N)[:, None] * sizes, low, high)
    qpos, qvel = np.tile(model.qpos0, (N, 1)), np.tile(np.linspace(-SPEED, SPEED, N)[:, None], model.nv)
    drive = Drive(np.zeros((N, STEPS, model.nu)), 0, None, {})
    hooks = " or ".join(hook for hook in HOOKS if effect.overrides(hook)) + f" of {type(effect).__name__}"
    try:
        simulation = Simulation(model, [effect], 1)
        (bound,) = simulation.effects
        motion = simulation.rollout(values, qpos, qvel, drive)
        alone = [simulation.rollout(values[[i]], qpos[[i]], qvel[[i]], drive.take(np.array([i]))) for i in range(N)]
        sent = bound.command(np.zeros(N), values, {}, model.opt.timestep)  # MuJoCo takes one that is no number for 0
        true = np.tile(np.linspace(-1.0, 1.0, 5), (N, 1)), np.tile(np.linspace(0.0, SPEED, 5), (N, 1))
        seen = bound.observe(*true, values[:, None])
        undone = bound.unobserve(*seen, values[:, None])
        made = (*motion, sent, bound.late(values), *seen, *undone)
        finite = all(np.isfinite(array).all() for array in made)
    except Exception as error:  # whatever somebody's code raises
        raise ValueError(
            f"{effect.label}: {hooks} fails on {N} simulations at once "
            f"({type(error).__name__}: {error}); x has one row for each simulation and one column for each parameter"
        ) from error
    if not finite:
        raise ValueError(
            f"{effect.label}: what {hooks} makes of plausible parameters is not finite, at the model's zero pose, at "
            f"rest or at speeds up to {SPEED} rad/s or m/s; mind what it divides by there"
        )
    together = (np.concatenate(parts) for parts in zip(*alone))
    if not all(np.allclose(a, b, rtol=1e-6, atol=1e-9) for a, b in zip(motion, together)):
        raise ValueError(
            f"{effect.label}: {hooks} makes something else of a simulation beside others than alone; row i of x, and "
            "of all arrays, is that of simulation i"
        )
    off, shift = (max(np.abs(a - b).max() for a, b in zip(arrays, true)) for arrays in (undone, seen))
    if off > UNDONE * shift:
        raise ValueError(
            f"{effect.label}: unobserve of {type(effect).__name__} does not take back what its observe does: it is "
            f"off by {off:.3g} where that changes {shift:.3g}; it takes what the sensor shows, and returns q and v"
        )
