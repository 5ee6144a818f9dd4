"""What the results of a trace differ over, each written down by hand."""

import jax
import jax.numpy as jnp
import pytest

from ptsmc_jax.batching import dependence

TEST, ONE, OTHER = 1, 2, 4  # the three inputs, a bit each


def chosen(test, one, other):
    """Which of two comes out hangs on the test."""
    return jax.lax.cond(test > 0.0, lambda: (one, other), lambda: (other, -other))


def called(test, one, other):
    return jax.jit(lambda a, b: (a + b, 2.0 * b))(one, other)


def summed(test, one, other):
    """The first carry takes up the second, and that one the rows, in the next turn."""

    def step(carry, row):
        a, b = carry
        return (a + b, row), a

    carry, rows = jax.lax.scan(step, (one, other), jnp.stack([test, test]))
    return (*carry, rows)


def repeated(test, one, other):
    """How often hangs on the test, and so does all that comes out."""
    return jax.lax.while_loop(
        lambda carry: carry[0] < test, lambda carry: (carry[0] + 1.0, 2.0 * carry[1]), (one, other)
    )


@pytest.mark.parametrize(("function", "expected"), [
    (chosen, [TEST | ONE | OTHER, TEST | OTHER]),
    (called, [ONE | OTHER, OTHER]),
    (summed, [TEST | ONE | OTHER, TEST | OTHER, TEST | ONE | OTHER]),
    (repeated, [TEST | ONE, TEST | ONE | OTHER]),
])  # fmt: skip
def test_results_differ_over_what_they_are_made_of_and_over_what_chooses(function, expected):
    closed = jax.make_jaxpr(function)(1.0, 2.0, 3.0)
    assert dependence.dependence(closed.jaxpr, [TEST, ONE, OTHER]) == expected
    assert dependence.dependence(closed.jaxpr, [0, 0, 0]) == [0] * len(expected)
