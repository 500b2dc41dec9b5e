"""A few kinds of effects, each at all its places, that account for the data: joints of a machine are built alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_rpto.tracing.concentrate import concentrated
from sb3_rpto.tracing.identify import Fit
from sb3_rpto.tracing.loss import FAR
from sb3_rpto.tracing.select import JOINT, TENTH, Model, Selector

#: So many of the nearest are led on.
NEAREST = 3
#: Most kinds that account for exact data together.
MOST = 3
#: A further one is looked for where the nearest lowers the cost to less than this share.
FURTHER = 0.8


def few_kinds(selector: Selector, effects: Sequence[int], base: Fit) -> Model | None:
    """The kinds that account for the data, if so few do: the simplest of the nearest that meets exact data.

    Each is looked at alone; of exact data the nearest is then looked at with each other one, and so on, as one kind may
    take up some of what another lacks while that is not there.

    :param selector: of the windows
    :param effects: indices of the candidates
    :param base: the declared parameters alone
    """
    train = selector.train
    kinds, chosen, fit = selector.by_kind(effects, apart=True), list[int](), base
    for _ in range(min(MOST if train.exact else 1, len(kinds))):
        fits = {}
        for (kind, driven), places in kinds.items():
            selector.say(0.0, f"{kind} at all places")
            together = [*chosen, *places]
            begun = train.fit(fit.values, selector.free(together), fit.starts, JOINT)
            fits[kind, driven] = together, begun
        nearest = {}
        for key in sorted(fits, key=lambda key: fits[key][1].cost)[:NEAREST]:
            together, begun = fits[key]
            nearest[key] = together, concentrated(train, begun, selector.free(together))
        for together, begun in sorted(nearest.values(), key=lambda found: len(selector.free(found[0]))):
            if np.median(begun.errors) < max(FAR, TENTH * np.median(base.errors)):  # else kinks are not all it lacks
                model = selector.led_on(selector.model(together, begun))
                if selector.met(model) if train.exact else not selector.far(model):
                    return model
        key, (together, begun) = min(nearest.items(), key=lambda found: found[1][1].cost)
        if not begun.cost < FURTHER * fit.cost:
            return None
        chosen, fit = together, begun
        del kinds[key]
    return None
