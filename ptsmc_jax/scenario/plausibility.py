"""Warn about valid scenarios whose values are probably mistakes. Start with `warnings`.

Three warnings concern noise: disturbance bounds far from the disturbance, noisy estimates, a missing gyro error. Three
concern the torque limits: they contradict an inertia, a requirement or a disturbance. The others concern values in
wrong units, a sliding surface too fast for the period, and a ground target below the horizon.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.scenario import disturbance_tables, errors, tables
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.theory import stability_limits

# largest ratio of a stated bound to the bound of the disturbance, or its inverse, without a warning
MAX_BOUND_RATIO = 10.0
# Delay or lag as a fraction of t_f. With a lag of 0.1 t_f, a turn with the default gains does not converge at t_f.
MAX_DELAY_FRACTION = 0.1
MAX_TORQUE_RATIO = 100.0  # torque of the slew relative to the limit; an inertia in kg cm^2 is wrong by 1e4
MAX_TURN = 1.0  # largest turn in one control period [rad]; for real spacecraft it is a few mrad
# Noise of the attitude [rad]; a larger one was probably given in another unit. For a gyro it is the noise of the angle
# that is integrated until t_f: 0.5 deg/sqrt(h) reaches it after 100 h. It is not compared with the angle of the turn,
# since a run may begin at the reference.
MAX_ATTITUDE_NOISE = np.deg2rad(5.0)


def warnings(scenario: Scenario, *, tuned: bool = False) -> list[str]:
    """Return the warnings of a scenario, one sentence each.

    Bounds and estimate are not examined if custom code that defines the disturbance has not run yet.

    Args:
        scenario: the scenario.
        tuned: whether a search found the free gains of the scenario.
    """
    bounds, bound_warnings = disturbance_tables.largest_disturbance(scenario), list[str]()
    if bounds is not None:
        tuned = tuned and "observer_gain" in scenario.search.gains
        bound_warnings = [*_implausible_bound(scenario, *bounds), *_noisy_estimate(scenario, bounds[0], tuned=tuned)]
    checks = (
        _implausible_inertia,
        _implausible_noise,
        _delay_in_seconds,
        _lag_in_milliseconds,
        _unstable_surface_rate,
        _target_below_horizon,
        _limit_beyond_actuators,
        _disturbance_beyond_actuators,
    )
    return [*bound_warnings, *(warning for check in checks for warning in check(scenario))]


def _torque_limits(scenario: Scenario) -> Iterator[tuple[str, float, np.ndarray]]:
    """Yield key and value of each torque limit, and the axes (inputs, channels) of the torques that it limits."""
    limit, wheels = scenario.devices.torque_limit, scenario.reaction_wheels
    if limit is not None:
        yield "hardware.torque_limit", limit, np.eye(scenario.inputs)
    if wheels is not None and wheels.torque_limit is not None:
        yield "wheels.torque_limit", wheels.torque_limit, formulas.wheel_axes(wheels.spin_axes()).T


def _limit_beyond_actuators(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about a required torque that is larger than the torque limits of the actuators."""
    unit = " N m" if scenario.motion == "spacecraft" else ""
    for key, limit, axes in _torque_limits(scenario):
        about_axis = limit * float(np.max(np.sum(np.abs(axes), axis=1)))
        largest = {"peak_torque": about_axis, "peak_torque_delivered": about_axis}
        if key == "wheels.torque_limit":
            largest["peak_wheel_torque"] = limit
        for metric, torque in largest.items():
            required = tables.limit_of(scenario, metric)
            if required is not None and required > torque * (1.0 + 1e-9):
                yield (
                    f"requirements.{metric} is {required:g}{unit}, but with {key} = {limit:g}{unit} the actuators "
                    f"deliver at most {torque:.3g}{unit}: the requirement does not prevent saturation"
                )


def _disturbance_beyond_actuators(scenario: Scenario) -> Iterator[str]:
    """Yield a warning if constants and sinusoids that disturb a spacecraft exceed its torque limits together.

    Sinusoids from the Nyquist frequency on are not counted: vibration may be larger, and no actuator follows it.
    """
    if scenario.motion != "spacecraft":
        return
    constant, periodic = np.zeros(3), np.zeros(3)
    for term in scenario.terms_by_place.values():
        if term.kind == "constant":
            constant += term.amplitude
        elif term.kind == "sinusoid":
            is_slow = np.abs(term.frequency) * scenario.loop.period < np.pi
            constant += term.bias
            periodic += np.where(is_slow, np.abs(term.amplitude), 0.0)
    for key, limit, axes in _torque_limits(scenario):
        to_actuators = np.linalg.pinv(axes)
        needed = float(np.max(np.abs(to_actuators @ constant) + np.abs(to_actuators) @ periodic))
        if needed > limit:
            each = "of a wheel" if key == "wheels.torque_limit" else "about an axis"
            largest = errors.brief((np.abs(constant) + periodic).tolist())
            yield (
                f"disturbance reaches {largest} N m, but {key} is {limit:g} N m: "
                f"the actuators cannot hold the attitude, which needs {needed:.3g} N m {each}"
            )


