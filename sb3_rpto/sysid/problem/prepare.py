"""From a model and recordings to what the search works on: parts, noise, simulations, windows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from sb3_rpto.effects import LIBRARY, Declared, Effect, Scales, Simulation
from sb3_rpto.effects.library import candidates as all_candidates
from sb3_rpto.effects.library import given
from sb3_rpto.effects.mjcf import restore, rounded
from sb3_rpto.effects.model import load_model
from sb3_rpto.effects.names import near
from sb3_rpto.effects.validate_effect import try_out
from sb3_rpto.envs.step_fidelity import odd_step
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.repairs import remove_whole_turns, use_even_clock
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.problem.contacts import OFTEN, contact_changes
from sb3_rpto.sysid.problem.data_model_consistency import carried_weights, check_against, soft_friction, soft_ties
from sb3_rpto.sysid.problem.data_origin import idle, origin
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.selection.pipeline import Selectors
from sb3_rpto.sysid.selection.stepwise_selection import Selector
from sb3_rpto.sysid.shooting.windows import BLOCK, MEMORY, Windows, cut, discretised, noise_levels, step_for

#: Most windows to fit, and to select on.
TRAIN, SELECT = 40, 40
#: Few windows overlap by this share.
OVERLAP = 2 / 3
#: Seconds of training data that count as short.
SHORT = 15.0
#: Fewer windows than this overlap.
FEW = 40
#: Where contacts come and go, windows are so many seconds long: an error about the moment of a touch-down grows to far
#: more than noise.
BRIEF = 0.1
#: And so many times as many.
MANY = 4
#: Where steps in time seem to err by more than the noise, others so many times as short are tried.
SHORTER = 4
#: Where what is found leaves errors far above the noise, windows so many times as long show more of what is missing,
#: and what only stands in for it shows too.
LONGER = 2

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SetUp:
    """What the search works on.

    :param spec: of the model; None where it was given compiled
    :param nominal: the model as it was given
    :param findings: about the data
    :param train: recordings to fit to
    :param select: to decide on
    :param test: that nothing but the report looks at
    :param fitted: training runs first, then those to select on
    :param sigma: noise of each position column, (m,)
    :param fine: integrates finely, with all effects that may act
    :param rough: integrates as the model does
    :param scales: what is large at each effect's place
    :param length: of the windows in s
    :param longer: of the windows to go on with, in s; None: there are none
    """

    spec: mujoco.MjSpec | None
    nominal: mujoco.MjModel
    findings: list[Finding]
    train: Measurements
    select: Measurements
    test: Measurements
    fitted: Measurements
    sigma: np.ndarray
    fine: Simulation
    rough: Simulation
    scales: list[Scales]
    length: float
    longer: float | None

    def selectors(self, horizon: float, say: Progress) -> Selectors:
        """Selectors on windows of a length in s; longer ones begin where the others do."""
        fine, rough = (
            Selector.on(s, self._windows(s.model, horizon), self.scales, horizon, say) for s in (self.fine, self.rough)
        )
        return Selectors(fine, rough, say)

    def with_all_to_fit(self) -> SetUp:
        """The same with no run set apart to select on."""
        return replace(self, train=self.fitted, select=replace(self.select, episodes=[]), findings=[*self.findings])

    def finer(self, horizon: float, say: Progress) -> Selectors | None:
        """The same with shorter steps to judge with; None for what comes from a simulator's own steps."""
        if self.fitted.exact or self.fitted.simulated:
            return None
        nominal = self.fine.model.__copy__()
        nominal.opt.timestep /= SHORTER
        simulation = Simulation(nominal, self.fine.effects, self.fine.nthread)
        fine = Selector.on(simulation, self._windows(nominal, horizon), self.scales, horizon, say)
        return replace(self.selectors(horizon, say), fine=fine)

    def in_substeps(self, substeps: int, horizon: float, say: Progress) -> Selectors | None:
        """The same with the recordings taken for a simulator's own, or None where they are so already.

        :param substeps: its steps in one of the model as it was given
        """
        if self.fitted.exact or self.fitted.simulated or self.nominal.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            return None
        model = self.fine.model.__copy__()
        model.opt.timestep, model.opt.integrator = self.nominal.opt.timestep / substeps, self.nominal.opt.integrator
        model.actuator_dyntype[:] = self.nominal.actuator_dyntype
        train, select = (replace(part, simulated=True, substeps=substeps) for part in (self.train, self.select))
        there = replace(self, train=train, select=select)._windows(model, horizon)
        fine = Selector.on(Simulation(model, self.fine.effects, self.fine.nthread), there, self.scales, horizon, say)
        return Selectors(fine, fine, say)

    def _windows(self, model: mujoco.MjModel, horizon: float) -> tuple[Windows, Windows | None]:
        return windows(model, self.train, self.select, self.sigma, horizon, 1 - self.length / horizon)


