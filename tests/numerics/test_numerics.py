"""Pytrees, paths, guarded functions, integrators, phi functions and matrices against exact or independent results."""

import math
from dataclasses import dataclass, field
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from ptsmc_jax.numerics import guards, integrators, matrices, paths, pytrees
from tests.helpers import vector

EPS = np.finfo(float).eps


# pytrees


@dataclass(frozen=True)
class _Law:
    """A law with a gain, a model and a static field."""

    gain: Any
    model: Any
    order: int = field(metadata={"static": True})


class _Other(_Law):
    """Another class with the same fields as `_Law`."""


def test_classes_with_the_same_fields_have_different_tree_structures():
    """`jit` identifies classes by their structure. `register_dataclass` of jaxlib 0.10.2 confuses them."""
    kinds = [pytrees.pytree(kind) for kind in (_Law, _Other)]
    one, other = (jax.tree.structure(kind(1.0, {"inertia": 2.0}, 3)) for kind in kinds)
    assert one != other
    assert one == jax.tree.structure(_Law(5.0, {"inertia": 6.0}, 3))
    assert one != jax.tree.structure(_Law(1.0, {"inertia": 2.0}, 4))  # static fields belong to the structure
    doubled = jax.tree.map(lambda x: 2.0 * x, _Other(1.0, {"inertia": 2.0}, 3))
    assert doubled == _Other(2.0, {"inertia": 4.0}, 3)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(doubled)[0]]
    assert paths == [".gain", ".model['inertia']"]


# paths


class _State(NamedTuple):
    """Attitude q and body rate w."""

    q: Any
    w: Any


@pytrees.pytree
@dataclass(frozen=True)
class _Observer:
    """An observer whose model may be None."""

    gain: Any
    model: Any = None


@pytrees.pytree
@dataclass(frozen=True)
class _Run:
    """A tree of nested classes. The tests replace its values by path."""

    observer: _Observer
    initial: _State


RUN = _Run(_Observer(jnp.array([1.0, 2.0, 3.0])), _State(jnp.ones(4), jnp.zeros(3)))


@pytest.mark.parametrize("path", ["observer.gain", "observer.gain[1]", "initial.w", "initial", "observer.model"])
def test_put_replaces_the_value_at_a_path_and_nothing_else(path):
    new = paths.put(RUN, path, jnp.asarray(7.0))
    assert float(paths.get(new, path)) == 7.0
    unchanged = [k for k in ("observer.gain[0]", "observer.gain[2]", "initial.q") if not k.startswith(path)]
    for other in unchanged:
        np.testing.assert_array_equal(paths.get(new, other), paths.get(RUN, other))
    assert float(paths.get(RUN, "observer.gain[1]")) == 2.0


def test_put_is_differentiable():
    gradient = jax.grad(lambda v: jnp.sum(paths.put(RUN, "observer.gain[1]", v).observer.gain ** 2))(3.0)
    assert float(gradient) == 6.0


def test_path_exists_if_all_of_its_fields_exist():
    assert paths.exists(RUN, "observer.model")  # its value is None
    assert not paths.exists(RUN, "observer.model.inertia")
    assert not paths.exists(RUN, "observer.bias")
    with pytest.raises(AttributeError, match="bias"):
        paths.get(RUN, "observer.bias")


# smooth sign


def test_smooth_sign_equals_tanh_and_approaches_the_sign():
    s = np.array([-2.0, -0.3, -1e-4, 0.0, 1e-7, 0.01, 5.0])
    for width in (1e-5, 1e-3, 0.7):
        got = np.asarray(guards.smooth_sign(vector(s), vector(width)))
        # one rounding error each of s / width and tanh: 2 eps, with a factor of 2 for the compiled tanh
        np.testing.assert_allclose(got, [math.tanh(x / width) for x in s], rtol=4 * EPS, atol=0)
        # 1 - tanh(x) <= 2 exp(-2 x)
        assert np.all(np.abs(got - np.sign(s)) <= 2 * np.exp(-2 * np.abs(s) / width) + 4 * EPS)


def test_smooth_sign_of_width_zero_is_discontinuous():
    s = np.array([-1e300, -1e-300, -0.0, 0.0, 1e-300, 1e-9, 3.0])
    np.testing.assert_array_equal(guards.smooth_sign(vector(s), vector(0.0)), np.sign(s))


