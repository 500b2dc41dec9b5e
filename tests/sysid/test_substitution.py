"""Exchanges of effects that could stand for one another, on small problems with a known answer."""

import pytest
from simulated import compiled, problem, recorded, torques

from sb3_rpto.effects.commands import ActuatorLag, CommandDelay
from sb3_rpto.effects.effect import Effect
from sb3_rpto.effects.friction import CoulombFriction, SoftFriction, StribeckFriction, ViscousFriction
from sb3_rpto.sysid import trace
from sb3_rpto.sysid.selection.screening import screen
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector
from sb3_rpto.sysid.selection.substitution import Substitution


def test_substitution_replaces_a_wrong_effect_by_the_right_one() -> None:
    effects: list[Effect] = [CoulombFriction("hinge"), ViscousFriction("hinge")]
    planted = [CoulombFriction("hinge", level=0.08)]
    train, unseen = (problem(effects, recorded(planted, seed=seed)) for seed in (2, 102))
    s = Selector(train, unseen)
    nothing = train.score(train.null)
    wrong = s.fit_model([1], nothing, 12)
    found = Substitution(s, screen(train, nothing)).substitute(Selection(wrong))
    assert found.model.effects == (0,)
    assert found.alike[0] == []  # the wrong one is clearly worse, and so of no class with it


def test_what_does_as_well_is_of_the_class() -> None:
    """One pose of the motor tells no delay from a lag of the same few milliseconds."""
    effects: list[Effect] = [CommandDelay("motor"), ActuatorLag("motor")]
    planted = [ActuatorLag("motor", time_constant=0.004)]
    train, unseen = (problem(effects, recorded(planted, noise=5e-3, seed=seed)) for seed in (2, 102))
    s = Selector(train, unseen)
    nothing = train.score(train.null)
    found = Substitution(s, screen(train, nothing)).substitute(Selection(s.fit_model([0], nothing, 12)))
    (kept,) = found.model.effects
    assert found.alike[kept] == [1 - kept]


FOUR_BAR = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="crank"><joint name="a" axis="0 -1 0" damping=".02"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"
 mass=".3" contype="0" conaffinity="0"/><body name="coupler" pos="0 0 .3"><joint name="b" axis="0 -1 0" damping=".01"/>
 <geom type="capsule" fromto="0 0 0 .6 0 0" size=".02" mass=".4" contype="0" conaffinity="0"/></body></body>
<body name="rocker" pos=".6 0 0"><joint name="c" axis="0 -1 0" damping=".02"/><geom type="capsule" fromto="0 0 0 0 0 .3"
 size=".02" mass=".3" contype="0" conaffinity="0"/></body></worldbody>
<equality><connect body1="coupler" body2="rocker" anchor=".6 0 0" solref="0.004 1"
 solimp="0.99 0.999 0.0001"/></equality>
