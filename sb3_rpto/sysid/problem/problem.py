"""The problem of identification: recordings and model, their split, their noise, simulations, and what is assumed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

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
from sb3_rpto.sysid.data.encoder_offsets import EncoderOffsets
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.data.repairs import remove_whole_turns, use_even_clock
from sb3_rpto.sysid.findings import Finding, FindingKind
from sb3_rpto.sysid.problem.contacts import contact_changes
from sb3_rpto.sysid.problem.data_model_consistency import carried_weights, check_against, soft_friction, soft_ties
from sb3_rpto.sysid.problem.data_origin import begins_idle, find_origin
from sb3_rpto.sysid.problem.inverse_dynamics import force_residuals, typical
from sb3_rpto.sysid.settings import DEFAULTS, ProblemSettings, Settings
from sb3_rpto.sysid.shooting.windows import BLOCK, MEMORY, Windows, cut, discretised, noise_levels, step_for

Progress = Callable[[float, str], None]


def silent(share: float, what: str) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True)
class Inputs:
    """What is to be traced, as :func:`sb3_rpto.sysid.trace.trace` was given it."""

    model: Any
    data: Measurements
    declared: Sequence[str] = ()
    known: Sequence[Effect] = ()
    seed: int = 0
    candidates: Sequence[str] | None = None
    horizon: float | None = None
    calibrate: int = 0
    threads: int = 0
    say: Progress = silent
    settings: Settings = DEFAULTS


@dataclass(frozen=True)
class Assumptions:
    """What is taken for granted of the recordings beyond what they say of themselves.

    :param exact: they are a simulator's states, without noise
    :param simulated: the model's own steps in time are to meet them, noise apart
    :param substeps: steps of that simulator in one of the model's
    :param soft_friction: declared dry friction gives way near rest, see :func:`~sb3_rpto.effects.library.given`
    :param kinds: of effects to look for; None: the candidates that were asked for
    """

    exact: bool = False
    simulated: bool = False
    substeps: int = 1
    soft_friction: bool = False
    kinds: tuple[str, ...] | None = None


class Split(NamedTuple):
    """Episodes to fit to, to select on, and to test on; nothing but the report looks at the last."""

    train: list[Episode]
    select: list[Episode]
    test: list[Episode]


@dataclass(frozen=True)
class IdentificationProblem:
    """What a search works on.

    :param inputs: what was asked
    :param assumptions: what is taken for granted of the recordings
    :param spec: of the model; None where it was given compiled
    :param nominal: the model as it was given
    :param findings: about the data
    :param data: all recordings, checked and repaired
    :param split: their episodes
    :param sigma: noise of each position column, rad or m, (m,)
    :param fine: integrates finely, with all effects that may act
    :param rough: integrates as the model does
    :param scales: what is large at each effect's place
    :param length: of the windows in s
    :param longer: of the windows to go on with, in s; None: there are none
    :param offsets: encoder offsets of single runs that were taken off the data; None: none were
    """

    inputs: Inputs
    assumptions: Assumptions
    spec: mujoco.MjSpec | None
    nominal: mujoco.MjModel
    findings: list[Finding]
    data: Measurements
    split: Split
    sigma: np.ndarray
    fine: Simulation
    rough: Simulation
    scales: list[Scales]
    length: float
    longer: float | None = None
    offsets: EncoderOffsets | None = None
    _cut: dict[tuple[int, float], tuple[Windows, Windows | None]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def train(self) -> Measurements:
        """Recordings to fit to."""
        return replace(self.data, episodes=self.split.train)

    @cached_property
    def select(self) -> Measurements:
        """Recordings to select on; they may have no episodes."""
        return replace(self.data, episodes=self.split.select)

    @cached_property
    def test(self) -> Measurements:
        """Recordings that nothing but the report looks at; they may have no episodes."""
        return replace(self.data, episodes=self.split.test)

    @cached_property
    def fitted(self) -> Measurements:
        """Recordings to fit to and to select on, in this order."""
        return replace(self.data, episodes=[*self.split.train, *self.split.select])

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the fitted runs."""
        return tuple(dict.fromkeys(episode.run for episode in self.fitted.episodes))

    @property
    def settings(self) -> Settings:
        """Thresholds."""
        return self.inputs.settings

    # --- the same, changed --------------------------------------------------------------------------------------

    def assuming(self, **changes: Any) -> IdentificationProblem:
        """The recordings read again under other :class:`Assumptions`, from the inputs on."""
        return prepare(self.inputs, replace(self.assumptions, **changes))

    def with_finding(self, finding: Finding) -> IdentificationProblem:
        """The same with one more finding."""
        return replace(self, findings=[*self.findings, finding])

    def with_blocks_of_all_runs(self) -> IdentificationProblem:
        """The same with no run set apart to select on: blocks of all runs take turns."""
        return replace(self, split=Split(self.fitted.episodes, [], self.split.test))

    def without_offsets(self, offsets: EncoderOffsets) -> IdentificationProblem:
        """The same with encoder offsets of single runs taken off the episodes to fit to and to select on."""
        train, select = (offsets.taken_off(part).episodes for part in (self.train, self.select))
        together = offsets if self.offsets is None else replace(offsets, offsets=self.offsets.offsets + offsets.offsets)
        return replace(self, split=Split(train, select, self.split.test), offsets=together)

    def in_finer_steps(self) -> IdentificationProblem | None:
        """The same judged with shorter steps in time; None for what comes from a simulator's own steps."""
        if self.data.exact or self.data.simulated:
            return None
        nominal = self.fine.model.__copy__()
        nominal.opt.timestep /= self.settings.problem.finer_steps
        return replace(self, fine=Simulation(nominal, self.fine.effects, self.fine.nthread))

    def in_simulator_steps(self, substeps: int) -> IdentificationProblem | None:
        """The same with the recordings taken for a simulator's own; None where they are so already, or cannot be.

        :param substeps: its steps in one of the model as it was given
        """
        runge_kutta = self.nominal.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        if self.data.exact or self.data.simulated or runge_kutta:
            return None
        model = self.fine.model.__copy__()
        model.opt.timestep, model.opt.integrator = self.nominal.opt.timestep / substeps, self.nominal.opt.integrator
        model.actuator_dyntype[:] = self.nominal.actuator_dyntype
        simulation = Simulation(model, self.fine.effects, self.fine.nthread)
        data = replace(self.data, simulated=True, substeps=substeps)
        return replace(self, data=data, fine=simulation, rough=simulation)

    # --- windows ------------------------------------------------------------------------------------------------

    def windows(self, simulation: Simulation, horizon: float) -> tuple[Windows, Windows | None]:
        """Windows to fit and to select on, for one of the simulations; longer ones begin where the others do.

        None to select on where too little is set apart: then blocks take turns.

        :param simulation: ``fine`` or ``rough``
        :param horizon: length of the windows in s
        :raises ValueError: the data are too few
        """
        key = (id(simulation), horizon)
        if key not in self._cut:
            self._cut[key] = self._windows(simulation.model, horizon, 1 - self.length / horizon)
        return self._cut[key]

    def _windows(self, model: mujoco.MjModel, horizon: float, overlap: float) -> tuple[Windows, Windows | None]:
        settings = self.settings.problem
        many = settings.contact_windows if self.data.touching else 1
        if any(e.time[-1] - e.time[0] >= 2 * horizon for e in self.split.select):
            judging = cut(model, self.select, self.sigma, horizon, many * settings.select_windows, overlap)
            # A single block is no evidence for anything.
            if len(np.unique(judging.block)) > 1:
                return cut(model, self.train, self.sigma, horizon, many * settings.train_windows, overlap), judging
        most = many * (settings.train_windows + settings.select_windows)
        every = cut(model, self.fitted, self.sigma, horizon, most, overlap)
        few = len(every) < settings.few_windows
        if few:
            every = cut(model, self.fitted, self.sigma, horizon, 2 * settings.few_windows, overlap=settings.overlap)
        # Some hundred transitions of a simulator are soon over, and tell much.
        if (few or not self.data.whole_states) and len(np.unique(every.block)) < 3:
            enough = sum(float(np.ptp(e.time)) for e in self.fitted.episodes) > 2 * BLOCK  # for a third block to begin
            needed = math.ceil(2 * BLOCK + horizon + MEMORY)
            raise ValueError(
                f"the training runs hold {len(every)} window(s) of {horizon:.2g} s in fewer than three blocks of a "
                f"second: too few to select on; record longer, three runs or {needed:g} s "
                f"and more to fit to{', or lower horizon' if enough else ''}"
            )
        return every, None

    def longer_horizon(self) -> float | None:
        """Length of the windows to go on with, in s, where the data hold enough of them to select on."""
        settings = self.settings.problem
        longer = settings.longer_windows * self.length
        if sum(int((e.time[-1] - e.time[0]) / longer) for e in self.fitted.episodes) < settings.few_windows // 2:
            return None
        try:
            self.windows(self.rough, longer)
        except ValueError:  # in too few blocks
            return None
        return longer


