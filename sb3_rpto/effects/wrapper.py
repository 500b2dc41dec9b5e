"""Effects in an environment: what corrects a simulator, or shifts a target, while an agent learns in it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle, RecordConstructorArgs

from sb3_rpto.effects.batch import LiveSimulation
from sb3_rpto.effects.declared import Declared
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.model_numbers import numbers, set_number
from sb3_rpto.effects.sensors import SensorGain, ago, readers
from sb3_rpto.effects.simulation import Active, Push, prepare, pushing

# Where gymnasium's MujocoEnv steps its physics, and what an environment without that method may offer instead.
_SEAMS = ("_step_mujoco_simulation", "do_simulation")


def own(effects: Sequence[Effect], model: mujoco.MjModel) -> list[Effect]:
    """The same effects for ``model``, whose nominal values declared parameters start from.

    :param effects: left as they are
    :raises TypeError: no list of effects
    :raises ValueError: the model lacks an object that an effect sits on
    """
    mine: list[Effect] = []
    if isinstance(effects, Effect):
        raise TypeError(f"effects must be a list of effects, not one of them; write [{effects.label}]")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must hold effects, not {type(effect).__name__}; of a report take report.apply(env), or "
                "[found.effect for found in report.effects]"
            )
        if isinstance(effect, Declared):
            effect = Declared(model, effect.label, (-np.inf, np.inf)).with_values(effect.values)
        else:
            effect = copy.copy(effect)
        effect.bind(model)
        mine.append(effect)
    return mine


def active(effects: Sequence[Effect]) -> Active:
    """Effects that do something, each with its values, (1, p), as :class:`~sb3_rpto.effects.Simulation` picks them."""
    return [
        (e, e.values[None])
        for e in effects
        if e.known or isinstance(e, Declared) or any(v != p.null for p, v in zip(e.parameters, e.values) if not p.shape)
    ]


class CorrectedEnv(gym.Wrapper, RecordConstructorArgs):
    """A gymnasium MuJoCo environment with effects, exactly as :class:`~sb3_rpto.effects.Simulation` has them.

    Numbers of the model are written once, into the environment's own model: afterwards that environment **is** the
    corrected one. :func:`sb3_rpto.envs.corrected.apply_effects` corrects a copy instead. Forces and commands
    act in every substep, sensors in every observation; rewards and terminations that a task computes from its state see
    the true state. Without effects every step is the wrapped environment's, bit for bit.

    They come on top of the effects that ``env`` has already: numbers change from where those left them, forces add up,
    commands reach those after these, and these observe what those show.

    :param env: one whose innermost environment has MuJoCo's ``model`` and ``data`` and steps them by ``do_simulation``
    :param effects: those of the model's own numbers, forces, commands and sensors, with their values
    :raises ValueError: no MuJoCo environment; an effect on an object not in the model
    """

    #: what changes after it is made, for :func:`sb3_rpto.envs.env_snapshot.save_state`
    state_attributes: ClassVar[tuple[str, ...]] = ("_memory", "_past", "_time")

    def __init__(self, env: gym.Env, effects: Sequence[Effect]) -> None:
        RecordConstructorArgs.__init__(self, effects=effects)
        gym.Wrapper.__init__(self, env)
        base, self._seam = stepped_by(env)
        self._batch = LiveSimulation(base.model, base.data)
        self.effects: list[Effect] = []
        self._commanding: list[tuple[Effect, np.ndarray]] = []
        self._memory: list[dict[str, Any]] = []
        self._sensing: list[tuple[Effect, np.ndarray]] = []
        # States of the last substeps, the newest last: what late sensors show.
        self._past: list[tuple[np.ndarray, np.ndarray]] = []
        self._acting: list[tuple[Effect, np.ndarray]] = []
        self._time = 0.0  # of the simulation when it was last seen
        beneath = corrections(env)
        self._covered = False
        # What the environment was seen to use, and must: one for all, since the outermost simulates for the others.
        self._called: set[str] = beneath[0]._called if beneath else set()
        self._wanted: set[str] = set()
        self.set_effects(effects)
        for layer in beneath[:1]:
            layer._covered = True

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """Have these effects instead of the ones before; the simulation goes on from where it is.

        Delays and filters that act before and after remember their commands.

        :param effects: with their values, those of declared parameters too: what is not among them is nominal again
        :raises ValueError: an effect on an object that is not in the model, or on sensors that are read elsewhere than
            in ``_get_obs``; physics stepped by a method of the environment's own; a gain of a sensor that a servo reads
            and effects beneath change, or the other way round; other effects came on top of these; nothing is changed
            then
        """
        if self._covered:
            raise ValueError("other effects came on top of these; set those, or begin from an environment without")
        base: Any = self.unwrapped
        self._batch.restore()
        self._batch.settle()
        try:
            # Only now: what declared parameters start from is the model's own again.
            mine = own(effects, base.model)
            sensing = [effect.label for effect, _ in active(mine) if effect.senses]
            if sensing and not callable(getattr(base, "_get_obs", None)):
                raise ValueError(
                    f"{', '.join(sensing)}: {type(base).__name__} has no _get_obs(); read its sensors there"
                )
            self._require_whole_servos(mine)
            hooked = [e.label for e, _ in active(mine) if any(map(e.overrides, ("act", "command", "late")))]
            if hooked and getattr(type(base), _SEAMS[0], None) not in (None, MujocoEnv._step_mujoco_simulation):
                raise ValueError(
                    f"{', '.join(hooked)}: {type(base).__name__} has a {_SEAMS[0]}() of its own, in whose place these "
                    "would act; override do_simulation() instead, and call super() in it"
                )
        except Exception:
            prepare(self._batch, active(self.effects))
            raise
        self.effects, found = mine, active(mine)
        prepare(self._batch, found)
        memories = {effect.label: memory for (effect, _), memory in zip(self._commanding, self._memory)}
        self._acting = [pair for pair in found if pair[0].overrides("act")]
        self._commanding = sorted((p for p in found if p[0].overrides("command")), key=lambda pair: pair[0].order)
        self._sensing = [pair for pair in found if pair[0].senses]
        self._memory = [memories.get(effect.label, {}) for effect, _ in self._commanding]
        stack = corrections(self)
        self._wanted = set()
        for seam, answer, wanted in (
            (self._seam, self._simulate, any(x._acting or x._commanding or _ages(x._sensing) for x in stack)),
            ("_get_obs", self._observe, any(layer._sensing for layer in stack)),
        ):
            vars(base).pop(seam, None)
            if wanted:
                setattr(base, seam, answer)
                self._wanted.add(seam)

    def _require_whole_servos(self, effects: Sequence[Effect]) -> None:
        """What a servo feeds back of its sensor is written once, with all that the sensor does."""
        model = self._batch.model
        beneath = [effect for layer in corrections(self)[1:] for effect, _ in layer._sensing]
        for effect, _ in active(effects):
            fed_back = effect.senses and effect.overrides("write") and readers(effect, model)
            others = [x for x in beneath if x.on == effect.on and x.overrides("write")] if fed_back else []
            if any(isinstance(x, SensorGain) for other in others for x in (effect, other)):
                raise ValueError(
                    f"{effect.label}: a servo regulates what this sensor shows, and {others[0].label} beneath changes "
                    "that already; put both into one list of effects"
                )

    @property
    def alters_observations(self) -> bool:
        """Whether sensors, of these effects or of those beneath, show something else than the state."""
        return any(layer._sensing for layer in corrections(self))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; commands from before it are forgotten.

        :raises ValueError: the environment's own reset writes numbers of the model that these effects have set
        """
        self._begin_anew()
        before = self._batch.written()
        begun = self.env.reset(seed=seed, options=options)
        lost = [name for name, values in self._batch.written().items() if not np.array_equal(values, before[name])]
        if lost:
            raise ValueError(
                f"reset() of {type(self.unwrapped).__name__} writes {', '.join(lost)} of its model, which the effects "
                "have set; let it leave them as they are"
            )
        self._time = float(self.unwrapped.data.time)  # type: ignore[attr-defined]
        return begun

    def _begin_anew(self) -> None:
        step = float(self._batch.model.opt.timestep)
        self._memory = [effect.memory_at_reset(x, step) for effect, x in self._commanding]
        self._past = []

    def _look_at_time(self) -> None:
        """Begin anew where a wrapper beneath, such as ``Autoreset``, has reset the simulation by itself."""
        time = float(self.unwrapped.data.time)  # type: ignore[attr-defined]
        if time < self._time:
            for layer in corrections(self):
                layer._begin_anew()
        self._time = time

    def forget_commands(self) -> None:
        """Go on as if the next command had been sent all along."""
        self._memory = [{} for _ in self._commanding]

    def render(self) -> Any:
        """The wrapped environment's picture.

        :raises RuntimeError: it is a copy, which draws none
        """
        if getattr(self.unwrapped, "mujoco_renderer", self) is None:
            raise RuntimeError(
                "a corrected copy draws no pictures; for those sb3_rpto.effects.walker_reset.StandingEnv(gym.make(..., "
                "render_mode='rgb_array'), effects)"
            )
        return self.env.render()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the wrapped environment.

        :raises ValueError: the environment steps or reads its simulation by other ways than do_simulation and _get_obs
        """
        if not self._covered:
            self._called.discard("_get_obs")  # that reset() reads by it says nothing of step()
        result = self.env.step(action)
        unused = sorted(self._wanted - self._called)
        if unused:
            raise ValueError(
                f"{type(self.unwrapped).__name__} does not use {' and '.join(unused)}, so its effects cannot act; "
                "step the physics by self.do_simulation(ctrl, self.frame_skip) and read it in self._get_obs()"
            )
        return result

    def _simulate(self, ctrl: np.ndarray, n_frames: int) -> None:
        """In place of MujocoEnv's own: the same, with the effects in every substep."""
        base: Any = self.unwrapped
        model, data = base.model, base.data
        self._called.add(self._seam)
        self._look_at_time()
        stack = corrections(self)
        acting = pushing([pair for layer in reversed(stack) for pair in layer._acting])
        commanding = [
            (*pair, earlier) for layer in stack for pair, earlier in zip(layer._commanding, layer._memory, strict=True)
        ]
        batch = LiveSimulation(model, data)  # whose restore takes back the substeps' own changes alone
        for effect, _ in acting:
            if effect.place == "joint":
                batch.rough(effect.dof)
        batch.settle()
        command, dt = np.array(ctrl, dtype=float), model.opt.timestep
        forces, pulls = data.qfrc_applied.copy(), data.xfrc_applied.copy()  # the environment's own
        ages = _ages([pair for layer in stack for pair in layer._sensing])
        kept = math.ceil(max(ages.values(), default=0.0) / dt) + 1
        if kept > 1 and not self._past:
            self._past = [(data.qpos.copy(), data.qvel.copy())]
        push = Push(batch, acting)
        for k in range(n_frames):
            sent = command.copy()
            for effect, x, earlier in commanding:
                sent[effect.ctrl] = effect.command(np.array([sent[effect.ctrl]]), x, earlier, dt)[0]
            data.ctrl[:] = sent
            if acting:
                push(begins=k == 0)
                data.qfrc_applied += forces
                if batch.pulls:
                    data.xfrc_applied[:, :3] += pulls[:, :3]
            mujoco.mj_step(model, data)
            if kept > 1:
                self._past = [*self._past[1 - kept :], (data.qpos.copy(), data.qvel.copy())]
        if acting:
            # What a later set_state computes must not depend on the substep before it.
            batch.restore()
            data.qfrc_applied[:], data.xfrc_applied[:] = forces, pulls
        mujoco.mj_rnePostConstraint(model, data)
        self._time = float(data.time)

    def _observe(self, *args: Any, **kwargs: Any) -> Any:
        """In place of the task's own ``_get_obs``: the same, of what the sensors show."""
        self._called.add("_get_obs")
        self._look_at_time()
        base: Any = self.unwrapped
        data = base.data
        qpos, qvel = data.qpos.copy(), data.qvel.copy()
        sensing = [pair for layer in reversed(corrections(self)) for pair in layer._sensing]
        for (adr, dof), delay in _ages(sensing).items() if self._past else ():
            q = np.array([[q[adr] for q, _ in self._past]])
            v = np.array([[v[dof] for _, v in self._past]])
            (data.qpos[adr],), (data.qvel[dof],) = ago(np.array([delay / base.model.opt.timestep]), q, v)
        for effect, x in sensing:
            q, v = effect.observe(np.array([data.qpos[effect.adr]]), np.array([data.qvel[effect.dof]]), x)
            data.qpos[effect.adr], data.qvel[effect.dof] = q[0], v[0]
        readings = data.sensordata.copy()
        try:
            if sensing and base.model.nsensor:
                data.sensordata += _errors(base.model, data, qpos, qvel)
            # A copy: observations may be views of the state.
            return copy.deepcopy(type(base)._get_obs(base, *args, **kwargs))
        finally:
            data.qpos[:], data.qvel[:], data.sensordata[:] = qpos, qvel, readings

    def __getstate__(self) -> dict[str, Any]:
        """What makes a new one, as gymnasium pickles MuJoCo tasks, and the numbers of its model; no state of it."""
        if not isinstance(self.unwrapped, EzPickle):
            raise TypeError(
                f"{type(self.unwrapped).__name__} is no EzPickle, so its pickle would hide what was written to its "
                "model; derive it from gymnasium.utils.EzPickle (envs.env_copy.copy_env copies it in one process)"
            )
        if self._covered:  # the outermost keeps the numbers for all
            return {"env": self.env, "effects": self.effects}
        self._batch.restore()
        self._batch.settle()
        try:
            model = copy.copy(self.unwrapped.model)  # type: ignore[attr-defined]
        finally:
            prepare(self._batch, active(self.effects))
        return {"env": self.env, "effects": self.effects, "model": model}

    def __setstate__(self, state: dict[str, Any]) -> None:
        env = with_numbers(state.pop("env"), state.pop("model", None))
        type(self).__init__(self, env, **state)


