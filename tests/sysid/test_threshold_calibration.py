"""The threshold of selection, measured on sets in which nothing is missing."""

import numpy as np
import pytest
from simulated import problem, recorded

from sb3_rpto.effects.forces import TorqueOffset
from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.sysid.selection import threshold_calibration
from sb3_rpto.sysid.selection.stepwise_selection import Selector
from sb3_rpto.sysid.selection.threshold_calibration import calibrate_threshold, threshold_of_set
from sb3_rpto.sysid.settings import DEFAULTS


def selector(level: float) -> Selector:
    planted = [CoulombFriction("hinge", level=level)] if level else []
    effects = [CoulombFriction("hinge"), TorqueOffset("hinge")]
    train, select = (problem(effects, recorded(planted, seed=seed)) for seed in (0, 100))
    return Selector(train, select)


def test_what_is_in_the_data_does_not_raise_the_threshold() -> None:
    """The sets are simulated from the declared model, so a planted effect must not raise what they need."""
    s = selector(0.08)
    base = s.fit_model((), s.train.score(s.train.null))
    everything = s.fit_model((0, 1), base.fit, 10)
    assert s.evidence(everything, base).t > 10
    assert threshold_of_set(s, base.fit, [0, 1], seed=1) < 5


def test_effects_in_what_judges_do_not_raise_the_threshold_either(monkeypatch: pytest.MonkeyPatch) -> None:
    s, made = selector(0.08), []
    monkeypatch.setattr(
        threshold_calibration, "least_threshold", lambda drawn, base, chosen: (made.append(drawn), 0.0)[1]
    )
    threshold_of_set(s, s.fit_model((), s.train.score(s.train.null)).fit, [0, 1], seed=1)
    (drawn,) = made
    for problem_, own in ((drawn.train, s.train), (drawn.select, s.select)):
        assert problem_ is not own
        # Friction is in none of it: the model without leaves no more than noise.
        assert np.median(problem_.score(problem_.null).errors) < 1.2 < np.median(own.score(own.null).errors)


@pytest.mark.slow
def test_the_threshold_is_a_quantile_of_the_sets_and_no_less_than_that_of_a_test(monkeypatch) -> None:
    s = selector(0.0)
    base = s.fit_model((), s.train.score(s.train.null)).fit
    ts = [threshold_of_set(s, base, [0, 1], seed) for seed in range(3, 6)]
    assert all(t >= 0 for t in ts)
    assert calibrate_threshold(s, base, [0, 1], 3, 3) == max(DEFAULTS.selection.threshold_far, np.quantile(ts, 0.95))
    monkeypatch.setattr(threshold_calibration, "threshold_of_set", lambda selector, base, chosen, seed: float(seed))
    assert calibrate_threshold(s, base, [0, 1], 3, 3) == pytest.approx(4.9)


def test_a_complete_set_is_the_models_own_motion_with_the_estimated_noise() -> None:
    s = selector(0.08)
    base = s.fit_model((), s.train.score(s.train.null)).fit
    one, other = (s.train.redrawn(base, np.random.default_rng(seed)).windows for seed in (0, 1))
    own = s.train.predict(np.tile(base.values, (len(one), 1)), base.starts, np.arange(len(one)))
    noise = np.stack([(w.measured - own) / w.sigma for w in (one, other)])
    assert noise.std(axis=(1, 2, 3)) == pytest.approx([1.0, 1.0], abs=0.1)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.1
