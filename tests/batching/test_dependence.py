"""Dependence of the outputs of a jaxpr on its inputs, against flags that are written by hand."""

import jax
import jax.numpy as jnp
import pytest

from ptsmc_jax.batching import dependence

TEST, ONE, OTHER = 1, 2, 4  # one bit for each of the three inputs


def chosen(test, one, other):
    """Return (one, other) if test > 0, else (other, -other), by `cond`.

    Both outputs depend on `test` and `other`, and only the first depends on `one`.
    """
    return jax.lax.cond(test > 0.0, lambda: (one, other), lambda: (other, -other))


def jitted(test, one, other):
    """Return one + other and 2 other from a jitted function. They do not depend on `test`."""
    return jax.jit(lambda a, b: (a + b, 2.0 * b))(one, other)


def shifted(test, one, other):
    """Scan twice over the test; return both last carries, and the first carry before each step (2,).

    The first carry depends on the second, which is the row of the previous step.
    """

    def step(carry, row):
        a, b = carry
        return (a + b, row), a

    carry, rows = jax.lax.scan(step, (one, other), jnp.stack([test, test]))
    return (*carry, rows)


def repeated(test, one, other):
    """Add 1 to `one` and double `other` while one < test; return both.

    Both depend on the test, which determines the number of steps.
    """
    return jax.lax.while_loop(
        lambda carry: carry[0] < test, lambda carry: (carry[0] + 1.0, 2.0 * carry[1]), (one, other)
    )


@pytest.mark.parametrize(("function", "expected"), [
    (chosen, [TEST | ONE | OTHER, TEST | OTHER]),
    (jitted, [ONE | OTHER, OTHER]),
    (shifted, [TEST | ONE | OTHER, TEST | OTHER, TEST | ONE | OTHER]),
    (repeated, [TEST | ONE, TEST | ONE | OTHER]),
])  # fmt: skip
def test_dependence_of_outputs_includes_operands_and_conditions(function, expected):
    closed = jax.make_jaxpr(function)(1.0, 2.0, 3.0)
    assert dependence.dependence(closed.jaxpr, [TEST, ONE, OTHER]) == expected
    assert dependence.dependence(closed.jaxpr, [0, 0, 0]) == [0] * len(expected)