<actuator><position name="servo" joint="a" kp="20" kv="1"/></actuator></mujoco>"""


@pytest.mark.slow
def test_joints_of_a_linkage_that_turn_alike_are_one_class() -> None:
    """What is the likest to first order is far from what is, as friction has a kink."""
    commands = torques(4, 250, 1, size=0.9, rate=100)
    finely = compiled(FOUR_BAR.replace('"0.002"', '"0.0002"'))
    planted = [CoulombFriction("a", level=0.3)]
    data = recorded(planted, finely, start=[0, 0], rate=100, commands=commands, duration=2.5)
    report = trace(FOUR_BAR, data, candidates=["coulomb_friction"], threads=1)
    (named,) = report.effects
    assert {named.effect.on, *(label[-2] for label in named.alike)} == {"a", "b", "c"}


def test_exact_data_are_met_before_the_simpler_of_a_class_is_taken() -> None:
    """A Stribeck friction that has come near a Coulomb's path errs less than a Coulomb's first fit."""
    effects: list[Effect] = [CoulombFriction("hinge"), StribeckFriction("hinge")]
    data = recorded([CoulombFriction("hinge", level=0.08)], noise=0.0, exact=True)
    s = Selector(problem(effects, data, noise=1e-5))
    assert s.train.exact
    found = screen(s.train, s.fit_model((), s.train.score(s.train.null)).fit)
    assert found.alike(1) == [0]
    rich = s.refine(s.fit_model([1], s.train.fit(s.train.null, s.free([1]))))
    assert not s.model_error_dominates(rich)
    assert Substitution(s, found).prefer_simplest(rich, Selection(rich)).effects == (0,)


def test_of_two_that_meet_exact_data_the_one_that_errs_far_less_is_right() -> None:
    """A friction that gives way for a moment is a Coulomb's within the tolerance of exact data."""
    effects: list[Effect] = [CoulombFriction("hinge"), SoftFriction("hinge")]
    data = recorded([SoftFriction("hinge", level=0.08)], noise=0.0, exact=True)
    s = Selector(problem(effects, data, noise=4e-3))
    nothing = s.train.score(s.train.null)
    dry, soft = (s.refine(s.fit_model([i], nothing, 12)) for i in (0, 1))
    assert s.fits_exactly(dry)
    assert s.fits_exactly(soft)
    found = Substitution(s, screen(s.train, nothing)).substitute(Selection(dry))
    assert found.model.effects == (1,)
    assert found.alike[1] == [0]
    again = Substitution(s, screen(s.train, nothing)).substitute(Selection(soft))
    assert again.model.effects == (1,)


@pytest.mark.slow
def test_one_takes_the_place_of_two_where_its_first_fit_had_failed() -> None:
    """Beside one that can stand for one of the two the other is needless, which a bad fit of it alone would hide."""
    effects: list[Effect] = [CoulombFriction("hinge"), ViscousFriction("hinge"), StribeckFriction("hinge")]
    planted = [CoulombFriction("hinge", level=0.08)]
    train, unseen = (problem(effects, recorded(planted, noise=5e-3, seed=seed), noise=5e-3) for seed in (2, 102))
    s = Selector(train, unseen)
    nothing = train.score(train.null)
    both = s.fit_model([1, 2], nothing, 12)
    s._remembered((0,), nothing)  # as of a search that had ended elsewhere
    found = Substitution(s, screen(train, nothing)).merge(Selection(both, alike={1: [0]}))
    assert found.model.effects == (0,)
    assert found.model.fit.values[0] == pytest.approx(0.08, rel=0.05)


#: three links, of which a motor drives the first
LINK = """<body pos="0 0 -.3"><joint name="{0}" axis="0 -1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="{1}"/>"""
CHAIN = f"""<mujoco><option timestep="0.005" integrator="RK4"><flag contact="disable"/></option><worldbody>
{LINK.format("one", 0.4)}{LINK.format("two", 0.3)}{LINK.format("three", 0.2)}</body></body></body></worldbody>
<actuator><motor name="motor" joint="one"/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("kept", [(0, 1, 5), (3, 4, 5)])
def test_joints_are_built_alike(kept: tuple[int, ...]) -> None:
    """Dry friction at three joints: one odd kind is made like the others, three wrong ones are made right at once."""
    joints, model = ("one", "two", "three"), compiled(CHAIN)
    effects: list[Effect] = [kind(j) for kind in (CoulombFriction, ViscousFriction) for j in joints]
    there = [CoulombFriction(j, level=level) for j, level in zip(joints, (0.1, 0.06, 0.03))]
    data = recorded(there, model, noise=0.0, exact=True)
    s = Selector(problem(effects, data, noise=1e-5, model=model))
    found = screen(s.train, s.fit_model((), s.train.score(s.train.null)).fit)
    wrong = s.fit_model(kept, s.train.fit(s.train.null, s.free(kept)))
    if 0 in kept:
        assert Substitution(s, found).make_uniform(wrong, Selection(wrong)).effects == (0, 1, 2)
    else:
        assert Substitution(s, found).substitute(Selection(wrong)).model.effects == (0, 1, 2)
