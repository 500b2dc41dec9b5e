"""What an effect sees and moves: many simulations of one model side by side, or the one of an environment."""

from abc import ABC, abstractmethod

import mujoco
import numpy as np
from mujoco.batch import Batch

from sb3_rpto.cores import cores

#: Fields whose change asks for mj_setConst.
_DERIVING = frozenset(mujoco.MjModel._setconst_inputs)


#: A force range that limits nothing; MuJoCo's own largest number.
UNLIMITED = 1e10


def add(numbers: np.ndarray, amounts: np.ndarray) -> None:
    """Add, in place, to numbers of a model that are never negative; negative amounts take away, at most all."""
    numbers[:] = np.maximum(numbers + amounts, 0.0)


class SimulationBatch(ABC):
    """``n`` simulations of one model, as arrays whose first axis is the simulation.

    State arrays are live: what the physics moves shows in them. ``force`` and ``friction`` are collected from the
    effects in every substep, then written at once.

    :param model: the nominal model; its fields are never written through a :class:`MujocoBatch`
    :param n: number of simulations
    """

    qpos: np.ndarray  # (n, nq)
    qvel: np.ndarray  # (n, nv)
    ctrl: np.ndarray  # (n, nu)
    time: np.ndarray  # (n,)
    actuation: np.ndarray  # (n, nv), the actuators' generalised force at the last evaluate

    def __init__(self, model: mujoco.MjModel, n: int) -> None:
        self.model = model
        self.n = n
        self.force = np.zeros((n, model.nv))  # N·m or N, added to the generalised forces
        self.friction = np.zeros((n, model.nv))  # N·m or N, added to the level of dry friction
        self.pull = np.zeros((n, model.nbody, 3))  # N, at the bodies' centres of mass, in the world's frame
        self.pulls = False  # whether there was any since settle
        self.loss = np.zeros((n, model.nv))  # N·m or N, what motors do not give of their torques
        self.missed = np.zeros((n, model.nv))  # N·m or N, what reaches the joints less for it
        self.room = np.zeros((n, model.nactuator, 2))  # lowest and highest force of the actuators, in their units
        self._nominal: dict[str, np.ndarray] = {}
        self._base_friction: np.ndarray | None = None  # (n, nv), before the substep's own
        self._dry = np.zeros(model.nv, dtype=bool)  # joints whose friction has varied since settle
        self._base_range: np.ndarray | None = None  # (n, nactuator, 2), before the substep's own
        self._tight = np.zeros(model.nactuator, dtype=bool)  # actuators whose force was limited since settle
        self.forget()

    def forget(self) -> None:
        """Nothing acts in the substep to come, until effects say so."""
        self.force[:], self.pull[:], self.friction[:], self.loss[:], self.missed[:] = 0, 0, 0, 0, 0
        self.room[:] = -np.inf, np.inf
        if self._base_range is not None:  # what the simulator computes before they do is without it
            self.field("actuator_forcerange")[:, self._tight] = self._base_range[:, self._tight]

    def force_range(self, actuator: int) -> np.ndarray:
        """What the model, without :attr:`room`, lets an actuator give, (n, 2)."""
        ranges = self.field("actuator_forcerange") if self._base_range is None else self._base_range
        return ranges[:, actuator]

    @abstractmethod
    def _live(self, name: str) -> np.ndarray:
        """The (n, ...) live values of a model field."""

    def field(self, name: str) -> np.ndarray:
        """A model field's values for each simulation, (n, ...), to write to; ``"opt.gravity"`` for an option.

        :meth:`restore` brings the nominal values back.
        """
        if name not in self._nominal:
            self._nominal[name] = self._live(name)[:1].copy()
        return self._live(name)

    def written(self) -> dict[str, np.ndarray]:
        """Copies of the fields that were ever written, by name, (n, ...) each."""
        return {name: self._live(name).copy() for name in self._nominal}

    def restore(self) -> None:
        """Give every field that was written its nominal values again."""
        for name, values in self._nominal.items():
            self._live(name)[:] = values

    def settle(self) -> None:
        """Derive the constants that follow from the fields, and keep the level of dry friction."""
        if any(name in _DERIVING for name in self._nominal):
            self.derive()
        self._begin_to_act()

    def _begin_to_act(self) -> None:
        """No effect has acted yet: keep the level of dry friction before one does."""
        self._dry[:] = self._tight[:] = self.pulls = False
        self._base_friction = self._base_range = None
        if "dof_frictionloss" in self._nominal:
            self._base_friction = self._live("dof_frictionloss").copy()

    @abstractmethod
    def derive(self) -> None:
        """Derive the constants that follow from the fields (mj_setConst) in every simulation."""

    def rough(self, dof: int, where: np.ndarray | slice = slice(None)) -> None:
        """Make a joint ready for dry friction that holds: the stiffest constraint that the time step allows.

        MuJoCo's default lets a loaded joint creep at up to about a tenth of a radian a second. A joint whose model has
        dry friction already keeps the model's own constraint, so that a little more changes only a little.

        :param where: in which simulations, (n,)
        """
        self.field("dof_frictionloss")
        if self._nominal["dof_frictionloss"][0, dof] == 0:
            self.field("dof_solref")[where, dof] = (2 * self.model.opt.timestep, 1.0)
            self.field("dof_solimp")[where, dof] = (0.99, 0.99, 0.001, 0.5, 2.0)

    def commit(self) -> None:
        """Write the collected ``force``, ``pull``, ``friction`` and ``room`` to the physics."""
        self._applied()[:] = self.force
        if self.pulls or self.pull.any():
            self.pulls = True
            self._pulled()[:] = self.pull
        dry = self.friction.any(axis=0)
        if dry.any():
            if self._base_friction is None:
                self._base_friction = self.field("dof_frictionloss").copy()
            for dof in np.flatnonzero(dry & ~self._dry):
                self.rough(int(dof), self._base_friction[:, dof] == 0)  # some have what gives way, and keep it
            self._dry |= dry
        if self._dry.any() and self._base_friction is not None:
            np.maximum(self._base_friction + self.friction, 0.0, out=self._live("dof_frictionloss"))

        tight = np.isfinite(self.room).any(axis=(0, 2))
        if tight.any() and self._base_range is None:
            self._base_range = self.field("actuator_forcerange").copy()
            self._base_range[:, ~self.model.actuator_forcelimited.astype(bool)] = -UNLIMITED, UNLIMITED
        self._tight |= tight
        if self._base_range is not None:
            # MuJoCo's own limit: what feeds back the speed within a step sees it, as a force beside it would not.
            low, high = np.split(self._base_range[:, self._tight], 2, axis=2)
            self.field("actuator_forcelimited")[:, self._tight] = True
            self.field("actuator_forcerange")[:, self._tight] = np.clip(self.room[:, self._tight], low, high)

    @abstractmethod
    def evaluate(self) -> None:
        """Compute :attr:`actuation` for the present states and commands."""

    @abstractmethod
    def _applied(self) -> np.ndarray:
        """The (n, nv) live qfrc_applied."""

    @abstractmethod
    def _pulled(self) -> np.ndarray:
        """The (n, nbody, 3) live forces of xfrc_applied."""


