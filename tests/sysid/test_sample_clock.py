"""Stamps that jitter, and samples that do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.data.sample_clock import settle_clock
from sb3_rpto.sysid.findings import FindingKind


def recorded(stamps: float, samples: float, noise: float = 3e-4, slow: float = 1.0, lost: int = 0) -> Measurements:
    """Two runs of a fast swing at 100 Hz: its stamps, or its samples, are off their ticks by these seconds."""
    tables = {}
    for run in range(2):
        rng = np.random.default_rng(run)
        ticks = np.delete(np.arange(800), np.arange(100, 100 + lost))
        even = 0.01 * ticks
        taken = even + samples * rng.standard_normal(len(even))
        time = (taken if samples else even) + stamps * rng.standard_normal(len(even))
        q = np.sin(2 * np.pi * slow * taken) + noise * rng.standard_normal(len(even))
        tables[f"run{run}"] = {"time": time, "qpos.hinge": q, "ctrl.motor": np.zeros(len(even))}
    return Measurements.from_tables(tables)


@pytest.mark.parametrize("simulated", [False, True])
@pytest.mark.parametrize("lost", [0, 2])
def test_stamps_that_jitter_give_way_to_an_even_clock(lost: int, simulated: bool) -> None:
    there = recorded(stamps=3e-4, samples=0.0, lost=lost)
    data, findings = settle_clock(replace(there, simulated=simulated))
    assert [f.kind for f in findings] == [FindingKind.EVEN_CLOCK] * 2
    assert not [f for f in data.findings if f.kind == FindingKind.JITTER]
    for e in data.episodes:
        ticks = np.round((e.time - e.time[0]) / 0.01)
        np.testing.assert_allclose(e.time, 0.01 * ticks + e.time[0], atol=1.2e-4)
        assert len(e) == 800 - lost


@pytest.mark.parametrize(
    ("stamps", "samples", "slow"),
    [
        pytest.param(0.0, 3e-4, 1.0, id="samples jitter"),
        pytest.param(0.0, 0.0, 1.0, id="nothing jitters"),
        pytest.param(3e-4, 0.0, 0.02, id="too slow to tell"),
    ],
)
def test_what_the_positions_do_not_speak_against_stays(stamps: float, samples: float, slow: float) -> None:
    there = recorded(stamps, samples, slow=slow)
    data, findings = settle_clock(there)
    assert data is there
    assert findings == []
