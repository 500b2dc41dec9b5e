"""Where fits of an effect with a shape may start."""

import numpy as np
import pytest
from simulated import compiled, problem, recorded

from sb3_rpto.effects import declare
from sb3_rpto.effects.commands import CommandSaturation
from sb3_rpto.effects.forces import TorqueRipple
from sb3_rpto.tracing.select import Selection, Selector
from sb3_rpto.tracing.shapes import TRIED, places_to_begin


@pytest.mark.parametrize("turns", [3.0, 17.0, 40.0])
def test_of_all_counts_the_cogging_motors_own_is_among_those_that_are_tried(turns: float) -> None:
    model = compiled()
    data = recorded([TorqueRipple("hinge", cosine=0.05, sine=0.05, turns=turns)], episodes=3)
    on = problem([TorqueRipple("hinge"), *declare(model, ["hinge.damping"])], data, model)
    damping = np.array([3])
    tried = places_to_begin(on, on.fit(on.null, damping, iterations=3), damping, 0)
    assert len(tried) == TRIED
    assert turns in [values[2] for values in tried]
    assert all((values[:2] == 0).all() for values in tried)


def test_few_starts_are_all_tried() -> None:
    on = problem([CommandSaturation("motor")], recorded(episodes=2))
    tried = places_to_begin(on, on.score(on.null), [], 0)
    np.testing.assert_allclose(np.concatenate(tried), np.array([0.0, 0.6, 1.5, 3.0]) * on.size[0])


def test_a_ripple_of_another_count_is_found() -> None:
    data = recorded([TorqueRipple("hinge", cosine=0.05, sine=0.05, turns=14.0)], episodes=6)
    on = problem([TorqueRipple("hinge")], data)
    selector = Selector(on, None, 3.5, lambda share, what: None)
    found = selector.look_forward(Selection(selector.model((), on.score(on.null))), [0])
    np.testing.assert_allclose(found.model.fit.values, [0.05, 0.05, 14.0], rtol=0.02)
