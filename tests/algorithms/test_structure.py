"""The package's structure: private names stay in their modules, imports go round in no circle, inheritance is flat."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from stable_baselines3 import SAC

import sb3_rpto
from sb3_rpto import RPTO

ROOT = Path(sb3_rpto.__file__).parent
#: What namedtuples offer in public.
NAMEDTUPLE = {"_replace", "_asdict", "_fields", "_make"}
#: What Stable-Baselines3, gymnasium, MuJoCo and torch have under no public name, and who reads it.
OF_OTHERS = {
    "algorithms.callback_adapters": {"_total_max_episodes", "_num_timesteps_at_start"},
    "algorithms.fast_update": {
        *("_backward_hooks", "_post_accumulate_grad_hooks"),
        *("_optimizer_step_pre_hooks", "_optimizer_step_post_hooks"),
    },
    "algorithms.normalisation": {"_wrap_env", "_last_obs", "_last_original_obs"},
    "algorithms.plain_sac": {"_n_updates", "_setup_model"},
    "algorithms.target_checks": {"_get_obs"},
    "baselines.domain_randomization": {"_n_updates"},
    "callbacks": {"_get_constructor_parameters"},
    "dynamics.env": {"_max_episode_steps"},
    "effects.model_numbers": {"_setconst_inputs", "_setconst_outputs"},
    "effects.walker_reset": {"_healthy_z_range"},
    "effects.batch": {"_setconst_inputs", "_setconst_outputs"},
    "effects.wrapper": {"_step_mujoco_simulation", "_get_obs"},
    "envs.env_copy": {"_np_random", "_np_random_seed"},
    "envs.env_snapshot": {"_np_random", "_np_random_seed", "_elapsed_steps"},
    "envs.step_fidelity": {"_get_obs"},
    "evaluation.learning_curve": {"_n_updates"},
    "sysid.findings": {"_value_"},
}


@cache
def modules() -> dict[str, ast.Module]:
    """The syntax tree of each module, by its name without the package's."""
    found = {}
    for file in sorted(ROOT.rglob("*.py")):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix("__init__").rstrip(".")
        found[name] = ast.parse(file.read_text(encoding="utf-8"))
    return found


def own_names(tree: ast.Module) -> set[str]:
    """Private names that the classes of a module define."""
    names: set[str] = set()
    for cls in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for node in ast.walk(cls):
            if isinstance(node, ast.FunctionDef):
                names.add(node.name)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                names.add(node.target.id)
            elif isinstance(node, ast.Assign):
                names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and _is_own(node.value):
                names.add(node.attr)
    return names


def _is_own(value: ast.expr) -> bool:
    """Whether an attribute is looked up in the object or the class itself."""
    if isinstance(value, ast.Call):
        return isinstance(value.func, ast.Name) and value.func.id == "super"
    return isinstance(value, ast.Name) and value.id in ("self", "cls")


def accesses(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Private attributes of other objects, and where."""
    allowed = own_names(tree) | NAMEDTUPLE
    for node in ast.walk(tree):
        private = isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.endswith("__")
        if private and not _is_own(node.value) and node.attr not in allowed:
            yield node.attr, f"{node.lineno}: {ast.unparse(node)}"


def imported(name: str, tree: ast.Module) -> Iterator[str]:
    """Modules of the package that a module imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "sb3_rpto":
            parent = node.module.removeprefix("sb3_rpto").removeprefix(".")
            for alias in node.names:
                child = f"{parent}.{alias.name}" if parent else alias.name
                yield child if child in modules() else parent
        elif isinstance(node, ast.Import):
            yield from (a.name.removeprefix("sb3_rpto.") for a in node.names if a.name.startswith("sb3_rpto."))


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Sets of modules of which each leads to each, by Tarjan's algorithm."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[set[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            members = set(stack[stack.index(node) :])
            del stack[stack.index(node) :]
            if len(members) > 1:
                found.append(members)

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def test_private_attributes_are_read_and_written_in_their_own_modules_alone() -> None:
    found = defaultdict(list)
    for name, tree in modules().items():
        for attribute, where in accesses(tree):
            if attribute not in OF_OTHERS.get(name, set()):
                found[name].append(where)
    assert not found


def test_imports_go_round_in_no_circle() -> None:
    graph = {name: set(imported(name, tree)) - {name} for name, tree in modules().items()}
    assert circles(graph) == []


def test_two_classes_stand_between_sac_and_rpto() -> None:
    between = RPTO.__mro__[1 : RPTO.__mro__.index(SAC)]
    assert [cls.__name__ for cls in between] == ["TransferAlgorithm", "TwoEnvSAC"]
