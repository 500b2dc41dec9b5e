"""What tests compare two environments by."""

import numpy as np

from sb3_rpto.effects.model_numbers import numbers


def fields(env):
    """All numbers of its model, copied."""
    return {name: value.copy() for name, value in numbers(env.unwrapped.model).items()}


def assert_same(one, other):
    """Answers of two environments to as many steps."""
    for a, b in zip(one, other, strict=True):
        np.testing.assert_equal(a, b)