def _own_step(model: Any) -> list[Finding]:
    """An environment that does more in ``step()`` than simulate: only its MJCF is compared with the data."""
    base: Any = model.unwrapped if isinstance(model, gym.Env) else None
    if base is None or base.action_space.shape != (base.model.nu,):
        return []
    found = odd_step(base, int(getattr(base, "frame_skip", 1)))
    if found is None:
        return []
    message = (
        f"{found}. The MJCF alone is compared with the data: what step() adds is named as missing where the data show "
        "it, and is there twice in a corrected environment. Make it part of the MJCF or an effect, or leave it out"
    )
    return [Finding(FindingKind.OWN_STEP, "step() of the environment", message)]


def prepare(
    model: Any,
    data: Measurements,
    declared: Sequence[str],
    seed: int,
    kinds: Sequence[str] | None,
    horizon: float | None,
    threads: int,
    known: Sequence[Effect] = (),
    simulated: bool = False,
    soft: bool = False,
) -> SetUp:
    """Check the data against the model, part them, measure their noise, and set up the simulations.

    Parameters and errors as :func:`sb3_rpto.sysid.trace.trace`.

    :param soft: see :func:`~sb3_rpto.effects.library.given`
    """
    spec, compiled = load_model(model)
    data = replace(data, simulated=data.simulated or simulated)
    data, turned = remove_whole_turns(compiled, data)
    data, clock = use_even_clock(data)
    findings = [*data.findings, *turned, *clock, *check_against(compiled, data), *_own_step(model)]
    given(compiled, declared, known)  # what is wrong there is said before the work
    roomy = with_room(spec, compiled, data)
    train, select, test = data.split(seed)
    findings += [f for f in train.findings if f not in findings]
    fitted = replace(data, episodes=train.episodes + select.episodes)
    resting = at_rest(fitted)
    if resting:
        unobserved = (*data.unobserved, *resting)
        data, train, select, test, fitted = (
            replace(d, unobserved=unobserved) for d in (data, train, select, test, fitted)
        )
        message = "never changes, so nothing tells how finely it is measured: it is not compared with predictions"
        findings += [Finding(FindingKind.AT_REST, f"fitted runs, qpos.{name}", message) for name in resting]
    sigma = noise_levels(fitted)
    changes = contact_changes(compiled, fitted, sigma)
    touching = changes > OFTEN
    length = _horizon(fitted, touching) if horizon is None else float(horizon)
    if touching and horizon is None:
        message = f"{changes:.1f} a second come or go; windows of {length:.2g} s, as errors about a touch-down grow"
        findings.append(Finding(FindingKind.CONTACTS, "fitted runs", message))
    # What was told need not be found out.
    seems = "told" if data.simulated else origin(roomy, fitted, declared, sigma, length, threads, known)
    if seems in ("simulated", "exact"):
        exact = seems == "exact"
        data, train, select, test, fitted = (
            replace(d, simulated=True, exact=exact, noise=None if exact else d.noise)
            for d in (data, train, select, test, fitted)
        )
        sigma = noise_levels(fitted)
        noise = "without noise" if data.exact else "with noise"
        message = f"from the model's own steps in time, {noise}: they meet them better than the continuous motion does"
        findings.append(Finding(FindingKind.SIMULATED, "fitted runs", message))
    touching &= not data.exact  # those are met, or fits begin anew until they are
    train, select, test, fitted = (replace(d, touching=touching) for d in (train, select, test, fitted))
    nominal = discretised(roomy, fitted, fine=True)
    there = given(nominal, declared, known, soft)
    if seems == "machine" and not data.exact:
        findings += soft_friction(nominal) + soft_ties(nominal) + carried_weights(nominal)
    settings = {Declared(nominal, name, (-np.inf, np.inf)).number: name for name in data.columns.params}
    for one in there:
        if isinstance(one, Declared) and one.number in settings:
            column = f"param.{settings[one.number]}"
            raise ValueError(f"declared {one.label!r} is the column {column!r} of the data, too; leave one of them out")
    effects = [*there, *_candidates(nominal, there, kinds, data.exact)]
    nowhere = [kind for kind in kinds or () if not LIBRARY[kind].places(nominal)]
    message = "named among the candidates, but nothing in this model can have it: it is not looked for"
    findings += [Finding(FindingKind.NO_PLACE, kind, message) for kind in dict.fromkeys(nowhere)]
    for effect in effects:
        if not type(effect).__module__.startswith("sb3_rpto."):
            try_out(nominal, effect)
    fine = Simulation(nominal, effects, threads)
    if (data.exact or data.simulated) and idle(fine, fitted, sigma):
        train, select, test, fitted = (replace(d, idle=True) for d in (train, select, test, fitted))
    scales = typical(fine, force_residuals(fine, fine.null, fitted)).scales(fine.effects)
    rough = Simulation(discretised(roomy, fitted, fine=False), effects, threads)
    longer = _longer(rough.model, train, select, sigma, length) if horizon is None else None
    return SetUp(spec, compiled, findings, train, select, test, fitted, sigma, fine, rough, scales, length, longer)


