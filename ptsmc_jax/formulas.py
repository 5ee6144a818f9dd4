"""Formulas of plants, devices and angles in plain NumPy, which need no import of JAX."""

import numpy as np
from numpy.typing import ArrayLike

ARCSEC = 180.0 * 3600.0 / np.pi  # arcsec in a radian


def check_inertia(inertia: object) -> np.ndarray:
    """Return the inertia tensor (3, 3) [kg m^2] from three principal moments or a tensor.

    Raises:
        ValueError: no rigid body has this inertia; the message gives the reason.
    """
    try:
        tensor = np.asarray(inertia, dtype=float)
    except (ValueError, TypeError):  # rows of different lengths, or values that are not numbers
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
    if not is_rigid_body(tensor[None])[0]:
        raise ValueError(
            "no rigid body has these principal moments: the largest, "
            f"{moments[2]:.6g}, must not exceed the sum of the other two, {moments[0] + moments[1]:.6g}"
        )
    return tensor


def is_rigid_body(tensors: np.ndarray) -> np.ndarray:
    """Return which symmetric tensors (n, 3, 3) [kg m^2] can be the inertia of a rigid body, (n,) bool.

    Such a tensor is positive definite, and no principal moment exceeds the sum of the other two.
    """
    moments, scale = np.linalg.eigvalsh(tensors), np.abs(tensors).max(axis=(1, 2))
    return (moments[:, 0] > 1e-12 * scale) & (moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1 + 1e-9))


def is_flexible_body(tensors: np.ndarray, couplings: np.ndarray) -> np.ndarray:
    """Return which flexible bodies are possible, (n,) bool: those with a positive definite J - D'D.

    Args:
        tensors: J (n, 3, 3) [kg m^2].
        couplings: D (n, modes, 3) [sqrt(kg) m].
    """
    smallest_moments = np.linalg.eigvalsh(tensors - np.swapaxes(couplings, 1, 2) @ couplings)[:, 0]
    return smallest_moments > 1e-9 * np.abs(tensors).max(axis=(1, 2))


def rest_inertia(inertia: np.ndarray, coupling: object) -> np.ndarray:
    """Return J - D'D (3, 3) [kg m^2], the inertia of the rigid rest of a flexible body.

    Args:
        inertia: J (3, 3) [kg m^2] of the whole body with its modes at rest.
        coupling: D (modes, 3) [sqrt(kg) m].

    Raises:
        ValueError: J - D'D is not positive definite.
    """
    rows = np.asarray(coupling, dtype=float)
    rest = inertia - rows.T @ rows
    if not is_flexible_body(inertia[None], rows[None])[0]:
        smallest_moment = float(np.linalg.eigvalsh(rest)[0])
        raise ValueError(
            "the inertia minus D'D, the inertia without the modes, must be positive definite "
            f"(its smallest principal moment is {smallest_moment:.6g} kg m^2)"
        )
    return rest


def free_mode_frequencies(inertia: np.ndarray, frequency: object, coupling: object) -> np.ndarray:
    """Return the undamped angular frequencies (modes,) [rad/s] of a free flexible body.

    They solve det(W^2 - w^2 (1 - D J^-1 D')) = 0.

    Args:
        inertia: J (3, 3) [kg m^2].
        frequency: W of each mode with the body held (modes,) [rad/s].
        coupling: D (modes, 3) [sqrt(kg) m].
    """
    rows, stiffness = np.asarray(coupling, dtype=float), np.asarray(frequency, dtype=float) ** 2
    # eliminate w': (1 - D J^-1 D') e'' + W^2 e = 0
    mass = np.eye(len(rows)) - rows @ np.linalg.solve(inertia, rows.T)
    root = np.sqrt(stiffness)
    return np.sqrt(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(mass) * root))


def surface_roots(a: ArrayLike) -> np.ndarray:
    """Return the roots (n-1,) [1/s] of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1: the motion on the surface (39)."""
    return np.roots([1.0, *np.asarray(a, dtype=float)[::-1]])


def is_hurwitz(a: ArrayLike) -> bool:
    """Whether the matrix of (39) is Hurwitz: all roots of p^(n-1) + .. + a_1 have a negative real part."""
    return bool(np.all(np.real(surface_roots(a)) < 0.0))


def wheel_axes(axes: ArrayLike) -> np.ndarray:
    """Return spin axes of wheels (n, 3) in body axes, normalised; raise ValueError if they do not span all directions.

    `axes` are directions (n, 3) of any length.
    """
    unit = np.asarray(axes, dtype=float)
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(unit, axis=-1, keepdims=True)
    if unit.ndim != 2 or unit.shape[1] != 3 or not np.all(np.isfinite(norms) & (norms > 0.0)):
        raise ValueError("allowed are rows of three numbers, a direction for each wheel")
    unit = unit / norms
    if np.linalg.svd(unit, compute_uv=False)[-1] < 1e-6 or len(unit) < 3:
        raise ValueError("the wheels' axes must span all three directions")
    return unit


def pyramid(cant: float = np.arctan(1.0 / np.sqrt(2.0))) -> np.ndarray:
    """Return the spin axes (4, 3) of four wheels, `cant` [rad] above the x-y plane.

    With the default cant, the largest torque is equal about all body axes.
    """
    azimuths = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    return np.stack(
        [np.cos(cant) * np.cos(azimuths), np.cos(cant) * np.sin(azimuths), np.full(4, np.sin(cant))], axis=1
    )


def noise_per_sample(density: float, period: float) -> float:
    """Return the noise of samples of white noise, 1 sigma, each averaged over a period: density / sqrt(period).

    Args:
        density: noise density; for a rate in [rad/s/sqrt(Hz)] = [rad/sqrt(s)], the angle random walk of a gyro (IEEE
            Std 952).
        period: sample period [s].
    """
    return float(density / np.sqrt(period))


def best_bandwidth(attitude_noise: float, rate_noise: float, period: float, interval: float) -> float:
    """Return the bandwidth [rad/s] at which star tracker and gyro noise have equal weight.

    It is sigma_v / (sigma_n sqrt(interval)), with the gyro's angle random walk sigma_v = rate_noise sqrt(period).

    Args:
        attitude_noise: sigma_n, noise of a star tracker sample, 1 sigma [rad].
        rate_noise: noise of a gyro sample, 1 sigma [rad/s].
        period: control period [s].
        interval: time between star tracker samples [s].
    """
    return rate_noise * float(np.sqrt(period)) / (attitude_noise * float(np.sqrt(interval)))


def pointing_angle(error: ArrayLike) -> np.ndarray:
    """Return the angle 2 asin |v| [rad] of the norm |v| [-] of an error vector of the quaternion."""
    return 2.0 * np.arcsin(np.minimum(error, 1.0))


def angle_unit(largest: float) -> tuple[str, float]:
    """Return the unit that shows angles of at most `largest` [rad], and the number of these units in a radian.

    >>> angle_unit(0.01)[0], angle_unit(0.02)[0]
    ('arcsec', 'deg')
    """
    return ("arcsec", ARCSEC) if largest < np.radians(1.0) else ("deg", float(np.degrees(1.0)))