@pytest.mark.parametrize(("s", "width"), [(0.0, 0.0), (0.3, 0.0), (0.0, 1e-3), (2e-3, 1e-3), (1.0, 1e-9)])
def test_derivatives_of_smooth_sign_equal_closed_forms(s, width):
    value, ratio = guards.smooth_sign, s / width if width else math.inf
    cosh = math.cosh(ratio) if ratio < 300 else math.inf
    expected = (0.0, 0.0) if width == 0 else (1 / (width * cosh**2), -ratio / (width * cosh**2))
    point = (vector(s), vector(width))
    backward = jax.grad(value, argnums=(0, 1))(*point)
    forward = [jax.jvp(value, point, (vector(a), vector(b)))[1] for a, b in ((1.0, 0.0), (0.0, 1.0))]
    # 1 - tanh^2 has cancellation: its error is a few eps times 1/width
    for got in (backward, forward):
        np.testing.assert_allclose(got, expected, rtol=1e-14, atol=10 * EPS * max(1, ratio) / width if width else 0)


# norm


@pytest.mark.parametrize("size", [1.0, 5e-9, 1e-150, 1e150])
def test_norm_and_its_gradient_are_accurate_at_all_sizes(size):
    direction = np.array([[0.6, -1.2, 0.3], [0.1, 0.0, 2.0]])
    direction /= math.sqrt(math.fsum(v * v for v in direction.flat))
    x = vector(size * direction)
    np.testing.assert_allclose(guards.norm(x), size, rtol=8 * EPS)  # rounding: six squares and a root
    np.testing.assert_allclose(jax.grad(guards.norm)(x), direction, rtol=16 * EPS, atol=0)


def test_norm_at_zero_has_gradient_zero():
    for shape in ((3,), (3, 3), ()):
        zero = jnp.zeros(shape)
        assert guards.norm(zero) == 0.0
        np.testing.assert_array_equal(jax.grad(guards.norm)(zero), np.zeros(shape))
        np.testing.assert_array_equal(jax.jvp(guards.norm, (zero,), (jnp.ones(shape),))[1], 0.0)


# interpolation and selection


def test_lerp_interpolates_from_b_to_a():
    a, b = {"x": vector(2.0), "y": vector([1.0, -1.0])}, {"x": vector(4.0), "y": vector([5.0, 7.0])}
    got = guards.lerp(vector(0.25), a, b)
    assert got["x"] == 3.5
    np.testing.assert_array_equal(got["y"], [4.0, 5.0])


def test_select_ignores_the_tangent_of_the_other_value():
    def f(x, condition):
        return guards.select(condition, {"v": 3.0 * x}, {"v": jnp.sqrt(x)})["v"]  # sqrt has an infinite derivative at 0

    for condition, value, derivative in ((True, 0.0, 3.0), (False, 0.0, math.inf)):
        found = jax.jvp(partial(f, condition=jnp.asarray(condition)), (vector(0.0),), (vector(1.0),))
        assert found == (value, derivative)


# integrators


def convergence_orders(errors):
    """Return the orders of convergence (n - 1,), from n errors of step sizes that are halved each time."""
    return np.log2(np.asarray(errors)[:-1] / np.asarray(errors)[1:])


@partial(jax.jit, static_argnames=("step", "count"))
def integrate(step, y, end, count):
    """Integrate from t = 0 to `end` in `count` steps and return the last state; step: of (t, y, dt)."""

    def advance(y, k):
        return step(k * (end / count), y, end / count), None

    return lax.scan(advance, y, jnp.arange(count))[0]


def test_rolled_rk4_equals_unrolled_rk4_and_has_the_same_jacobian():

    def rate(t, y):
        a, b = y
        return jnp.sin(t) * b - a, jnp.stack([a[0] * b[1], -a[1]]) + jnp.cos(3.0 * t)

    def step(dt, rolled):
        y = vector([0.3, -1.2]), vector([0.8, 0.1])
        return jnp.concatenate(integrators.rk4(rate, vector(0.4), y, dt, rolled=rolled))

    @partial(jax.jit, static_argnums=1)
    def value_and_jacobians(dt, rolled):
        return [of(lambda dt: step(dt, rolled))(dt) for of in (lambda f: f, jax.jacfwd, jax.jacrev)]

    for unrolled, looped in zip(*(value_and_jacobians(vector(0.3), rolled) for rolled in (False, True)), strict=True):
        np.testing.assert_allclose(looped, unrolled, rtol=0.0, atol=16 * EPS)  # about ten operations on numbers below 2


