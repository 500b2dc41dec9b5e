"""Where fits of an effect with a shape may start."""

import numpy as np
import pytest
from simulated import compiled, problem, recorded

from sb3_rpto.effects import declare
from sb3_rpto.effects.bodies import Payload
from sb3_rpto.effects.commands import CommandSaturation
from sb3_rpto.effects.effect import Parameter
from sb3_rpto.effects.forces import Spring, TorqueOffset, TorqueRipple
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector, rank_starts

#: the pole hangs from a cart, which is driven: mass and place of what hangs on the pole show apart
WITH_CART = """<mujoco><option timestep="0.005" integrator="RK4"/><worldbody><body name="cart">
<joint name="slider" type="slide" axis="1 0 0" damping="1"/><geom size=".05" mass="1"/>
<body name="pole"><joint name="hinge" axis="0 -1 0" damping="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="0.5" contype="0"/></body></body>
</worldbody><actuator><motor name="motor" joint="slider" gear="5"/></actuator></mujoco>"""


@pytest.mark.parametrize("turns", [3.0, 17.0, 40.0])
def test_of_all_counts_the_cogging_motors_own_is_among_those_that_are_tried(turns: float) -> None:
    model = compiled()
    data = recorded([TorqueRipple("hinge", cosine=0.05, sine=0.05, turns=turns)], episodes=3)
    on = problem([TorqueRipple("hinge"), *declare(model, ["hinge.damping"])], data, model)
    damping = np.array([3])
    tried = rank_starts(on, on.fit(on.null, damping, iterations=3), damping, [0], 3)[0]
    assert len(tried) == 3
    assert turns in [begin.values[2] for begin in tried]
    assert all((begin.values[:2] == 0).all() for begin in tried)
    assert [begin.fall for begin in tried] == sorted((begin.fall for begin in tried), reverse=True)


def test_few_starts_are_all_tried() -> None:
    on = problem([CommandSaturation("motor")], recorded(episodes=2))
    tried = rank_starts(on, on.score(on.null), [], [0], 3)[0]
    assert all(begin.fall == np.inf for begin in tried)  # beyond reach it does nothing, and promises nothing
    starts = np.concatenate([begin.values for begin in tried])
    np.testing.assert_allclose(starts, np.array([0.0, 0.6, 1.5, 3.0]) * on.size[0])


def test_shapes_without_starts_of_their_own_are_tried_over_their_range() -> None:
    bounded = Parameter("x", "", 0.2, lower=0.0, upper=6.0, null=2.0, shape=True)
    assert bounded.starts_for(0.2) == pytest.approx([0.5, 1.5, 2.5, 3.5, 4.5, 5.5])
    above = Parameter("x", "", 0.1, lower=0.05, null=0.3, shape=True)
    tried = above.starts_for(0.1)
    assert min(tried) > 0.05
    assert max(tried) == pytest.approx(3.0)
    free = Parameter("x", "", 1.0, shape=True).starts_for(0.5)
    assert sorted(free) == pytest.approx([-5.0, -1.5, -0.5, 0.5, 1.5, 5.0])
    assert Parameter("x", "", 1.0).starts_for(1.0) == []


def test_what_the_bounds_forbid_promises_nothing() -> None:
    """A spring is never negative: one that pushes away from its rest promises nothing about the rest that it has."""
    model = compiled()
    data = recorded([TorqueOffset("hinge", offset=0.3)], episodes=3)
    on = problem([Spring("hinge")], data, model)
    tried = rank_starts(on, on.score(on.null), [], [0], 3)[0]
    assert tried[0].values[1] > 0  # a torque to the positive side is a spring that rests far there
    assert tried[0].fall > 0


@pytest.mark.parametrize("along", [0.4, 1.4, 3.0])
def test_a_payload_is_found_wherever_it_sits_along_the_link(along: float) -> None:
    model = compiled(WITH_CART)
    data = recorded([Payload("pole", mass=0.2, along=along)], model, episodes=4, start=[0.2, 0.5])
    on = problem([Payload("pole")], data, model)
    selector = Selector(on)
    found = selector.add_effects(Selection(selector.fit_model((), on.score(on.null))), [0])
    np.testing.assert_allclose(found.model.fit.values, [0.2, along], rtol=0.05)


def test_a_ripple_of_another_count_is_found() -> None:
    data = recorded([TorqueRipple("hinge", cosine=0.05, sine=0.05, turns=14.0)], episodes=6)
    on = problem([TorqueRipple("hinge")], data)
    selector = Selector(on)
    found = selector.add_effects(Selection(selector.fit_model((), on.score(on.null))), [0])
    np.testing.assert_allclose(found.model.fit.values, [0.05, 0.05, 14.0], rtol=0.02)
