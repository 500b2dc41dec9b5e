"""The algorithms in the RL Zoo (https://github.com/DLR-RM/rl-baselines3-zoo); see docs/zoo.md."""

from __future__ import annotations


def require() -> None:
    """Refuse to start without the extra.

    :raises ImportError: with the command that installs it
    """
    try:
        import rl_zoo3  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"the zoo needs rl_zoo3 and Optuna ({error}): pip install -e '.[zoo]' in the checkout"
        ) from error