def test_rk4_converges_with_order_4():
    # exact solution of growth' = growth cos t: exp(sin t); of a rotation at the rate 2 t: the angle t^2
    def rate(t, y):
        x, z = y["turn"]
        return {"growth": y["growth"] * jnp.cos(t), "turn": 2 * t * jnp.stack([-z, x])}

    start = {"growth": vector(1.0), "turn": vector([1.0, 0.0])}
    step, errors = partial(integrators.rk4, rate), []
    for count in (40, 80, 160, 320):
        got = integrate(step, start, 2.0, count)
        turn = np.linalg.norm(got["turn"] - np.array([math.cos(4.0), math.sin(4.0)]))
        errors.append([abs(got["growth"] - math.exp(math.sin(2.0))), turn])
    assert np.min(errors) > 1e4 * EPS  # truncation error, above rounding
    # the next term of the error is smaller by a factor h, so the order differs from 4 by a few h
    np.testing.assert_allclose(convergence_orders(errors)[1:], 4.0, atol=0.1)


def phi_exact(x, order, differentiate=False):
    """Return phi_k of a number for k = order, or its derivative, with 100 digits rounded to a float.

    The recursion is phi_k' = (phi_(k-1)' - phi_k) / x.
    """
    if x == 0.0:
        return 1 / math.factorial(order + differentiate)
    with localcontext() as context:
        context.prec = 100
        z = Decimal(float(x))
        value = derivative = z.exp()
        for k in range(1, order + 1):
            value = (value - Decimal(1) / math.factorial(k - 1)) / z
            derivative = (derivative - value) / z
        return float(derivative if differentiate else value)


def phi_series(x, order):
    """Return phi_k of a matrix for k = order, the sum of x^j / (j + k)!, in exact integer arithmetic."""
    exact = np.array([[Fraction(float(v)) for v in row] for row in x])
    unit = max(v.denominator for v in exact.flat)  # a power of two
    whole = np.array([[int(v * unit) for v in row] for row in exact], object)
    one = np.eye(len(x), dtype=int).astype(object)
    total, scale = one, 1
    for j in range(89, 0, -1):  # 1 + x / (k + 1) (1 + x / (k + 2) ..), to 20^90 / 90! = 1e-21
        scale *= unit * (j + order)
        total = scale * one + whole.dot(total)
    scale *= math.factorial(order)
    return np.array([[float(Fraction(int(v), scale)) for v in row] for row in total])


phi_0_to_3 = jax.jit(lambda x: integrators.phi_functions(x, 3))
phi_gradients = jax.jit(jax.jacrev(lambda x: sum(jnp.sum(phi) for phi in integrators.phi_functions(x, 3))))
BASIS = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    "rates",
    [
        (0.0, 0.0, 0.0),
        (1e-12, 2e-12, 5e-12),
        (1e-6, 1e-3, 1.0),
        (1.0, 1.0, 1.0),  # repeated
        (2.0, 2.0, 2.0 + 1e-9),
        (0.1, 5.0, 30.0),
        (9.6, 9.6, 9.65),
        (1e-6, 1.0, 1e6),
        (1e6, 1e6, 3e6),
    ],
)
def test_phi_functions_of_symmetric_matrices_are_accurate(rates):
    x = -BASIS @ np.diag(rates) @ BASIS.T
    x = (x + x.T) / 2
    # one rounding error of x changes the result by eps |x|
    tolerance = 20 * EPS * (1 + np.abs(x).sum(axis=0).max())
    for order, got in enumerate(phi_0_to_3(vector(x))):
        exact = BASIS @ np.diag([phi_exact(-rate, order) for rate in rates]) @ BASIS.T
        np.testing.assert_allclose(got, exact, rtol=0, atol=tolerance)
    assert np.all(np.isfinite(phi_gradients(vector(x))))


@pytest.mark.parametrize("size", [0.3, 3.0, 8.0, 9.5, 20.0])
def test_phi_functions_of_general_matrices_are_accurate(size):
    shear = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])  # not diagonalisable
    turn = np.array([[0.0, 0.7, -0.1], [-0.7, 0.0, 0.7], [0.1, -0.7, 0.0]])
    growth = np.diag([1.0, 0.5, -1.0]) + 0.1
    for x in (shear, turn, growth):
        x = size * x / np.abs(x).sum(axis=0).max()
        for order, got in enumerate(phi_0_to_3(vector(x))):
            exact = phi_series(x, order)
            # as above, relative to the largest entry
            tolerance = 20 * EPS * (1 + size) * max(1.0, np.abs(exact).max())
            np.testing.assert_allclose(got, exact, rtol=0, atol=tolerance)


