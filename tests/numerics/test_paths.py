"""Values inside nested parts by their paths."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax.numerics import paths
from ptsmc_jax.numerics.pytrees import pytree


class _State(NamedTuple):
    q: Any
    w: Any


@pytree
@dataclass(frozen=True)
class _Observer:
    gain: Any
    model: Any = None


@pytree
@dataclass(frozen=True)
class _Run:
    observer: _Observer
    initial: _State


RUN = _Run(_Observer(jnp.array([1.0, 2.0, 3.0])), _State(jnp.ones(4), jnp.zeros(3)))


@pytest.mark.parametrize("path", ["observer.gain", "observer.gain[1]", "initial.w", "initial", "observer.model"])
def test_the_value_that_is_put_at_a_path_is_read_there_and_nothing_else_changes(path):
    new = paths.put(RUN, path, jnp.asarray(7.0))
    assert float(paths.get(new, path)) == 7.0
    same = [k for k in ("observer.gain[0]", "observer.gain[2]", "initial.q") if not k.startswith(path)]
    for other in same:
        np.testing.assert_array_equal(paths.get(new, other), paths.get(RUN, other))
    assert float(paths.get(RUN, "observer.gain[1]")) == 2.0


def test_a_value_at_a_path_has_a_derivative():
    slope = jax.grad(lambda v: jnp.sum(paths.put(RUN, "observer.gain[1]", v).observer.gain ** 2))(3.0)
    assert float(slope) == 6.0


def test_a_path_exists_if_all_of_its_fields_do():
    assert paths.exists(RUN, "observer.model")  # which is None
    assert not paths.exists(RUN, "observer.model.inertia")
    assert not paths.exists(RUN, "observer.bias")
    with pytest.raises(AttributeError, match="bias"):
        paths.get(RUN, "observer.bias")
