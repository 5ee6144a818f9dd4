"""Random numbers as a pure function of (seed, trial, name, sample): same values whatever the batch or the device.

Threefry-2x32 with 20 rounds (Salmon, Moraes, Dror, Shaw, SC11, 2011) on plain uint32. The rule, fixed for good:
    key   = threefry(key=(seed, 0), counter=(trial, crc32(name)))
    words = threefry(key, counter=(sample, block)), two a block
    uniform u = (word + 1/2) / 2^32; normals in pairs by Box-Muller, r cos(a) and r sin(a), r from the first word.
"""

import zlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from ptsmc_jax.numerics import elementary

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))

Word = UInt32[Array, "..."]
WholeNumber = int | np.integer | Array  # negative ones wrap to 32 bits


class Key(NamedTuple):
    """Key of one stream of one trial: two 32-bit words."""

    a: Array
    b: Array


def _word(value: WholeNumber) -> Array:
    check_fits("a seed, trial or sample", value)
    if isinstance(value, int):
        return jnp.asarray(np.uint32(value & 0xFFFFFFFF), dtype=jnp.uint32)
    number = jnp.asarray(value)
    if not jnp.issubdtype(number.dtype, jnp.integer):  # a cast would cut fractions off
        raise ValueError(f"a seed, trial or sample is of type {number.dtype}, but must be a whole number")
    return number.astype(jnp.uint32)


def _one(value: WholeNumber) -> Array:
    """A seed or trial as a word. Raises ValueError for several, whose streams would be mixed, sample by sample."""
    word = _word(value)
    if word.ndim:
        several = f"a seed or trial is of shape {word.shape}, but must be one number"
        raise ValueError(f"{several}; jax.vmap takes one at a time")
    return word


def check_whole_number(name: str, value: object, least: int = 0) -> None:
    """Raise ValueError where JAX would overflow, cut a fraction off, or count backwards; value: a known one."""
    number = np.asarray(value)
    if number.ndim or not np.issubdtype(number.dtype, np.integer) or not least <= number < 2**32:
        raise ValueError(f"{name} is {value!r}, but must be a whole number from {least} to {2**32 - 1}")


def check_fits(name: str, value: object) -> None:
    """Raise ValueError where a known whole number has more than 32 bits: its stream would be that of another one."""
    if isinstance(value, int | np.integer) and not -(2**31) <= value < 2**32:
        raise ValueError(f"{name} is {value}, but must be a whole number below 2^32 = {2**32}")


@jax.jit
def threefry(key: Key, counter: tuple[Word, Word]) -> tuple[Word, Word]:
    """The two words [-] of Threefry-2x32-20 for a key and a counter (broadcast against each other)."""
    schedule = (key.a, key.b, key.a ^ key.b ^ jnp.uint32(0x1BD11BDA))
    x, y = counter[0] + schedule[0], counter[1] + schedule[1]
    for group in range(5):
        for r in _ROTATIONS[group % 2]:
            x = x + y
            y = ((y << r) | (y >> (32 - r))) ^ x
        x = x + schedule[(group + 1) % 3]
        y = y + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    if jnp.result_type(float) != jnp.float64:  # without 64 bits there is no such number
        return x, y
    # packed into one number on the way: XLA then makes one kernel of all rounds, not one of each
    both = (x.astype(jnp.uint64) << 32) | y.astype(jnp.uint64)
    return (both >> 32).astype(jnp.uint32), both.astype(jnp.uint32)


def stream(seed: WholeNumber, trial: WholeNumber, name: str) -> Key:
    """Key [-] of the stream `name` of a trial; seed and trial are whole numbers from 0 to 2^32 - 1."""
    return _key(seed, trial, jnp.uint32(_label(name)))


def streams(seed: WholeNumber, trial: WholeNumber, names: Sequence[str]) -> list[Key]:
    """Keys [-] of several streams of a trial, each as `stream` gives it: less code to compile than one by one."""
    seed, trial = _word(seed), _word(trial)
    keys = jax.lax.map(lambda label: _key(seed, trial, label), np.array([_label(name) for name in names], np.uint32))
    return [Key(keys.a[k], keys.b[k]) for k in range(len(names))]


def _label(name: str) -> int:
    return zlib.crc32(name.encode())