def with_numbers(env: gym.Env, model: mujoco.MjModel | None) -> gym.Env:
    """An environment that was made anew, with what had been written to its model since it was first made."""
    if model is None:
        return env
    base: Any = env.unwrapped
    mine = numbers(base.model)
    for name, value in numbers(model).items():
        if not np.array_equal(value, mine[name], equal_nan=True):
            set_number(base.model, name, list(range(value.size)), value.ravel().tolist())
    return env


def corrections(env: gym.Env) -> list[CorrectedEnv]:
    """The wrappers that put effects into ``env``, outermost first; each acts on top of those after it."""
    found: list[CorrectedEnv] = []
    while isinstance(env, gym.Wrapper):
        if isinstance(env, CorrectedEnv):
            found.append(env)
        env = env.env
    return found


def _ages(sensing: Active) -> dict[tuple[int, int], float]:
    """How late sensors are in s, by their joints' addresses in qpos and qvel; delays on one joint add up."""
    found: dict[tuple[int, int], float] = {}
    for effect, x in sensing:
        if effect.late(x)[0] > 0:
            place = effect.adr, effect.dof
            found[place] = found.get(place, 0.0) + float(effect.late(x)[0])
    return found


def _errors(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """What the model's own sensors of positions and velocities show more in the state of ``data`` than in another."""
    scratch, shown = mujoco.MjData(model), []
    mujoco.mj_copyData(scratch, model, data)
    for q, v in ((data.qpos, data.qvel), (qpos, qvel)):
        scratch.qpos[:], scratch.qvel[:] = q, v
        mujoco.mj_fwdPosition(model, scratch)
        mujoco.mj_sensorPos(model, scratch)
        mujoco.mj_fwdVelocity(model, scratch)
        mujoco.mj_sensorVel(model, scratch)
        shown.append(scratch.sensordata.copy())
    return shown[0] - shown[1]


def beyond_model(env: gym.Env) -> list[str]:
    """Labels of the effects in ``env`` that are no numbers of its model: forces, commands and sensors."""
    pairs = (pair for c in corrections(env) for pair in (*c._acting, *c._commanding, *c._sensing))
    return sorted({effect.label for effect, _ in pairs})


def stepped_by(env: gym.Env) -> tuple[Any, str]:
    """The innermost environment and the name of the method that steps its physics.

    :raises ValueError: it is none of gymnasium's MuJoCo environments, so effects have no place to act
    """
    base: Any = env.unwrapped
    seam = next((name for name in _SEAMS if callable(getattr(base, name, None))), None)
    mine = isinstance(getattr(base, "model", None), mujoco.MjModel) and isinstance(
        getattr(base, "data", None), mujoco.MjData
    )
    if seam is None or not mine:
        raise ValueError(
            f"{type(base).__name__} is no gymnasium MuJoCo environment; derive it from "
            "gymnasium.envs.mujoco.MujocoEnv, which has model, data and do_simulation"
        )
    return base, seam
