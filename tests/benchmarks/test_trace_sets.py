"""The sets of two studies: coarse encoders, and shapes planted over their range."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.runner import read_table
from benchmarks.tracing import encoders, shapes
from benchmarks.tracing.encoders import MACHINES, QUANTUM, SAMPLES, Job, recorded
from sb3_rpto.effects import LIBRARY
from sb3_rpto.sysid.findings import FindingKind


def report(verdict: str, *effects: tuple) -> SimpleNamespace:
    """What is judged: the verdict, and effects with the intervals and the class of each."""
    traced = [SimpleNamespace(effect=e, interval=np.array(interval), alike=alike) for e, interval, alike in effects]
    for t in traced:
        t.label = t.effect.label
    adequacy = SimpleNamespace(ratio=1.0)
    return SimpleNamespace(
        verdict=verdict, effects=traced, adequacy_before=adequacy, adequacy_after=adequacy, findings=[]
    )


def test_there_are_twenty_complete_and_twenty_single_sets_of_each_machine_and_kind_of_samples() -> None:
    sets = encoders.jobs()
    assert len({*sets}) == len(sets) == 40
    assert sum(job.lacking for job in sets) == 20
    assert {(job.machine, job.samples) for job in sets} == {(m, s) for m in MACHINES for s in SAMPLES}


@pytest.mark.parametrize("samples", SAMPLES)
def test_samples_are_as_their_name_says(samples: str) -> None:
    quantised, velocity, jitters = SAMPLES[samples]
    data = recorded(Job("servo", samples, lacking=True))
    steps = np.concatenate([e.qpos / QUANTUM for e in data.episodes])
    assert np.allclose(steps, np.round(steps), atol=1e-6) == quantised
    assert (FindingKind.MISSING_VELOCITY in {f.kind for f in data.findings}) == (not velocity)
    intervals = np.concatenate([np.diff(e.time) for e in data.episodes])
    assert (np.ptp(intervals) > 1e-4) == jitters
    assert intervals.mean() == pytest.approx(0.01, rel=0.01)
    again = recorded(Job("servo", samples, lacking=True))
    assert all((a.qpos == b.qpos).all() for a, b in zip(data.episodes, again.episodes))


def test_what_is_named_too_much_is_counted() -> None:
    friction, drag = (
        LIBRARY["coulomb_friction"]("hinge", level=0.1),
        LIBRARY["quadratic_drag"]("hinge", coefficient=0.2),
    )
    judged = encoders.judged
    assert judged(None, report("complete"))["right"]
    assert judged(None, report("explained", (drag, [[0], [1]], [])))["too_many"] == 1
    assert judged(friction, report("explained", (friction, [[0], [1]], [])))["right"]
    assert judged(friction, report("explained", (drag, [[0], [1]], [friction.label])))["right"]
    both = judged(friction, report("explained", (friction, [[0], [1]], []), (drag, [[0], [1]], [])))
    assert (both["too_many"], both["right"]) == (1, False)
    assert not judged(friction, report("complete"))["right"]


def test_a_shape_is_right_by_name_and_value() -> None:
    planted = LIBRARY["spring"]("hinge", stiffness=0.3, reference=2.0)
    near = planted.with_values(np.array([0.3, 1.9]))
    off = planted.with_values(np.array([0.3, 1.0]))
    narrow = [[0.29, 0.9], [0.31, 1.05]]
    assert shapes.judged(planted, report("explained", (near, narrow, [])))["right"]
    assert not shapes.judged(planted, report("explained", (off, narrow, [])))["right"]
    assert shapes.judged(planted, report("explained", (off, [[0.2, 0.5], [0.4, 2.5]], [])))["right"]
    assert not shapes.judged(planted, report("partly explained", (near, narrow, [])))["right"]


def test_shapes_are_planted_over_their_range_on_two_machines() -> None:
    sets = shapes.jobs()
    assert len({*sets}) == len(sets) == 200
    for job in sets:
        effect = job.effect()
        (shape,) = [v for p, v in zip(effect.parameters, effect.values) if p.name == shapes.SHAPES[job.kind][0]]
        assert shape == job.shape
        assert all(p.lower <= v <= p.upper for p, v in zip(effect.parameters, effect.values))


def test_a_study_of_traces_makes_one_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoders, "trace", lambda *_, **__: report("complete"))
    out = ["--runs", str(tmp_path), "--workers", "1", "--only", "^servo_(quantised|jittered)_0$"]
    assert encoders.main(out) == 0
    rows = read_table(tmp_path / "table.csv")
    assert [(row["samples"], row["verdict"], row["right"]) for row in rows] == [
        ("quantised", "complete", True),
        ("jittered", "complete", True),
    ]
    monkeypatch.setattr(encoders, "trace", lambda *_, **__: pytest.fail("it is there"))
    assert encoders.main(out) == 0
