"""What a run on a log says and leaves: the report as soon as there is one, checkpoints, what the policy earns."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_rpto.commands.policies import save_statistics
from sb3_rpto.commands.runs import CURVE, RunFolder, class_name
from sb3_rpto.commands.terminal import say
from sb3_rpto.files import write_text

if TYPE_CHECKING:
    from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop

#: Rows of a run; a checkpoint with each but the last.
COUNT = 8


class Progress(BaseCallback):
    """Writes the report before the policy learns, and now and then a checkpoint with a row of what the policy earns.

    The first checkpoint, at once, has no row: it holds what was traced.

    It is no learning curve: there is no target, and the policy is judged in the corrected simulator, where that may.

    :param run: whose folder
    :param total: source steps of the run
    :param rows: of the checkpoint that the run goes on from: steps, updates, seconds, simulated_return
    :param quiet: say the verdict alone
    """

    def __init__(self, run: RunFolder, total: int, rows: list[dict[str, Any]], quiet: bool) -> None:
        super().__init__()
        self.run, self.total, self.rows, self.quiet = run, total, rows, quiet
        self._before = rows[-1]["seconds"] if rows else 0.0
        self._since = time.perf_counter()

    def _on_training_start(self) -> None:
        loop = self.model.loop  # type: ignore[attr-defined]
        if loop.reports:  # else it goes on from a checkpoint, and the report is there
            loop.reports[0].save(self.run.path)
            verdict = loop.reports[0].verdict
            report = self.run.path / "report.html"
            say(verdict if self.quiet else f"{loop.reports[0]}\n\nwritten: {report}")

    def _on_step(self) -> bool:
        if self.n_calls == 1 and not self.rows and self.num_timesteps < self.total // COUNT:
            self.run.save_checkpoint(self.num_timesteps, self._write)
        taken = sum(self.num_timesteps >= self.total * n // COUNT for n in range(1, COUNT))
        if taken > len(self.rows) and self.num_timesteps < self.total:  # the last row is that of the end
            self._add_row()
            self.run.save_checkpoint(self.num_timesteps, self._write)
        return True

    def _on_training_end(self) -> None:
        self._add_row()

    def _add_row(self) -> None:
        model: Any = self.model
        self.rows.append(
            {
                "steps": self.num_timesteps,
                "updates": model.n_updates,
                "seconds": round(self._before + time.perf_counter() - self._since, 2),
                "simulated_return": float(model.loop.selection.best) if model.loop.simulator_validated else None,
            }
        )
        if not self.quiet:
            say(f"{self.num_timesteps:>9,} of {self.total:,} steps: {earnings(model.loop)}")

    def _write(self, folder: Path) -> None:
        self.model.save(folder / "model.zip")
        self.model.save_replay_buffer(folder / "replay_buffer.pkl")  # type: ignore[attr-defined]
        save_statistics(folder, self.model)
        state = {"class": class_name(self.model), "rows": self.rows}
        write_text(folder / CURVE, json.dumps(state))


def read_rows(checkpoint: Path) -> list[dict[str, Any]]:
    """The rows of a checkpoint."""
    return json.loads((checkpoint / CURVE).read_text(encoding="utf-8"))["rows"]


def earnings(loop: ClosedLoop) -> str:
    """What the best policy so far earns, where anything tells."""
    if not loop.simulator_validated:
        return "the simulator does not account for the log, so nothing tells what the policy is worth"
    return f"return {loop.selection.best:.1f} in the corrected simulator"
