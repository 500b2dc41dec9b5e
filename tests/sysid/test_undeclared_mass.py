"""What speaks for a number that nobody declared, where recordings are not explained."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from simulated import PENDULUM, recorded

from benchmarks.tracing.planting import generate
from sb3_rpto.sysid import trace
from sb3_rpto.sysid.findings import FindingKind
from sb3_rpto.sysid.hypotheses.undeclared_mass import UndeclaredMass
from sb3_rpto.sysid.problem.problem import Inputs, prepare
from sb3_rpto.sysid.report.descriptions import VERDICTS, verdict
from sb3_rpto.sysid.selection.search import SearchResult, Selection, SelectorPair


@pytest.mark.parametrize(
    ("damping", "mass", "bodies"),
    [
        pytest.param(0.5, 0.5, [], marks=pytest.mark.slow, id="fitted anew"),
        pytest.param(0.05, 0.4, ["pole"], id="another mass"),
    ],
)
def test_a_mass_is_not_named_for_what_fitting_the_declared_numbers_does(
    damping: float, mass: float, bodies: list[str]
) -> None:
    xml = PENDULUM.replace('mass="0.5"', f'mass="{mass}"').replace('damping="0.05"', f'damping="{damping}"')
    task = prepare(Inputs(xml, recorded(), ["hinge.damping"], candidates=[], horizon=0.35, threads=1))
    on = SelectorPair.on(task, 0.35)
    fit = on.fine.train.fit(on.fine.simulation.null, on.fine.free(()), iterations=1)
    base = on.fine.fit_model((), fit)
    base = replace(base, fit=replace(base.fit, values=on.fine.simulation.null))  # not fitted as well as it may be
    result = SearchResult(on, base, None, None, Selection(base), None)  # type: ignore[arg-type]
    hints = UndeclaredMass().hints(task, result, None)  # type: ignore[arg-type]
    assert [hint.where for hint in hints] == bodies
    for hint in hints:
        assert float(hint.message.split()[1]) == pytest.approx(0.5 / mass, rel=0.02)


@pytest.mark.slow
def test_a_mass_that_was_not_declared_is_named_with_its_size() -> None:
    planted = generate("cartpole", None, seed=3, episodes=6, duration=3.0)
    light, times = 0.225, planted.truth.declared["pole.mass"] / 0.225
    xml, found = re.subn(
        r'mass="0.3" diaginertia="[^"]*"', f'mass="{light}" diaginertia="0.00675 0.00675 4.5e-05"', planted.xml
    )
    assert found == 1
    others = [name for name in planted.declared if name != "pole.mass"]
    report = trace(xml, planted.measurements, others, candidates=["coulomb_friction", "payload"])
    assert report.verdict == "unexplained"
    (hint,) = [finding for finding in report.findings if finding.kind == FindingKind.UNDECLARED_MASS]
    assert hint.where == "pole"
    assert float(hint.message.split()[1]) == pytest.approx(times, rel=0.02)
    assert "declare pole.mass" in hint.message
    assert trace(xml, planted.measurements, planted.declared, candidates=["coulomb_friction"]).verdict == "complete"


def test_candidates_that_the_model_has_no_place_for_are_named() -> None:
    kinds = ["wind", "spring", "wind"]
    task = prepare(Inputs(PENDULUM, recorded(), ["hinge.damping"], candidates=kinds, horizon=0.35, threads=1))
    assert [finding.where for finding in task.findings if finding.kind == FindingKind.NO_PLACE] == ["wind"]
    assert [effect.kind for effect in task.fine.effects] == ["declared", "spring"]


def test_where_nothing_was_looked_for_the_verdict_does_not_say_it_was() -> None:
    assert "no effects were looked for" in verdict("unexplained", searched=False)[0]
    assert verdict("unexplained", searched=True) == VERDICTS["unexplained"]
    assert verdict("complete", searched=False) == VERDICTS["complete"]
