"""A few kinds of effects, each at all its places, that account for the data: joints of a machine are built alike."""

from __future__ import annotations

import numpy as np

from sb3_rpto.fitting.loss import FAR
from sb3_rpto.sysid.selection.screening import Screening, screen
from sb3_rpto.sysid.selection.stepwise_selection import JOINT, TENTH, Model, Selector
from sb3_rpto.sysid.shooting.multiple_shooting import Fit
from sb3_rpto.sysid.shooting.trimmed_refinement import concentrated

#: So many of the nearest are led on: dry friction may lie behind what holds it and more, and what gives way.
NEAREST = 4
#: Most kinds that account for exact data together.
MOST = 3
#: A further one is looked for where the nearest lowers the cost to less than this share.
FURTHER = 0.8
#: Beside the simplest whose cost is not so many times the lowest one.
LIKE = 2.0


def few_kinds(selector: Selector, screening: Screening, base: Fit) -> Model | None:
    """The kinds that account for the data, if so few do: the simplest of the nearest that meets exact data.

    Each is looked at alone; of exact data the simplest of the nearest is kept and looked at with each other one, and
    so on. Beside it others may show that did not before: longer legs, say, slip.

    :param selector: of the windows
    :param screening: of the candidates, beside the declared parameters alone
    :param base: those
    """
    train, effects = selector.train, selector.simulation.effects
    chosen, fit = list[int](), base
    for turn in range(MOST if train.exact else 1):
        screening = screen(train, fit) if turn else screening
        shown = [i for i, e in enumerate(effects) if not e.known and screening.excited(i) and i not in chosen]
        fits = []
        for (kind, _), places in selector.by_kind(shown, apart=True).items():
            selector.say(0.0, f"{kind} at all places")
            together = [*chosen, *places]
            fits.append((together, train.fit(fit.values, selector.free(together), fit.starts, JOINT)))
        nearest = sorted(fits, key=lambda found: found[1].cost)[:NEAREST]
        led = []
        for together, begun in sorted(nearest, key=lambda found: len(selector.free(found[0]))):
            begun = concentrated(train, begun, selector.free(together))
            if np.median(begun.errors) < max(FAR, TENTH * np.median(base.errors)):  # else kinks are not all it lacks
                model = selector.led_on(selector.model(together, begun))
                if selector.met(model) if train.exact else not selector.far(model):
                    return model
            led.append((together, begun))
        lowest = min([begun.cost for _, begun in led], default=np.inf)
        if not lowest < FURTHER * fit.cost:
            return None
        # What has many parameters takes up much of whatever is missing.
        near = [found for found in led if found[1].cost < min(LIKE * lowest, fit.cost)]
        chosen, fit = min(near, key=lambda found: len(selector.free(found[0])))
    return None
