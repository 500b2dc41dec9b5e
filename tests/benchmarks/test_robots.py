"""Traces of gymnasium's robots at random actions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.tracing.robots import CAUSES, KINDS, NOTHING, ROBOTS, Job, fits, make_target, run
from benchmarks.tracing.targets import GUSTS
from sb3_rpto.effects import Declared, Effect


def planted(job: Job) -> list[Effect]:
    """What is in the target."""
    return make_target(job)[1]


def test_what_is_put_in_follows_from_the_seed_and_is_a_share_of_the_motors() -> None:
    effects = planted(Job("InvertedPendulum-v5", "coulomb_friction"))
    assert [e.label for e in effects[:-1]] == ["pole.length", "pole.mass"]
    assert effects[-1].label == "coulomb_friction(slider)"
    assert effects[-1].values == pytest.approx([30.0])  # a tenth of 3 units of command at a gear of 100
    again, other = (planted(Job("InvertedPendulum-v5", "coulomb_friction", seed)) for seed in (0, 1))
    assert [e.values.tolist() for e in effects] == [e.values.tolist() for e in again]
    assert effects[0].values != other[0].values
    for declared, nominal in zip(effects[:-1], planted(Job("InvertedPendulum-v5", NOTHING))):
        assert isinstance(declared, Declared)
        assert 0.8 <= declared.values[0] / nominal.parameters[0].null <= 1.2


@pytest.mark.parametrize(
    ("kind", "value"),
    [("quadratic_drag", 0.1 * 300 / 25), ("command_gain", 0.8), ("command_delay", 0.02), ("torque_offset", 30.0)],
)
def test_sizes(kind: str, value: float) -> None:
    assert planted(Job("InvertedPendulum-v5", kind))[-1].values == pytest.approx([value])


def test_the_ground_is_softer_where_a_robot_touches_one() -> None:
    job = Job("Hopper-v5", "contact_softness")
    assert fits(job)
    assert planted(job)[-1].values == pytest.approx([0.5, 0.0])
    assert planted(job)[-1].label == "contact_softness(floor)"
    assert not fits(Job("Reacher-v5", "contact_softness"))
    assert fits(Job("Reacher-v5", NOTHING))


@pytest.mark.slow
def test_every_robot_and_kind_can_be_made_and_moves() -> None:
    for robot in ROBOTS:
        for kind in (kind for kind in CAUSES if fits(Job(robot, kind))):
            target, effects = make_target(Job(robot, kind))
            declared, rest = effects[: len(effects) - (kind in KINDS)], effects[len(effects) - (kind in KINDS) :]
            assert declared
            assert all(isinstance(e, Declared) for e in declared)
            assert [e.kind for e in rest] == [kind] * (kind in KINDS)
            target.reset(seed=0)
            assert np.isfinite(target.step(target.action_space.sample())[0]).all()


def test_gusts_push_at_a_motor_by_a_share_of_its_force() -> None:
    target, effects = make_target(Job("InvertedPendulum-v5", GUSTS))
    assert all(isinstance(e, Declared) for e in effects)
    target.reset(seed=0)
    pushes = []
    for _ in range(60):
        target.step(np.zeros(1, dtype=np.float32))
        pushes.append(target.unwrapped.data.qfrc_applied.copy())  # type: ignore[attr-defined]
    slider, hinge = np.abs(pushes).max(axis=0)
    assert slider == pytest.approx(30.0, rel=0.01)
    assert hinge == 0.0


@pytest.mark.slow
def test_what_is_put_in_is_found(tmp_path: Path) -> None:
    (row,) = run(Job("InvertedPendulum-v5", "coulomb_friction"), tmp_path)
    assert (row["verdict"], row["there"], row["named"], row["right"]) == ("explained", 1, 1, 1)
    assert row["declared_error_max"] < 1e-3
    assert np.isfinite(row["seconds"])