def prepare(inputs: Inputs, assumptions: Assumptions = Assumptions()) -> IdentificationProblem:
    """Check the data against the model, part them, measure their noise, and set up the simulations.

    :raises ValueError: data and model do not fit together, or the data are too few
    """
    declared, known, threads, settings = inputs.declared, inputs.known, inputs.threads, inputs.settings.problem
    spec, compiled = load_model(inputs.model)
    data, findings = _check(inputs, assumptions, compiled)
    given(compiled, declared, known)  # what is wrong there is said before the work
    roomy = make_room_for_delays(spec, compiled, data, settings)
    data, split = _part(data, inputs.seed, findings)
    runs = [*split.train, *split.select]
    fitted = replace(data, episodes=runs)
    sigma = noise_levels(fitted)
    length, touching = _length(inputs, compiled, fitted, sigma, findings)
    # What was told need not be found out.
    asked = (declared, sigma, length, threads, known, inputs.settings)
    seems = "told" if data.simulated else find_origin(roomy, fitted, *asked)
    if seems in ("simulated", "exact"):
        data = _of_a_simulator(data, seems == "exact", findings)
        sigma = noise_levels(replace(data, episodes=runs))
    data = replace(data, touching=touching and not data.exact)  # those are met, or fits begin anew until they are
    fitted = replace(data, episodes=runs)
    nominal = discretised(roomy, fitted, fine=True, settings=settings)
    if seems == "machine" and not data.exact:
        soft = inputs.settings.consistency.soft
        findings += soft_friction(nominal, soft) + soft_ties(nominal, soft) + carried_weights(nominal)
    kinds = inputs.candidates if assumptions.kinds is None else assumptions.kinds
    effects = _effects(nominal, data, given(nominal, declared, known, assumptions.soft_friction), kinds)
    findings += _without_a_place(nominal, kinds)
    fine = Simulation(nominal, effects, threads)
    if (data.exact or data.simulated) and begins_idle(fine, fitted, sigma, inputs.settings.origin):
        data = replace(data, idle=True)
    residuals = force_residuals(fine, fine.null, replace(data, episodes=runs))
    scales = typical(fine, residuals).scales(fine.effects)
    rough = Simulation(discretised(roomy, fitted, fine=False, settings=settings), effects, threads)
    problem = IdentificationProblem(
        inputs, assumptions, spec, compiled, findings, data, split, sigma, fine, rough, scales, length
    )
    return replace(problem, longer=problem.longer_horizon()) if inputs.horizon is None else problem


