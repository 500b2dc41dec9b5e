"""The force that the motion needed and the model does not know, for reports; decisions are made on predictions."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from sb3_rpto.effects import Simulation
from sb3_rpto.effects.batch import MujocoBatch
from sb3_rpto.effects.simulation import prepare
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.data.settings import DATA
from sb3_rpto.sysid.problem.inverse_dynamics import ForceResidual, force_residuals
from sb3_rpto.sysid.shooting.windows import Windows, cut


def missing_forces(simulation: Simulation, values: np.ndarray, data: Measurements) -> list[ForceResidual]:
    r"""What is missing in every episode that is long enough.

    By inverse dynamics; but exact samples are a simulator's, as far apart as the decisions of a policy, and their
    differences no accelerations. There it is the force that lets the model arrive at the next sample's velocities,
    :math:`M(q)\,(\dot q_{t+1} - \hat{\dot q}_{t+1}) / \Delta t`.

    :param simulation: the model with its effects
    :param values: their parameters, (p,)
    :param data: recordings
    """
    found = force_residuals(simulation, values, data)
    if not data.exact:
        return found
    episodes = (e for e in data.episodes if len(e) >= DATA.min_rows)
    by_step = [_step_by_step(simulation, values, data, r, e) for r, e in zip(found, episodes)]
    return [r for r in by_step if len(r.time) > 1]


def _step_by_step(
    simulation: Simulation, values: np.ndarray, data: Measurements, r: ForceResidual, e: Episode
) -> ForceResidual:
    h = float(np.median(np.diff(e.time)))
    try:
        windows = cut(simulation.model, replace(data, episodes=[e]), np.ones(e.qpos.shape[1]), 2 * h, len(e), 0.5)
    except ValueError:  # no two steps of known states
        return _rows(r, np.empty(0, dtype=int))
    one_each = np.tile(values, (len(windows), 1))
    qpos, qvel = windows.qpos.copy(), windows.qvel.copy()
    simulation.undo_sensors(one_each, qpos, qvel, windows.qacc)
    _, predicted = simulation.rollout(one_each, qpos, qvel, windows.drive)
    row = np.rint((windows.time - e.time[0] - r.time[0]) / h).astype(int)
    # The next window begins at the next sample.
    kept = np.flatnonzero((np.diff(row) == 1) & (row[:-1] >= 0) & (row[:-1] < len(r.time)))
    steps = np.rint(windows.at[kept, 0]).astype(int)
    rate = (qvel[kept + 1] - predicted[kept, steps]) / (steps * simulation.model.opt.timestep)[:, None]
    force = np.einsum("wij,wj->wi", _inertia(simulation, values, windows.take(kept)), rate)
    return replace(_rows(r, row[kept]), force=force, stopped=None)  # its own steps have the limits in them


def _rows(r: ForceResidual, rows: np.ndarray) -> ForceResidual:
    return replace(r, **{n: getattr(r, n)[rows] for n in ("time", "qpos", "qvel", "load", "command", "force")})


def _inertia(simulation: Simulation, values: np.ndarray, windows: Windows) -> np.ndarray:
    """The mass matrix at each window's start, (W, nv, nv)."""
    world = MujocoBatch(simulation.model, 1, 1)
    settings = {name: value[:1] for name, value in windows.drive.settings.items()}
    prepare(world, [*simulation.from_settings(settings), *simulation.active(values[None])])
    model = world.engine.get_model(0)
    mj, full = mujoco.MjData(model), np.zeros((len(windows), model.nv, model.nv))
    for w, qpos in enumerate(windows.qpos):
        mj.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, mj)
        mujoco.mj_fullM(model, mj, full[w])
    return full
