"""A cart whose amplifier limits the commands of a few bursts; simulated without MuJoCo."""

from dataclasses import replace

import numpy as np
import pytest

from sb3_rpto.effects.commands import CommandSaturation
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.problem.problem import Inputs, prepare
from sb3_rpto.sysid.selection.search import SelectorPair, fit_declared
from sb3_rpto.sysid.selection.stepwise_selection import Model, Selection

MASS, DAMPING, GEAR, LIMIT, RATE, NOISE = 1.1, 0.6, 10.0, 0.5, 200, 1e-3
CART = f"""<mujoco><option timestep="0.005"/><worldbody><body name="cart">
<joint name="rail" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.05" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="rail" gear="{GEAR}"/></actuator></mujoco>"""


def driven(rng: np.random.Generator, burst: bool, duration: float = 2.5, steps: int = 10) -> dict[str, np.ndarray]:
    count, dt = round(duration * RATE), 1 / RATE / steps
    time = np.arange(count) / RATE
    sizes, rates, phases = rng.uniform(0.05, 0.2, 3), rng.uniform(0.3, 2.5, 3), rng.uniform(0, 6.3, 3)
    u = np.sin(2 * np.pi * np.outer(time, rates) + phases) @ sizes
    if burst:
        begin = rng.uniform(0.4, duration - 0.6)
        u += rng.choice([-0.9, 0.9]) * ((time > begin) & (time < begin + 0.3))
    x, v, seen = 0.0, 0.0, np.empty(count)
    for k in range(count):
        seen[k] = x
        for _ in range(steps):
            v += dt * (GEAR * np.clip(u[k], -LIMIT, LIMIT) - DAMPING * v) / MASS
            x += dt * v
    return {"time": time, "qpos.rail": seen + NOISE * rng.standard_normal(count), "ctrl.motor": u}


def add_effects() -> Model:
    rng = np.random.default_rng(1)
    data = Measurements.from_tables({f"run{i:02}": driven(rng, burst=i % 3 == 0) for i in range(12)})
    declared = ["rail.damping", "cart.mass"]
    task = prepare(Inputs(CART, data, declared, candidates=["command_saturation"], threads=1))
    selector = SelectorPair.on(task, task.length).rough
    base = selector.fit_model((), fit_declared(selector, 0))
    (limit,) = (i for i, e in enumerate(selector.simulation.effects) if not e.known)
    return selector.add_effects(Selection(base), [limit]).model


@pytest.mark.slow
def test_a_limit_that_few_commands_reach_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    damping, mass, inverse = add_effects().fit.values
    assert 1 / inverse == pytest.approx(LIMIT, rel=0.02)
    assert (damping, mass) == pytest.approx((DAMPING, MASS), rel=0.05)
    # From no limit at all a fit sees only the one where screening looks: too low, it costs more than it saves.
    monkeypatch.setattr(CommandSaturation, "parameters", (replace(CommandSaturation.parameters[0], starts=()),))
    assert add_effects().effects == ()
