"""Formulas of the parts in plain NumPy: what a scenario is checked by before JAX is loaded."""

from typing import Any

import numpy as np


def check_inertia(inertia: object) -> np.ndarray:
    """The (3, 3) inertia tensor [kg m^2] that `spacecraft` would use; raises ValueError as it does."""
    try:
        tensor = np.asarray(inertia)
        if not np.issubdtype(tensor.dtype, np.number):
            raise TypeError
        tensor = tensor.astype(float)
    except (ValueError, TypeError):  # rows of different lengths, or no numbers
        tensor = np.zeros(0)
    tensor = np.diag(tensor) if tensor.shape == (3,) else tensor
    if tensor.shape != (3, 3):
        raise ValueError("allowed are three principal moments or a symmetric 3x3 tensor [kg m^2]")
    if not np.all(np.isfinite(tensor)):
        raise ValueError("every entry must be a finite number")
    scale = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > 1e-9 * scale:
        raise ValueError("the tensor must be symmetric")
    tensor = (tensor + tensor.T) / 2
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 1e-12 * scale:
        raise ValueError(f"the tensor must be positive definite (its smallest principal moment is {moments[0]:.6g})")
    if not bodies(tensor[None])[0]:
        raise ValueError(
            "no rigid body has these principal moments: the largest, "
            f"{moments[2]:.6g}, must not exceed the sum of the other two, {moments[0] + moments[1]:.6g}"
        )
    return tensor


def bodies(tensors: np.ndarray) -> np.ndarray:
    """Which symmetric tensors (n, 3, 3) a rigid body may have, (n,) bool.

    Those that are positive definite, no principal moment of theirs above the sum of the other two.
    """
    moments, scale = np.linalg.eigvalsh(tensors), np.abs(tensors).max(axis=(1, 2))
    return (moments[:, 0] > 1e-12 * scale) & (moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1 + 1e-9))


def flexible_bodies(tensors: np.ndarray, couplings: np.ndarray) -> np.ndarray:
    """Which flexible bodies can be, (n,) bool: those whose J - D'D is positive definite.

    tensors: J (n, 3, 3) [kg m^2]; couplings: D (n, modes, 3) [sqrt(kg) m].
    """
    least = np.linalg.eigvalsh(tensors - np.swapaxes(couplings, 1, 2) @ couplings)[:, 0]
    return least > 1e-9 * np.abs(tensors).max(axis=(1, 2))


def rest_inertia(inertia: np.ndarray, coupling: Any) -> np.ndarray:
    """J - D'D (3, 3) of a flexible body [kg m^2], for D (modes, 3) [sqrt(kg) m]; raises ValueError where it is not > 0.

    inertia: J (3, 3), of the whole body with its modes at rest.
    """
    rows = np.asarray(coupling, dtype=float)
    rest = inertia - rows.T @ rows
    if not flexible_bodies(inertia[None], rows[None])[0]:
        least = float(np.linalg.eigvalsh(rest)[0])
        raise ValueError(
            "the inertia less D'D, what is left when all modes move along, must be positive definite "
            f"(its smallest principal moment is {least:.6g} kg m^2)"
        )
    return rest


def free_modes(inertia: np.ndarray, frequency: Any, coupling: Any) -> np.ndarray:
    """Angular frequencies (modes,) at which a flexible body rings where nothing holds it, without damping [rad/s]."""
    rows, stiff = np.asarray(coupling, dtype=float), np.asarray(frequency, dtype=float) ** 2
    # w' eliminated: (1 - D J^-1 D') e'' + W^2 e = 0
    mass = np.eye(len(rows)) - rows @ np.linalg.solve(inertia, rows.T)
    root = np.sqrt(stiff)
    return np.sqrt(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(mass) * root))


def surface_roots(a: Any) -> np.ndarray:
    """Roots of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1 [1/s], a number for each a_i: the motion on a surface (39)."""
    return np.roots([1.0, *np.asarray(a, dtype=float)[::-1]])


def hurwitz(a: Any) -> bool:
    """Whether the matrix of (39) is Hurwitz: all roots of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1 left of the axis."""
    return bool(np.all(np.real(surface_roots(a)) < 0.0))


def wheel_axes(axes: Any) -> np.ndarray:
    """Unit spin axes (n, 3) of wheels in body axes, of any length; raises ValueError where they do not span all."""
    unit = np.asarray(axes, dtype=float)
    if (
        unit.ndim != 2
        or unit.shape[1] != 3
        or not np.all(np.isfinite(unit))
        or np.any(np.linalg.norm(unit, axis=1) == 0)
    ):
        raise ValueError("allowed are rows of three numbers, a direction for each wheel")
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    if np.linalg.svd(unit, compute_uv=False)[-1] < 1e-6 or len(unit) < 3:
        raise ValueError("the wheels' axes must span all three directions")
    return unit


def pyramid(cant: float = np.arctan(1.0 / np.sqrt(2.0))) -> np.ndarray:
    """Spin axes (4, 3) of four wheels, `cant` [rad] above the x-y plane; by default all axes are equally strong."""
    around = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    return np.stack([np.cos(cant) * np.cos(around), np.cos(cant) * np.sin(around), np.full(4, np.sin(cant))], axis=1)


def per_sample(density: float, period: float) -> float:
    """1 sigma of samples of white noise, each an average over a period [s]: density / sqrt(period).

    density: of a rate in rad/s/sqrt(Hz), which is rad/sqrt(s), a gyro's angle random walk (IEEE Std 952).
    """
    return float(density / np.sqrt(period))


def best_bandwidth(attitude_noise: float, rate_noise: float, period: float, interval: float) -> float:
    """Bandwidth [rad/s] at which star tracker and gyro noise weigh the same: sigma_v / (sigma_n sqrt(interval)).

    attitude_noise: 1 sigma a sample [rad]; rate_noise: 1 sigma a control period [rad/s]; sigma_v = rate_noise
    sqrt(period) is the gyro's angle random walk.
    """
    return rate_noise * float(np.sqrt(period)) / (attitude_noise * float(np.sqrt(interval)))
