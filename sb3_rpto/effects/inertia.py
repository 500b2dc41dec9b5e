"""Inertia tensors and MuJoCo's principal frames, for many simulations at once."""

import mujoco
import numpy as np


def matrices(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotations(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that turn about the y axis by ``y``, then about the x axis by ``x``, rad."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    about_x = ((one, zero, zero), (zero, np.cos(x), -np.sin(x)), (zero, np.sin(x), np.cos(x)))
    about_y = ((np.cos(y), zero, np.sin(y)), (zero, one, zero), (-np.sin(y), zero, np.cos(y)))
    rx, ry = (np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) for rows in (about_x, about_y))
    return rx @ ry


def spread(mass: np.ndarray, offset: np.ndarray) -> np.ndarray:
    r"""Tensor of point masses (n,) at ``offset`` (n, 3): :math:`m\,(|d|^2 1 - d d^T)`, (n, 3, 3)."""
    square = np.einsum("ni,ni->n", offset, offset)[:, None, None] * np.eye(3)
    return mass[:, None, None] * (square - offset[:, :, None] * offset[:, None, :])


def to_tensor(inertia: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Tensors (n, 3, 3) in the body's frame, from principal moments (n, 3) and the frame's quaternions (n, 4)."""
    axes = matrices(quat)
    return (axes * inertia[:, None, :]) @ np.swapaxes(axes, 1, 2)


def from_tensor(tensor: np.ndarray, near: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of :func:`to_tensor`: principal moments, largest first as MuJoCo has them, and quaternions.

    :param tensor: (n, 3, 3)
    :param near: quaternions (n, 4) of frames that are kept where they are principal. Of a body of revolution many are,
        and MuJoCo's drag in a fluid, on a box in the principal frame, depends on which is taken
    """
    moments, axes = np.linalg.eigh(tensor)
    moments, axes = moments[:, ::-1].copy(), axes[:, :, ::-1].copy()
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    quat = np.empty((len(tensor), 4))
    for i, matrix in enumerate(axes):
        mujoco.mju_mat2Quat(quat[i], matrix.ravel())
    if near is not None:
        turned = np.swapaxes(matrices(near), 1, 2) @ tensor @ matrices(near)
        diagonal = np.einsum("nii->ni", turned)
        rest = np.abs(turned - diagonal[:, None, :] * np.eye(3)).max(axis=(1, 2))
        kept = rest <= 1e-12 * np.trace(tensor, axis1=1, axis2=2)
        moments[kept], quat[kept] = diagonal[kept], near[kept]
    return moments, quat
