"""The force that the motion needed and the model does not know, for reports; decisions are made on predictions."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from sb3_rpto.effects import Simulation
from sb3_rpto.effects.simulation import prepare
from sb3_rpto.effects.world import BatchWorld
from sb3_rpto.tracing.checks import MIN_ROWS
from sb3_rpto.tracing.episodes import Episode
from sb3_rpto.tracing.evaluate import predictions
from sb3_rpto.tracing.measurements import Measurements
from sb3_rpto.tracing.residuals import ForceResidual, force_residuals
from sb3_rpto.tracing.starts import straight
from sb3_rpto.tracing.windows import Windows, cut


def missing_forces(simulation: Simulation, values: np.ndarray, data: Measurements) -> list[ForceResidual]:
    r"""What is missing in every episode that is long enough.

    By inverse dynamics; but exact samples are a simulator's, as far apart as the decisions of a policy, and their
    differences no accelerations. There it is the force that makes the model arrive at the next sample, :math:`M(q)\,
    (q_{t+1} - \hat q_{t+1}) / s`, where :math:`s` is how far an acceleration of one leads until then.

    :param simulation: the model with its effects
    :param values: their parameters, (p,)
    :param data: recordings
    """
    found = force_residuals(simulation, values, data)
    if not data.exact:
        return found
    episodes = (e for e in data.episodes if len(e) >= MIN_ROWS)
    by_step = [_step_by_step(simulation, values, data, r, e) for r, e in zip(found, episodes)]
    return [r for r in by_step if len(r.time)]


def _step_by_step(
    simulation: Simulation, values: np.ndarray, data: Measurements, r: ForceResidual, e: Episode
) -> ForceResidual:
    h = float(np.median(np.diff(e.time)))
    try:
        windows = cut(simulation.model, replace(data, episodes=[e]), np.ones(e.qpos.shape[1]), 2 * h, len(e), 0.5)
    except ValueError:  # no two steps of known states
        return _rows(r, np.empty(0, dtype=int))
    _, difference, usable = predictions(simulation, values, windows)
    row = np.rint((windows.time - e.time[0] - r.time[0]) / h).astype(int)
    kept = np.flatnonzero(usable[:, 0] & (row >= 0) & (row < len(r.time)))
    force = np.zeros((len(windows), simulation.model.nv))
    dof_of = straight(simulation.model)
    for column, address in enumerate(windows.columns):
        if int(address) in dof_of:
            force[:, dof_of[int(address)]] = -difference[:, 0, column] / _reach(simulation.model, windows)
    force = np.einsum("wij,wj->wi", _inertia(simulation, values, windows), force)
    return replace(_rows(r, row[kept]), force=force[kept])


def _rows(r: ForceResidual, rows: np.ndarray) -> ForceResidual:
    return replace(r, **{n: getattr(r, n)[rows] for n in ("time", "qpos", "qvel", "load", "command", "force")})


def _reach(model: mujoco.MjModel, windows: Windows) -> np.ndarray:
    """How far an acceleration of one leads until the first sample of each window, in s^2, (W,)."""
    dt, steps = float(model.opt.timestep), windows.at[:, 0]
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return (dt * steps) ** 2 / 2
    return dt**2 * steps * (steps + 1) / 2  # Euler's method moves by the velocity at the end of a step


def _inertia(simulation: Simulation, values: np.ndarray, windows: Windows) -> np.ndarray:
    """The mass matrix at each window's start, (W, nv, nv)."""
    world = BatchWorld(simulation.model, 1, 1)
    settings = {name: value[:1] for name, value in windows.drive.settings.items()}
    prepare(world, [*simulation.from_settings(settings), *simulation.active(values[None])])
    model = world.batch.get_model(0)
    mj, full = mujoco.MjData(model), np.zeros((len(windows), model.nv, model.nv))
    for w, qpos in enumerate(windows.qpos):
        mj.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, mj)
        mujoco.mj_fullM(model, mj, full[w])
    return full
