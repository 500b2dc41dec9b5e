"""Several policies side by side in one film, each in its world."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_rpto.commands.policies import Policy
from sb3_rpto.files import write_atomically

SUFFIXES = (".mp4", ".gif")
#: Pictures a second at most; a GIF has no more than 50.
FRAME_RATE = 30
_CAPTION, _GAP = 40, 4  # pixels: above a picture, and to its right


@dataclass(frozen=True)
class Panel:
    """A policy in a world.

    :param title: what the film calls it
    :param policy: that acts
    :param make_env: makes the world, which draws ``rgb_array``
    :param deterministic: whether it acts by its mean
    """

    title: str
    policy: Policy
    make_env: Callable[[], gym.Env]
    deterministic: bool = True


def require(path: Path) -> None:
    """Refuse what cannot be written, before anything is run.

    :param path: of the film
    :raises ValueError: for another suffix, or a folder that takes no files
    :raises ImportError: with the extra that is missing
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"--video {path}: a film is {' or '.join(SUFFIXES)}")
    made = next(folder for folder in path.absolute().parents if folder.exists())  # the others are made
    if not (made.is_dir() and os.access(made, os.W_OK)):
        raise ValueError(f"--video {path}: nothing can be written into {made}; give another folder")
    needed = ("imageio", "PIL", *(("imageio_ffmpeg",) if path.suffix == ".mp4" else ()))
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise ImportError(f"--video needs {', '.join(missing)}: pip install -e '.[video]' in the checkout")


def film(panels: Sequence[Panel], path: Path, seconds: float, seed: int) -> list[float]:
    """Draw an episode of each panel, in real time, and write the film; a panel stops where its episode ends.

    :param panels: from left to right
    :param path: .mp4 or .gif, replaced as a whole
    :param seconds: of simulated time, at most
    :param seed: of the resets: all start alike
    :return: the return of each within that time
    """
    import imageio.v2 as imageio

    scenes = [_Scene(panel, seed) for panel in panels]
    rate = scenes[0].rate
    stride = math.ceil(rate / FRAME_RATE)
    fps = rate / stride

    def write(file: Path) -> None:
        settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
        if path.suffix == ".mp4":
            settings = {"fps": fps, "macro_block_size": 2, "codec": "libx264"}
        writer: Any = imageio.get_writer(file, **settings)
        with writer:
            for frame in _frames(scenes, math.ceil(seconds * fps), stride):
                writer.append_data(frame)
            for _ in range(round(fps)):  # a second to look at the end
                writer.append_data(frame)

    try:
        write_atomically(path, write, suffix=path.suffix.removeprefix("."))
    finally:
        for scene in scenes:
            scene.env.close()
    return [scene.total for scene in scenes]


def _frames(scenes: Sequence[_Scene], n_frames: int, stride: int) -> Iterator[np.ndarray]:
    """The panels' pictures side by side."""
    for _ in range(n_frames):
        yield np.hstack([scene.picture() for scene in scenes])
        for scene in scenes:
            scene.advance(stride)
        if all(scene.over for scene in scenes):
            break
    yield np.hstack([scene.picture() for scene in scenes])


class _Scene:
    """An episode under way."""

    def __init__(self, panel: Panel, seed: int) -> None:
        self.panel = panel
        self.env = panel.make_env()
        self.observation, _ = self.env.reset(seed=seed)
        self.memory: Any = None  # of a recurrent policy
        self.total, self.steps, self.over = 0.0, 0, False

    @property
    def rate(self) -> float:
        """Steps a second."""
        inner: Any = self.env.unwrapped
        return float(1 / inner.dt if hasattr(inner, "dt") else inner.metadata.get("render_fps", FRAME_RATE))

    def advance(self, n_steps: int) -> None:
        """Act so often, or to the episode's end."""
        for _ in range(n_steps):
            if self.over:
                return
            action, self.memory = self.panel.policy.predict(
                self.observation, self.memory, deterministic=self.panel.deterministic
            )
            self.observation, reward, terminated, truncated, _ = self.env.step(action)
            self.total += float(reward)
            self.steps += 1
            self.over = terminated or truncated

    def picture(self) -> np.ndarray:
        """What the world draws, under a caption; height and width are even, as films need them."""
        from PIL import Image, ImageDraw, ImageFont

        drawn = Image.fromarray(np.asarray(self.env.render()))
        width, height = (size - size % 2 for size in drawn.size)
        page = Image.new("RGB", (width + _GAP, height + _CAPTION), "white")
        page.paste(drawn.crop((0, 0, width, height)), (0, _CAPTION))
        score = f"return {self.total:,.0f} after {self.steps:,} steps{', ended' if self.over else ''}"
        write = ImageDraw.Draw(page)
        for line, text in enumerate((self.panel.title, score)):
            write.text((6, 2 + line * _CAPTION // 2), text, fill="black", font=ImageFont.load_default(size=14))
        return np.asarray(page)
