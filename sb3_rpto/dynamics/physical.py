"""A MuJoCo simulator as trainable dynamics: phi is named numbers of its model, and effects that it lacked."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from gymnasium import spaces
from scipy.linalg import block_diag
from stable_baselines3.common.vec_env import VecEnv

from sb3_rpto.dynamics.base import Dynamics, Prediction, Transitions, relative_error
from sb3_rpto.dynamics.onestep import BLOWN, OneStepError, Steps, as_steps
from sb3_rpto.dynamics.simulator import check_memoryless
from sb3_rpto.effects import Declared, Effect, Scales, Simulation, declare
from sb3_rpto.effects.actuation import command_limits
from sb3_rpto.effects.effect import from_json
from sb3_rpto.effects.mjcf import PlainModel
from sb3_rpto.effects.model import ModelSource, load_model
from sb3_rpto.effects.simulation import Drive
from sb3_rpto.effects.walker_reset import StandingEnv
from sb3_rpto.effects.wrapper import CorrectedEnv
from sb3_rpto.envs.env_copy import CopyError, must_copy
from sb3_rpto.envs.observations import StateMap, are_known, env_name, noise_of_each, single_env, whole_state
from sb3_rpto.envs.step_fidelity import place_as_after_a_step
from sb3_rpto.ranges import NOT_NEGATIVE, POSITIVE, THREADS, check, of_type, whole

#: What the constructor's arguments may be.
RULES = {
    "max_step": POSITIVE,
    **dict.fromkeys(("max_steps", "frame_skip"), whole(1)),
    "randomise": NOT_NEGATIVE,
    "threads": THREADS,
    **dict.fromkeys(("declared", "effects"), of_type("be a list", list, tuple)),
}

#: A simulator must stay finite for so many steps from states of the target, and below what MuJoCo takes for such.
TRIAL_STATES, TRIAL_STEPS, LARGEST = 16, 20, mujoco.mjMAXVAL


class PhysicalDynamics(Dynamics):
    r"""Any gymnasium MuJoCo simulator with trainable numbers and effects.

    :meth:`fit` minimises the robust weighted one-step error

    .. math:: \sum_i w_i \sum_j \rho((f_\phi(s_i, a_i) - s'_i)_j / \sigma_j)

    over positions and velocities (sigma: their standard one-step change; rho: soft-L1) by Gauss-Newton steps within the
    parameters' bounds and within a trusted size, so that the source moves smoothly towards the target; a step that
    would raise the error is shortened. Derivatives are finite differences, all columns and transitions in one
    :class:`mujoco.batch.Batch`. Parameters that the data do not show stay where they are, and are named in a warning.
    Of those that the data show only together, such as a motor's gear and gain, the ones declared last stay, as many as
    it takes for the others to be determined; they are named, too.

    The source world is the environment itself with phi in it (:meth:`effects`), so rewards, terminations and resets are
    the environment's own.

    :param observation_space: the environment's
    :param action_space: the environment's; actions are the commands of the actuators
    :param mj_model: the simulator's model: the path or text of an MJCF, or as :func:`sb3_rpto.effects.model.load_model`
        takes it
    :param recover: states from observations, see :func:`sb3_rpto.envs.observations.state_map`; None: observations are
        states, qpos and then qvel, NaN where one is not known
    :param frame_skip: simulation steps in one step of the environment
    :param declared: names of the model's numbers to train, as :func:`sb3_rpto.effects.declare` takes them
    :param effects: further effects to train, as :meth:`~sb3_rpto.effects.effect.Effect.to_json` describes them
    :param max_step: largest change of a parameter in one step, as a share of its value or its scale (its nominal value,
        or what is plausible), whichever is larger
    :param max_steps: steps that a fit takes at most, unless it is told otherwise
    :param randomise: each source episode has a phi of its own, drawn from the normal distribution around the estimate
        that its covariance tells, so many times as wide; 0: the estimate itself
    :param threads: that simulate; 0: one for each core
    :param observation_noise: standard deviation of the white noise of each of the target's observations, (d,), or of
        all alike, in their units: what a sensor shows while the machine stands still. A closed loop's traces reckon
        with it, and phi stays what they found: one-step errors of noisy states tell less. None: there is none
    :raises ValueError: unknown names (with the near ones), spaces that are not the model's, values out of range
    """

    rollout: ClassVar[Literal["branches", "episodes"]] = "episodes"
    fits_newest: ClassVar[int] = 500  # a few numbers are known long before

    _values: th.Tensor
    _covariance: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        mj_model: ModelSource | PlainModel,
        recover: StateMap | None = None,
        frame_skip: int = 1,
        declared: Sequence[str] = (),
        effects: Sequence[Mapping[str, Any]] = (),
        max_step: float = 0.1,
        max_steps: int = 10,
        randomise: float = 0.0,
        threads: int = 0,
        observation_noise: float | Sequence[float] | None = None,
    ) -> None:
        super().__init__(observation_space, action_space)
        check(RULES, locals())
        model = mj_model.compile() if isinstance(mj_model, PlainModel) else load_model(mj_model)[1]
        recover = whole_state(model.nq, model.nv) if recover is None else recover
        if action_space.shape != (model.nu,):
            raise ValueError(f"action_space has shape {action_space.shape}, the model {model.nu} actuators")
        if observation_space.shape != (recover.width,):
            raise ValueError(
                f"observation_space has shape {observation_space.shape}, and states are recovered from {recover.width} "
                "numbers; give recover= for observations that are not qpos and qvel"
            )
        self.mj_model, self.recover, self.frame_skip = model, recover, frame_skip
        self.max_step, self.max_steps, self.randomise = max_step, max_steps, randomise
        self.threads = threads
        #: whether the last fit came to its end, or phi would have moved on with more steps
        self.settled = False
        self.observation_noise = (
            None if observation_noise is None else noise_of_each(observation_noise, recover, "observation_noise")
        )
        self._twin: CorrectedEnv | None = None
        self._vague: tuple[str, ...] = ()
        self._confounded: tuple[str, ...] = ()
        known: list[Effect] = [*declare(model, declared)]
        every = [*known, *map(from_json, effects)]
        labels = [effect.label for effect in every]
        twice = [label for label in dict.fromkeys(labels) if labels.count(label) > 1]
        if twice:
            raise ValueError(f"effects: {twice[0]!r} is there twice, and would act twice; leave one of them out")
        self._adopt(every)

    def _adopt(self, effects: Sequence[Effect], covariance: np.ndarray | None = None) -> None:
        """Let phi be the values of these effects, with their covariance (p, p); None: all zero."""
        self.simulation = Simulation(self.mj_model, effects, self.threads)
        largest = np.abs(self.mj_model.actuator_ctrlrange).max(axis=1, initial=0)[self.mj_model.actuator_ctrladr]
        gears = np.abs(self.mj_model.actuator_gear[:, 0]) * largest
        strongest = float(gears.max(initial=0.0))
        scales = Scales(torque=strongest if strongest > 0 else 1.0)
        parameters = [p for e in self.simulation.effects for p in e.parameters]
        self.names = [_name(e, p.name) for e in self.simulation.effects for p in e.parameters]
        values = self.simulation.values()
        sizes = np.array([p.size_for(scales) for p in parameters])
        #: what is much of each parameter: its nominal value or what is plausible, (p,)
        self.scale = np.maximum(np.abs(self.simulation.null), sizes)
        device = self._values.device if "_values" in self._buffers else None
        self.register_buffer("_values", th.as_tensor(values, dtype=th.float64, device=device))
        told = np.zeros((len(values), len(values))) if covariance is None else covariance
        self.register_buffer("_covariance", th.as_tensor(told, dtype=th.float64, device=device))

    # ------------------------------------------------------------------ phi

    @property
    def values(self) -> np.ndarray:
        """phi in its units, (p,)."""
        return self._values.cpu().numpy()

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of phi in its units, (p, p): of the last fit (robust against correlated errors) or trace.

        0 before; of a parameter that the data did not determine the variance is infinite, and the rest of its row 0.
        """
        return self._covariance.cpu().numpy()

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of phi in its units, (p,), from the :attr:`covariance`."""
        return np.sqrt(np.diag(self.covariance))

    def effects(self, generator: np.random.Generator | None = None) -> list[Effect]:
        """Declared numbers and effects with the values of phi, for :class:`~sb3_rpto.effects.CorrectedEnv`.

        :param generator: draws phi from its uncertainty, ``randomise`` times as wide, but for parameters that the data
            did not determine; None: the estimate
        """
        values = self.values.copy()
        if generator is not None and self.randomise > 0:
            told = np.flatnonzero(np.isfinite(self.deviation) & (self.deviation > 0))  # of the rest nothing tells it
            spread = self.deviation[told]
            # What the data tell together, such as a mass and its friction, differs together.
            share, axes = np.linalg.eigh(self.covariance[np.ix_(told, told)] / np.outer(spread, spread))
            drawn = axes @ (np.sqrt(np.maximum(share, 0.0)) * generator.standard_normal(len(told)))
            values[told] += self.randomise * spread * drawn
            values = np.clip(values, self.simulation.lower, self.simulation.upper)
        return [e.with_values(values[s]) for e, s in zip(self.simulation.effects, self.simulation.slices)]

    def adopt(self, found: Sequence[Effect], covariance: np.ndarray | None = None) -> None:
        """Take effects that were traced into phi, and the values that declared numbers had beside them.

        :param found: declared numbers by the names that were declared, and further effects, p' parameters in all
        :param covariance: of these parameters in this order, (p', p'); None: all zero
        """
        mine = {e.label: e for e in self.effects()}
        rows = {label: list(range(s.start, s.stop)) for label, s in zip(mine, self.simulation.slices)}
        begin = end = len(self.values)
        for effect in found:
            old = mine.get(effect.label)
            mine[effect.label] = effect if old is None else old.with_values(effect.values)
            rows[effect.label] = list(range(end, end := end + len(effect.parameters)))
        told = np.zeros((end - begin, end - begin)) if covariance is None else covariance
        order = [row for label in mine for row in rows[label]]
        self._adopt(list(mine.values()), block_diag(self.covariance, told)[np.ix_(order, order)])

    def replace(self, effects: Sequence[Effect], covariance: np.ndarray | None = None) -> None:
        """Let phi be exactly these, as :meth:`effects` and :attr:`covariance` gave them; None: all zero."""
        self._adopt(effects, covariance)

    def runs(self, observations: np.ndarray, actions: np.ndarray) -> bool:
        """Whether simulations from some states under some actions stay finite.

        :param observations: of the states, (n, observation_dim)
        :param actions: of the transitions from there on, (n, length, nu)
        """
        states = self.recover(observations.astype(np.float64))
        commands = np.repeat(
            np.clip(actions.astype(np.float64), *command_limits(self.mj_model)), self.frame_skip, axis=1
        )
        qpos, qvel = np.nan_to_num(states.qpos), np.nan_to_num(states.qvel)
        values = np.tile(self.values, (len(observations), 1))
        self.simulation.undo_sensors(values, qpos, qvel)
        q, v = self.simulation.rollout(values, qpos, qvel, Drive(commands, hold=self.frame_skip))
        with np.errstate(invalid="ignore"):  # comparisons with what is not a number are false
            return bool((np.abs(q) < LARGEST).all() and (np.abs(v) < LARGEST).all())

    def runs_on(self, data: Transitions) -> bool:
        """Whether the simulator runs on from states of ``data``, oldest first, under their own actions."""
        count = max(1, len(data) - TRIAL_STEPS)
        first = np.unique(np.linspace(0, count - 1, TRIAL_STATES).astype(int))
        rows = np.minimum(first[:, None] + np.arange(min(TRIAL_STEPS, len(data))), len(data) - 1)
        return self.runs(data.observations.cpu().numpy()[first], data.actions.cpu().numpy()[rows])

    def declared_at_bounds(self) -> list[str]:
        """Names and values of declared numbers that have moved to a bound."""
        declared = np.array(
            [isinstance(e, Declared) for e in self.simulation.effects for _ in e.parameters], dtype=bool
        )
        values = self.values
        there = (values <= self.simulation.lower) | (values >= self.simulation.upper)
        moved = declared & there & (values != self.simulation.null)
        return [f"{self.names[i]} = {values[i]:.4g}" for i in np.flatnonzero(moved)]

    def added(self) -> list[dict[str, Any]]:
        """The effects beside the declared numbers, as ``effects=`` takes them."""
        return [e.to_json() for e in self.effects() if not isinstance(e, Declared)]

    def describe(self) -> dict[str, float]:
        """phi by name, with the standard deviations."""
        values = dict(zip(self.names, map(float, self.values)))
        return values | {f"{name}_se": float(d) for name, d in zip(self.names, self.deviation)}

    # ------------------------------------------------------------------ prediction

    def forgotten(self) -> list[str]:
        """Labels of the effects that remember: commands and states from before a step count as the same."""
        return [effect.label for effect in self.effects() if effect.remembers]

    def knows(self, observations: np.ndarray) -> np.ndarray:
        """As in :class:`~sb3_rpto.dynamics.base.Dynamics`: a speed at its observation's bound is not known."""
        return are_known(self.recover, observations.astype(np.float64))

    @property
    def attached(self) -> bool:
        """Whether :meth:`attach` was called."""
        return self._twin is not None

    def attach(self, env: gym.Env | VecEnv) -> None:
        """Give the environment whose rewards, terminations and observations :meth:`step` answers with; it is copied.

        :raises ValueError: it cannot be copied, or set to a state, or its answer to a step does not follow from the
            state before it
        """
        try:
            twin = must_copy(single_env(env))
        except CopyError as error:
            raise ValueError(f"{env} cannot be copied ({error}), which dynamics='physical' needs") from error
        for name in ("set_state", "_get_obs"):
            if not callable(getattr(twin.unwrapped, name, None)):
                raise ValueError(
                    f"{env_name(twin)} has no {name}(), by which single steps begin in recorded states; derive it from "
                    "gymnasium.envs.mujoco.MujocoEnv, or use dynamics='physical' without weighting='value_aware'"
                )
        check_memoryless(single_env(env), self.recover)
        twin.reset(seed=0)
        self._twin = StandingEnv(twin, self.effects())

    @th.no_grad()
    def step(self, observations: th.Tensor, actions: th.Tensor, deterministic: bool = False) -> Prediction:
        """One step of the corrected environment from each state; commands from before it count as the same.

        :param observations: (n, observation_dim)
        :param actions: (n, action_dim)
        :param deterministic: no effect, the simulator always is
        :raises RuntimeError: before :meth:`attach`
        """
        if self._twin is None:
            raise RuntimeError("step() needs the environment's rewards: call attach(env) first")
        twin, base = self._twin, self._twin.unwrapped
        twin.set_effects(self.effects())
        states = self.recover(observations.cpu().numpy())
        qpos, qvel = np.nan_to_num(states.qpos), np.nan_to_num(states.qvel)
        self.simulation.undo_sensors(np.tile(self.values, (len(qpos), 1)), qpos, qvel)
        following, rewards, ends = [], [], []
        for q, v, action in zip(qpos, qvel, actions.cpu().numpy()):
            twin.reset()
            base.set_state(q, v)  # type: ignore[attr-defined]
            place_as_after_a_step(base.model, base.data)  # type: ignore[attr-defined]
            twin.forget_commands()
            observation, reward, terminated, _, _ = twin.step(action)
            following.append(observation)
            rewards.append(float(reward))
            ends.append(terminated)
        device = observations.device
        return Prediction(
            th.as_tensor(np.array(following), dtype=observations.dtype, device=device),
            th.as_tensor(rewards, device=device),
            th.as_tensor(ends, device=device),
        )

    def error(self, data: Transitions, lead: int = 0) -> float:
        """As in :class:`~sb3_rpto.dynamics.base.Dynamics`, of positions and velocities in place of observations.

        :param data: transitions, oldest first
        :param lead: of so many of the oldest only the commands count
        """
        steps = self._steps(data, np.arange(lead, len(data)))
        shown = steps.compared
        if not len(steps) or not shown.any():
            return float("nan")
        begun = np.concatenate([steps.qpos, steps.qvel], axis=1)
        reached = steps.reach(self.simulation, self.values[None])[0]
        reached = np.where(np.isfinite(reached), reached, begun + BLOWN * np.where(shown, steps.scale, 0.0))
        before, predicted, after = (th.as_tensor(x[:, shown]) for x in (begun, reached, steps.reached))
        return relative_error(predicted, Transitions(before, before, before, after, before))

    def undone(self, data: Transitions) -> float:
        """Share of the typical one-step error that the next one undoes: about 0.5 where observations are noisy.

        What the commands of a step and of the one before tell of an error is left out: a motor's, or of inertia.

        :param data: transitions, oldest first
        :return: of the position or velocity where it is largest; 0 where few follow on others
        """
        steps = self._steps(data)
        after = np.flatnonzero(steps.before >= 0)
        sent = data.actions.cpu().numpy()[steps.rows]
        before = np.where(steps.before[:, None] >= 0, sent[steps.before], 0.0)
        told = np.concatenate([sent, before, np.ones((len(sent), 1))], axis=1)
        if len(after) < max(80, 4 * told.shape[1]):
            return 0.0
        off = (steps.reach(self.simulation, self.values[None])[0] - steps.reached)[:, steps.compared]
        off = off - told @ np.linalg.lstsq(told, off, rcond=None)[0]
        now, past = off[after], off[steps.before[after]]
        return float(-np.min((now * past).mean(axis=0) / np.maximum((off**2).mean(axis=0), 1e-300)))

    def _steps(self, data: Transitions, chosen: np.ndarray | None = None) -> Steps:
        idle = any(effect.idle for effect in self.simulation.effects)
        return as_steps(data, self.recover, self.mj_model, self.frame_skip, chosen, idle)

    # ------------------------------------------------------------------ the fit

    def fit(
        self, data: Transitions, weights: th.Tensor | None = None, max_steps: int | None = None
    ) -> dict[str, float]:
        """Move phi towards ``data`` by at most ``max_steps`` trusted steps; see the class.

        :param data: transitions, of which the newest with a positive weight are fitted
        :param weights: (n,), RTO's, not negative; None weighs all alike
        :param max_steps: default: that of the class
        :return: ``steps`` taken, how many transitions were ``left_out`` (a state that is clipped or not known), and how
            many positions and speeds are ``unobserved``, in no observation, and not compared
        :raises ValueError: weights of another shape, negative ones, or such that are not finite
        """
        if weights is not None and weights.shape != (len(data),):
            raise ValueError(f"weights must have shape ({len(data)},), one a transition, not {tuple(weights.shape)}")
        if weights is not None and not (weights.isfinite() & (weights >= 0)).all():
            raise ValueError("weights must be finite and not negative")
        counted = np.arange(len(data)) if weights is None else np.flatnonzero(weights.cpu().numpy())
        steps = self._steps(data, counted[-self.fits_newest :])
        counts = {"unobserved": float(steps.unobserved.sum())}
        counts["left_out"] = float(min(len(counted), self.fits_newest) - len(steps))
        if not steps.compared.any() or not len(self.names):
            return {"steps": 0.0, **counts}
        begin, most = self.values.copy(), self.max_steps if max_steps is None else max_steps
        error = OneStepError(self.simulation, self.scale, self.simulation.lower, self.simulation.upper, steps, weights)
        values, taken = error.fit(begin, self.max_step, most)
        self._values.copy_(th.as_tensor(values))
        self.settled = taken < most
        if taken and not self.runs_on(data):
            self._values.copy_(th.as_tensor(begin))
            warnings.warn(
                "the simulator as it was fitted to the target's data becomes unstable: refused, the last one is kept; "
                "give bounds to what you declare",
                stacklevel=3,
            )
            return {"steps": 0.0, **counts}
        self._covariance.copy_(th.as_tensor(error.covariance(values)))
        self._name_vague(error.vague)
        self._name_confounded(error.confounded, error.fixed)
        return {"steps": float(taken), **counts}

    def _name_vague(self, vague: np.ndarray) -> None:
        """Warn once of parameters that the data do not show, or too faintly."""
        names = self._which(vague)
        _warn_of_new(
            names,
            self._vague,
            f"the target's data do not show {', '.join(names)}: left at what it was; do not declare it, or move so "
            "that it matters",
        )
        self._vague = tuple(dict.fromkeys([*self._vague, *names]))  # with more data they may come and go

    def _name_confounded(self, confounded: np.ndarray, fixed: np.ndarray) -> None:
        """Warn once of parameters that the data do not tell apart."""
        names = self._which(confounded)
        _warn_of_new(
            names,
            self._confounded,
            f"the target's data do not tell {', '.join(names)} apart: {', '.join(self._which(fixed))} left at what it "
            "was, the rest is fitted to that and has no standard error; declare fewer of them, or add what is known of "
            "one",
        )
        self._confounded = names

    def _which(self, marked: np.ndarray) -> tuple[str, ...]:
        return tuple(self.names[i] for i in np.flatnonzero(marked))


def _warn_of_new(names: tuple[str, ...], known: tuple[str, ...], message: str) -> None:
    if set(names) - set(known):
        warnings.warn(message, stacklevel=4)


def _name(effect: Effect, parameter: str) -> str:
    return effect.label if isinstance(effect, Declared) else f"{effect.label}.{parameter}"