def _check(inputs: Inputs, assumptions: Assumptions, model: mujoco.MjModel) -> tuple[Measurements, list[Finding]]:
    """The recordings as they are assumed to be, repaired and checked against the model, and what was found."""
    data = replace(
        inputs.data,
        exact=inputs.data.exact or assumptions.exact,
        simulated=inputs.data.simulated or assumptions.simulated,
        substeps=inputs.data.substeps if assumptions.substeps == 1 else assumptions.substeps,
    )
    data, turned = remove_whole_turns(model, data)
    data, clock = use_even_clock(data)
    checked = check_against(model, data, inputs.settings)
    return data, [*data.findings, *turned, *clock, *checked, *_own_step(inputs.model)]


def _part(data: Measurements, seed: int, findings: list[Finding]) -> tuple[Measurements, Split]:
    """The recordings without columns that never change, and their parts; what is found joins the findings."""
    parts = data.split(seed)
    split = Split(*(part.episodes for part in parts))
    findings += [f for f in parts[0].findings if f not in findings]
    resting = columns_at_rest(replace(data, episodes=[*split.train, *split.select]))
    message = "never changes, so nothing tells how finely it is measured: it is not compared with predictions"
    findings += [Finding(FindingKind.AT_REST, f"fitted runs, qpos.{name}", message) for name in resting]
    return replace(data, unobserved=(*data.unobserved, *resting)), split


