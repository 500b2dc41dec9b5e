"""The suites of ``python -m benchmarks transfer``, as plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.transfer.ablation import FACTORS, cells
from benchmarks.transfer.plan import Place, Suite, Variant
from sb3_rpto.envs.tasks import TASKS, env_id
from sb3_rpto.presets import resolve_preset

# --- quick ----------------------------------------------------------------------------------------------------------

#: Networks of every learned model in the quick suite and the ablation. The default of 4 x 400 units takes eight times
#: as long to fit, most of a run.
NETWORKS = {"hidden": (128, 128, 128)}
#: 20 TRPO updates a stage in place of the published 800, which take half an hour.
SHORT_STAGES = {"iterations": 5, "policy_updates": 4}
QUICK_POINTS = (100, 250, 500, 1_000)
#: Expected seconds of a run on one core, measured on a busy machine: InvertedDoublePendulum, ContinuousCartPole.
SECONDS = {
    "zero-shot": (3, 1),
    "rpo": (75, 35),
    "rto-ensemble": (105, 75),
    "rto-physical": (90, 25),
    "rpto-ensemble": (115, 75),
    "rpto-physical": (150, 35),
    "rpto-physical-closed": (800, 0),
    "sac": (15, 5),
    "sac-warm": (20, 5),
    "sac-warm-high": (60, 20),
    "sac-mixed": (20, 6),
    "trpo-warm": (20, 10),
    "mbpo": (160, 75),
    "slbo": (250, 145),
    "ptp": (210, 115),
    "pdml": (160, 75),
    "sysid-retrain": (115, 45),
}


def _methods(declared: Sequence[str], learned: Mapping[str, Any]) -> dict[str, tuple[str, dict[str, Any]]]:
    """Every method of the registry but the oracle, with each backend: label -> method, settings.

    :param declared: names of the numbers that a physical model may fit
    :param learned: settings of all methods with a learned model
    """
    physical = {"dynamics": "physical", "declared": list(declared)}
    return {
        "zero-shot": ("zero-shot", {}),
        "rpo": ("rpo", {}),
        "rto-ensemble": ("rto", {"dynamics": "ensemble", **learned}),
        "rto-physical": ("rto", dict(physical)),
        "rpto-ensemble": ("rpto", {"dynamics": "ensemble", **learned}),
        "rpto-physical": ("rpto", dict(physical)),
        "sac": ("sac", {}),
        "sac-warm": ("sac-warm", {}),
        "sac-warm-high": ("sac-warm-high", {}),
        "sac-mixed": ("sac-mixed", {}),
        "trpo-warm": ("trpo-warm", {}),
        "mbpo": ("mbpo", dict(learned)),
        "slbo": ("slbo", {}),
        "ptp": ("ptp", dict(learned)),
        "pdml": ("pdml", dict(learned)),
        "sysid-retrain": ("sysid-retrain", {"declared": list(declared)}),
    }


def _quick_variants(task: str, declared: Sequence[str], known: Sequence[str] = ()) -> tuple[Variant, ...]:
    """The quick suite's methods.

    :param task: its name
    :param declared: what the target changes
    :param known: what the user of the closed loop declares; empty: there is no closed loop
    """
    methods = _methods(declared, {"dynamics_kwargs": NETWORKS})
    methods["slbo"][1].update(SHORT_STAGES)
    methods["sysid-retrain"][1].update({"retrain_steps": 10_000})
    if task == "ContinuousCartPole":
        methods["sac"][1].update(CARTPOLE_SAC)
    if known:
        closed = {"dynamics": "physical", "declared": list(known), "close_loop": True}
        methods["rpto-physical-closed"] = ("rpto", closed)
    place = 1 if task == "ContinuousCartPole" else 0
    often = ("rpo", "rto", "rpto", "sac-warm")
    return tuple(
        Variant(label, method, settings, 5 if method in often else 3, SECONDS[label][place])
        for label, (method, settings) in methods.items()
    )


#: What users declare who do not know that it is the damping that changes.
LENGTHS = ("pole.length", "pole2.length")
#: Arguments of SAC with which the cart-pole is learned within minutes.
CARTPOLE_SAC = {"policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 1e-3, "gamma": 0.98, "tau": 0.01}


def _small_places(cartpole: tuple[Variant, ...], pendulum: tuple[Variant, ...]) -> tuple[Place, ...]:
    """One target for each small task, chosen because source policies fail there as they are."""
    return (
        Place(
            "ContinuousCartPole",
            ("limb-x3.5",),
            cartpole,
            QUICK_POINTS,
            agent="rpto-ContinuousCartPole-v0",
            source_steps=20_000,
            source_settings=CARTPOLE_SAC,
            oracle_steps=30_000,
        ),
        Place(
            "InvertedDoublePendulum",
            ("friction-x20",),
            pendulum,
            QUICK_POINTS,
            agent="InvertedDoublePendulum-v5",
            source_steps=20_000,
            oracle_steps=30_000,
        ),
    )


QUICK = Suite(
    "quick",
    "two small tasks, one target each, all methods",
    _small_places(
        _quick_variants("ContinuousCartPole", ["pole_length"]),
        _quick_variants("InvertedDoublePendulum", ["*.damping"], known=LENGTHS),
    ),
)


# --- paper ----------------------------------------------------------------------------------------------------------

PAPER_TASKS = ("Ant", "HalfCheetah", "Hopper", "Walker2d", "Swimmer")
#: Target steps: of the author's run configuration.
PAPER_BUDGETS = {"Swimmer": 20_000}
#: Expected seconds before the first target step, and milliseconds of a target step, on one core: rough.
PAPER_COSTS = {
    "zero-shot": (5, 0),
    "rpo": (5, 20),
    "rto-ensemble": (200, 90),
    "rto-physical": (5, 150),
    "rpto-ensemble": (200, 95),
    "rpto-physical": (5, 220),
    "sac": (0, 11),
    "sac-warm": (0, 11),
    "sac-warm-high": (60, 100),
    "sac-mixed": (0, 12),
    "trpo-warm": (10, 2),
    "mbpo": (200, 220),
    "slbo": (60, 200),
    "ptp": (200, 900),
    "pdml": (200, 220),
    "sysid-retrain": (250, 1),
}


def _paper_place(task: str) -> Place:
    budget = PAPER_BUDGETS.get(task, 100_000)
    numbers = resolve_preset("paper", "ensemble", env_id(task), ())
    methods = _methods([*TASKS[task].lengths, *TASKS[task].frictions], {})
    for label in ("rpo", "rto-ensemble", "rpto-ensemble"):
        methods[label][1]["preset"] = "paper"
    # With SAC's two critics it would be sac-warm over again where the paper makes one update.
    methods["sac-warm-high"][1].update({"gradient_steps": numbers["gradient_steps"], "n_critics": 10})
    gamma = {"gamma": numbers["gamma"]} if "gamma" in numbers else {}
    methods["sac"][1].update(gamma)
    variants = [
        Variant(label, method, settings, 4, PAPER_COSTS[label][0] + budget * PAPER_COSTS[label][1] / 1_000)
        for label, (method, settings) in methods.items()
    ]
    return Place(
        task,
        tuple(f"target{i}" for i in range(4)),
        tuple(variants),
        tuple(p for p in (1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000) if p <= budget),
        agent="rpto-Swimmer-v0" if task == "Swimmer" else f"{task}-v5",  # the Swimmer has more links than gymnasium's
        source_steps=300_000,
        source_settings=gamma,
        oracle_steps=max(100_000, 2 * budget),
    )


PAPER = Suite("paper", "the paper's five tasks, four targets each", tuple(map(_paper_place, PAPER_TASKS)))


# --- ablation, smoke ------------------------------------------------------------------------------------------------

ABLATION = Suite(
    "ablation",
    f"{' x '.join(FACTORS)}: a third of all combinations, strictly matched",
    _small_places(
        *(
            tuple(
                Variant(
                    cell.label, cell.method, {**cell.settings, "dynamics_kwargs": NETWORKS}, 3, seconds, cell.factors
                )
                for cell in cells()
            )
            for seconds in (65.0, 110.0)
        )
    ),
    interactions=(("RPO", "updates"), ("weighting", "updates"), ("weighting", "fit every")),
)


def _many_updates(ensemble: float, alone: float) -> tuple[Variant, ...]:
    """20 updates a target step, as MBPO makes, where the default preset makes 5; seconds of a run on one core."""
    networks = {"dynamics": "ensemble", "dynamics_kwargs": NETWORKS}
    return (
        Variant("rpto-ensemble-20", "rpto", {**networks, "gradient_steps": 20}, 5, ensemble),
        Variant("sac-warm-20", "sac-warm-high", {"gradient_steps": 20}, 3, alone),
    )


RESIDUAL = Variant("rpto-residual", "rpto", {"dynamics": "residual", "declared": list(LENGTHS)}, 5, 400)
FURTHER = Suite(
    "further",
    "what quick leaves out: 20 updates a target step, with the learned model and without; the residual model",
    _small_places(_many_updates(200, 80), (*_many_updates(250, 200), RESIDUAL)),
)

_TINY = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 50}
SMOKE = Suite(
    "smoke",
    "three methods, 40 target steps: shows that it works",
    (
        Place(
            "ContinuousCartPole",
            ("limb-x2",),
            (
                Variant("zero-shot", "zero-shot", seeds=2, seconds=1),
                Variant("sac-warm", "sac-warm", seeds=2, seconds=1),
                Variant("rpto-physical", "rpto", {"dynamics": "physical", "declared": ["pole_length"]}, 2, 5),
            ),
            (20, 40),
            agent="tiny-ContinuousCartPole-v0",
            source_steps=300,
            source_settings=_TINY,
            oracle_steps=100,
        ),
    ),
    episodes=2,
)

SUITES = {suite.name: suite for suite in (QUICK, PAPER, ABLATION, FURTHER, SMOKE)}
