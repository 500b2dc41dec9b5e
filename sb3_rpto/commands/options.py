"""Arguments that several commands take: how they are read, and what is said of wrong ones."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import inspect
import os
import re
import sys
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import gymnasium as gym

#: Names the statistics by which an agent sees observations.
STATISTICS = "--vec-normalize"


def add_common(parser: argparse.ArgumentParser, of_target: str = "") -> None:
    """Options of commands that train and evaluate: how long, how often it is judged, and the settings.

    :param parser: of the command
    :param of_target: what to call the steps
    """
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder of the run; it resumes there")
    parser.add_argument("--steps", metavar="N", type=int, help=f"{of_target}steps (default: those of the task)")
    parser.add_argument("--every", metavar="N", type=int, help="steps between evaluations (default: a tenth of all)")
    parser.add_argument("--episodes", metavar="N", type=int, default=10, help="of an evaluation (default: 10)")
    add_settings(parser)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Options of all commands that learn: the seed, the settings, the device.

    :param parser: of the command
    """
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="(default: 0)")
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        type=setting,
        action="append",
        default=[],
        help="an argument of the algorithm, its value in YAML: gradient_steps=5, declared=[pole_length]; repeatable",
    )
    parser.add_argument("--device", type=device, default="auto", help="cpu, cuda or auto (default)")
    parser.add_argument("--quiet", action="store_true", help="print the result alone")


def add_statistics(parser: argparse.ArgumentParser, of: str) -> None:
    """The option that names an agent's statistics.

    :param parser: of the command
    :param of: the agent's argument
    """
    parser.add_argument(
        STATISTICS,
        metavar="FILE",
        help=f"statistics of VecNormalize by which {of} sees observations (default: vecnormalize.pkl beside it, if "
        "there is one; 'none': it sees raw ones)",
    )


def device(text: str) -> str:
    """A device that torch can use, by its name; ``auto`` is the GPU where there is one.

    :raises argparse.ArgumentTypeError: for a name that torch does not know, and a GPU that is not there
    """
    from sb3_rpto.algorithms.argument_ranges import check_device

    try:
        check_device(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def setting(text: str) -> tuple[str, Any]:
    """``gradient_steps=5`` -> ("gradient_steps", 5); see :func:`_read` of what YAML leaves as text.

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
    value = _read(parsed)
    return name, tuple(value) if name == "train_freq" and isinstance(value, list) else value


def _read(parsed: Any) -> Any:
    """What Python users mean by ``1e-3`` (YAML 1.1 takes it for text), ``1e6`` (a whole number) and ``None``."""
    if isinstance(parsed, dict):
        return {name: _read(value) for name, value in parsed.items()}
    if isinstance(parsed, list):
        return [_read(value) for value in parsed]
    if parsed == "None":
        return None
    if isinstance(parsed, str):
        with contextlib.suppress(ValueError):
            number = float(parsed)
            return int(number) if number.is_integer() and "." not in parsed else number
    return parsed


def check_seed(seed: int) -> None:
    """Refuse a seed that NumPy's generators would not take.

    :raises ValueError: with the range
    """
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed is {seed}; give a number from 0 to {2**32 - 1:,}")


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


def check_names(given: Iterable[str], known: Collection[str]) -> None:
    """Refuse settings that do not exist.

    :param given: names
    :param known: names that do
    :raises ValueError: naming the first wrong one, and what was perhaps meant
    """
    for name in given:
        if name not in known:
            raise ValueError(f"--set {name}: there is no such argument{_perhaps(name, known)}")


def check_sac(settings: dict[str, Any]) -> None:
    """Refuse values that SAC would take and fail on later; what is not given is its own.

    :raises ValueError: naming the argument
    """
    from stable_baselines3 import SAC

    from sb3_rpto.algorithms.argument_ranges import OF_SAC
    from sb3_rpto.ranges import check

    own = {name: p.default for name, p in inspect.signature(SAC).parameters.items()} | settings
    rate = own["learning_rate"]
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not rate > 0:
        raise ValueError(f"--set learning_rate is {rate!r}; give a number above 0 (schedules: the Python interface)")
    if own["optimize_memory_usage"]:
        raise ValueError("--set optimize_memory_usage: a transfer needs the next observations; leave it out")
    for name in ("action_noise", "replay_buffer_class", "replay_buffer_kwargs"):
        if own[name] is not None:
            raise ValueError(f"--set {name}: it takes an object of Python; use the Python interface")
    check(OF_SAC, {name: value for name, value in own.items() if name != "policy"} | settings)


def check_learns(settings: dict[str, Any], steps: int) -> None:
    """Refuse a training of SAC's that ends before its first update.

    :raises ValueError: naming the options
    """
    first = settings.get("learning_starts", 100)
    if first >= steps:
        raise ValueError(
            f"--steps {steps} ends before the first update (learning_starts={first}): nothing would be learned; give "
            "more steps, or a smaller --set learning_starts"
        )


@dataclass(frozen=True)
class World:
    """An environment by the name that the user gave it.

    :param name: id, also of a shift of ours that is not registered
    :param env_id: that gymnasium knows
    :param kwargs: that make the rest of it
    """

    name: str = field(compare=False)
    env_id: str
    kwargs: dict[str, Any] = field(default_factory=dict)

    def make(self, **more: Any) -> gym.Env:
        """The environment.

        :param more: arguments of ``gymnasium.make``
        """
        import gymnasium as gym

        return gym.make(self.env_id, **self.kwargs, **more)


def world(name: str, argument: str) -> World:
    """The environment that a user means by the name of a task, an id, or ``package:id``; it can be made.

    :param name: ``Hopper``, ``rpto/Hopper-target0-v0``, any shift (``rpto/Hopper-gravity-x3-v0``), ``Pendulum-v1``,
        ``package:name/Task-v0``
    :param argument: what the user passed it as
    :raises ValueError: for an environment that does not exist or whose packages are missing
    """
    import gymnasium as gym

    found = _find(name, argument)
    try:
        found.make().close()
    except (gym.error.Error, ImportError, ValueError) as error:
        raise ValueError(f"{argument} {name!r} cannot be made: {error}") from error
    return found


def _find(name: str, argument: str) -> World:
    import gymnasium as gym

    from sb3_rpto.envs import tasks

    if name in tasks.TASKS:
        name = tasks.env_id(name)
    package, _, env_id = name.rpartition(":")
    if package:
        here = os.getcwd()
        if here not in sys.path:  # as of python -m: a module beside the logs, say
            sys.path.insert(0, here)
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ValueError(f"{argument} {name!r}: {package} cannot be imported ({error})") from error
    if env_id in gym.registry:
        return World(name, env_id)
    shifted = re.fullmatch(r"rpto/(\w+)-(.+)-v0", env_id)
    if shifted and shifted[1] in tasks.TASKS:
        return World(name, tasks.env_id(shifted[1]), {"shift": shifted[2]})
    perhaps = _perhaps(env_id, [*gym.registry, *tasks.TASKS])
    if not package:
        perhaps += f"{' One' if perhaps else '; one'} of your own is module:{name}, of the module that registers it"
    raise ValueError(f"{argument} {name!r} is no environment{perhaps}")


def _perhaps(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