class MujocoBatch(SimulationBatch):
    """``n`` simulations on the threads of a :class:`mujoco.batch.Batch`; 0: one for each of :func:`cores`."""

    def __init__(self, model: mujoco.MjModel, n: int, nthread: int = 0) -> None:
        super().__init__(model, n)
        self.engine = Batch(model, n, nthread or cores())
        self.qpos, self.qvel = self.engine.bind("qpos"), self.engine.bind("qvel")
        self.ctrl, self.time = self.engine.bind("ctrl"), self.engine.bind("time")
        self.actuation = self.engine.bind("qfrc_actuator")

    def _live(self, name: str) -> np.ndarray:
        return self.engine.expand(name)

    def settle_as(self, few: "MujocoBatch", kind: np.ndarray) -> None:
        """Take the fields of another batch that has settled, and the constants that follow from them.

        :param few: of the same model
        :param kind: which of its simulations each one here is like, (n,)
        """
        for name in few._nominal:
            self.field(name)[:] = few._live(name)[kind]
        for name in mujoco.MjModel._setconst_outputs:
            # Of both: what followed here from the numbers of a rollout before must go, too.
            if any(batch.engine.expanded(name) is not None for batch in (few, self)):
                self._live(name)[:] = few._live(name)[kind]
        self._begin_to_act()

    def derive(self) -> None:
        """As in :class:`SimulationBatch`; once for all simulations whose fields are alike, as many are in a fit."""
        written = [self._live(name).reshape(self.n, -1) for name in self._nominal if name in _DERIVING]
        if not written:
            return
        _, first, kind = np.unique(np.concatenate(written, axis=1), axis=0, return_index=True, return_inverse=True)
        self.engine.set_const(np.sort(first))
        for name in mujoco.MjModel._setconst_outputs:
            if self.engine.expanded(name) is not None:
                live = self._live(name)
                live[:] = live[first[kind.ravel()]]

    def evaluate(self) -> None:
        """As in :class:`SimulationBatch`."""
        self.engine.forward()

    def _applied(self) -> np.ndarray:
        return self.engine.bind("qfrc_applied")

    def _pulled(self) -> np.ndarray:
        return np.asarray(self.engine.bind("xfrc_applied")[:, :, :3])


