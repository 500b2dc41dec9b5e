"""Two quick methods with two seeds, for the tests of sweeps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.transfer import sources, sweep
from benchmarks.transfer.plan import Suite
from benchmarks.transfer.suites import SMOKE

PLACE = replace(SMOKE.places[0], variants=SMOKE.places[0].variants[:2])
SUITE = Suite("tiny", "for tests", (PLACE,), episodes=2)


def returns(results: list[dict[str, Any]]) -> dict[str, list[float]]:
    return {result["name"]: [row["return"] for row in result["rows"]] for result in results}


def stored(folder: Path) -> dict[str, list[float]]:
    return returns([json.loads(file.read_text()) for file in (folder / "runs").glob("*.json")])


def run_here(folder: Path) -> Path:
    """Run it in this process, source agent and oracle included."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(sources.FOLDER_VARIABLE, str(folder / "none"))
        sweep.run(SUITE, folder, workers=1)
    return folder