def _key(seed: WholeNumber, trial: WholeNumber, label: Word) -> Key:
    return Key(*threefry(Key(_one(seed), jnp.uint32(0)), (_one(trial), label)))


def derive(seed: int, name: str) -> int:
    """Another seed, from 0 to 2^32 - 1, that follows from this one and a name (concrete, for whole studies)."""
    return int(stream(seed, 0, name).a)


@jax.jit
def _unit(word: Array) -> Array:
    """The number between 0 and 1 that a word stands for."""
    kind = jnp.result_type(float)
    below_one = np.nextafter(kind.type(1.0), kind.type(0.0))  # float32 would round the largest words up to 1
    return jnp.minimum((word.astype(kind) + kind.type(0.5)) * kind.type(2.0**-32), below_one)


def _uniform(a: Word, b: Word) -> tuple[Array, Array]:
    """The two uniform numbers of two words."""
    return _unit(a), _unit(b)


@jax.jit
def _normal(a: Word, b: Word) -> tuple[Array, Array]:
    """The two standard normal numbers of two words."""
    radius = jnp.sqrt(-2.0 * elementary.log(_unit(a)))
    cosine, sine = elementary.cos_sin_turns(_unit(b))
    return radius * cosine, radius * sine


Distribution = Literal["uniform", "normal"]
DISTRIBUTIONS: dict[Distribution, Callable] = {"uniform": _uniform, "normal": _normal}  # of two words


def _interleaved(pairs: tuple[Array, Array], count: int) -> Array:
    """The first `count` numbers of pairs (blocks,) each, pair after pair."""
    return jnp.stack(pairs, axis=1).reshape(-1)[:count]


@partial(jax.jit, static_argnames=("distribution", "count"))
def _numbers(distribution: Distribution, key: Key, sample: Word, count: int) -> Array:
    """`count` numbers of a stream's sample, by a loop over blocks of two: the same work, but less code to compile."""
    blocks = np.arange((count + 1) // 2, dtype=np.uint32)
    words = jax.lax.map(lambda block: threefry(key, (sample, block)), blocks)
    return _interleaved(DISTRIBUTIONS[distribution](*words), count)


def uniforms(key: Key, count: int, sample: WholeNumber = 0) -> Float[Array, " {count}"]:
    """(count,) numbers uniform on (0, 1) [-]; `sample` may be negative (it wraps to 32 bits).

    >>> key = stream(seed=0, trial=7, name="attitude_noise")
    >>> bool((uniforms(key, 3, sample=5) == uniforms(stream(0, 7, "attitude_noise"), 3, sample=5)).all())
    True
    """
    return _numbers("uniform", key, _word(sample), count)


def normals(key: Key, count: int, sample: WholeNumber = 0) -> Float[Array, " {count}"]:
    """(count,) standard normal numbers [-] (Box and Muller, Ann. Math. Stat. 29, 1958); |n| stays below 6.77."""
    return _numbers("normal", key, _word(sample), count)


def several(
    seed: WholeNumber, trial: WholeNumber, distribution: Distribution, counts: dict[str, int]
) -> dict[str, Array]:
    """The numbers (count,) [-] of several streams of a trial, as `uniforms` or `normals` give them for each.

    counts: how many, by the stream's name. All of them by one loop, over blocks of two numbers: the same work, but a
    fraction of the code to compile.
    """
    return _several(_word(seed), _word(trial), distribution, tuple(counts.items()))


@partial(jax.jit, static_argnames=("distribution", "counts"))
def _several(
    seed: Word, trial: Word, distribution: Distribution, counts: tuple[tuple[str, int], ...]
) -> dict[str, Array]:
    blocks = [(_label(name), block) for name, count in counts for block in range((count + 1) // 2)]

    def pair(row: Word) -> tuple[Array, Array]:
        return DISTRIBUTIONS[distribution](*threefry(_key(seed, trial, row[0]), (jnp.uint32(0), row[1])))

    first, second = jax.lax.map(pair, jnp.asarray(blocks, dtype=jnp.uint32).reshape(-1, 2))
    numbers, start = {}, 0
    for name, count in counts:
        end = start + (count + 1) // 2
        numbers[name] = _interleaved((first[start:end], second[start:end]), count)
        start = end
    return numbers
