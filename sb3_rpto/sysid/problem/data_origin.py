"""Where do recordings come from: a machine, or the model's own simulation with noise on it?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias

import mujoco
import numpy as np

from sb3_rpto.effects import Effect, Simulation
from sb3_rpto.effects.library import given
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.settings import DEFAULTS, OriginSettings, Settings
from sb3_rpto.sysid.shooting.multiple_shooting import Problem
from sb3_rpto.sysid.shooting.windows import cut, discretised, noise_levels

Origin: TypeAlias = Literal["machine", "simulated", "exact"]


def may_be_exact(data: Measurements, slow: float = DEFAULTS.consistency.slow_step) -> bool:
    """Whether noise cannot be told from motion, so that recordings that seem noisy may be a simulator's, without any.

    Where commands change from one slow sample to the next the motion between them is not smooth. All velocities are to
    be known, as predictions would begin at the samples themselves.
    """
    step = data.step
    return not (data.whole_states or data.columns.missing or data.unobserved) and bool(step >= slow)


def begins_idle(
    simulation: Simulation, data: Measurements, sigma: np.ndarray, settings: OriginSettings = DEFAULTS.origin
) -> bool:
    """Whether runs of a simulator seem to begin without a command: not all of the first one acts in the first step.

    So it is where a queue of commands is empty at a reset, or a filter at rest. Where nothing is late, as in a weak
    motor, what was before does not matter.

    :param simulation: of the model
    :param data: to fit to
    :param sigma: noise of each position column, (m,)
    """
    beginnings = [e.part_of(slice(0, 3), False) for e in data.episodes if not e.after_gap and len(e) > 2]
    if not beginnings or not simulation.model.nu:
        return False
    try:
        windows = cut(simulation.model, replace(data, episodes=beginnings), sigma, 2 * data.step, len(beginnings))
    except ValueError:  # none of their states is known
        return False
    steps, rows = windows.at[:, 0].astype(int), np.arange(len(windows))
    values = np.tile(simulation.null, (len(windows), 1))

    def reached(share: float) -> np.ndarray:
        commands = windows.drive.commands.copy()
        commands[:, windows.drive.before :] *= share
        drive = windows.drive._replace(commands=commands)
        qpos, _ = simulation.rollout(values, windows.qpos, windows.qvel, drive)
        return np.asarray(qpos[rows, steps][:, windows.columns] / windows.sigma)

    none = reached(0.0)
    gained, seen = reached(1.0) - none, windows.measured[:, 0] / windows.sigma - none
    known = np.maximum((gained**2).sum(axis=1), 1e-12)
    arrives = float(np.median((gained * seen).sum(axis=1) / known))
    return arrives + settings.arriving_deviations / float(np.sqrt(known.sum())) < settings.arriving_share


def find_origin(
    model: mujoco.MjModel,
    data: Measurements,
    declared: Sequence[str],
    sigma: np.ndarray,
    horizon: float,
    threads: int,
    known: Sequence[Effect] = (),
    settings: Settings = DEFAULTS,
) -> Origin:
    """Whether recordings seem to be a machine's, or the model's own with noise, or without any.

    They are the model's own where its fit to the declared parameters meets them clearly better in its own steps in time
    than in fine ones, or meets them there and not so in fine ones: a simulator's long semi-implicit steps err by more
    than many a sensor does. They are exact where
    they hardly have noise and their states lead to one another as exact ones do.

    :param model: as it was compiled
    :param data: to fit to
    :param declared: names of the parameters to fit
    :param sigma: noise of each position column, (m,)
    :param horizon: length of the windows in s
    :param threads: that simulate
    :param known: effects that it has besides, with the values to begin at
    """
    limits = settings.origin
    steps = {(m.opt.timestep, m.opt.integrator) for m in (model, discretised(model, data, True, settings.problem))}
    if data.exact or len(steps) == 1:
        return "machine"

    fit = partial(_error, model, declared=declared, horizon=horizon, threads=threads, known=known, settings=settings)
    continuous = fit(data, sigma)
    if continuous < limits.enough:
        return "machine"
    own = fit(replace(data, simulated=True), sigma)
    if own > (limits.share_where_enough if own < limits.enough else limits.clear_share) * continuous:
        return "machine"
    noiseless = bool(np.all(sigma < limits.noiseless * noise_levels(replace(data, exact=True, noise=None))))
    exact = noiseless and are_exact_states(model, data, declared, horizon, threads, known, settings)
    return "exact" if exact else "simulated"


def are_exact_states(
    model: mujoco.MjModel,
    data: Measurements,
    declared: Sequence[str],
    horizon: float,
    threads: int,
    known: Sequence[Effect] = (),
    settings: Settings = DEFAULTS,
) -> bool:
    """Whether the model's own steps lead from the states of recordings to those after them, but for rounding.

    Parameters as of :func:`find_origin`.
    """
    exact = replace(data, exact=True, noise=None)
    error = _error(model, exact, noise_levels(exact), declared, horizon, threads, known, settings)
    return error < settings.origin.enough


def _error(
    model: mujoco.MjModel,
    data: Measurements,
    noise: np.ndarray,
    declared: Sequence[str],
    horizon: float,
    threads: int,
    known: Sequence[Effect],
    settings: Settings,
) -> float:
    """Typical error of some windows, in units of the noise, where the declared parameters and ``known`` are fitted."""
    stepped = discretised(model, data, True, settings.problem)
    simulation = Simulation(stepped, given(stepped, declared, known), threads)
    scales = typical(simulation, force_residuals(simulation, simulation.null, data)).scales(simulation.effects)
    problem = Problem(simulation, cut(stepped, data, noise, horizon, settings.origin.windows), scales)
    fit = problem.fit(simulation.null, np.flatnonzero(simulation.strength), iterations=settings.origin.iterations)
    return float(np.median(fit.errors))
