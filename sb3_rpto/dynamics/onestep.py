"""One-step errors of a simulator on transitions, and trusted Gauss-Newton steps that lower them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch as th

from sb3_rpto.dynamics.base import Transitions, predecessors
from sb3_rpto.effects import Simulation
from sb3_rpto.effects.actuation import command_limits
from sb3_rpto.effects.sensors import ago
from sb3_rpto.effects.simulation import Drive
from sb3_rpto.envs.observations import StateMap, known_at_rest
from sb3_rpto.fitting.covariance import sandwich_covariance, serial_scatter
from sb3_rpto.fitting.gauss_newton import Trial, add_ridge, add_step, bounded_least_squares, minimise
from sb3_rpto.fitting.identifiability import confounded_parameters, null_directions, parameters_to_fix, sensitive
from sb3_rpto.fitting.loss import Loss

#: Commands from before a transition, for delays and filters, in s, and at least of so many transitions.
MEMORY, FILTERED = 0.2, 10
#: Finite differences, in the parameters' scales: wide ones see over the kinks of contacts, narrow ones see the slope.
DIFFERENCES = (1e-2, 1e-3, 1e-4)
#: Shares of the trusted size that a step may have.
REACHES = (tuple(0.25 ** np.arange(5)),)
#: A parameter whose standard error is more than this many of its scales (or times what it was) is not identified,
#: unless it is so many standard errors from what it was.
VAGUE, CLEARLY = 1.0, 3.0
#: A fit stops when no parameter moves by more than this share of its scale.
STILL = 1e-6
#: Scores of so many transitions in a row may be correlated.
LAGS = 4
#: Typical residuals are not taken to be smaller, in standard one-step changes: of exact data they are rounding.
LEAST = 1e-6
#: Residuals of what blows up, in standard one-step changes.
BLOWN = 100.0


@dataclass(frozen=True)
class Steps:
    """Transitions as simulator steps; what no observation tells of a state is zero and not compared.

    :param rows: which of the transitions: those whose states are known, (n,)
    :param qpos: (n, nq)
    :param qvel: (n, nv)
    :param drive: the commands, some from before each step
    :param reached: positions and velocities after the step, (n, nq + nv)
    :param scale: standard change in one step of those, (nq + nv,); inf where nothing moves or is known
    :param unobserved: which positions and speeds no observation tells, (nq + nv,)
    :param before: the step that each follows, by its place among these; -1 where it is not among them, (n,)
    """

    rows: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    drive: Drive
    reached: np.ndarray
    scale: np.ndarray
    unobserved: np.ndarray
    before: np.ndarray

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def compared(self) -> np.ndarray:
        """Which positions and velocities are compared, (nq + nv,)."""
        return np.asarray(np.isfinite(self.scale))

    def reach(self, simulation: Simulation, values: np.ndarray) -> np.ndarray:
        """Where each of ``k`` phis leads, (k, n, nq + nv), from ``values`` (k, p), as its sensors show it."""
        k, n = len(values), len(self)
        every = np.repeat(values, n, axis=0)
        qpos, qvel = np.tile(self.qpos, (k, 1)), np.tile(self.qvel, (k, 1))
        lasted = self.drive.commands.shape[1] - self.drive.before
        gained = (self.reached[:, simulation.model.nq :] - self.qvel) / (lasted * simulation.model.opt.timestep)
        simulation.undo_sensors(every, qpos, qvel, np.tile(gained, (k, 1)))
        q, v = simulation.rollout(every, qpos, qvel, self.drive.take(np.tile(np.arange(n), k)))
        qpos, qvel = q[:, -1].copy(), v[:, -1].copy()
        sensing = simulation.sensing(every)
        for effect, x in sensing:
            steps = effect.late(x) / float(simulation.model.opt.timestep)
            if steps.any():
                qpos[:, effect.adr], qvel[:, effect.dof] = ago(steps, q[:, :, effect.adr], v[:, :, effect.dof])
        for effect, x in sensing:
            qpos[:, effect.adr], qvel[:, effect.dof] = effect.observe(qpos[:, effect.adr], qvel[:, effect.dof], x)
        return np.concatenate([qpos, qvel], axis=1).reshape(k, n, -1)


def as_steps(
    data: Transitions,
    recover: StateMap,
    model: mujoco.MjModel,
    frame_skip: int,
    chosen: np.ndarray | None = None,
    idle: bool = False,
) -> Steps:
    """Transitions as simulator steps; those with an unknown state (a speed at the observation's bound) are left out.

    :param data: oldest first; a transition that begins where an earlier one ended follows it
    :param recover: states from observations
    :param model: the simulator's
    :param frame_skip: simulation steps in one transition
    :param chosen: ascending rows that become steps, of the others only the commands count; None: all
    :param idle: whether zeros were sent before an episode's first command, see :class:`~sb3_rpto.effects.Effect`
    """
    earlier = remembered(model, frame_skip)
    chosen = np.arange(len(data)) if chosen is None else chosen
    arrays = (data.observations, data.next_observations, data.actions)
    observations, next_observations, actions = (a.cpu().numpy().astype(np.float64) for a in arrays)
    now, then = recover(observations[chosen]), recover(next_observations[chosen])
    known = np.concatenate([now.known_qpos & then.known_qpos, now.known_qvel & then.known_qvel], axis=1)
    ever = known.any(axis=0) | known_at_rest(recover)
    kept = np.flatnonzero(known[:, ever].all(axis=1))
    rows = chosen[kept]
    commands = np.clip(actions, *command_limits(model))
    before = predecessors(observations, next_observations, data.terminations.cpu().numpy())
    drive = np.repeat(_history(commands, before, rows, earlier, idle), frame_skip, axis=1)
    begun, reached = (np.nan_to_num(np.concatenate([s.qpos, s.qvel], axis=1))[kept] for s in (now, then))
    turned = list(now.wrapped)
    # The simulator counts whole turns on from where it begins; an observed angle jumps by one.
    reached[:, turned] -= 2 * np.pi * np.round((reached - begun)[:, turned] / (2 * np.pi))
    spread = (reached - begun).std(axis=0) if len(rows) else np.zeros(len(ever))
    qpos, qvel = np.split(begun, [model.nq], axis=1)
    scale = np.where(ever & (spread > 1e-8), np.maximum(spread, 1e-8), np.inf)
    place = np.full(len(data) + 1, -1)  # the last stands for what follows nothing
    place[rows] = np.arange(len(rows))
    drives = Drive(drive, earlier * frame_skip, hold=frame_skip)
    return Steps(rows, qpos, qvel, drives, reached, scale, ~ever, place[before[rows]])


def remembered(model: mujoco.MjModel, frame_skip: int) -> int:
    """Transitions before one whose commands may still act in it."""
    return max(FILTERED, -(-round(MEMORY / float(model.opt.timestep)) // frame_skip))


def _history(commands: np.ndarray, before: np.ndarray, rows: np.ndarray, earlier: int, idle: bool) -> np.ndarray:
    """The commands of the transitions at ``rows`` and of those before, (len(rows), earlier + 1, nu), oldest first.

    Before an episode's first transition come zeros where it was ``idle``, else the first command is taken to have held.

    :param commands: of all transitions, (n, nu)
    :param before: see :func:`sb3_rpto.dynamics.base.predecessors`
    """
    past, sent, history = rows, np.ones((len(rows), 1)), [commands[rows]]
    for _ in range(earlier):
        first = before[past] < 0
        sent[first & idle] = 0
        past = np.where(first, past, before[past])
        history.insert(0, sent * commands[past])
    return np.stack(history, axis=1)


class OneStepError:
    """The robust weighted one-step error, as a function of phi.

    :param simulation: whose parameters phi is
    :param scale: of each parameter: its nominal value, or what is plausible, (p,)
    :param lower: bounds, (p,)
    :param upper: (p,)
    :param steps: transitions
    :param weights: of all transitions that the steps were chosen from; None: all alike
    """

    def __init__(
        self,
        simulation: Simulation,
        scale: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        steps: Steps,
        weights: th.Tensor | None,
    ) -> None:
        self.simulation, self.scale, self.lower, self.upper, self.steps = simulation, scale, lower, upper, steps
        share = np.ones(len(steps)) if weights is None else weights.cpu().numpy().astype(float)[steps.rows]
        self.share = share / share.sum()
        #: of the residuals where phi was linearised last
        self.loss = Loss(1.0)
        nothing = np.zeros(len(scale), dtype=bool)
        #: parameters that the transitions did not show there, and those that they show too faintly to tell, (p,)
        self.insensitive, self.vague = nothing, nothing
        #: parameters that the transitions show, but do not tell apart, and those of them that stay, (p,)
        self.confounded, self.fixed = nothing, nothing

    @property
    def free(self) -> np.ndarray:
        """Which parameters may move, (p,)."""
        return ~self.fixed & ~self.vague

    def fit(self, begin: np.ndarray, max_step: float, most: int) -> tuple[np.ndarray, int]:
        """Lower the error by trusted Gauss-Newton steps; what the transitions do not tell stays.

        :param begin: phi, (p,)
        :param max_step: largest change of a parameter in a step, as a share of its scale or its value, whichever is
            larger
        :param most: steps
        :return: phi (p,), and how many steps led there
        """
        self.fix_confounded(begin)
        values, taken = self.descend(begin, max_step, most)
        vague = self.find_vague(values, begin)
        while (values != begin)[vague].any():  # what the data do not tell has moved: without it, from the start
            self.vague = self.vague | vague
            values, taken = self.descend(begin, max_step, most)
            vague = self.find_vague(values, begin)
        self.vague = self.vague | vague
        return values, taken

    def descend(self, values: np.ndarray, max_step: float, most: int) -> tuple[np.ndarray, int]:
        """At most ``most`` trusted steps from ``values`` on: where they lead, and how many they were."""
        descent = minimise(self.linearise, values, trust=max_step, ladder=REACHES, iterations=most)
        return descent.point, descent.steps

    def linearise(self, values: np.ndarray) -> OneStepLinearisation:
        """The error around phi (p,), from narrow and wide differences."""
        parts, self.insensitive = [], np.ones(len(values), dtype=bool)
        for difference in DIFFERENCES:
            residual, slopes = self.differentiate(values, difference)
            self.loss = Loss.of(residual, LEAST)
            a, b = self.weighted(residual, slopes)
            shown = sensitive(a, b)
            self.insensitive &= ~shown
            parts.append((a, b, shown))
        return OneStepLinearisation(self, values, parts)

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Errors of ``k`` phis (k, p) in standard one-step changes, (k, n, c)."""
        steps = self.steps
        off = (steps.reach(self.simulation, values) - steps.reached)[:, :, steps.compared] / steps.scale[steps.compared]
        return np.clip(np.nan_to_num(off, nan=BLOWN), -BLOWN, BLOWN)

    def cost(self, residuals: np.ndarray) -> np.ndarray:
        """The weighted robust error, (k,), of residuals (k, n, c)."""
        return np.asarray(np.einsum("knc,n->k", self.loss.cost(residuals), self.share) / residuals.shape[2])

    def differentiate(self, values: np.ndarray, difference: float) -> tuple[np.ndarray, np.ndarray]:
        """Residuals at one phi (p,), (n, c), and their derivative by phi in scales, (n, c, p).

        :param difference: of the parameters, in scales; negative: downwards
        """
        change = difference * self.scale
        beyond = (values + change > self.upper) | (values + change < self.lower)
        change = np.where(beyond, -change, change)
        found = self.residuals(np.concatenate([values[None], values + np.diag(change)]))
        slopes = (found[1:] - found[0]) * (self.scale / change)[:, None, None]
        return found[0], slopes.transpose(1, 2, 0)

    def fix_confounded(self, values: np.ndarray) -> None:
        """Let one parameter stay for each direction of phi, at ``values`` (p,), that no residual shows."""
        narrow = DIFFERENCES[-1]
        (residual, up), (_, down) = self.differentiate(values, narrow), self.differentiate(values, -narrow)
        self.loss = Loss.of(residual, LEAST)
        # One-sided differences of products such as gear x gain would leave a trace of the direction.
        a, b = self.weighted(residual, (up + down) / 2)
        directions = null_directions(a.T @ a, sensitive(a, b))
        self.confounded, self.fixed = confounded_parameters(directions), parameters_to_fix(directions)

    def weighted(self, residual: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The least squares ``a x = b`` of a step x in scales: (n c, p) and (n c,)."""
        root = np.sqrt(self.weights(residual))
        return (root[:, :, None] * slopes).reshape(-1, slopes.shape[2]), -(root * residual).reshape(-1)

    def weights(self, residual: np.ndarray) -> np.ndarray:
        """Weights of the residuals (n, c) in the least squares that stand for the robust loss."""
        return self.loss.weights(residual, self.share[:, None])

    def covariance(self, values: np.ndarray) -> np.ndarray:
        """Covariance of phi by the sandwich estimate, (p, p).

        Scores of up to :data:`LAGS` transitions in a row may be correlated: an observation that errs ends one
        transition and begins the next, and what the simulator lacks lasts longer than a transition. Of what the
        transitions do not show or tell apart the variance is infinite, and the rest of its row zero.
        """
        curvature = self.curvature(*self.differentiate(values, DIFFERENCES[1]))
        told = self.covariance_in_scales(*curvature, self.free) * np.outer(self.scale, self.scale)
        unknown = self.insensitive | self.confounded
        told[unknown] = told[:, unknown] = 0.0
        told[unknown, unknown] = np.inf
        return told

    def find_vague(self, values: np.ndarray, begin: np.ndarray) -> np.ndarray:
        """Parameters that the transitions show, if at all, too faintly to tell: :data:`VAGUE`; (p,).

        One after the other, the vaguest first: of two that act almost alike the other may be told given the one.
        Judged where a whole step would lead, as what phi still has to go for is no noise. One that is clearly not what
        it was is told, however roughly.

        :param values: phi, (p,)
        :param begin: phi before, where what is vague stays, (p,)
        """
        residual, slopes = self.differentiate(values, DIFFERENCES[1])
        free, found = self.free & ~self.insensitive, self.insensitive.copy()
        while free.any():
            step = np.zeros(len(values))
            step[free] = np.linalg.lstsq(*add_ridge(*self.weighted(residual, slopes[:, :, free])))[0]
            curvature = self.curvature(residual + slopes @ step, slopes)
            spread = np.where(free, np.sqrt(np.diag(self.covariance_in_scales(*curvature, free))), 0.0)
            told = np.abs((values - begin) / self.scale + step) > CLEARLY * spread
            faint = np.where(told, 0.0, spread / np.maximum(1.0, np.abs(begin) / self.scale))
            worst = int(np.argmax(faint))
            if not faint[worst] > VAGUE:
                break
            free[worst], found[worst] = False, True
        return found

    def curvature(self, residual: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the cost, in scales: about its Hessian (p, p), and each transition's part of its slope (n, p)."""
        # The loss's own second derivative: the least squares that stand for it in a step curve more.
        curved = self.share[:, None] * self.loss.second_derivative(residual)
        hessian = np.einsum("nc,ncp,ncq->pq", curved, slopes, slopes)
        return hessian, np.einsum("nc,ncp,nc->np", self.weights(residual), slopes, residual)

    def covariance_in_scales(self, hessian: np.ndarray, scores: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Covariance (p, p) where only the ``free`` ones move, from what :meth:`curvature` returns."""
        count = 1 / np.square(self.share).sum()  # of transitions that weigh alike
        scatter = serial_scatter(scores, self.steps.before, LAGS)
        return sandwich_covariance(hessian, scatter, free, count)


@dataclass(frozen=True)
class OneStepLinearisation:
    """The one-step error around phi, see :class:`~sb3_rpto.fitting.gauss_newton.Linearisation`.

    :param error: of which
    :param point: phi, (p,)
    :param parts: by each of :data:`DIFFERENCES` the weighted least squares ``a x = b`` of a step x in scales, and which
        parameters it may move, (p,)
    """

    error: OneStepError
    point: np.ndarray
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]

    def expected_fall(self, trust: float) -> float:
        """Nothing is expected: all steps are tried."""
        return 0.0

    def converged(self, fall: float) -> bool:
        """Only simulations tell."""
        return False

    def best_trial(self, trusts: np.ndarray) -> Trial[np.ndarray]:
        """The best of the steps from narrow and wide differences and of several sizes, or none."""
        points = np.stack([self.point, *(self._step(*part, float(t)) for part in self.parts for t in trusts)])
        costs = self.error.cost(self.error.residuals(points))
        best = int(np.argmin(costs))
        return Trial(points[best], float(costs[0] - costs[best]), float(trusts[0]))

    def is_last(self, trial: Trial[np.ndarray]) -> bool:
        """Whether no parameter moves by more than :data:`STILL`."""
        return bool(np.max(np.abs(trial.point - self.point) / self.error.scale) < STILL)

    def _step(self, a: np.ndarray, b: np.ndarray, shown: np.ndarray, reach: float) -> np.ndarray:
        """Phi after the weighted least-squares step in the bounds and within a reach, (p,)."""
        error, values = self.error, self.point
        free = np.flatnonzero(shown & error.free)
        step = np.zeros(len(values))
        if len(free):
            low, high = ((bound - values)[free] / error.scale[free] for bound in (error.lower, error.upper))
            far = reach * np.maximum(1.0, np.abs(values[free]) / error.scale[free])
            box = np.maximum(low, -far), np.minimum(high, far)
            step[free] = bounded_least_squares(*add_ridge(a[:, free], b), *box) * error.scale[free]
        return add_step(values, step, error.lower, error.upper)