def with_room(spec: mujoco.MjSpec | None, compiled: mujoco.MjModel, data: Measurements) -> mujoco.MjModel:
    """The model, whose delayed actuators hold as many commands as the shorter steps of measured data take.

    MuJoCo keeps ``nsample`` of them, one for each step: in shorter ones as many span less than the delay.

    :param spec: of the model; None where nothing tells it
    :param compiled: the model
    :param data: recordings
    :raises ValueError: there is not enough room, and nothing tells the MJCF
    """
    if data.substeps == 1 and (data.exact or data.simulated):
        return compiled
    step = compiled.opt.timestep / data.substeps if data.simulated else step_for(compiled, data) / SHORTER
    needed = np.ceil(compiled.actuator_delay / step - 1e-9).astype(int)
    lacking = np.flatnonzero(needed > np.where(compiled.actuator_delay > 0, compiled.actuator_history[:, 0], needed))
    if not len(lacking):
        return compiled
    if spec is None:
        i = lacking[0]
        raise ValueError(
            f"actuator {compiled.actuator(i).name!r} is delayed by {compiled.actuator_delay[i]:g} s and holds "
            f"nsample={compiled.actuator_history[i, 0]} commands; measured data are simulated in steps down to "
            f'{step:.3g} s, which take nsample="{needed[i]}": write that in the MJCF'
        )
    spec = spec.copy()
    for i in lacking:
        spec.actuators[i].nsample = int(needed[i])
    roomy = spec.compile()
    others = rounded(roomy, compiled)
    for name in ("actuator_history", "actuator_historyadr", "sensor_historyadr"):
        others.pop(name, None)
    restore(roomy, others)
    return roomy


