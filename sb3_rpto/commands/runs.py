"""A run's folder: what was asked, the newest checkpoint, the result. A killed run goes on where it was left."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_rpto.algorithms.transfer import TransferAlgorithm
from sb3_rpto.commands.policies import STATISTICS, save_statistics
from sb3_rpto.commands.terminal import lines
from sb3_rpto.evaluation.learning_curve import LearningCurve, MakeEnv
from sb3_rpto.files import digest, plain, write_json, write_text

if TYPE_CHECKING:
    from sb3_rpto.sysid import Report

#: In a checkpoint: the class of its model, and the rows until then.
CURVE = "curve.json"
PACKAGES = ("sb3-rpto", "stable-baselines3", "gymnasium", "torch", "numpy")


@dataclass(frozen=True)
class RunFolder:
    """Everything of one run. ``result.json`` is written last, so it is there when the run is finished.

    :param path: the folder
    :param lock: held while this process writes there
    """

    path: Path
    lock: FileLock | None = None

    @property
    def model(self) -> Path:
        """Zip of the model at the end."""
        return self.path / "model.zip"

    @property
    def replay_buffer(self) -> Path:
        """What it has learned from."""
        return self.path / "replay_buffer.pkl"

    @property
    def statistics(self) -> Path:
        """By which the model sees observations; only there where it does."""
        return self.path / STATISTICS

    @property
    def result(self) -> Path:
        """Configuration and learning curve."""
        return self.path / "result.json"

    @property
    def config(self) -> Path:
        """What was asked."""
        return self.path / "config.json"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    def begun(self) -> dict[str, Any] | None:
        """What was asked of the run that the folder holds; None where it holds none of ours."""
        try:
            found = json.loads(self.config.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) and "command" in found else None

    @classmethod
    def open(cls, path: Path, config: dict[str, Any]) -> RunFolder:
        """Begin a run, or go on with it.

        :param path: of the folder; it is made where it is not there
        :param config: all that decides the outcome, as JSON has it
        :raises ValueError: when the folder holds a run of another configuration, or what no run of ours wrote, or
            another process runs there
        """
        path.mkdir(parents=True, exist_ok=True)
        cls(path)._check_ours()
        run, asked = cls(path, _alone_in(path)), plain(config)
        begun = run.begun()
        if begun is None or (not run.result.exists() and run.newest_checkpoint() is None):
            write_json(run.config, asked)
            return run
        names = {*begun, *asked}
        changed = sorted(n for n in names if begun.get(n) != asked.get(n) and not _same_file(path, begun, asked, n))
        if changed:
            name = changed[0]
            raise ValueError(
                f"--out {path} holds a run with {name}={begun.get(name)!r}, not {asked.get(name)!r}; choose another "
                "folder, or repeat the command that began it to go on"
            )
        return run

    def _check_ours(self) -> None:
        if self.begun() is None:
            for kept in (self.config, self.model, self.statistics, self.replay_buffer, self.result, self.checkpoints):
                if kept.exists():
                    raise ValueError(
                        f"--out {self.path} holds a {kept.name} that no run of ours wrote; give another folder"
                    )

    def finish(self, rows: list[dict[str, Any]]) -> None:
        """Write the result and forget the checkpoints.

        :param rows: the learning curve
        """
        config = json.loads(self.config.read_text(encoding="utf-8"))
        versions = {package: version(package) for package in PACKAGES}
        write_json(self.result, {"config": config, "versions": versions, "rows": rows})
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def save_checkpoint(self, steps: int, write: Callable[[Path], None]) -> None:
        """Replace the checkpoint by a new one, as a whole: its folder gets its name when all files are in it.

        :param steps: taken so far
        :param write: writes its files into the folder that it is given
        """
        folder = self.checkpoints
        unfinished = folder / f".{steps:010d}.{os.getpid()}"
        for left in folder.glob(".[0-9]*"):  # of killed runs, which may have filled the disk
            shutil.rmtree(left)
        unfinished.mkdir(parents=True)
        try:
            write(unfinished)
        except (OSError, RuntimeError) as error:  # a full disk, by torch too: not fuller by half a checkpoint
            shutil.rmtree(unfinished, ignore_errors=True)
            raise OSError(f"{folder}: the checkpoint of step {steps:,} cannot be written: {error}") from error
        unfinished.rename(folder / f"{steps:010d}")
        for old in folder.iterdir():
            if old.name != f"{steps:010d}":
                shutil.rmtree(old)

    def newest_checkpoint(self) -> Path | None:
        """The folder of the last whole checkpoint."""
        found = sorted(path for path in self.checkpoints.glob("[0-9]*"))
        return found[-1] if found else None


def _alone_in(folder: Path) -> FileLock:
    """A lock that no other process gets while this one holds it; it ends with the process, however that ends."""
    lock = FileLock(folder / ".lock", is_singleton=True)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise ValueError(
            f"--out {folder}: another process runs there; wait until it ends, or give another folder"
        ) from error
    return lock


def beside(folder: Path, file: str | None) -> str | None:
    """The path of a file from a run's folder, which holds wherever the command is given."""
    return None if file is None else os.path.relpath(Path(file).resolve(), folder.resolve())


