"""Pictures of every task's source and one of its targets side by side, as in the paper's figure.

    MUJOCO_GL=egl python -m benchmarks transfer pictures [--target target3] [--out docs/images]

Writes ``target_<task>.png``, the source on the left, both in the same pose; a few seconds.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import mujoco
import numpy as np
from PIL import Image

from sb3_rpto.envs.tasks import TASKS, env_id, make_shift

WIDTH, HEIGHT = 320, 240
#: Joint angles in rad that show the links.
POSES = {
    "Ant": {f"ankle_{leg}": angle for leg, angle in zip(range(1, 5), (0.9, -0.9, -0.9, 0.9))},
    "HalfCheetah": {},
    "Hopper": {"rooty": 0.3, "thigh_joint": -0.1, "leg_joint": -0.6, "foot_joint": 0.4},
    "Walker2d": {
        "thigh_joint": -0.9,
        "leg_joint": -1.1,
        "foot_joint": -0.2,
        "thigh_left_joint": -0.1,
        "leg_left_joint": -0.2,
    },
    "Swimmer": {"motor1_rot": 0.7, "motor2_rot": -0.7, "motor3_rot": 0.7, "motor4_rot": -0.7},
    "InvertedDoublePendulum": {"hinge": 0.3, "hinge2": -0.5},
}
SIDE = {"elevation": -8.0, "azimuth": 90.0}
CAMERAS: dict[str, dict[str, Any]] = {
    "Ant": {"distance": 3.0, "elevation": -35.0},
    "HalfCheetah": {**SIDE, "distance": 2.2, "lookat": np.array((0.05, 0.0, 0.45))},
    "Hopper": {**SIDE, "distance": 2.8, "lookat": np.array((-0.1, 0.0, 0.65))},
    "Walker2d": {**SIDE, "distance": 2.9, "lookat": np.array((-0.2, 0.0, 0.75))},
    "Swimmer": {"distance": 6.5, "lookat": np.array((-0.7, 0.0, 0.0)), "elevation": -90.0, "azimuth": 90.0},
    "InvertedDoublePendulum": {**SIDE, "distance": 2.6, "lookat": np.array((0.0, 0.0, 0.5))},
}


def strike(base: Any, pose: dict[str, float]) -> None:
    """Put a simulation into a pose, with its lowest point on the floor where it can move up and down."""
    qpos = base.init_qpos.copy()
    for joint, angle in pose.items():
        qpos[base.model.joint(joint).qposadr] = angle
    base.set_state(qpos, 0 * base.init_qvel)
    names = [base.model.joint(i).name for i in range(base.model.njnt)]
    if "rootz" in names or "root" in names:
        moving = np.flatnonzero(base.model.geom_bodyid)
        floor = base.model.geom("floor").id
        gap = min(mujoco.mj_geomDistance(base.model, base.data, floor, int(g), 10.0, None) for g in moving)
        qpos[base.model.joint("rootz").qposadr[0] if "rootz" in names else 2] -= gap
        base.set_state(qpos, 0 * base.init_qvel)


def picture(task: str, shift: str = "") -> np.ndarray:
    """The environment in its pose, (HEIGHT, WIDTH, 3)."""
    kwargs: dict[str, Any] = {"render_mode": "rgb_array"}
    if task in CAMERAS:
        kwargs |= {"width": WIDTH, "height": HEIGHT, "default_camera_config": CAMERAS[task]}
    env = gym.make(env_id(task, shift), **kwargs)
    env.reset(seed=0)
    if task in POSES:
        strike(env.unwrapped, POSES[task])
    frame = np.asarray(env.render())
    env.close()
    return np.asarray(Image.fromarray(frame).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS))


def side_by_side(task: str, shift: str) -> Image.Image:
    """The source, a white line, and a target."""
    line = np.full((HEIGHT, 4, 3), 255, dtype=np.uint8)
    return Image.fromarray(np.concatenate([picture(task), line, picture(task, shift)], axis=1))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks transfer pictures", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--target", default="target0", help="name of a shift that every task has")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    asked = parser.parse_args(arguments)
    asked.out.mkdir(parents=True, exist_ok=True)
    for task in TASKS:
        path = asked.out / f"target_{task}.png"
        # Few colours suffice, and keep the files small.
        side_by_side(task, asked.target).quantize(96).save(path, optimize=True)
        print(f"{path}: the source, and\n{make_shift(task, asked.target)}")