class LiveSimulation(SimulationBatch):
    """The one simulation of an environment; writes go to its own model and data.

    :param data: the environment's data
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        super().__init__(model, 1)
        self.data = data
        self._numbers: dict[str, np.ndarray] = {}  # options that are plain numbers: written here, then to the model

    # Views are taken when asked for: a copy of this has those of its own data.

    @property
    def qpos(self) -> np.ndarray:  # type: ignore[override]
        """Positions, (1, nq), live."""
        return np.asarray(self.data.qpos[None])

    @property
    def qvel(self) -> np.ndarray:  # type: ignore[override]
        """Velocities, (1, nv), live."""
        return np.asarray(self.data.qvel[None])

    @property
    def ctrl(self) -> np.ndarray:  # type: ignore[override]
        """Commands, (1, nu), live."""
        return np.asarray(self.data.ctrl[None])

    @property
    def actuation(self) -> np.ndarray:  # type: ignore[override]
        """The actuators' generalised force at the last evaluate, (1, nv), live."""
        return np.asarray(self.data.qfrc_actuator[None])

    @property
    def time(self) -> np.ndarray:  # type: ignore[override]
        """Simulated time in s, (1,)."""
        return np.array([self.data.time])

    def _live(self, name: str) -> np.ndarray:
        owner = self.model.opt if name.startswith("opt.") else self.model
        values = getattr(owner, name.removeprefix("opt."))
        if not isinstance(values, np.ndarray):
            return self._numbers.setdefault(name, np.array([float(values)]))
        return values[None]

    def restore(self) -> None:
        """As in :class:`SimulationBatch`."""
        super().restore()
        self._write_numbers()

    def settle(self) -> None:
        """As in :class:`SimulationBatch`."""
        self._write_numbers()
        super().settle()

    def _write_numbers(self) -> None:
        for name, value in self._numbers.items():
            setattr(self.model.opt, name.removeprefix("opt."), value.item())

    def derive(self) -> None:
        """As in :class:`SimulationBatch`."""
        # mj_setConst writes the data at the reference pose: a scratch copy keeps the environment where it is.
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def evaluate(self) -> None:
        """As in :class:`SimulationBatch`."""
        mujoco.mj_forward(self.model, self.data)

    def _applied(self) -> np.ndarray:
        return self.data.qfrc_applied[None]

    def _pulled(self) -> np.ndarray:
        return self.data.xfrc_applied[None, :, :3]