def statistics_asked(folder: Path, statistics: str | Literal[False] | None) -> dict[str, Any]:
    """The entries of a run's configuration for its source agent's statistics; none where there are none."""
    if not statistics:
        return {}
    return {"vec_normalize": beside(folder, statistics), "vec_normalize_sha256": digest(statistics)}


def _same_file(folder: Path, begun: dict[str, Any], asked: dict[str, Any], name: str) -> bool:
    """Whether a run was begun with the same file by a path from where its command was given."""
    before, now = begun.get(name), asked.get(name)
    if name not in ("source_model", "source_data", "vec_normalize") or before is None or now is None:
        return False
    return Path(before).resolve() == (folder / now).resolve()


class SavedCurve(LearningCurve):
    """A learning curve that tells its rows as they come and leaves a checkpoint after each.

    The last return is that of the model as the run leaves it, after the last updates. A checkpoint of ours is written
    at the step itself and resumes bit for bit. Of SB3's own algorithms it is written when the update that follows is
    over, before the next rollout. Where a loop is closed, the report of its last trace goes to the run's folder.

    :param run: whose checkpoints
    :param make_env: makes an evaluation environment
    :param every: steps between evaluations; the last is at the end, whatever it is
    :param total: steps of the run; after the last there is no checkpoint
    :param n_episodes: of an evaluation
    :param seed: of the evaluation's initial states
    :param after_update: as that of :class:`~sb3_rpto.evaluation.learning_curve.LearningCurve`
    :param until: return at which the run ends early
    :param resumable: whether to leave checkpoints
    :param say: told of each row in a line
    """

    def __init__(
        self,
        run: RunFolder,
        make_env: MakeEnv,
        every: int,
        total: int,
        n_episodes: int,
        seed: int,
        *,
        after_update: bool = False,
        until: float | None = None,
        resumable: bool = True,
        say: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(make_env, {*range(every, total, every), total}, n_episodes, seed, after_update=after_update)
        self.run, self.total, self.until, self.resumable, self.say = run, total, until, resumable, say
        #: the model that the newest row is of
        self.judged: Any = None
        self._unsaved = self._resumed = False

    def evaluate(self, model: Any, steps: int) -> None:
        """Add a row, and tell of it."""
        super().evaluate(model, steps)
        self.judged = model
        self._unsaved = self.resumable and 0 < steps < self.total
        if self.say is not None:
            row = self.rows[-1]
            left = (
                f", about {_duration(row['seconds'] * (self.total / steps - 1))} left" if 0 < steps < self.total else ""
            )
            self.say(f"{steps:>9,} of {self.total:,} steps: return {row['return']:.1f}{left}")

    def restore(self, folder: Path) -> None:
        """Go on with the rows of a checkpoint.

        :param folder: of the checkpoint
        """
        state = json.loads((folder / CURVE).read_text(encoding="utf-8"))
        self.rows, self.source_steps, self._due = state["rows"], state["source_steps"], state["due"]
        self._spent, self._updates_at_start = state["spent"], state["updates_at_start"]
        self._resumed = True
        if self.say is not None:
            self.say(f"going on from {folder}")

    def _waits(self, steps: int) -> bool:
        return self.after_update or steps == self.total

    def _init_callback(self) -> None:
        dynamics = getattr(self.model, "dynamics", None)
        if self.say is not None and dynamics is not None and dynamics.rollout == "branches" and not dynamics.fitted:
            self.say("the networks learn what the source does first, which may take minutes on a CPU")

    def _on_training_start(self) -> None:
        loop = getattr(self.model, "loop", None)
        if loop is not None:
            loop.on_report = self._report
            loop.progress = None if self.say is None else lines()  # a trace takes minutes
        if self._resumed:
            self._since = time.perf_counter()
        else:
            super()._on_training_start()

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if not isinstance(self.model, TransferAlgorithm):
            self._save()

    def _on_training_end(self) -> None:
        if self._due == self.total:
            self._due = self.num_timesteps
        super()._on_training_end()

    def _report(self, report: Report) -> None:
        """Write what a trace has found."""
        report.save(self.run.path)
        if self.say is not None:
            named = ", ".join(found.label for found in report.effects) or "nothing"
            page = self.run.path / "report.html"
            self.say(f"{self.num_timesteps:>9,} steps: {report.verdict}, {named} named; written: {page}")

    def _on_step(self) -> bool:
        if self._due == self.total:  # a rollout that goes on beyond: its update comes first
            return True
        super()._on_step()
        if isinstance(self.model, TransferAlgorithm):
            self._save()
        last = self.rows[-1]
        return self.until is None or last["steps"] < self.num_timesteps or last["return"] < self.until

    def _save(self) -> None:
        if not self._unsaved:
            return
        self._unsaved = False
        state = {
            "class": class_name(self.model),
            "rows": self.rows,
            "source_steps": self.source_steps,
            "due": self._due,
            "spent": self._spent + time.perf_counter() - self._since,
            "updates_at_start": self._updates_at_start,
        }

        def write(folder: Path) -> None:
            self.model.save(folder / "model.zip")
            if getattr(self.model, "replay_buffer", None) is not None:
                self.model.save_replay_buffer(folder / "replay_buffer.pkl")  # type: ignore[attr-defined]
            save_statistics(folder, self.model)
            write_text(folder / CURVE, json.dumps(state))

        self.run.save_checkpoint(self.num_timesteps, write)


def class_name(model: BaseAlgorithm) -> str:
    """By which :func:`algorithm_of` finds a model's class again."""
    return f"{type(model).__module__}:{type(model).__qualname__}"


def algorithm_of(folder: Path) -> type[BaseAlgorithm]:
    """The class of a checkpoint's model.

    :param folder: of the checkpoint
    """
    state = json.loads((folder / CURVE).read_text(encoding="utf-8"))
    module, _, name = state["class"].partition(":")
    return getattr(importlib.import_module(module), name)


def load_checkpoint(folder: Path, env: Any, device: str = "cpu", **worlds: Any) -> BaseAlgorithm:
    """The model of a checkpoint, with its replay buffers.

    :param folder: of the checkpoint
    :param env: SB3's environment
    :param device: to learn on
    :param worlds: ``target_env``, for an algorithm of ours
    """
    model = algorithm_of(folder).load(folder / "model.zip", env, device=device, **worlds)
    if (folder / "replay_buffer.pkl").is_file():
        model.load_replay_buffer(folder / "replay_buffer.pkl")  # type: ignore[attr-defined]
    return model


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