def phi_entries(rate):
    """Return phi_0 to phi_3 (4,) of -rate by the tested `phi_functions`: entry [0, 0] for the matrix -rate I."""
    return jnp.stack([phi[0, 0] for phi in integrators.phi_functions(-rate * jnp.eye(2), 3)])


phi_jacobians = [jax.jit(jacobian(phi_entries)) for jacobian in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("rate", [0.0, 1e-9, 1e-3, 0.8, 4.0, 40.0, 1e4, 1e6])
def test_derivatives_of_phi_functions_equal_exact_ones(rate):
    expected = [-phi_exact(-rate, order, differentiate=True) for order in range(4)]
    # a few eps for each of up to 40 doublings, relative to the largest derivative
    tolerance = 200 * EPS * np.abs(expected).max()
    for jacobian in phi_jacobians:
        got = np.asarray(jacobian(vector(rate)))
        assert np.all(np.abs(got - expected) <= tolerance)


def test_etdrk4_without_linear_part_equals_rk4():
    a, b = vector([[0.3, -1.0], [0.8, 0.1]]), vector([0.5, -0.2])
    dt, t = vector(0.3), vector(1.7)

    def rate(t, y, m):
        return jnp.sin(t) * (a @ y) + m[:2], jnp.append(jnp.cos(y) * b, m[0] * m[2] + t), None

    def joined(t, x):
        f, g, _ = rate(t, x[:2], x[2:])
        return jnp.concatenate([f, g])

    y, m = vector([1.0, -2.0]), vector([0.4, 0.3, -0.9])
    linear = integrators.decay(jnp.zeros((3, 3)), dt)
    y_next, m_next, _ = integrators.etdrk4(rate, linear, t, y, m, dt)
    expected = integrators.rk4(joined, t, jnp.concatenate([y, m]), dt)
    # phi_k(0) = 1/k! has an error of eps; the weights of m are sums of three phi functions
    np.testing.assert_allclose(jnp.concatenate([y_next, m_next]), expected, rtol=0, atol=50 * EPS)


def test_etdrk4_converges_with_order_4_for_coupled_parts():
    matrix = vector(BASIS @ np.diag([0.5, 1.0, 3.0]) @ BASIS.T)

    def exact(t):
        return jnp.stack([jnp.sin(t), jnp.exp(-t)]), jnp.stack([jnp.cos(t), t * t, jnp.sin(2 * t)])

    def rate(t, y, m):  # nonlinear coupling in both directions that vanishes on the exact solution
        (y0, m0), (y1, m1) = jax.jvp(exact, (t,), (jnp.ones_like(t),))
        coupling = jnp.sin(y[0] * m[1]) - jnp.sin(y0[0] * m0[1])
        forcing = m1 + matrix @ m0 + jnp.sum(y * y) * m - jnp.sum(y0 * y0) * m0
        return y1 + coupling + y - y0, forcing + coupling, None

    errors = []
    for count in (10, 20, 40, 80):
        linear = decay(matrix, vector(1.5 / count))

        def step(t, y, dt, linear=linear):
            return integrators.etdrk4(rate, linear, t, y[0], y[1], dt)[:2]

        end = integrate(step, exact(vector(0.0)), vector(1.5), count)
        errors.append(max(np.abs(a - b).max() for a, b in zip(end, exact(1.5), strict=True)))
    assert errors[-1] > 1e4 * EPS
    np.testing.assert_allclose(convergence_orders(errors)[1:], 4.0, atol=0.2)


RATES = 10.0 ** np.arange(-6, 7)
decay = jax.jit(integrators.decay)


@jax.jit
def step_with_constant_forcing(linear, m, g, dt):
    """Return y and m after an ETDRK4 step with the constant forcing g; linear: coefficients of the step dt."""
    return integrators.etdrk4(lambda t, y, m: (jnp.zeros(1), g, None), linear, jnp.zeros(()), jnp.zeros(1), m, dt)[:2]


def step_with_cosine_forcing(t, y, dt):
    """Return (y, m, linear) after an ETDRK4 step with the forcing cos t.

    y: the same three values before the step. The coefficients `linear` do not change.
    """
    y, m, linear = y
    step = integrators.etdrk4(lambda t, y, m: (jnp.zeros(1), jnp.cos(t)[None], None), linear, t, y, m, dt)
    return *step[:2], linear


@pytest.mark.parametrize("rate", RATES)
def test_etdrk4_is_exact_for_constant_forcing_at_any_stiffness(rate):
    rates, dt = rate * np.array([1.0, 1.5, 3.0]), 0.05
    m, g = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.7])
    y, got = step_with_constant_forcing(decay(vector(np.diag(rates)), vector(dt)), vector(m), vector(g), vector(dt))
    decayed, gained = np.exp(-rates * dt) * m, -np.expm1(-rates * dt) / rates * g
    # a few eps of the forced part, and of the decayed part an eps of the exponent as well
    tolerance = 20 * EPS * ((1 + rates * dt) * np.abs(decayed) + np.abs(gained))
    assert np.all(np.abs(got - decayed - gained) <= tolerance)
    assert y == 0.0