def _length(
    inputs: Inputs, model: mujoco.MjModel, fitted: Measurements, sigma: np.ndarray, findings: list[Finding]
) -> tuple[float, bool]:
    """Length of the windows in s, and whether contacts come and go, which joins the findings."""
    settings = inputs.settings.problem
    changes = contact_changes(model, fitted, sigma)
    touching = changes > settings.contact_changes
    if inputs.horizon is not None:
        return float(inputs.horizon), touching
    length = _horizon(fitted, touching, settings)
    if touching:
        message = f"{changes:.1f} a second come or go; windows of {length:.2g} s, as errors about a touch-down grow"
        findings.append(Finding(FindingKind.CONTACTS, "fitted runs", message))
    return length, touching


def _of_a_simulator(data: Measurements, exact: bool, findings: list[Finding]) -> Measurements:
    """The recordings as a simulator's own, with noise or ``exact``; that joins the findings."""
    noise = "without noise" if exact else "with noise"
    message = f"from the model's own steps in time, {noise}: they meet them better than the continuous motion does"
    findings.append(Finding(FindingKind.SIMULATED, "fitted runs", message))
    return replace(data, simulated=True, exact=exact, noise=None if exact else data.noise)


def _effects(
    model: mujoco.MjModel, data: Measurements, there: Sequence[Effect], kinds: Sequence[str] | None
) -> list[Effect]:
    """What is declared or known, and the candidates.

    :param there: what is declared or known
    :raises ValueError: a declared number is a column of the data, too
    """
    settings = {Declared(model, name, (-np.inf, np.inf)).number: name for name in data.columns.params}
    for one in there:
        if isinstance(one, Declared) and one.number in settings:
            column = f"param.{settings[one.number]}"
            raise ValueError(f"declared {one.label!r} is the column {column!r} of the data, too; leave one of them out")
    effects = [*there, *_candidates(model, there, kinds, data.exact)]
    for effect in effects:
        if not type(effect).__module__.startswith("sb3_rpto."):
            try_out(model, effect)
    return effects


def _without_a_place(model: mujoco.MjModel, kinds: Sequence[str] | None) -> list[Finding]:
    """Kinds that were named among the candidates and sit nowhere in this model."""
    nowhere = [kind for kind in kinds or () if not LIBRARY[kind].places(model)]
    message = "named among the candidates, but nothing in this model can have it: it is not looked for"
    return [Finding(FindingKind.NO_PLACE, kind, message) for kind in dict.fromkeys(nowhere)]


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


def make_room_for_delays(
    spec: mujoco.MjSpec | None,
    compiled: mujoco.MjModel,
    data: Measurements,
    settings: ProblemSettings = DEFAULTS.problem,
) -> mujoco.MjModel:
    """The model, whose delayed actuators hold as many commands as the shorter steps of measured data take.

    MuJoCo keeps ``nsample`` of them, one for each step: in shorter ones as many span less than the delay.

    :param spec: of the model; None where nothing tells it
    :param compiled: the model
    :param data: recordings
    :raises ValueError: there is not enough room, and nothing tells the MJCF
    """
    if data.substeps == 1 and (data.exact or data.simulated):
        return compiled
    step = (
        compiled.opt.timestep / data.substeps
        if data.simulated
        else step_for(compiled, data, settings) / settings.finer_steps
    )
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


def columns_at_rest(data: Measurements) -> list[str]:
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


def _horizon(data: Measurements, touching: bool, settings: ProblemSettings) -> float:
    """Half a second, at least eight samples, at most a third of the longest episode.

    Short data take 0.8 s: an effect shows more against the noise of so few windows. Where contacts come and go,
    a tenth of a second, at least three steps from sample to sample.
    """
    step = data.step
    if touching:
        return max(settings.contact_horizon, 3 * step)
    lengths = [float(e.time[-1] - e.time[0]) for e in data.episodes]
    usual = settings.horizon if sum(lengths) >= settings.short_data else settings.horizon_of_short_data
    return min(max(usual, 8 * step), max(max(lengths) / 3, 3 * step))
