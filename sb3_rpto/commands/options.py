"""Arguments that several commands take: how they are read, and what is said of wrong ones."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


def add_common(parser: argparse.ArgumentParser, of_target: str = "") -> None:
    """Options of commands that train: how long, how often it is judged, the seed, the settings.

    :param parser: of the command
    :param of_target: what to call the steps
    """
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder of the run; it resumes there")
    parser.add_argument("--steps", metavar="N", type=int, help=f"{of_target}steps (default: those of the task)")
    parser.add_argument("--every", metavar="N", type=int, help="steps between evaluations (default: a tenth of all)")
    parser.add_argument("--episodes", metavar="N", type=int, default=10, help="of an evaluation (default: 10)")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="(default: 0)")
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        type=setting,
        action="append",
        default=[],
        help="an argument of the algorithm, its value in YAML: gradient_steps=5, declared=[pole_length]; repeatable",
    )
    parser.add_argument("--quiet", action="store_true", help="print the result alone")


def setting(text: str) -> tuple[str, Any]:
    """``gradient_steps=5`` -> ("gradient_steps", 5); numbers such as 1e-3 are numbers.

    :raises argparse.ArgumentTypeError: for a text of another form
    """
    import yaml

    name, given, value = text.partition("=")
    if not given or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: the value is no YAML") from error
    if isinstance(parsed, str):  # YAML 1.1 takes 1e-3 for text
        with contextlib.suppress(ValueError):
            parsed = float(parsed)
    return name, parsed


def check_positive(parsed: argparse.Namespace, *names: str) -> None:
    """Refuse numbers below 1; None stands for a default.

    :raises ValueError: naming the option
    """
    for name in names:
        value = getattr(parsed, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; give a number of at least 1")


def check_file(path: str | Path | None, argument: str) -> None:
    """Refuse a path at which there is no file.

    :raises FileNotFoundError: naming the argument
    """
    if path is not None and not Path(path).is_file():
        raise FileNotFoundError(f"{argument}: there is no file {str(path)!r}; check the path")


def check_names(given: Iterable[str], function: Callable[..., Any], beside: Iterable[str] = ()) -> None:
    """Refuse settings that a function does not take.

    :param given: names
    :param function: whose parameters they are
    :param beside: names that are good too
    :raises ValueError: naming the first wrong one, and what was perhaps meant
    """
    known = {*inspect.signature(function).parameters, *beside}
    for name in given:
        if name not in known:
            raise ValueError(f"--set {name}: there is no such argument{_perhaps(name, known)}")


def environment(name: str, argument: str) -> str:
    """The gymnasium id that a user means by the name of a task, an id, or ``package:id``; it can be made.

    :param name: ``Hopper``, ``rpto/Hopper-target0-v0``, ``Pendulum-v1``, ``package:name/Task-v0``
    :param argument: what the user passed it as
    :raises ValueError: for an environment that does not exist or whose packages are missing
    """
    import gymnasium as gym

    from sb3_rpto.envs import tasks

    if name in tasks.TASKS:
        name = tasks.env_id(name)
    package, _, env_id = name.rpartition(":")
    if package:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ValueError(f"{argument} {name!r}: {package} cannot be imported ({error})") from error
    if env_id not in gym.registry:
        raise ValueError(f"{argument} {name!r} is no environment{_perhaps(env_id, [*gym.registry, *tasks.TASKS])}")
    try:
        gym.make(name).close()
    except (gym.error.Error, ImportError) as error:
        raise ValueError(f"{argument} {name!r} cannot be made: {error}") from error
    return name


def _perhaps(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
