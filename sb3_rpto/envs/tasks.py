"""The paper's tasks and targets, and those of the quick suite, as gymnasium ids; importing this needs no MuJoCo."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

if TYPE_CHECKING:
    from sb3_rpto.envs.shifts import EnvShift

#: Seeds of the random targets; the paper has four for each task.
TARGETS = (0, 1, 2, 3)


@dataclass(frozen=True)
class Task:
    """A source world, and what of it may be another in a target.

    :param entry_point: class of the environment
    :param kwargs: of its constructor
    :param lengths: of all links, as :func:`sb3_rpto.effects.declare` names them
    :param frictions: of everything that rubs
    :param gravity: empty where it does nothing
    :param ranges: of joints
    :param limb: lengths of the limbs that a limb shift scales
    :param levels: factors that are registered, by kind of shift, which is the name of a field above
    :param max_episode_steps: of an episode
    """

    entry_point: str
    lengths: tuple[str, ...] = ("*.length",)
    frictions: tuple[str, ...] = ("*.friction",)
    gravity: tuple[str, ...] = ("option.gravity",)
    ranges: tuple[str, ...] = ("*.range",)
    limb: tuple[str, ...] = ()
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    max_episode_steps: int = 1_000

    def numbers(self, kind: str) -> tuple[str, ...]:
        """Names of the numbers that a kind of shift scales.

        :param kind: ``gravity``, ``friction``, ``joint-range`` or ``limb``
        """
        return {"gravity": self.gravity, "friction": self.frictions, "joint-range": self.ranges, "limb": self.limb}[
            kind
        ]


_GYMNASIUM = "gymnasium.envs.mujoco"
_SCALES = (0.5, 2.0, 5.0)
_WALKER = {"gravity": _SCALES, "friction": _SCALES, "joint-range": (0.5,), "limb": (0.5, 2.0)}
_ROOMY = {**_WALKER, "joint-range": (0.5, 2.0)}  # twice the range leaves every joint within half a turn

TASKS: dict[str, Task] = {
    "Ant": Task(
        f"{_GYMNASIUM}.ant_v5:AntEnv",
        kwargs={"include_cfrc_ext_in_observation": False},  # 27 observations, as in MBPO
        limb=("aux_1.length", "body4.length", "aux_2.length", "body7.length"),  # the front legs
        levels=_ROOMY,
    ),
    "HalfCheetah": Task(f"{_GYMNASIUM}.half_cheetah_v5:HalfCheetahEnv", limb=("?thigh.length",), levels=_ROOMY),
    "Hopper": Task(f"{_GYMNASIUM}.hopper_v5:HopperEnv", limb=("foot.length",), levels=_WALKER),
    "Walker2d": Task(f"{_GYMNASIUM}.walker2d_v5:Walker2dEnv", limb=("foot.length", "foot_left.length"), levels=_WALKER),
    "Swimmer": Task(
        "sb3_rpto.envs.swimmer:Swimmer5Env",
        frictions=("option.viscosity", "option.density"),  # it touches nothing
        gravity=(),  # it moves in a horizontal plane
        limb=("back3.length",),
        levels={"friction": _SCALES, "joint-range": (0.5,), "limb": (0.5, 2.0)},
    ),
    "InvertedDoublePendulum": Task(
        f"{_GYMNASIUM}.inverted_double_pendulum_v5:InvertedDoublePendulumEnv",
        lengths=("pole.length", "pole2.length"),
        frictions=("*.damping",),  # it touches nothing
        ranges=(),
        limb=("pole2.length",),
        levels={"gravity": _SCALES, "friction": _SCALES, "limb": (2.0,)},  # half as long it ends below height 1
    ),
    "ContinuousCartPole": Task(
        "sb3_rpto.envs.cartpole:ContinuousCartPoleEnv",
        lengths=("pole_length",),
        frictions=(),  # there is none
        gravity=("gravity",),
        ranges=(),
        limb=("pole_length",),
        levels={"gravity": _SCALES, "limb": (0.5, 1.2, 2.0)},  # 1.2 and 2 are the paper's
        max_episode_steps=500,
    ),
}


def env_id(task: str, shift: str = "") -> str:
    """The gymnasium id of a source, or of a target by the name of its shift: ``rpto/Hopper-gravity-x0.5-v0``."""
    return f"rpto/{task}-{shift}-v0" if shift else f"rpto/{task}-v0"


def shift_names(task: str) -> list[str]:
    """Names of a task's registered shifts.

    :raises ValueError: an unknown task
    """
    scaled = [f"{kind}-x{factor:g}" for kind, factors in _task(task).levels.items() for factor in factors]
    return [*(f"target{seed}" for seed in TARGETS), *scaled]


def make_shift(task: str, name: str, env: gym.Env | None = None) -> EnvShift:
    """A task's shift by name, registered or not.

    - ``target<seed>``: every link length and every friction by its own factor from U(0.8, 1.2)
    - ``gravity-x<factor>``, ``friction-x<factor>``, ``joint-range-x<factor>``, ``limb-x<factor>``: all of them by one

    :param task: its name, one of :data:`TASKS`
    :param name: of the shift
    :param env: the task's source, if there is one already
    :raises ValueError: an unknown task, an unknown shift, or one that means nothing in this task
    """
    from sb3_rpto.envs.shifts import EnvShift

    known = _task(task)
    if found := re.fullmatch(r"target(\d+)", name):
        names = [*known.lengths, *known.frictions]
        return EnvShift.draw(env if env is not None else make(task), names, int(found[1]), name=name)
    if found := re.fullmatch(r"(gravity|friction|joint-range|limb)-x(\d+(?:\.\d+)?)", name):
        numbers = known.numbers(found[1])
        if not numbers:
            raise ValueError(f"shift={name!r} means nothing in {task}; registered are {', '.join(shift_names(task))}")
        return EnvShift(name, dict.fromkeys(numbers, float(found[2])))
    raise ValueError(f"shift={name!r} does not exist; registered for {task} are {', '.join(shift_names(task))}")


def make(task: str, shift: str | EnvShift | Mapping[str, Any] | None = None, **kwargs: Any) -> gym.Env:
    """What gymnasium calls to make an environment of ours.

    :param task: its name, one of :data:`TASKS`
    :param shift: of a target: by name (see :func:`make_shift`), or one's own
    :param kwargs: of the environment's constructor
    :raises ValueError: an unknown task or shift
    """
    known = _task(task)
    maker: Any = load_env_creator(known.entry_point)
    env: gym.Env = maker(**{**known.kwargs, **kwargs})
    if shift is None:
        return env
    from sb3_rpto.envs.shifts import as_shift

    return (make_shift(task, shift, env) if isinstance(shift, str) else as_shift(shift)).wrap(env)


def make_cartpole(**kwargs: Any) -> gym.Env:
    """As :func:`make`, for an environment that draws pictures only."""
    return make(**kwargs)


# What gymnasium.make looks up to offer windows and lists of pictures.
make.metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # type: ignore[attr-defined]
make_cartpole.metadata = {"render_modes": ["rgb_array"]}  # type: ignore[attr-defined]


def register_tasks() -> None:
    """Register every task and its targets with gymnasium."""
    for name, task in TASKS.items():
        maker = "make_cartpole" if name == "ContinuousCartPole" else "make"
        for shift in ("", *shift_names(name)):
            gym.register(
                env_id(name, shift),
                entry_point=f"{__name__}:{maker}",
                max_episode_steps=task.max_episode_steps,
                kwargs={"task": name, **({"shift": shift} if shift else {})},
            )


def _task(name: str) -> Task:
    if name not in TASKS:
        raise ValueError(f"task {name!r} does not exist; choose from {', '.join(TASKS)}")
    return TASKS[name]