@pytest.mark.parametrize("rate", [1e-6, 1.0, 1e3, 1e6])
def test_etdrk4_is_accurate_for_smooth_forcing_at_any_stiffness(rate):
    # m' = -rate m + cos t; the step integrates the quadratic through the forcing at its start, middle and end
    start = (jnp.zeros(1), vector([rate / (1 + rate**2)]), decay(vector([[rate]]), vector(0.05)))
    end = integrate(step_with_cosine_forcing, start, vector(5.0), 100)[1][0]
    exact = (rate * math.cos(5.0) + math.sin(5.0)) / (1 + rate**2)
    # |(s)(s-h/2)(s-h)|/3! <= h^3/124.7, weighed by (1 - exp(-rate T)) / rate <= min(1/rate, T)
    assert abs(end - exact) <= 0.05**3 / 124 * min(1 / rate, 5.0) + 200 * EPS * min(1 / rate, 5.0)


def test_etdrk4_returns_the_auxiliary_output_of_its_first_stage():
    arguments = vector(0.7), vector([0.3, -1.1]), vector([0.2])
    linear = integrators.decay(vector([[0.5]]), vector(0.4))
    *_, aux = integrators.etdrk4(lambda t, y, m: (y - t, m * m, (t, y, m)), linear, *arguments, vector(0.4))
    for found, argument in zip(aux, arguments, strict=True):
        np.testing.assert_array_equal(found, argument)


@jax.jit
@partial(jax.grad, argnums=(0, 1))
def step_derivatives(rate, dt):
    """Return the derivatives of the first component after an ETDRK4 step, by decay rate and step length."""
    linear = integrators.decay(rate * jnp.eye(2), dt)
    return integrators.etdrk4(
        lambda t, y, m: (m, vector([0.3, -0.4]), None), linear, vector(0.0), jnp.zeros(2), vector([1.0, 2.0]), dt
    )[1][0]


@pytest.mark.parametrize("rate", [0.0, *RATES])
def test_derivatives_of_etdrk4_by_rate_and_step_length_equal_closed_forms(rate):
    dt = 0.05
    got = step_derivatives(vector(rate), vector(dt))
    x = -rate * dt
    by_rate = -dt * math.exp(x) - 0.3 * dt * dt * phi_exact(x, 1, differentiate=True)
    by_dt = (0.3 - rate) * math.exp(x)
    # as above: an eps of the exponent in the decayed part, a few eps of the forced part
    decayed = (1 - x) * math.exp(x) * np.array([dt, 0.3 + rate])
    gained = 0.3 * np.array([dt * dt * phi_exact(x, 1, differentiate=True), phi_exact(x, 1)])
    assert np.all(np.abs(np.array(got) - [by_rate, by_dt]) <= 200 * EPS * (decayed + gained))


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_solve_and_determinant_equal_lapack(n):
    rng = np.random.default_rng(n)
    for k in range(20):
        a, b = rng.normal(size=(n, n)), rng.normal(size=(n, 2))
        if k % 2 and n > 1:
            a[0, 0] = 0.0  # requires pivoting
        a *= 10.0 ** rng.uniform(-6, 6, size=(n, 1))  # rows in different units
        b *= np.abs(a).max(axis=1, keepdims=True)
        expected = np.linalg.solve(a, b)
        tolerance = 100 * EPS * np.linalg.cond(a / np.linalg.norm(a, axis=1, keepdims=True))
        np.testing.assert_allclose(
            matrices.solve(vector(a), vector(b)), expected, rtol=0, atol=tolerance * np.abs(expected).max()
        )
        np.testing.assert_allclose(
            matrices.solve(vector(a), vector(b[:, 0])), expected[:, 0], rtol=0, atol=tolerance * np.abs(expected).max()
        )
        rows = a / np.linalg.norm(a, axis=1, keepdims=True)
        scale = np.prod(np.linalg.norm(a, axis=1))
        np.testing.assert_allclose(
            matrices.determinant(vector(a)) / scale, np.linalg.det(rows), rtol=0, atol=20 * n * EPS
        )


