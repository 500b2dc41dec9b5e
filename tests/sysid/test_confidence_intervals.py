"""The fit that is reported and its intervals, on simulated recordings whose truth is known."""

import numpy as np
import pytest
from simulated import problem, recorded

from sb3_rpto.effects.friction import CoulombFriction
from sb3_rpto.fitting.loss import Loss
from sb3_rpto.sysid.selection.confidence_intervals import fit_with_intervals
from sb3_rpto.sysid.selection.stepwise_selection import Selection, Selector


def test_intervals_are_as_wide_as_the_curvature_of_the_loss_says(monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem([CoulombFriction("hinge")], recorded([CoulombFriction("hinge", level=0.05)]))
    s = Selector(p, p)
    selection, widths = Selection(s.fit_model((0,), p.score(p.null))), []
    for curvature in (1.0, 0.5):
        monkeypatch.setattr(Loss, "curvature", lambda loss, r, by=curvature: by)
        values, intervals, correlation = fit_with_intervals(selection, p)
        assert correlation.tolist() == [[1.0]]
        assert values[0] == pytest.approx(0.05, rel=0.05)
        widths.append(np.diff(intervals[:, 0])[0])
    assert 0 < widths[0] < 0.05
    assert widths[1] == pytest.approx(2 * widths[0])
