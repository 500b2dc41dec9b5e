"""Which sets are generated and traced: a fixed fractional design of 215, of which the quick one is a part.

=============  =====  ==================================================================================================
group          cases  what is in the machine
=============  =====  ==================================================================================================
complete          40  nothing: five machines, noise of 1 and 5 mrad, also with jitter, a coarse encoder, no velocities
single           105  each of the 21 effects five times, on different machines: 63 sets with 1 mrad, 42 with 5 mrad
pair              20  two effects
outside           15  what no effect of the library can explain
not excited       10  an effect that the motion does not show
own classes       15  one effect, simulated by MuJoCo and the effect classes of the package rather than by NumPy
run zeros         10  encoders whose zeros differ from episode to episode, alone and beside an effect
=============  =====  ==================================================================================================
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.tracing.own import OWN, UNSEEN
from benchmarks.tracing.planting import KINDS, SYSTEMS, places

SCALES = ("quick", "full")
GROUPS = ("complete", "single", "pair", "outside", "not excited", "own classes", "run zeros")
RATE, EPISODES, DURATION = 250.0, 10, 4.0
"""Samples a second (each lasts two of the models' timesteps of 2 ms), episodes, and their length in s."""
LOW, HIGH = 1e-3, 5e-3
"""Noise of the positions in rad or m."""
ENCODER = 0.0015
"""Step of a coarse encoder in rad or m, about 12 bits a turn."""
ZEROS = 0.02
"""Standard deviation of the encoders' zeros over the episodes of the last group, in rad or m."""
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "jitter": {"jitter": 0.3},
    "encoder": {"quantum": ENCODER},
    "positions": {"velocity": False},
}
"""What may be wrong with the samples beside noise."""
PAIRS = (
    ("coulomb_friction", "command_delay"),
    ("torque_offset", "actuator_lag"),
    ("spring", "coulomb_friction"),
    ("payload", "command_deadband"),
    ("sensor_bias", "quadratic_drag"),
    ("armature", "stribeck_friction"),
    ("torque_ripple", "command_saturation"),
    ("load_friction", "torque_offset"),
    ("command_delay", "asymmetric_damping"),
    ("command_gain", "position_friction"),
)
_EVERY = {"complete": 12, "single": 14, "pair": 10, "outside": 8, "not excited": 6, "own classes": 8, "run zeros": 8}
_SEED = 50_000  # of sets that the tracer was not developed on


@dataclass(frozen=True)
class Case:
    """One generated set.

    :param id: unique, also a file name: group, effects, machine, noise, variant
    :param group: one of :data:`GROUPS`
    :param system: one of the planting's machines or a gymnasium id
    :param effects: kind and size of each effect; the size ``"own"`` or ``"unseen"`` stands for values written down
    :param seed: of the set, and of the split when it is traced
    :param planted_by: ``"numpy"`` (equations of its own) or ``"effects"`` (MuJoCo and the package's effect classes)
    :param noise: of the positions in rad or m
    :param jitter: of the sample times, as a fraction of their interval
    :param quantum: of the encoder in rad or m, 0 for none
    :param velocity: whether the velocity is recorded
    :param zeros: standard deviation of the encoders' zeros over the episodes in rad or m
    """

    id: str
    group: str
    system: str
    effects: tuple[tuple[str, str], ...]
    seed: int
    planted_by: str = "numpy"
    noise: float = LOW
    jitter: float = 0.0
    quantum: float = 0.0
    velocity: bool = True
    zeros: float = 0.0

    @property
    def name(self) -> str:
        """Of its result."""
        return self.id

    def to_json(self) -> dict[str, Any]:
        """All fields in types of JSON, those that came later only where they are set: older results stay."""
        found: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return found if self.zeros else {k: v for k, v in found.items() if k != "zeros"}


def design(scale: str) -> list[Case]:
    """The cases, always the same.

    :param scale: ``"full"`` (215) or ``"quick"`` (22 of them)
    :raises ValueError: another scale
    """
    if scale not in SCALES:
        raise ValueError(f"scale is {scale!r}; use one of {', '.join(SCALES)}")
    groups = [_complete(), _single(), _pairs(), _outside(), _not_excited(), _own(), _run_zeros()]
    if scale == "quick":
        groups = [cases[:: _EVERY[cases[0].group]] for cases in groups]
    return [case for cases in groups for case in cases]


