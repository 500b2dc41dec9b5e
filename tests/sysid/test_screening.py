"""Screening: what the data could show, what looks alike, and what the declared parameters could take."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated import WITH_WHEEL, compiled, problem, recorded

from sb3_rpto.effects import declare
from sb3_rpto.effects.commands import ActuatorLag, CommandDeadband, CommandDelay, CommandGain, CommandSaturation
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction, QuadraticDrag, StribeckFriction, ViscousFriction
from sb3_rpto.sysid.data.measurements import Measurements
from sb3_rpto.sysid.selection.screening import Screening, _orthogonal, screen
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.multiple_shooting import Fit, Problem


def at_null(p: Problem) -> Fit:
    return p.score(p.null)


def screened(effects: list[Effect], data: Measurements, xml: str | None = None) -> tuple[Screening, Problem]:
    p = problem(effects, data, *([compiled(xml)] if xml else []))
    return screen(p, at_null(p)), p


def constant(episodes: int = 4, samples: int = 420) -> np.ndarray:
    return np.repeat(np.linspace(-1, 1, episodes)[:, None], samples, axis=1)


def test_what_delays_commands_is_not_excited_by_constant_ones() -> None:
    effects = [CommandDelay("motor"), ActuatorLag("motor"), CommandGain("motor"), CoulombFriction("hinge")]
    still, _ = screened(effects, recorded(commands=constant()))
    assert [still.excited(i) for i in range(4)] == [False, False, True, True]
    np.testing.assert_allclose(still.sensitivity[:2], 0, atol=1e-6)
    assert still.alike(0) == []
    varied, _ = screened(effects, recorded())
    assert all(varied.excited(i) for i in range(4))


def test_each_window_has_the_same_say_in_what_looks_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near an unstable pose one window tells a thousand times as much as others do, and there all grows alike."""
    p = problem([CoulombFriction("hinge"), ViscousFriction("hinge")], recorded())
    reduce = p.reduce

    def uneven(*args: Any) -> Any:
        found = reduce(*args)
        normal = np.tile(np.eye(2), (len(p.windows), 1, 1))
        normal[0] = 1e3 * np.array([[1.0, 0.999], [0.999, 1.0]])
        return replace(found, normal=normal)

    monkeypatch.setattr(p, "reduce", uneven)
    found = screen(p, at_null(p))
    assert found.cosine[0, 1] == pytest.approx(0.999 / len(p.windows), rel=0.1)
    assert found.alike(0) == []


def test_nothing_about_a_motor_that_gets_no_command_is_excited() -> None:
    effects = [CommandGain("motor"), CommandDeadband("motor"), CommandSaturation("motor"), CommandDelay("motor")]
    found, _ = screened(effects, recorded(commands=0 * constant()))
    assert not any(found.excited(i) for i in range(4))


def test_saturation_is_excited_only_by_commands_near_its_plausible_size() -> None:
    small, _ = screened([CommandSaturation("motor")], recorded(commands=0.3 * np.sign(constant())))
    assert not small.excited(0)
    large, _ = screened([CommandSaturation("motor")], recorded())
    assert large.excited(0)


def test_friction_of_a_joint_that_never_moves_is_not_excited() -> None:
    effects = [CoulombFriction("axle"), ViscousFriction("axle"), QuadraticDrag("axle"), CoulombFriction("hinge")]
    data = recorded(model=compiled(WITH_WHEEL))
    p = problem(effects, data, compiled(WITH_WHEEL))
    found = screen(p, at_null(p))
    assert [found.excited(i) for i in range(4)] == [False, False, False, True]


def test_coulomb_and_stribeck_friction_are_alike_and_so_are_lag_and_delay() -> None:
    effects = [
        CoulombFriction("hinge"),
        StribeckFriction("hinge"),
        CommandDelay("motor"),
        ActuatorLag("motor"),
        TorqueOffset("hinge"),
        QuadraticDrag("hinge"),
    ]
    found, _ = screened(effects, recorded(episodes=6))
    assert found.alike(0) == [1]
    assert found.alike(1) == [0]
    assert found.alike(2) == [3]
    assert found.alike(3) == [2]
    assert found.alike(4) == []
    np.testing.assert_array_equal(np.diag(found.cosine), 1)
    np.testing.assert_array_equal(found.cosine, found.cosine.T)
    assert np.all((found.cosine >= 0) & (found.cosine <= 1))


