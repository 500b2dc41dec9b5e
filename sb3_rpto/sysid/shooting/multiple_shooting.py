"""Fitting the parameters of a simulation to windows of recordings (multiple shooting)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sb3_rpto.effects import Declared, Scales, Simulation
from sb3_rpto.fitting.gauss_newton import Trial, add_step, bounded_step, minimise, quadratic_fall
from sb3_rpto.fitting.loss import CLIP, Loss
from sb3_rpto.sysid.data.coordinates import straight
from sb3_rpto.sysid.shooting.initial_states import moved
from sb3_rpto.sysid.shooting.windows import Windows

#: Where a simulation became unstable, its residual in units of the noise.
UNSTABLE = 1e4
#: Weak pull of an effect's parameters towards their null values, in plausible sizes.
RIDGE = 30.0
#: Finite differences, in plausible sizes: at a null value they are as wide as the effect must be to show.
WIDE, NARROW = 1.0, 0.01
#: Shares of a start's step that are tried.
SHARES = (1.0, 0.2)
#: Changes of the damping that are tried, in their turn: the first alone where its step does as expected; and its range.
LADDER = ((0.1,), (1.0, 10.0, 100.0), (1e4, 1e6))
DAMPINGS = (1e-6, 1e6)
#: Fits to measured data far from the noise end when the cost falls by less than this share: what is missing makes it.
CRUDE = 0.01
#: All windows' errors below so many units of the noise, for exact data 1e-7 of what a position varies by, are met.
MET = 1e-3
#: Steps of the starts by themselves after which a verdict may rest on them; none where all fall by less than a share.
START_STEPS, STILL = 10, 1e-3
#: Most simulations in one batch.
CHUNK = 6000


@dataclass(frozen=True)
class Fit:
    """Parameters fitted to windows.

    :param values: all parameters of the simulation, (p,)
    :param starts: corrections of the windows' starts, in units of their spread, (W, 2 nv)
    :param errors: root mean squared residual of each window in units of the noise, (W,)
    :param cost: robust cost, comparable between fits of like size only
    :param linear: the cost around it, where it is known
    """

    values: np.ndarray
    starts: np.ndarray
    errors: np.ndarray
    cost: float
    linear: Linear | None = None


@dataclass(frozen=True)
class Linear:
    """The cost around a fit, each window's start eliminated, in coordinates of plausible sizes.

    :param normal: (W, f, f) Gauss-Newton matrices of the free parameters
    :param gradient: (W, f)
    :param free: indices of the free parameters, (f,)
    """

    normal: np.ndarray
    gradient: np.ndarray
    free: np.ndarray

    def fall(self, rows: np.ndarray) -> float:
        """How far the cost would fall by some of the free parameters if it were quadratic."""
        normal, gradient = self.normal.sum(0)[np.ix_(rows, rows)], self.gradient.sum(0)[rows]
        ridge = 1e-6 * np.diag(np.diag(normal)) + 1e-9 * np.eye(len(rows))
        return float(gradient @ np.linalg.solve(normal + ridge, gradient))


class Problem:
    """Windows, and the simulation that is to predict them.

    Unknown are the simulation's parameters, common to all windows, and each window's start, near its smoothed state.
    The residual is (predicted - measured) / noise, and the corrections of the start in units of their trusted spread.

    :param simulation: with all effects that may be free
    :param windows: recordings
    :param scales: what is large at each effect's place, in the order of the effects
    """

    def __init__(self, simulation: Simulation, windows: Windows, scales: Sequence[Scales]) -> None:
        self.simulation, self.windows, self.scales = simulation, windows, scales
        parameters = [(p, s) for e, s in zip(simulation.effects, scales) for p in e.parameters]
        self.size = np.array([p.size_for(s) for p, s in parameters])
        self.lower = simulation.lower
        self.upper = np.array(
            [
                e.ceiling(s) if isinstance(e, Declared) else p.upper
                for e, s in zip(simulation.effects, scales)
                for p in e.parameters
            ]
        )
        self.null = simulation.null
        self.known = np.array([e.known for e in simulation.effects for _ in e.parameters], dtype=bool)
        self.moving = np.flatnonzero((windows.spread > 0).any(axis=0))  # coordinates of the start that are free
        self.exact, self.touching = windows.exact, windows.touching

    def on(self, index: np.ndarray) -> Problem:
        """The same problem on the windows at ``index``."""
        return Problem(self.simulation, self.windows.take(index), self.scales)

    def first(self, samples: int) -> Problem:
        """The same problem on the first samples of the windows."""
        return Problem(self.simulation, self.windows.first(samples), self.scales)

    # --- prediction ---------------------------------------------------------------------------------------------

    def predict(self, values: np.ndarray, starts: np.ndarray, index: np.ndarray) -> np.ndarray:
        """What the sensors should have shown.

        :param values: (n, p)
        :param starts: corrections of the start, (n, 2 nv)
        :param index: window of each of the n simulations, (n,)
        :return: (n, S, m), NaN where unstable
        """
        parts = np.array_split(np.arange(len(index)), -(-len(index) // CHUNK))
        return np.concatenate([self._predict(values[i], starts[i], index[i]) for i in parts])

    def _predict(self, values: np.ndarray, starts: np.ndarray, index: np.ndarray) -> np.ndarray:
        w, model = self.windows, self.simulation.model
        shift = starts * w.spread[index] * w.trust
        qpos, qvel = moved(model, w.qpos[index], shift[:, : model.nv]), w.qvel[index] + shift[:, model.nv :]
        self.simulation.undo_sensors(values, qpos, qvel, w.qacc[index])
        q, v = self.simulation.rollout(values, qpos, qvel, w.drive.take(index))
        dt, dofs, at = float(model.opt.timestep), self._dofs(), dict.fromkeys(range(len(w.columns)), w.at[index])
        out = interpolate(q, v, w.at[index], dt, w.columns, dofs)
        sensing = self.simulation.sensing(values)
        for effect, x in sensing:
            age = effect.late(x)
            for column in np.flatnonzero(w.columns == effect.adr) if age.any() else ():
                at[column] = w.at[index] - age[:, None] / dt
                out[:, :, [column]] = interpolate(q, v, at[column], dt, w.columns[[column]], dofs[[column]])
        for effect, x in sensing:
            for column in np.flatnonzero(w.columns == effect.adr):
                speed = interpolate_linearly(v[:, :, effect.dof], at[column])
                out[:, :, column] = effect.observe(out[:, :, column], speed, x[:, None])[0]
        return out

    def _dofs(self) -> np.ndarray:
        """Address in qvel of each observed column, -1 for a coordinate without a velocity of its own."""
        dof_of = straight(self.simulation.model)
        return np.array([dof_of.get(int(c), -1) for c in self.windows.columns])

    def residuals(self, values: np.ndarray, starts: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Residuals in units of the noise, (n, S m); zero for samples that do not count."""
        w = self.windows
        r = (self.predict(values, starts, index) - w.measured[index]) / w.sigma
        r = np.clip(np.nan_to_num(r, nan=UNSTABLE), -UNSTABLE, UNSTABLE)
        return (r * w.usable[index][:, :, None]).reshape(len(index), -1)

    def errors(self, residuals: np.ndarray) -> np.ndarray:
        """Root mean squared residual of each window, (W,), from (W, S m)."""
        counts = self.windows.usable.sum(axis=1) * self.windows.measured.shape[2]
        return np.sqrt((residuals**2).sum(axis=1) / counts)

    def unstable(self, values: np.ndarray) -> int:
        """Number of windows whose simulation blows up, from the smoothed starts."""
        count = len(self.windows)
        starts = np.zeros((count, 2 * self.simulation.model.nv))
        predicted = self.predict(np.tile(values, (count, 1)), starts, np.arange(count))
        return int((~np.isfinite(predicted)).any(axis=(1, 2)).sum())

    # --- derivatives --------------------------------------------------------------------------------------------

    def steps(self, values: np.ndarray) -> np.ndarray:
        """Finite-difference steps of all parameters in their units, (p,), pointing inside the bounds."""
        at_null = np.isclose(values, self.null, rtol=0, atol=1e-9 * self.size) & ~self.known
        step = np.where(at_null, WIDE, NARROW) * self.size
        return np.where(values + step > self.upper, -step, step)

    def linearise(
        self,
        values: np.ndarray,
        starts: np.ndarray,
        free: np.ndarray,
        base: np.ndarray | None = None,
        down: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals and their derivatives by the free parameters (in plausible sizes) and by the start.

        :param values: (p,), or (W, p) for parameters of its own in each window (then none may be free)
        :param starts: (W, 2 nv)
        :param free: (f,) indices
        :param base: the residuals, (W, R), where they are known from before
        :param down: the parameters' differences are taken on the other side
        :return: (W, R), (W, R, f), (W, R, x)
        """
        count, f, x = len(self.windows), len(free), len(self.moving)
        if self.simulation.model.na:
            base = None  # how long filters are led depends on what is simulated beside
        columns, p = f + x + (base is None), values.shape[-1]
        all_values = np.tile(np.broadcast_to(values, (count, p)), (columns, 1, 1))
        all_starts = np.tile(starts, (columns, 1, 1))
        step = self.steps(values)[free] * (-1 if down else 1) if f else np.empty(0)
        for i, parameter in enumerate(free):
            all_values[i, :, parameter] += step[i]
        for i, coordinate in enumerate(self.moving):
            all_starts[f + i, :, coordinate] += 0.3
        index = np.tile(np.arange(count), columns)
        r = self.residuals(all_values.reshape(columns * count, p), all_starts.reshape(columns * count, -1), index)
        r = r.reshape(columns, count, -1)
        base = r[-1] if base is None else base
        by_values = (r[:f] - base) * (self.size[free] / step)[:, None, None]
        by_start = (r[f : f + x] - base) / 0.3
        # A difference across a simulation that blew up says nothing.
        by_values, by_start = (np.where(np.abs(d) < 0.5 * UNSTABLE, d, 0.0) for d in (by_values, by_start))
        return base, by_values.transpose(1, 2, 0), by_start.transpose(1, 2, 0)

    # --- fits ---------------------------------------------------------------------------------------------------

    def reduce(self, r: np.ndarray, jt: np.ndarray, jx: np.ndarray, starts: np.ndarray, loss: Loss) -> Reduced:
        """Weighted normal equations of each window with its start eliminated (Schur complement)."""
        weight, hold = loss.weights(r), start_weight(loss)
        wt = jt * weight[:, :, None]
        normal, gradient = np.einsum("wrf,wrg->wfg", wt, jt), np.einsum("wrf,wr->wf", wt, r)
        gain, move = np.zeros((len(r), jx.shape[2], jt.shape[2])), np.zeros((len(r), jx.shape[2]))
        fall = np.zeros(len(r))
        if jx.shape[2]:
            wx = jx * weight[:, :, None]
            hxx = np.einsum("wrx,wry->wxy", wx, jx) + hold * np.eye(jx.shape[2])
            hxt = np.einsum("wrx,wrf->wxf", wx, jt)
            gx = np.einsum("wrx,wr->wx", wx, r) + hold * starts[:, self.moving]
            gain, move = np.linalg.solve(hxx, hxt), np.linalg.solve(hxx, gx[:, :, None])[:, :, 0]
            normal = normal - np.einsum("wxf,wxg->wfg", hxt, gain)
            gradient = gradient - np.einsum("wxf,wx->wf", hxt, move)
            fall = (gx * move).sum(-1)
        return Reduced(normal, gradient, gain, move, fall)

    def cost(self, r: np.ndarray, starts: np.ndarray, values: np.ndarray, loss: Loss) -> np.ndarray:
        """Robust cost of one or more candidates: r (..., W, R), starts (..., W, 2 nv), values (..., p)."""
        pull = np.where(self.known, 0.0, (values - self.null) / self.size / RIDGE) ** 2
        return window_costs(loss, r, starts).sum(-1) + pull.sum(-1)

    def fit(
        self,
        values: np.ndarray,
        free: np.ndarray,
        starts: np.ndarray | None = None,
        iterations: int = 12,
        tolerance: float = 1e-3,
        crude: float = CRUDE,
    ) -> Fit:
        """Levenberg-Marquardt on the free parameters and all starts, within the bounds.

        :param values: where it begins, (p,); the others stay
        :param free: indices, (f,)
        :param starts: as in :class:`Fit`; default: the smoothed states
        :param iterations: most steps
        :param tolerance: stop when the cost falls by less than this share
        :param crude: the same of measured data far from the noise, where the typical window's falls no more either
        :return: never worse than where it began, if that is within the bounds
        """
        values = values.copy()
        values[free] = np.clip(values[free], self.lower[free], self.upper[free])
        starts = np.zeros((len(self.windows), 2 * self.simulation.model.nv)) if starts is None else starts.copy()
        begin: Estimate = (values, starts, None)
        descent = minimise(
            lambda point: self.around(*point, free, tolerance, crude),
            begin,
            trust=1e-3,
            ladder=LADDER if len(free) else LADDER[:1],
            iterations=iterations,
        )
        values, starts, _ = descent.point
        r = _residuals(descent.point)
        around = descent.around
        linear = (
            Linear(around.reduced.normal, around.reduced.gradient, free) if isinstance(around, Neighbourhood) else None
        )
        return Fit(values, starts, self.errors(r), float(self.cost(r, starts, values, Loss.of(r))), linear)

    def around(
        self,
        values: np.ndarray,
        starts: np.ndarray,
        r: np.ndarray | None,
        free: np.ndarray,
        tolerance: float = 1e-3,
        crude: float = CRUDE,
    ) -> Neighbourhood:
        """The cost around an estimate; arguments are those of :meth:`fit`.

        :param r: the residuals there, (W, R), where they are known
        """
        r, jt, jx = self.linearise(values, starts, free, r)
        loss = Loss.of(r)
        cost = float(self.cost(r, starts, values, loss))
        reduced = self.reduce(r, jt, jx, starts, loss)
        return Neighbourhood(self, (values, starts, r), free, loss, cost, reduced, tolerance, crude)

    def bounded_fall(self, linear: Linear, values: np.ndarray) -> float:
        """How far the cost would fall within the bounds of the free parameters if it were quadratic.

        :param linear: the cost around ``values``, (p,)
        """
        free, normal, gradient = linear.free, linear.normal.sum(0), linear.gradient.sum(0)
        if not len(free):
            return 0.0
        damped = normal + 1e-6 * np.diag(np.diag(normal)) + 1e-9 * np.eye(len(free))
        low, high = ((b[free] - values[free]) / self.size[free] for b in (self.lower, self.upper))
        z = bounded_step(damped, gradient, np.minimum(low, 0.0), np.maximum(high, 0.0))
        return quadratic_fall(normal, gradient, z)

    def linear(self, fit: Fit, free: np.ndarray) -> Linear:
        """The reduced normal equations at a fit, for screening, elimination and intervals."""
        if fit.linear is not None and np.array_equal(fit.linear.free, free):
            return fit.linear
        r, jt, jx = self.linearise(fit.values, fit.starts, free)
        reduced = self.reduce(r, jt, jx, fit.starts, Loss.of(r))
        return Linear(reduced.normal, reduced.gradient, free)

    def score(self, values: np.ndarray, starts: np.ndarray | None = None, iterations: int = 2) -> Fit:
        """Errors of the windows with the parameters given and their starts fitted.

        :param values: (p,), or (W, p) for parameters of its own in each window
        :param starts: where to begin, as in :class:`Fit`; default: the smoothed states
        :param iterations: Gauss-Newton steps of the starts
        """
        count, none = len(self.windows), np.empty(0, dtype=int)
        starts = np.zeros((count, 2 * self.simulation.model.nv)) if starts is None else starts.copy()
        rows = np.broadcast_to(values, (count, values.shape[-1]))
        best = None
        for _ in range(iterations if len(self.moving) else 0):
            r, jt, jx = self.linearise(values, starts, none, best)
            loss = Loss.of(r)
            trial = starts.copy()
            trial[:, self.moving] -= self.reduce(r, jt, jx, starts, loss).move
            now = self.residuals(rows, trial, np.arange(count))
            before, after = window_costs(loss, r, starts), window_costs(loss, now, trial)
            better = after < before
            starts = np.where(better[:, None], trial, starts)
            best = np.where(better[:, None], now, r)
            if np.minimum(before, after).sum() > (1 - STILL) * before.sum():
                break
        best = self.residuals(rows, starts, np.arange(count)) if best is None else best
        return Fit(values, starts, self.errors(best), float(window_costs(Loss.of(best), best, starts).sum()))

    def redrawn(self, fit: Fit, rng: np.random.Generator) -> Problem:
        """The same windows as the model itself would have been measured; starts that are samples get noise, too."""
        w, every, nv = self.windows, np.arange(len(self.windows)), self.simulation.model.nv
        true = self.predict(np.tile(fit.values, (len(w), 1)), fit.starts, every)
        measured = np.where(np.isfinite(true), true, w.measured) + rng.standard_normal(true.shape) * w.sigma
        if w.noisy_starts:
            off = (fit.starts + rng.standard_normal(fit.starts.shape)) * w.spread * w.trust
            w = replace(w, qpos=moved(self.simulation.model, w.qpos, off[:, :nv]), qvel=w.qvel + off[:, nv:])
        return Problem(self.simulation, replace(w, measured=measured), self.scales)

    def noise_errors(self, fit: Fit, seed: int, draws: int = 8) -> np.ndarray:
        """Errors that a true model would have: white noise, less what the fitted starts take of it, (draws, W).

        Noisy starts may lie across a contact: their draws are simulated, where smoothed ones leave a slope to go by.
        """
        if self.windows.noisy_starts:
            generators = np.random.default_rng(seed).spawn(draws)
            drawn = (self.redrawn(fit, rng).score(fit.values, iterations=START_STEPS) for rng in generators)
            return np.array([each.errors for each in drawn])
        _, _, jx = self.linearise(fit.values, fit.starts, np.empty(0, dtype=int))
        w = self.windows
        rng = np.random.default_rng(seed)
        mask = np.repeat(w.usable, w.measured.shape[2], axis=1)
        out = []
        for _ in range(draws):
            r = rng.standard_normal(mask.shape) * mask
            if jx.shape[2]:
                hxx = np.einsum("wrx,wry->wxy", jx, jx) + np.eye(jx.shape[2])
                move = np.linalg.solve(hxx, np.einsum("wrx,wr->wx", jx, r)[:, :, None])[:, :, 0]
                r = r - np.einsum("wrx,wx->wr", jx, move)
            out.append(self.errors(r))
        return np.array(out)


@dataclass(frozen=True)
class Reduced:
    """The normal equations of each window, its start eliminated.

    :param normal: (W, f, f)
    :param gradient: (W, f)
    :param gain: how the starts follow the parameters, (W, x, f)
    :param move: how the starts move by themselves, (W, x)
    :param fall: of the cost by that, (W,)
    """

    normal: np.ndarray
    gradient: np.ndarray
    gain: np.ndarray
    move: np.ndarray
    fall: np.ndarray


#: Parameters (p,), starts (W, 2 nv) and, where they are known, residuals (W, R).
Estimate = tuple[np.ndarray, np.ndarray, np.ndarray | None]


@dataclass(frozen=True)
class Neighbourhood:
    """The cost around an estimate, see :class:`~sb3_rpto.fitting.gauss_newton.Linearisation`; the trust is a damping.

    :param problem: windows
    :param point: the estimate
    :param free: indices of the free parameters, (f,)
    :param loss: of the residuals there
    :param cost: there
    :param reduced: its normal equations
    :param tolerance: see :meth:`Problem.fit`
    :param crude: likewise
    """

    problem: Problem
    point: Estimate
    free: np.ndarray
    loss: Loss
    cost: float
    reduced: Reduced
    tolerance: float
    crude: float

    def expected_fall(self, trust: float) -> float:
        """How far the cost would fall with a step of this damping if it were quadratic."""
        z = self._step(trust)[self.free] / self.problem.size[self.free]
        return float(self.reduced.fall.sum() + quadratic_fall(*self._normal, z))

    def converged(self, fall: float) -> bool:
        """Whether a step would gain less than the tolerance, or all windows are met exactly."""
        return bool(fall < self.tolerance * self.cost or self.problem.errors(_residuals(self.point)).max() < MET)

    def best_trial(self, trusts: np.ndarray) -> Trial[Estimate]:
        """Simulate the steps of several dampings side by side, and take the best.

        Each window takes what suits it of its start's own step: near an unstable pose a whole step may lead astray.
        """
        problem, (values, starts, _) = self.problem, self.point
        count, tries = len(problem.windows), len(trusts)
        steps = np.stack([self._step(d) for d in trusts])
        follow = np.einsum("wxf,tf->twx", self.reduced.gain, steps[:, self.free] / problem.size[self.free])
        moves = np.stack([share * (self.reduced.move + follow) for share in SHARES])
        trial_starts = np.tile(starts, (len(SHARES), tries, 1, 1))
        trial_starts[..., problem.moving] -= moves
        trial_values = add_step(values, steps, problem.lower, problem.upper)
        r = problem.residuals(
            np.tile(np.repeat(trial_values, count, 0), (len(SHARES), 1)),
            trial_starts.reshape(len(SHARES) * tries * count, -1),
            np.tile(np.arange(count), len(SHARES) * tries),
        ).reshape(len(SHARES), tries, count, -1)
        costs = window_costs(self.loss, r, trial_starts)
        share = np.argmin(costs, axis=0), np.arange(tries)[:, None], np.arange(count)
        fall = self.cost - problem.cost(r[share], trial_starts[share], trial_values, self.loss)
        best = int(np.argmax(fall))
        point = trial_values[best], trial_starts[share][best], r[share][best]
        return Trial(point, float(fall[best]), float(np.clip(trusts[best], *DAMPINGS)))

    def is_last(self, trial: Trial[Estimate]) -> bool:
        """Whether a step gains less than the tolerance, or measured data far from the noise are met little better.

        These are met little better as a whole and typically. In kinks, which contacts make and exact data show, fits
        creep before they get on.
        """
        if trial.fall < self.tolerance * self.cost:
            return True
        problem = self.problem
        if not self.loss.model_error_dominates or problem.exact or problem.touching:
            return False
        if trial.fall > self.crude * self.cost:
            return False
        after, before = (window_costs(self.loss, _residuals(p), p[1]) for p in (trial.point, self.point))
        return bool(np.median(after / np.maximum(before, 1e-300)) > 1 - self.crude)

    def _step(self, damping: float) -> np.ndarray:
        """A damped Gauss-Newton step within the bounds, (p,); what would leave them is held there."""
        problem, free, (values, _, _) = self.problem, self.free, self.point
        step = np.zeros(len(values))
        if not len(free):
            return step
        normal, gradient = self._normal
        normal = normal + damping * np.diag(np.diag(normal) + 1e-3 * np.diag(normal).max() + 1e-12)
        low, high = ((b[free] - values[free]) / problem.size[free] for b in (problem.lower, problem.upper))
        step[free] = bounded_step(normal, gradient, low, high) * problem.size[free]
        return np.clip(values + step, problem.lower, problem.upper) - values

    @cached_property
    def _normal(self) -> tuple[np.ndarray, np.ndarray]:
        """The normal equations of all windows with the pull towards the null values, (f, f) and (f,)."""
        problem, free = self.problem, self.free
        pull = np.where(problem.known[free], 0.0, 1 / RIDGE**2)
        z = (self.point[0][free] - problem.null[free]) / problem.size[free]
        return self.reduced.normal.sum(0) + np.diag(pull), self.reduced.gradient.sum(0) + pull * z


def _residuals(estimate: Estimate) -> np.ndarray:
    """Residuals (W, R) of an estimate around which the cost was linearised, or that a step led to."""
    assert estimate[2] is not None
    return estimate[2]


def start_weight(loss: Loss) -> float:
    """Weight of the starts: where the model errs by more than noise, they must not make up for it."""
    return (loss.clip / CLIP) ** 2


def window_costs(loss: Loss, r: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Robust sum of squares of each window with its start, (..., W), of residuals (..., W, R)."""
    return np.asarray(loss.cost(r).sum(-1) + start_weight(loss) * (starts**2).sum(-1))


# --- between steps ----------------------------------------------------------------------------------------------------


def interpolate(
    q: np.ndarray, v: np.ndarray, at: np.ndarray, dt: float, columns: np.ndarray, dofs: np.ndarray
) -> np.ndarray:
    """Positions at fractional steps by cubic Hermite interpolation, before the start in a straight line, (n, S, m).

    :param q: (n, K + 1, nq)
    :param v: (n, K + 1, nv)
    :param at: (n, S)
    :param dt: length of a step in s
    :param columns: addresses in q, (m,)
    :param dofs: addresses in v, -1 for a coordinate that is interpolated linearly, (m,)
    """
    past, at = np.minimum(at, 0.0), np.maximum(at, 0.0)
    if past.any():
        straight = np.where(dofs >= 0, dt * v[:, 0][:, dofs], 0.0)[:, None]
        return interpolate(q, v, at, dt, columns, dofs) + past[:, :, None] * straight
    k = np.minimum(at.astype(int), q.shape[1] - 2)
    s = (at - k)[:, :, None]
    rows = np.arange(len(q))[:, None]
    q0, q1 = q[rows, k][:, :, columns], q[rows, k + 1][:, :, columns]
    if not np.any(s % 1):
        return np.where(s == 0, q0, q1)
    slope = q1 - q0
    d0 = np.where(dofs >= 0, dt * v[rows, k][:, :, dofs], slope)
    d1 = np.where(dofs >= 0, dt * v[rows, k + 1][:, :, dofs], slope)
    return q0 + s * (d0 + s * ((3 * slope - 2 * d0 - d1) + s * (d0 + d1 - 2 * slope)))


def interpolate_linearly(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (n, K + 1) at fractional steps (n, S), linearly; before the start those of it."""
    at = np.maximum(at, 0.0)
    k = np.minimum(at.astype(int), values.shape[1] - 2)
    rows, part = np.arange(len(values))[:, None], at - k
    return np.asarray((1 - part) * values[rows, k] + part * values[rows, k + 1])
