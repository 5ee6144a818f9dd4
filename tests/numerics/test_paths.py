"""Reading and replacing values inside nested dataclasses by their paths."""

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