def _target_below_horizon(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about a ground target that the Earth hides during the run."""
    reference: Any = getattr(scenario, "reference", None)
    if hasattr(reference, "lowest_elevation"):
        elevation, t = reference.lowest_elevation(scenario)
        if elevation < 0.0:
            yield (
                f"reference.kind is {errors.show(reference.kind)}, but at t = {t:.4g} s the Earth hides the target: "
                f"seen from there the spacecraft is {-np.rad2deg(elevation):.3g} deg below the horizon"
            )


def _implausible_inertia(scenario: Scenario) -> Iterator[str]:
    """Yield a warning if the torque limits contradict the inertia: almost no slew, or a large turn in a control period.

    A turn by the angle a in the time t needs at least the acceleration 4 a / t^2: half of the time each to speed up
    and to slow down.
    """
    any_scenario: Any = scenario
    limit = scenario.largest_acceleration() if scenario.motion == "spacecraft" else None
    if limit is None:
        return
    acceleration = 2.0 * limit  # [rad/s^2], since the error is tan(angle / 2)
    beginning = f"spacecraft.inertia is {errors.brief(any_scenario.spacecraft.inertia)} kg m^2: "
    units = "check the units, 1 kg m^2 is 1e4 kg cm^2 or 1e7 g cm^2"
    angle, t_f = any_scenario.start_angle(), scenario.controller.t_f
    needed = 4.0 * angle / t_f**2
    if needed > MAX_TORQUE_RATIO * acceleration:
        yield (
            f"{beginning}the turn by {np.rad2deg(angle):.3g} deg in controller.t_f = {t_f:g} s needs at least "
            f"{needed:.3g} rad/s^2, but the torque limit allows {acceleration:.3g} rad/s^2; {units}"
        )
    turn = 0.5 * acceleration * scenario.loop.period**2
    if scenario.sampled and turn > MAX_TURN:
        period = f"one period, {scenario.loop.period:g} s"
        yield f"{beginning}the torque limit turns the body by {turn:.3g} rad in {period}; {units}"


def _delay_in_seconds(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about a delay that was probably given in seconds: the key counts control periods."""
    delay, period = scenario.devices.delay_periods, scenario.loop.period
    if delay * period >= MAX_DELAY_FRACTION * scenario.controller.t_f:
        yield (
            f"hardware.delay is {delay}, a delay of {delay * period:g} s with loop.period = {period:g} s; the key "
            "counts control periods, not seconds"
        )


def _lag_in_milliseconds(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about a lag that is not short compared with t_f. It was probably given in milliseconds."""
    lag, t_f = scenario.devices.torque_lag or 0.0, scenario.controller.t_f
    if lag >= MAX_DELAY_FRACTION * t_f:
        yield (
            f"hardware.torque_lag is {lag:g} s, which is too long for controller.t_f = {t_f:g} s; a number in another "
            f'unit has the unit in its value: "{lag:g} ms"'
        )


def _unstable_surface_rate(scenario: Scenario) -> Iterator[str]:
    """Yield a warning if no K1 stabilises the sampled hold phase at the scenario's surface rate c.

    The published c = 1 1/s assumes a control period that is short compared with 1 s.
    """
    law: Any = scenario.controller
    if not scenario.sampled or law.kind != "prescribed_time" or scenario.order != 2:
        return
    period, delay = scenario.loop.period, scenario.devices.delay_periods
    first_coefficient = getattr(law, "a", (1.0,))[0]  # the surface of a chain has the rate c a_1
    stability_limit = stability_limits.largest_surface(delay, implicit=law.implicit) / (first_coefficient * period)
    if law.surface_rate >= stability_limit:
        delayed = f" and a delay of {delay}" if delay else ""
        yield (
            f"controller.surface_rate is {law.surface_rate:g} 1/s: at a period of {period:g} s{delayed} no k1 "
            f"stabilises the hold phase; use a surface_rate below {stability_limit:.3g} 1/s, or add it to tune.free"
        )


def _implausible_noise(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about a noisy star tracker with a perfect gyro, or about noise larger than in real devices."""
    device: Any = scenario.hardware
    noise = getattr(device, "attitude_noise", None) or 0.0
    gyro_keys = ("rate_noise", "rate_noise_density", "rate_bias", "rate_bias_walk")
    if noise and scenario.sensors is None and all(getattr(device, name) is None for name in gyro_keys):
        yield (
            f"hardware.attitude_noise is {noise:g} rad, but the gyro has no error: the law measures the true rate; "
            "set hardware.rate_noise or rate_noise_density, or rate_noise = 0 to confirm a perfect gyro"
        )
    devices = {f"sensors[{k}]": sensor for k, sensor in enumerate(getattr(scenario.sensors, "each", ()))}
    devices["hardware"] = device
    t_f = scenario.controller.t_f
    at_t_f = f" when it is integrated until t_f = {t_f:g} s"
    keys = {  # factor from the noise to an angle, its unit, the unit of the number if it is wrong, and when it holds
        "attitude_noise": (1.0, "rad", "arcsec", ""),
        "noise_across": (1.0, "rad", "arcsec", ""),
        "rate_noise": (math.sqrt(scenario.loop.period * t_f), "rad/s", "deg/s", at_t_f),
        "rate_noise_density": (math.sqrt(t_f), "rad/s/sqrt(Hz)", "deg/sqrt(h)", at_t_f),
    }
    for (place, device), (key, (factor, unit, other_unit, when)) in itertools.product(devices.items(), keys.items()):
        noise = getattr(device, key, None) or 0.0
        angle = factor * noise
        if angle >= MAX_ATTITUDE_NOISE:
            yield (
                f"{place}.{key} is {noise:g} {unit}, {np.rad2deg(angle):.3g} deg{when}, "
                f'which is very large; a number in another unit has the unit in its value: "{noise:g} {other_unit}"'
            )


def _implausible_bound(scenario: Scenario, bound: float, rate_bound: float) -> Iterator[str]:
    """Yield a warning about a stated bound that is more than `MAX_BOUND_RATIO` times too large or too small.

    Only the bound that the law uses is examined: K without an observer, c with an observer.
    """
    name, computed = ("disturbance_rate_bound", rate_bound)
    if scenario.observer.kind in ("none", "custom"):
        name, computed = ("disturbance_bound", bound)
    stated = getattr(scenario.controller, name)
    if not scenario.controller.law.switches or stated is None:
        return
    if max(stated, computed) > MAX_BOUND_RATIO * min(stated, computed):
        effect = "switches more than necessary, and chatters" if stated > computed else "may not reject it"
        yield (
            f"controller.{name} is {stated:g}, but the disturbance of [disturbance] and [dispersion] has "
            f"{computed:g}: the law {effect}; remove the key to use the bound of the disturbance"
        )


def _noisy_estimate(scenario: Scenario, disturbance_bound: float, *, tuned: bool) -> Iterator[str]:
    """Yield a warning about an observer whose estimate has more noise than the disturbance has amplitude.

    The default gain is as small as is useful, see `mission.design`, so only a larger gain causes the warning. A search
    has already tried smaller gains.

    Args:
        scenario: the scenario.
        disturbance_bound: largest component of the disturbance [N m].
        tuned: whether a search found the observer gain.
    """
    noise = estimate_noise(scenario)
    if noise > disturbance_bound > 0.0:
        default: Any = msgspec.structs.replace(scenario.observer, gain=None).fill_defaults(scenario)
        if max(scenario.observer.gain) <= 1.001 * max(default.gain):
            return
        shown = errors.brief([float(f"{one:.4g}") for one in scenario.observer.gain])
        unit = " N m" if scenario.motion == "spacecraft" else ""
        yield (
            f"observer.gain is {shown}: the noise of its estimate, "
            f"{noise:.2g}{unit} (1 sigma), is larger than the disturbance, at most {disturbance_bound:.3g}{unit}; "
            f'try {"" if tuned else "a smaller gain, or "}observer.kind = "none"'
        )


def estimate_noise(scenario: Scenario) -> float:
    """Return the noise of the disturbance estimate on the noisiest axis [N m, 1 sigma], 0 if it is not known.

    It is known for an observer with a constant gain l in the sampled loop. A sample of the disturbance is
    d + J (n_(k+1) - n_k) / h, where n is the noise of the rate (1 sigma: `sigma`) and h the control period. The
    observer is a first-order filter of these samples with the decay E = exp(-l h / J). The noise of its output is
    J sigma / h (1 - E) sqrt(2 / (1 + E)).
    """
    gains, loop = getattr(scenario.observer, "gain", None), scenario.loop
    if scenario.observer.kind not in ("nonlinear", "prescribed_time") or gains is None or not scenario.sampled:
        return 0.0
    any_scenario: Any = scenario
    if scenario.motion == "spacecraft":
        inertia = np.asarray(any_scenario.spacecraft.inertia, dtype=float)
        moments = inertia if inertia.ndim == 1 else np.diag(inertia)
        sigmas = np.full(3, scenario.devices.gyro_noise(loop.period))
    else:
        noise = getattr(scenario.hardware, "state_noise", None)
        if noise is None or scenario.plant.kind != "chain":  # the matrix M of a custom system is not known here
            return 0.0
        moments, sigmas = np.ones(1), np.asarray(noise[-1:])
    decay = np.exp(-np.asarray(gains) * loop.period / moments)
    return float(np.max(moments * sigmas / loop.period * (1.0 - decay) * np.sqrt(2.0 / (1.0 + decay))))
