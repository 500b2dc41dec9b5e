"""Recordings that nothing explains, read in another way: commands that come late, columns exchanged, signs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import mujoco
import numpy as np

from sb3_rpto.effects.actuation import drivers
from sb3_rpto.effects.names import SCALAR_JOINTS, object_names
from sb3_rpto.sysid.data.columns import Columns, joint_of
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.data.recording import Episode
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint
from sb3_rpto.sysid.hypotheses.hypothesis import Hypothesis
from sb3_rpto.sysid.problem.problem import IdentificationProblem
from sb3_rpto.sysid.selection.confidence_intervals import FinalFit
from sb3_rpto.sysid.selection.search import SearchResult
from sb3_rpto.sysid.shooting.multiple_shooting import START_STEPS, Problem
from sb3_rpto.sysid.shooting.windows import cut


@dataclass(frozen=True)
class Reading:
    """Another way of reading recordings.

    :param kind: of the finding
    :param where: which columns
    :param what: the way, as part of a sentence
    :param remedy: what to do if it is right
    :param again: an episode read so
    :param order: of the position columns' noise then
    :param joints: that it concerns; none: all
    """

    kind: FindingKind
    where: str
    what: str
    remedy: str
    again: Callable[[Episode], Episode]
    order: Sequence[int]
    joints: tuple[str, ...] = ()


def readings(model: mujoco.MjModel, data: Measurements) -> Iterator[Reading]:
    """Ways in which recordings may have been logged otherwise than they say.

    :param model: of the machine
    :param data: recordings
    """
    columns = data.columns
    positions = list(range(len(columns.qpos)))
    step = data.step
    if columns.ctrl:
        what = f"with all commands one sample ({step:.3g} s) earlier"
        remedy = "each row seems to hold the command of the row before; shift the ctrl columns up a row"
        yield Reading(FindingKind.EARLY_RESPONSE, "all episodes, ctrl", what, remedy, _earlier, positions)
    types = {name: int(model.jnt_type[i]) for i, name in enumerate(object_names(model, "joint"))}
    scalar = [i for i, name in enumerate(columns.qpos) if types[joint_of(name)] in SCALAR_JOINTS]
    scalar = [i for i in scalar if columns.qpos[i] not in data.unobserved]
    motors = {i: _commands_at(model, columns, columns.qpos[i]) for i in scalar}
    for i, j in combinations(scalar, 2):
        one, other = columns.qpos[i], columns.qpos[j]
        if types[joint_of(one)] == types[joint_of(other)]:
            order = _exchanged(len(columns.qpos), i, j)
            speeds = _exchanged(len(columns.qvel), columns.qvel.index(one), columns.qvel.index(other))
            where, what = f"qpos.{one}, qpos.{other}", f"with the positions of {one} and {other} exchanged"
            again = _reordered(order, speeds)
            yield Reading(FindingKind.EXCHANGED, where, what, "exchange them", again, order, (one, other))
            if len(motors[i]) == len(motors[j]) == 1:
                (k,), (m,) = motors[i], motors[j]
                where += f", ctrl.{columns.ctrl[k]}, ctrl.{columns.ctrl[m]}"
                what = f"with {one} and {other} exchanged, positions and commands"
                both = _in_turn(again, _told(_exchanged(len(columns.ctrl), k, m)))
                yield Reading(FindingKind.EXCHANGED, where, what, "exchange them", both, order, (one, other))
    for i, j in combinations(range(len(columns.ctrl)), 2):
        one, other = columns.ctrl[i], columns.ctrl[j]
        where, what = f"ctrl.{one}, ctrl.{other}", f"with the commands of {one} and {other} exchanged"
        again = _told(_exchanged(len(columns.ctrl), i, j))
        yield Reading(FindingKind.EXCHANGED, where, what, "exchange them", again, positions)
    for i in scalar:
        name, speed = columns.qpos[i], columns.qvel.index(columns.qpos[i])
        what, remedy = f"with the sign of {name} reversed", "let the column count as the model's axis does"
        yield Reading(FindingKind.REVERSED, f"qpos.{name}", what, remedy, _reversed(i, speed, []), positions, (name,))
        if motors[i]:  # the machine's axis may be the other way round, for its commands as well
            commands = [columns.ctrl[k] for k in motors[i]]
            where = ", ".join([f"qpos.{name}", *(f"ctrl.{command}" for command in commands)])
            what = f"with the signs of {' and '.join([name, *commands])} reversed"
            remedy = "let these columns count as the model's axis does"
            yield Reading(FindingKind.REVERSED, where, what, remedy, _reversed(i, speed, motors[i]), positions, (name,))


class ColumnErrors(Hypothesis):
    """The recordings were logged otherwise than they say."""

    def hints(self, problem: IdentificationProblem, result: SearchResult, fit: FinalFit) -> list[Finding]:
        """The way of reading by which the model errs far less, with what was found for it as far as that is needed."""
        settings = problem.settings.hypotheses
        data, selector, model = problem.fitted, result.on.fine, result.selection.model
        simulation, scales, free = selector.simulation, selector.train.scales, selector.free(model.effects)

        def read(again: Callable[[Episode], Episode], order: Sequence[int]) -> Problem:
            episodes = [again(episode) for episode in data.episodes]
            noise = problem.sigma[list(order)]
            windows = cut(simulation.model, replace(data, episodes=episodes), noise, selector.horizon, settings.windows)
            return Problem(simulation, windows, scales)

        # The declared numbers alone may promise more: what was found makes up for the way of reading.
        begins = (model.fit.values, result.base.fit.values)
        as_read = read(lambda episode: episode, range(len(problem.sigma)))
        usual = float(np.median(as_read.score(begins[0], iterations=START_STEPS).errors))
        tried = []
        for reading in readings(problem.nominal, data):
            there = read(reading.again, reading.order)
            errors = [float(np.median(there.score(values).errors)) for values in begins]
            tried.append((min(errors), begins[int(np.argmin(errors))], there, reading))
        fitted = []
        for _, values, there, reading in sorted(tried, key=lambda one: one[0])[: settings.fitted]:
            tuned = there.fit(values, free, iterations=settings.fitted_iterations)
            fitted.append((float(np.median(tuned.errors)) / usual, reading))
        share, best = min(fitted, key=lambda one: one[0], default=(np.inf, None))
        if best is None or share > settings.told_share:
            return []
        message = f"{best.what} the model errs by {share:.0%} of what it does: {best.remedy} and trace again"
        names = object_names(problem.nominal, "joint")
        bodies = frozenset(int(problem.nominal.jnt_bodyid[names.index(joint)]) for joint in best.joints)
        return [Hint(best.kind, best.where, message, bodies=bodies or None, left=share)]


def _exchanged(count: int, i: int, j: int) -> list[int]:
    order = list(range(count))
    order[i], order[j] = j, i
    return order


def _earlier(episode: Episode) -> Episode:
    following = np.minimum(np.arange(len(episode)) + 1, len(episode) - 1)
    return replace(episode, ctrl=episode.ctrl[following], enabled=episode.enabled[following])


def _reordered(positions: Sequence[int], speeds: Sequence[int]) -> Callable[[Episode], Episode]:
    return lambda episode: replace(episode, qpos=episode.qpos[:, list(positions)], qvel=episode.qvel[:, list(speeds)])


def _told(order: Sequence[int]) -> Callable[[Episode], Episode]:
    return lambda episode: replace(episode, ctrl=episode.ctrl[:, list(order)], enabled=episode.enabled[:, list(order)])


def _commands_at(model: mujoco.MjModel, columns: Columns, joint: str) -> list[int]:
    """The columns of ``ctrl`` that drive a joint; those of an actuator that takes several are none."""
    names, index = object_names(model, "actuator"), object_names(model, "joint").index(joint)
    there = {names[actuator] for actuator in drivers(model, index)}
    return [k for k, name in enumerate(columns.ctrl) if name in there]


def _in_turn(first: Callable[[Episode], Episode], then: Callable[[Episode], Episode]) -> Callable[[Episode], Episode]:
    return lambda episode: then(first(episode))


def _reversed(position: int, speed: int, commands: Sequence[int]) -> Callable[[Episode], Episode]:
    def again(episode: Episode) -> Episode:
        qpos, qvel, ctrl = episode.qpos.copy(), episode.qvel.copy(), episode.ctrl.copy()
        qpos[:, position] *= -1
        qvel[:, speed] *= -1
        ctrl[:, list(commands)] *= -1
        return replace(episode, qpos=qpos, qvel=qvel, ctrl=ctrl)

    return again
