"""A few kinds of effects, each at all its places: what meets exact data needs no others."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import PENDULUM, WITH_WHEEL, compiled, problem, recorded

from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.forces import Spring, TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction, QuadraticDrag, StribeckFriction, ViscousFriction
from sb3_rpto.sysid.selection import stepwise_selection
from sb3_rpto.sysid.selection.screening import screen
from sb3_rpto.sysid.selection.search import SelectorPair, select_effects, select_groups
from sb3_rpto.sysid.selection.stepwise_selection import Model, Selection, Selector

#: rad that count as noise of exact data
EXACT = 1e-6
CANDIDATES: list[Effect] = [
    StribeckFriction("hinge"),
    CoulombFriction("hinge"),
    TorqueOffset("hinge"),
    ViscousFriction("hinge"),
]
WITH_FOREARM = PENDULUM.replace(
    "</body>",
    """<body pos="0 0 -.5"><joint name="elbow" axis="0 -1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5"/></body></body>""",
)
STRIBECK, COULOMB, OFFSET, VISCOUS = range(4)


def selector(planted: list[Effect], exact: bool = True, candidates: list[Effect] = CANDIDATES) -> Selector:
    data = recorded(planted, noise=0.0 if exact else 1e-3, exact=exact)
    train = problem(candidates, data, noise=EXACT if exact else 1e-3)
    return Selector(train)


def base(s: Selector) -> Model:
    return s.fit_model((), s.train.score(s.train.null))


def few(s: Selector) -> Model | None:
    begun = base(s).fit
    return select_groups(s, screen(s.train, begun), begun)


@pytest.mark.parametrize(
    ("planted", "found"),
    [(CoulombFriction("hinge", level=0.08), COULOMB), (ViscousFriction("hinge", coefficient=0.03), VISCOUS)],
    ids=["friction", "damping"],
)
def test_the_simplest_kind_that_meets_exact_data_is_taken(planted: Effect, found: int) -> None:
    """Stribeck friction contains the other two, so it meets them as well."""
    s = selector([planted])
    model = few(s)
    assert model is not None
    assert model.effects == (found,)
    assert s.fits_exactly(model)
    assert model.fit.values[s.simulation.slices[found]] == pytest.approx(planted.values, rel=1e-4)


@pytest.mark.slow
def test_two_kinds_meet_what_neither_does_alone() -> None:
    s = selector([CoulombFriction("hinge", level=0.08), TorqueOffset("hinge", offset=0.1)])
    model = few(s)
    assert model is not None
    assert s.fits_exactly(model)
    assert model.effects == (COULOMB, OFFSET)
    s.settings = replace(s.settings, selection=replace(s.settings.selection, kinds_together=1))
    assert few(s) is None


def test_kinds_are_given_up_where_the_nearest_hardly_helps() -> None:
    s = selector(
        [QuadraticDrag("hinge", coefficient=0.02)], candidates=[TorqueOffset("hinge"), CoulombFriction("hinge")]
    )
    looked: list[str] = []
    s.say = lambda share, what: looked.append(what)
    assert few(s) is None
    assert looked == ["torque_offset at all places", "coulomb_friction at all places"]


def test_a_single_effect_that_meets_exact_data_ends_the_search_before_kinds_are_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    s = selector([CoulombFriction("hinge", level=0.08)])
    monkeypatch.setattr("sb3_rpto.sysid.selection.search.select_groups", None)
    begun = base(s)
    selection = select_effects(SelectorPair(s, s), begun, screen(s.train, begun.fit))
    assert selection.model.effects == (COULOMB,)


@pytest.mark.slow
def test_a_kind_that_meets_exact_data_ends_the_search_before_all_candidates_are_fitted_together() -> None:
    s = selector([CoulombFriction("hinge", level=0.08)])
    s.add_effects = lambda selection, *_, **__: selection  # type: ignore[method-assign]
    s.fit_together = None  # type: ignore[method-assign, assignment]
    begun = base(s)
    selection = select_effects(SelectorPair(s, s), begun, screen(s.train, begun.fit))
    assert selection.model.effects == (COULOMB,)


def test_noisy_data_are_never_met() -> None:
    s = selector([CoulombFriction("hinge", level=0.08)], exact=False)
    model = s.fit_model([COULOMB], base(s).fit)
    assert np.median(model.errors) < 2
    assert not s.fits_exactly(model)


def test_driven_joints_are_a_kind_apart() -> None:
    model = compiled(WITH_WHEEL)
    effects = [CoulombFriction("axle"), CoulombFriction("hinge"), TorqueOffset("axle")]
    s = Selector(problem(effects, recorded(model=model), model))
    assert list(s.group_by_kind([0, 1, 2], apart=True).values()) == [[0], [1], [2]]
    assert list(s.group_by_kind([0, 1, 2]).values()) == [[0, 1], [2]]


def test_an_offset_that_a_bent_spring_cancels_is_dropped() -> None:
    """-k (q - r) - k r is -k q: both meet the data, and the spring alone does from its own reference."""
    s = selector([Spring("hinge", stiffness=0.5)], candidates=[Spring("hinge"), TorqueOffset("hinge")])
    both = s.fit_model((0, 1), s.train.score(np.array([0.5, 0.4, -0.2])))
    assert s.fits_exactly(both)
    alone = s.eliminate(Selection(both)).model
    assert alone.effects == (0,)
    assert s.fits_exactly(alone)
    assert alone.fit.values == pytest.approx([0.5, 0.0, 0.0], abs=1e-5)


def test_a_kind_goes_as_a_whole_where_none_of_its_places_can_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it is with the six bent springs and five offsets of a HalfCheetah; here it is made so."""
    monkeypatch.setattr(stepwise_selection, "_bundles", lambda order, trifles, alone: [])
    planted: list[Effect] = [Spring("hinge", stiffness=0.5), Spring("elbow", stiffness=0.5)]
    candidates: list[Effect] = [Spring("hinge"), Spring("elbow"), TorqueOffset("hinge"), TorqueOffset("elbow")]
    model = compiled(WITH_FOREARM)
    train = problem(candidates, recorded(planted, noise=0.0, exact=True, model=model), model, noise=EXACT)
    s = Selector(train)
    every = s.fit_model((0, 1, 2, 3), s.train.score(np.array([0.5, 0.4, 0.5, -0.3, -0.2, 0.15])))
    assert s.fits_exactly(every)
    springs = s.eliminate(Selection(every)).model
    assert springs.effects == (0, 1)
    assert s.fits_exactly(springs)
    assert springs.fit.values == pytest.approx([0.5, 0, 0.5, 0, 0, 0], abs=1e-4)
