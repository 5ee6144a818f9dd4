"""How lanes go through JAX's loops and branches, which take arrays: for `lanes`."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.batching import components
from ptsmc_jax.batching.components import DIRECTION, TRIAL, Lane, dense_of, object_array, parts_of, plain


class Packed:
    """How values are handed through JAX's loops and branches: lanes as tuples of components, large ones dense."""

    def __init__(self, variables: Sequence, differs: Sequence[int], leads: Sequence[tuple[int, ...]]):
        self.shapes, self.kinds = ([getattr(v.aval, name) for v in variables] for name in ("shape", "dtype"))
        self.differs, self.leads = differs, leads

    def pack(self, values: Sequence) -> tuple:
        """What JAX is handed for these values."""
        return tuple(self._pack(*item) for item in zip(values, self.shapes, self.differs, strict=True))

    def _pack(self, value: Any, shape: tuple[int, ...], differs: int) -> Any:
        if not differs:
            return plain(value)
        lead = self.leads[differs]
        if not self.apart(shape, differs):
            return dense_of(value, lead)
        return tuple(jnp.broadcast_to(part, lead) for part in parts_of(value).flat)

    def unpack(self, packed: Sequence) -> list:
        """The values of what JAX hands back."""
        return [self._unpack(*item) for item in zip(packed, self.shapes, self.differs, strict=True)]

    def _unpack(self, value: Any, shape: tuple[int, ...], differs: int) -> Any:
        if not differs:
            return value
        parts, dense = (object_array(shape, value), None) if self.apart(shape, differs) else (None, value)
        return Lane(shape, parts, dense, differs)

    def of_all(self, k: int, parts: np.ndarray) -> Any:
        """The k-th value as it is handed on, from components over all trials, and all directions if there are any."""
        shape, differs = self.shapes[k], self.differs[k]
        axes = self.leads[TRIAL | differs]  # that these components have, but for directions they do not differ over
        own = [part if part.ndim == len(axes) else part[0] for part in parts.flat]
        if differs & TRIAL:
            return tuple(own) if self.apart(shape, differs) else Lane(shape, object_array(shape, own)).dense(axes)
        if not own:
            return jnp.zeros((*self.leads[differs], *shape), self.kinds[k])
        first = [part[..., :1] if differs else part[0] for part in own]
        return jnp.stack(first, axis=-1).reshape((*self.leads[differs], *shape)) if shape else first[0]

    @staticmethod
    def apart(shape: tuple[int, ...], differs: int) -> bool:
        """Whether a value is taken apart: one that is equal in all trials would gain nothing."""
        return components.small(shape) and differs != DIRECTION