def fingerprint(cases: Sequence[Case]) -> str:
    """SHA-256 of a design, so that two tables can be told to be of the same sets."""
    return hashlib.sha256(json.dumps([case.to_json() for case in cases]).encode()).hexdigest()


def _case(group: str, number: int, system: str, effects: Sequence[tuple[str, str]], **settings: Any) -> Case:
    variant = settings.pop("variant", "plain")
    noise = settings.setdefault("noise", LOW)
    planted = [kind if size in ("own", "unseen") else f"{kind}-{size}" for kind, size in effects]
    words = [group.replace(" ", "_"), *planted, system, f"{1e3 * noise:g}mrad"]
    words += [variant] if variant != "plain" else []
    if settings.get("planted_by") == "effects":
        words.append("effects")
    seed = _SEED + 1000 * GROUPS.index(group) + number
    return Case("-".join(words), group, system, tuple(effects), seed, **VARIANTS[variant], **settings)


def _complete() -> list[Case]:
    settings = [(v, noise, s) for v in VARIANTS for noise in (LOW, HIGH) for s in SYSTEMS]
    return [_case("complete", i, s, (), noise=noise, variant=v) for i, (v, noise, s) in enumerate(settings)]


def _eligible(*kinds: str) -> list[str]:
    return [name for name, system in SYSTEMS.items() if all(places(system, kind) for kind in kinds)]


def _single() -> list[Case]:
    """Each effect small and large at both noises, and once more with another kind of samples; machines take turns."""
    cases: list[Case] = []
    variants = list(VARIANTS)
    for k, kind in enumerate(k for k, plant in KINDS.items() if plant.library):
        systems = _eligible(kind)
        again = (("small", "large")[k % 2], LOW, variants[1 + k % 3])
        rounds = [(size, noise, "plain") for noise in (LOW, HIGH) for size in ("small", "large")] + [again]
        for i, (size, noise, variant) in enumerate(rounds):
            system = systems[(k + i) % len(systems)]
            cases.append(_case("single", len(cases), system, [(kind, size)], noise=noise, variant=variant))
    return cases


def _pairs() -> list[Case]:
    cases: list[Case] = []
    for i, pair in enumerate(PAIRS):
        systems = _eligible(*pair)
        for j, size in enumerate(("large", "small")):
            system, noise = systems[(i + 2 * j) % len(systems)], HIGH if len(cases) % 4 == 2 else LOW
            cases.append(_case("pair", len(cases), system, [(kind, size) for kind in pair], noise=noise))
    return cases


def _outside() -> list[Case]:
    cases: list[Case] = []
    for k, kind in enumerate(k for k, plant in KINDS.items() if not plant.library):
        systems = _eligible(kind)
        for i, size in enumerate(("small", "large", "large")):
            cases.append(_case("outside", len(cases), systems[(k + 2 * i) % len(systems)], [(kind, size)]))
    return cases


def _not_excited() -> list[Case]:
    """A motor's limit above all commands; and gentle motion, in which all is linear and nothing reaches a limit."""
    limits = [_case("not excited", i, s, [("command_saturation", "unseen")]) for i, s in enumerate(SYSTEMS)]
    gentle = [
        _case("not excited", len(limits) + i, p.machine, [(p.kind, "unseen")], planted_by="effects")
        for i, p in enumerate(UNSEEN)
    ]
    return limits + gentle


def _own() -> list[Case]:
    return [
        _case("own classes", i, p.machine, [(p.kind, "own")], planted_by="effects", noise=HIGH if i % 3 == 2 else LOW)
        for i, p in enumerate(OWN)
    ]


def _run_zeros() -> list[Case]:
    beside = ("coulomb_friction", "quadratic_drag", "stribeck_friction", "command_delay", "armature")
    planted: list[tuple[str, tuple[tuple[str, str], ...]]] = [(system, ()) for system in SYSTEMS]
    planted += [(system, ((kind, "large"),)) for system, kind in zip(SYSTEMS, beside)]
    return [_case("run zeros", i, system, effects, zeros=ZEROS) for i, (system, effects) in enumerate(planted)]