def at_rest(data: Measurements) -> list[str]:
    """Measured positions that never change, by their columns' names; none where states are known whole.

    :param data: to fit to
    :raises ValueError: none of them changes
    """
    moves = np.ptp(np.concatenate([e.qpos for e in data.episodes]), axis=0) > 0
    seen = [name not in data.unobserved for name in data.columns.qpos]
    if data.whole_states:
        return []
    if any(seen) and not moves[seen].any():
        names = ", ".join(f"'qpos.{name}'" for name, one in zip(data.columns.qpos, seen) if one)
        raise ValueError(f"no position changes in the runs to fit to ({names}): a dead sensor, or nothing moved")
    return [name for name, one, moved in zip(data.columns.qpos, seen, moves) if one and not moved]


def _candidates(
    model: mujoco.MjModel, there: Sequence[Effect], kinds: Sequence[str] | None, exact: bool
) -> list[Effect]:
    if kinds is not None:
        unknown = [k for k in kinds if k not in LIBRARY]
        if unknown:
            raise ValueError(f"candidates: no effect {unknown[0]!r} is registered; {near(unknown[0], sorted(LIBRARY))}")
    labels = {effect.label for effect in there}
    # What is exact is of a simulator, and may have what no machine has; held forces are looked for apart.
    among = [kind for kind, e in LIBRARY.items() if not e.held] if exact and kinds is None else kinds
    found = all_candidates(model, [effect.label for effect in there if isinstance(effect, Declared)], among)
    return [e for e in found if e.label not in labels]


def _horizon(data: Measurements, touching: bool) -> float:
    """Half a second, at least eight samples, at most a third of the longest episode.

    Short data take 0.8 s: an effect shows more against the noise of so few windows. Where contacts come and go,
    :data:`BRIEF`, at least three steps from sample to sample.
    """
    step = data.step
    if touching:
        return max(BRIEF, 3 * step)
    lengths = [float(e.time[-1] - e.time[0]) for e in data.episodes]
    usual = 0.5 if sum(lengths) >= SHORT else 0.8
    return min(max(usual, 8 * step), max(max(lengths) / 3, 3 * step))


def _longer(
    model: mujoco.MjModel, train: Measurements, select: Measurements, sigma: np.ndarray, length: float
) -> float | None:
    """Length of the windows to go on with, in s, where the data hold enough of them to select on."""
    longer = LONGER * length
    episodes = (*train.episodes, *select.episodes)
    if sum(int((e.time[-1] - e.time[0]) / longer) for e in episodes) < FEW // 2:
        return None
    try:
        windows(model, train, select, sigma, longer, 1 - length / longer)
    except ValueError:  # in too few blocks
        return None
    return longer


def windows(
    model: mujoco.MjModel,
    train: Measurements,
    select: Measurements,
    sigma: np.ndarray,
    horizon: float,
    overlap: float,
) -> tuple[Windows, Windows | None]:
    """Windows to fit and to select on; None to select on where too little is set apart: then blocks take turns."""
    many = MANY if train.touching else 1
    if any(e.time[-1] - e.time[0] >= 2 * horizon for e in select.episodes):
        judging = cut(model, select, sigma, horizon, many * SELECT, overlap)
        # A single block is no evidence for anything.
        if len(np.unique(judging.block)) > 1:
            return cut(model, train, sigma, horizon, many * TRAIN, overlap), judging
    train = replace(train, episodes=train.episodes + select.episodes)
    every = cut(model, train, sigma, horizon, many * (TRAIN + SELECT), overlap)
    few = len(every) < FEW
    if few:
        every = cut(model, train, sigma, horizon, 2 * FEW, overlap=OVERLAP)
    # Some hundred transitions of a simulator are soon over, and tell much.
    if (few or not train.whole_states) and len(np.unique(every.block)) < 3:
        enough = sum(float(np.ptp(e.time)) for e in train.episodes) > 2 * BLOCK  # for a third block to begin
        raise ValueError(
            f"the training runs hold {len(every)} window(s) of {horizon:.2g} s in fewer than three blocks of a "
            f"second: too few to select on; record longer, three runs or {math.ceil(2 * BLOCK + horizon + MEMORY):g} s "
            f"and more to fit to{', or lower horizon' if enough else ''}"
        )
    return every, None
