"""Another processor's last digits on this one: products and decompositions err in them, differently for each shape.

BLAS, LAPACK and torch sum in an order that depends on the processor, the shape and the row's place in it. Tests of what
is computed twice in one way may ask for equality, others need a tolerance; ``make test-arithmetic`` tells.
"""

import zlib
from collections.abc import Callable
from functools import cache, wraps
from typing import Any

import numpy as np
import torch as th

#: Largest error, in units of the last place.
ULPS = 2.0
DECOMPOSITIONS = ("solve", "inv", "pinv", "lstsq", "qr", "svd", "eigh", "eigvalsh")


@cache
def errors(shape: tuple[int, ...], dtype: str, name: str) -> np.ndarray:
    """Factors near 1, always the same for what has this shape."""
    rng = np.random.default_rng(zlib.crc32(repr((shape, name)).encode()))
    return 1 + (ULPS * np.finfo(dtype).eps * rng.uniform(-1, 1, shape)).astype(dtype)


@cache
def torch_errors(shape: tuple[int, ...], dtype: th.dtype, name: str) -> th.Tensor:
    return th.as_tensor(errors(shape, str(dtype).removeprefix("torch."), name))


def rounded(value: Any, name: str) -> Any:
    """What came out, or its parts, with other last digits."""
    if isinstance(value, tuple):
        parts = [rounded(part, f"{name} {i}") for i, part in enumerate(value)]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, np.ndarray | np.floating) and value.dtype in (np.float32, np.float64):
        return value * errors(value.shape, value.dtype.name, name)
    if isinstance(value, th.Tensor) and value.dtype in (th.float32, th.float64) and value.device.type == "cpu":
        return value * torch_errors(tuple(value.shape), value.dtype, name)
    return value


def replace(module: Any, name: str, counts: Callable[..., bool] = lambda *args: True) -> None:
    """Let a function of a module err where the arguments ``counts``."""
    function = getattr(module, name)

    @wraps(function)
    def erring(*args: Any, **kwargs: Any) -> Any:
        found = function(*args, **kwargs)
        return rounded(found, name) if kwargs.get("out") is None and counts(*args) else found

    setattr(module, name, erring)


def several_arrays(*args: Any) -> bool:
    """Whether an einsum multiplies: of one array it may be a view."""
    return sum(isinstance(a, np.ndarray) for a in args) > 1


def install() -> None:
    """For the rest of this process."""
    for name in DECOMPOSITIONS:
        replace(np.linalg, name)
    replace(np, "einsum", several_arrays)
    for name in ("matmul", "bmm", "baddbmm", "addmm", "mm"):
        replace(th, name)
    for name in ("matmul", "__matmul__", "__rmatmul__", "bmm", "mm"):
        replace(th.Tensor, name)
    replace(th.nn.functional, "linear")
