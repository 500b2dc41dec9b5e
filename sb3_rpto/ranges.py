"""What an argument may be: a rule for each name, looked at before anything expensive."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

#: More threads than any machine has cores: a slip, of which the system would run out.
MOST_THREADS = 1024


@dataclass(frozen=True)
class Rule:
    """What one argument may be.

    :param says: after "must"
    :param holds: whether a value is such a one
    :param refusal: what is said of another, with its ``name``, the ``value`` and what the rule ``says``
    """

    says: str
    holds: Callable[[Any], bool]
    refusal: str = "{name} must {says}, got {value}"

    def __or__(self, other: Rule) -> Rule:
        return Rule(f"{self.says}, or {other.says.removeprefix('be ')}", lambda x: self.holds(x) or other.holds(x))


def check(rules: Mapping[str, Rule], values: Mapping[str, Any]) -> None:
    """Refuse the first value that breaks its rule; names without a rule pass.

    :param rules: by the names of arguments
    :param values: by those names
    :raises ValueError: naming the argument, what it must be and what it is
    """
    for name, value in values.items():
        if name in rules and not rules[name].holds(value):
            raise ValueError(rules[name].refusal.format(name=name, value=_shown(value), says=rules[name].says))


def is_number(value: Any) -> bool:
    """Whether it is a finite real number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def is_integer(value: Any) -> bool:
    """Whether it is a whole number, by its type."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def whole(least: int, most: float = math.inf, says: str | None = None) -> Rule:
    """A whole number from ``least`` to ``most``."""
    usual = {0: "be an integer and not negative", 1: "be a positive integer"}.get(least, f"be an integer from {least}")
    bounded = usual if most == math.inf else f"be an integer from {least:,} to {most:,}"
    return Rule(says or bounded, lambda x: is_integer(x) and least <= x <= most)


def number(says: str, holds: Callable[[Any], bool] = lambda x: True) -> Rule:
    """A finite number with a property.

    :param says: after "must"
    :param holds: of a finite number
    """
    return Rule(says, lambda x: is_number(x) and holds(x))


def one_of(choices: Collection[Any]) -> Rule:
    """A choice, by its name."""
    known = list(choices)
    says = f"be one of {known}"
    refusal = "{name}={value} does not exist; choose one of " + str(known)
    return Rule(says, lambda x: (x is None or isinstance(x, str)) and x in known, refusal)


def of_type(says: str, *types: type) -> Rule:
    """An object of one of the types."""
    return Rule(says, lambda x: isinstance(x, types))


def _widths(value: Any) -> bool:
    sized = isinstance(value, Collection) and not isinstance(value, str | bytes | Mapping | set | frozenset)
    return sized and len(value) > 0 and all(is_integer(width) and width >= 1 for width in value)


NONE = Rule("be None", lambda x: x is None)
FLAG = Rule("be True or False", lambda x: isinstance(x, bool) or type(x).__name__ in ("bool", "bool_"))
POSITIVE = number("be a number above 0", lambda x: x > 0)
NOT_NEGATIVE = number("be a finite number and not negative", lambda x: x >= 0)
SHARE_BELOW_1 = number("lie in [0, 1)", lambda x: 0 <= x < 1)
MAPPING = of_type("be a dict", Mapping)
#: NumPy's generators take no others.
SEED = whole(0, 2**32 - 1)
THREADS = whole(0, MOST_THREADS, f"be a number of threads from 1 to {MOST_THREADS}, or 0 for one for each core")
#: Of hidden layers.
WIDTHS = Rule("be a list of positive integers, the width of each hidden layer", _widths)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
