"""The docs are true: their code runs, what they name exists, and every logged key is explained.

Blocks that begin with "```python run" are executed, those of one page in order and in one namespace. Budgets are
written with an underscore (20_000) there and are run as ``BUDGET`` steps.
"""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import ALGORITHMS, SMALL_POLICY, pendulum, small
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

from sb3_rpto import RPTO
from sb3_rpto.algorithms.closed_loop.controller import ClosedLoop
from sb3_rpto.callbacks import RelativityGapCallback
from sb3_rpto.dynamics.ensemble import EnsembleDynamics
from sb3_rpto.effects import LIBRARY, Parameter, declare, parameter_names
from sb3_rpto.effects.corrected_model_io import carried_by
from sb3_rpto.envs.corrected import apply_effects
from sb3_rpto.presets import preset_names, resolve_preset
from sb3_rpto.sysid import findings

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
BUDGET = "10"

by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def runnable(page: Path) -> list[str]:
    return re.findall(r"^```python run\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def prose(page: Path) -> str:
    """The page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=pytest.mark.slow if page.name == "tracing.md" else ())  # half a minute
        for page in PAGES
        if runnable(page)
    ],
)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(EnsembleDynamics.__init__.__kwdefaults__, "hidden", (16, 16))
    namespace = {"__name__": "__main__"}
    known = dict(LIBRARY)
    try:
        for block in runnable(page):
            exec(compile(re.sub(r"\b\d+(_\d{3})+\b", BUDGET, block), str(page), "exec"), namespace)
    finally:
        LIBRARY.clear()
        LIBRARY.update(known)


@by_page
def test_links_lead_somewhere(page):
    for target in re.findall(r"(?<!!)\[[^\]]+\]\(([^)]+)\)", prose(page)):
        if not target.startswith("http"):
            path, _, anchor = target.partition("#")
            linked = page.parent / path if path else page
            assert linked.exists(), target
            headings = re.findall(r"^#+ (.+)$", linked.read_text(), re.MULTILINE) if anchor else []
            slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert not anchor or anchor in slugs, target


@by_page
def test_what_is_named_exists(page):
    """``folder/file.py:name`` is defined in that file of the package or the benchmarks, ``test_name`` in the tests."""
    for path, name in re.findall(r"`([\w/]+\.py):([\w.]+)`", prose(page)):
        file = ROOT / ("" if path.startswith("benchmarks/") else "sb3_rpto") / path
        assert file.exists(), path
        source = file.read_text()
        for part in name.split("."):
            assert re.search(rf"^\s*(def|class) {part}\b|^\s*{part}\b.*=", source, re.MULTILINE), f"{path}:{name}"
    tests = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", prose(page)):
        assert f"def {name}(" in tests, name


def explained() -> set[str]:
    """The keys in the first column of the page's tables; ``<name>`` stands for any name."""
    rows = re.findall(r"^\| (`.+?`) \|", (ROOT / "docs" / "logged-keys.md").read_text(), re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`([^`]+)`", row)}


def logged(model, **kwargs) -> set[str]:
    """The keys of a run."""
    keys: set[str] = set()
    model.set_logger(configure(None, []))
    record = model.logger.record
    model.logger.record = lambda key, value, *args, **more: (keys.add(key), record(key, value, *args, **more))
    model.learn(**{"total_timesteps": 220, "source_timesteps": 210, "log_interval": 1, **kwargs})
    return keys


class Succeeds(gym.Wrapper):
    def step(self, action):
        *answer, info = super().step(action)
        return *answer, {**info, "is_success": True}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_every_logged_key_is_explained_and_every_explained_key_is_logged(monkeypatch):
    keys: set[str] = set()
    for cls in ALGORITHMS:
        evaluation = EvalCallback(Monitor(Succeeds(pendulum(12.0))), eval_freq=210, n_eval_episodes=1, verbose=0)
        callback = [evaluation, RelativityGapCallback(frequency=210)]
        keys |= logged(small(cls, target=Succeeds(pendulum(12.0)), use_sde=True, gradient_steps=1), callback=callback)
    cartpole = "rpto/ContinuousCartPole-v0"
    physical = {"dynamics": "physical", "declared": ["pole_length", "gravity"], "policy_kwargs": SMALL_POLICY}
    model = RPTO("MlpPolicy", cartpole, target_env=gym.make(cartpole, pole_length=2.0), gradient_steps=1, **physical)
    keys |= logged(model)
    monkeypatch.setattr(ClosedLoop, "settings", replace(ClosedLoop.settings, first_trace=80, fill_steps=25))
    double = "InvertedDoublePendulum-v5"
    target = apply_effects(gym.make(double), [LIBRARY["coulomb_friction"]("slider", level=5.0)])
    settings = {
        "declared": ["pole.length"],
        "close_loop": True,
        "effects": ["coulomb_friction"],
        "model_train_freq": 40,
        "retrain_steps": 25,
    }
    keys |= logged(small(RPTO, gym.make(double), target, dynamics="physical", weighting=None, **settings))
    names = {"gravity", "pole_length", "pole.length", "coulomb_friction(slider).level"}
    patterns = {key: re.escape(key).replace("<name>", f"({'|'.join(map(re.escape, names))})") for key in explained()}
    assert {key for key in keys if not any(re.fullmatch(p, key) for p in patterns.values())} == set()
    assert {key for key, p in patterns.items() if not any(re.fullmatch(p, k) for k in keys)} == set()


def test_the_preset_table_is_the_files():
    text = (ROOT / "docs" / "how-it-works.md").read_text()
    lines = re.findall(rf"^\| ((?:preset|{'|'.join(preset_names())}) \|.*)\|$", text, re.MULTILINE)
    header, *rows = [[cell.strip() for cell in line.split("|")] for line in lines]
    assert header[:2] == ["preset", "backend"]
    assert [row[:2] for row in rows] == [
        list(p) for p in product(preset_names(), ["real", "ensemble", "physical", "mujoco", "residual"])
    ]
    for preset, backend, *cells in rows:
        values = resolve_preset(preset, backend, None, ())
        values |= values.pop("dynamics_kwargs", {})
        for name, cell in zip(header[2:], cells):
            assert cell.replace(",", "") == str(values.get(name, "")), (preset, backend, name)


def table_after(page: str, header: str) -> list[str]:
    """The rows of the table with this header."""
    lines = (ROOT / "docs" / page).read_text().splitlines()
    start = lines.index(header) + 2
    return lines[start : next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))]


EFFECTS = (
    "| kind | place | parameters (null) | bounds | equation | held by | left out where declared | what excites it |"
)


def bounds(p: Parameter) -> str:
    """What values a parameter may have."""
    if p.own:
        assert (p.lower, p.upper) == (0, np.inf)
        return f"-`{p.own}` or more"
    if np.isinf(p.upper):
        return "any" if np.isinf(p.lower) else f"{p.lower:g} or more"
    low, high = (f"{'-' * (end < 0)}pi" if abs(end) == np.pi else f"{end:g}" for end in (p.lower, p.upper))
    return f"{low} to {high}"


def effect_rows() -> list[str]:
    """The rows of the table of effects, by place and then as the library lists them."""
    rows = []
    for place in ("joint", "actuator", "sensor", "body", "geom", "world"):
        for kind in (k for k in LIBRARY.values() if k.place == place):
            parameters = "; ".join(
                " ".join(f"`{p.name}` {p.unit} ({'from ' if p.shape else ''}{p.null:g})".split())
                for p in kind.parameters
            )
            native = f"`{kind.native}`" if carried_by(kind("anywhere")) == "mjcf" else "wrapper"
            same = ", ".join(f"`{name}`" for name in kind.same)
            limits = "; ".join(map(bounds, kind.parameters))
            cells = [f"`{kind.kind}`", place, parameters, limits, f"`{kind.equation}`", native, same, kind.excite]
            row = "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
            rows.append(row.replace("|  |", "| |"))
    return rows


def test_the_table_of_effects_is_the_library():
    assert table_after("effects.md", EFFECTS) == effect_rows()
    assert all(kind.native or carried_by(kind("anywhere")) == "wrapper" for kind in LIBRARY.values())


DECLARED = "| object | parameter | unit | bounds |"
ONE_OF_EACH = """<mujoco><option density="1" viscosity="1"/><worldbody><body name="body">
<joint name="joint" damping="1" frictionloss="1" armature="1" stiffness="1" range="-1 1"/>
<geom name="geom" type="capsule" fromto="0 0 0 1 0 0" size=".1"/></body></worldbody>
<actuator><position name="actuator" joint="joint" kp="1" timeconst="0.1"/></actuator></mujoco>"""


def declared_rows() -> list[str]:
    """The rows of the table of parameters that can be declared."""
    model = mujoco.MjModel.from_xml_string(ONE_OF_EACH)
    rows = []
    for name in parameter_names(model):
        owner, _, parameter = name.rpartition(".")
        (known,) = declare(model, [name])
        (p,) = known.parameters
        limits = bounds(p) if np.isinf(p.upper) else f"{p.lower / p.null:g} to {p.upper / p.null:g} times"
        rows.append(f"| {owner} | `{parameter}` | {p.unit} | {limits} |".replace("|  |", "| |"))
    return rows


def test_the_table_of_declared_parameters_is_what_can_be_declared():
    assert table_after("effects.md", DECLARED) == declared_rows()


def test_the_page_of_findings_is_what_the_code_says():
    assert (ROOT / "docs" / "findings.md").read_text() == f"{findings.page()}\n"