def test_singular_matrix_has_determinant_zero_and_no_finite_solution():
    for a in ([[0.0]], [[1.0, 2.0], [2.0, 4.0]], [[0.0, 1.0], [0.0, 2.0]], [[0.0, 0.0], [1.0, 2.0]], np.zeros((3, 3))):
        matrix = vector(np.asarray(a))
        assert float(matrices.determinant(matrix)) == 0.0
        assert not np.all(np.isfinite(matrices.solve(matrix, jnp.ones(len(a)))))


def test_derivative_of_solve_equals_closed_form():
    rng = np.random.default_rng(4)
    a, b, da = (vector(rng.normal(size=shape)) for shape in ((3, 3), (3,), (3, 3)))
    x, tangent = jax.jvp(lambda a: matrices.solve(a, b), (a,), (da,))
    np.testing.assert_allclose(tangent, -np.linalg.solve(a, da @ x), rtol=1e-10)


@pytest.mark.parametrize("width", [0.0, 1e-3])
def test_signed_root_equals_its_closed_form_and_has_a_finite_derivative_at_zero(width):
    """The derivative at 0 is 0 for the width 0, and width^-0.5 otherwise."""
    x = vector(np.array([-4.0, -1e-3, 0.0, 1e-9, 0.25]))
    got = guards.signed_root(x, vector(width))
    exact = np.asarray(x) / np.where(np.asarray(x) == 0, 1.0, (np.asarray(x) ** 2 + width**2) ** 0.25)
    np.testing.assert_allclose(got, exact, rtol=4 * EPS, atol=0)
    if width == 0.0:
        np.testing.assert_allclose(got, np.sign(x) * np.sqrt(np.abs(x)), rtol=4 * EPS)
    derivative = jax.vmap(jax.grad(lambda v: guards.signed_root(v, vector(width))))(x)
    assert np.all(np.isfinite(derivative))
    np.testing.assert_allclose(derivative[2], 0.0 if width == 0.0 else width**-0.5, rtol=4 * EPS)


smallest_eigenvalue = jax.jit(jax.value_and_grad(matrices.smallest_eigenvalue))
ROTATION = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    "a",
    [
        np.diag([3.0, 1.0, 2.0]),
        ROTATION @ np.diag([1.0, 1.0, 3.0]) @ ROTATION.T,
        ROTATION @ np.diag([2.0, 2.0 + 1e-9, 2.0 - 1e-9]) @ ROTATION.T,
        ROTATION @ np.diag([1e-6, 1.0, 1e6]) @ ROTATION.T,
        2.0 * np.eye(3),
        np.array([[2.0, -1.0], [-1.0, 2.0]]),
        np.array([[0.7]]),
        np.cov(np.random.default_rng(9).normal(size=(4, 40))),
    ],
)
def test_smallest_eigenvalue_and_its_gradient_equal_lapack(a):
    a = (a + a.T) / 2
    expected, vectors = np.linalg.eigh(a)
    found, gradient = smallest_eigenvalue(vector(a))
    # rounding errors of the entries, relative to the largest eigenvalue; both methods add about n products n^2 times
    np.testing.assert_allclose(found, expected[0], rtol=0, atol=4 * len(a) ** 2 * EPS * expected[-1])
    gap = expected[1] - expected[0] if len(a) > 1 else 1.0
    if gap > 1e-6 * expected[-1]:  # otherwise the gradient does not exist, or rounding errors dominate it
        exact, gradient = np.outer(vectors[:, 0], vectors[:, 0]), np.asarray(gradient)
        np.testing.assert_allclose((gradient + gradient.T) / 2, exact, atol=1e3 * EPS * expected[-1] / gap + 1e-9)
