"""MuJoCo without what costs time and moves nothing: clocks, islands of one, a search for contacts that cannot be."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import mujoco


def lean(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model, to be simulated in large numbers: the same steps to the last bit, in less time.

    A model of one kinematic tree has one island at most, so none is looked for; where no two geoms may collide, no
    pair of them is looked at.
    """
    model = model.__copy__()
    if model.ntree <= 1:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    if not _may_collide(model):
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _may_collide(model: mujoco.MjModel) -> bool:
    """Whether any two geoms on different bodies share a bit, or are a pair by themselves."""
    bits = model.geom_contype[:, None] & model.geom_conaffinity
    body = model.body_weldid[model.geom_bodyid]
    return bool(model.npair or model.nflex or (bits.astype(bool) & (body[:, None] != body)).any())


@contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo from printing a line for every simulation that became unstable: NaN says so."""
    usual, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    silent.logto_console = silent.logto_file = False
    silent.set()
    try:
        yield
    finally:
        usual.set()


@contextmanager
def untimed() -> Iterator[None]:
    """Keep MuJoCo from reading the clock around each stage of a step: that is a fifth of a trace of a small model.

    ``MjData.timer`` counts no time meanwhile, in no thread. Nothing changes where MuJoCo's library is not found.
    """
    clock = _clock()
    usual = clock.value
    clock.value = None
    try:
        yield
    finally:
        if usual:  # another thread may have it for now, and brings it back
            clock.value = usual


@cache
def _clock() -> ctypes.c_void_p:
    """MuJoCo's ``mjcb_time``, which its Python package has no setter for that takes it away."""
    for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in Path(mujoco.__file__).parent.glob(pattern):
            try:
                return ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), "mjcb_time")
            except (OSError, ValueError):
                continue
    return ctypes.c_void_p()