def test_of_what_is_alike_up_to_rounding_none_is_the_likest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a last digit would decide which of several that act alike is tried first."""
    p = problem([CoulombFriction("hinge"), ViscousFriction("hinge"), TorqueOffset("hinge")], recorded())
    reduce, solve, found = p.reduce, np.linalg.svd, []
    ones = np.tile(np.ones((3, 3)), (len(p.windows), 1, 1))
    monkeypatch.setattr(p, "reduce", lambda *args: replace(reduce(*args), normal=ones))
    for seed in range(4):
        digits = iter(1 + 1e-15 * np.random.default_rng(seed).standard_normal(3))
        monkeypatch.setattr(np.linalg, "svd", lambda *a, digits=digits, **k: solve(*a, **k) * next(digits))
        found.append(screen(p, at_null(p)).cosine)
    np.testing.assert_array_equal(found, np.ones((4, 3, 3)))


def test_what_is_not_excited_is_alike_to_nothing() -> None:
    cosine = np.array([[1, 0.99, 1], [0.99, 1, 0.5], [1, 0.5, 1]])
    found = Screening(np.array([9.0, 9.0, 1.0]), cosine, [None] * 3)
    assert found.excited(1)
    assert not found.excited(2)
    assert found.alike(0) == [1]
    assert found.alike(1) == [0]


def test_declared_damping_takes_viscous_friction_whole() -> None:
    data = recorded()
    effects = [ViscousFriction("hinge"), CoulombFriction("hinge")]
    free, _ = screened(effects, data)
    held, _ = screened([*effects, *declare(compiled(), ["hinge.damping"])], data)
    assert free.excited(0)
    assert held.sensitivity[0] < 0.02 * free.sensitivity[0]
    assert not held.excited(0)
    # Dry friction keeps what viscous friction cannot do.
    assert DEFAULTS.screening.excited < held.sensitivity[1] < free.sensitivity[1]
    assert held.sensitivity[2] == 0
    assert held.taken == [2, None, None]
    assert free.taken == [None, None]


def test_orthogonal_is_the_normal_matrix_of_what_a_projection_leaves() -> None:
    rng = np.random.default_rng(0)
    j = rng.standard_normal((40, 5))
    known = np.array([True, False, False, True, False])
    left = j[:, ~known] - j[:, known] @ np.linalg.lstsq(j[:, known], j[:, ~known])[0]
    np.testing.assert_allclose(_orthogonal(j.T @ j, known), left.T @ left, rtol=1e-6)
    np.testing.assert_array_equal(_orthogonal(j.T @ j, np.zeros(5, dtype=bool)), j.T @ j)


def test_a_declared_parameter_without_influence_hides_nothing() -> None:
    j = np.random.default_rng(0).standard_normal((40, 3))
    j[:, 0] = 0
    found = _orthogonal(j.T @ j, np.array([True, True, False]))
    rest = j[:, 2] - j[:, 1] * (j[:, 1] @ j[:, 2]) / (j[:, 1] @ j[:, 1])
    assert found[0, 0] == pytest.approx(rest @ rest)


def test_declared_parameters_of_which_none_has_influence_hide_nothing() -> None:
    j = np.random.default_rng(0).standard_normal((40, 2))
    j[:, 0] = 0
    found = _orthogonal(j.T @ j, np.array([True, False]))
    assert found[0, 0] == pytest.approx(j[:, 1] @ j[:, 1])


def test_sensitivity_is_the_size_of_the_influence_in_units_of_noise() -> None:
    data = recorded(noise=1e-3)
    coarse = problem([TorqueOffset("hinge")], data, noise=4e-3)
    fine, found = problem([TorqueOffset("hinge")], data, noise=1e-3), []
    for p in (fine, coarse):
        found.append(screen(p, at_null(p)).sensitivity[0])
    # Starts are less sure, too, so that it falls by no less than the noise rises.
    assert found[0] / found[1] == pytest.approx(4.0, rel=0.35)
    _, jt, _ = fine.linearise(fine.null, np.zeros((len(fine.windows), 2)), np.array([0]))
    assert 0 < found[0] <= np.sqrt(np.sum(jt**2))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("names", [(), ("motor.gear",), ("hinge.damping", "motor.gear")])
def test_what_nothing_moves_divides_nothing_by_zero(names: tuple[str, ...]) -> None:
    """Neither a joint at rest, nor a motor without commands, nor windows in which nothing happens at all."""
    effects: list[Effect] = [CoulombFriction("hinge"), ViscousFriction("hinge"), CommandGain("motor")]
    data = recorded(commands=0 * constant(), start=(0.0, 0.0))
    found, _ = screened([*effects, *declare(compiled(), names)], data)
    assert np.isfinite(found.sensitivity).all()
    assert np.isfinite(found.cosine).all()
    assert not found.excited(2)
    wheel = compiled(WITH_WHEEL)
    p = problem(
        [CoulombFriction("axle"), ViscousFriction("axle"), *declare(wheel, names)], recorded(model=wheel), wheel
    )
    found = screen(p, at_null(p))
    assert np.isfinite(found.cosine).all()
    assert not found.excited(0)
