"""Random numbers as a pure function of seed, trial, stream name and sample index.

The numbers do not depend on the batch, the device or the order of evaluation. Read `stream` first, which returns the
key of a stream, then `uniforms` and `normals`. The generator is Threefry-2x32 with 20 rounds (Salmon, Moraes, Dror,
Shaw, SC11, 2011) on uint32 words. The following rule must never change, because results depend on it:

    key   = threefry(key=(seed, 0), counter=(trial, crc32(name)))
    words = threefry(key, counter=(sample, block)), two words for each block
    uniform numbers: u = (word + 1/2) / 2^32
    normal numbers: pairs r cos(a) and r sin(a) by Box-Muller, r from the first word, a from the second
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
LEAST_SAMPLE = -(2**31)  # smallest number of a sample; a negative one wraps to 32 bits
WholeNumber = int | np.integer | Array  # a negative number that JAX traces wraps to 32 bits


class Key(NamedTuple):
    """Key of one random stream of one trial: two 32-bit words."""

    a: Array
    b: Array


def _to_word(value: WholeNumber, least: int = 0) -> Array:
    """Return a seed, trial or sample of at least `least` as an unsigned 32-bit integer."""
    check_fits("a seed, trial or sample", value, least)
    if isinstance(value, int):
        return jnp.asarray(np.uint32(value & 0xFFFFFFFF), dtype=jnp.uint32)
    number = jnp.asarray(value)
    if not jnp.issubdtype(number.dtype, jnp.integer):  # a cast would truncate fractions
        raise ValueError(f"a seed, trial or sample is of type {number.dtype}, but must be a whole number")
    return number.astype(jnp.uint32)


def _to_scalar_word(value: WholeNumber) -> Array:
    """Return a seed or trial as a scalar word. An array is refused: its streams would be mixed sample by sample."""
    word = _to_word(value)
    if word.ndim:
        raise ValueError(f"a seed or trial is of shape {word.shape}, but must be one number; use jax.vmap for several")
    return word


def check_whole_number(name: str, value: object, least: int = 0) -> None:
    """Raise ValueError unless a concrete value is a scalar integer from `least` to 2^32 - 1.

    JAX itself would let it overflow, truncate a fraction, or count backwards.

    Args:
        name: name of the value in the message.
        value: the value, not traced.
        least: smallest allowed value.

    Raises:
        ValueError: The value is not such an integer.
    """
    number = np.asarray(value)
    if number.ndim or not np.issubdtype(number.dtype, np.integer) or not least <= number < 2**32:
        raise ValueError(f"{name} is {value!r}, but must be a whole number from {least} to {2**32 - 1}")


def check_fits(name: str, value: object, least: int = 0) -> None:
    """Raise ValueError if a concrete integer is not in [`least`, 2^32). Its stream would equal that of another integer.

    Args:
        name: name of the value in the message.
        value: any value; only concrete integers are checked.
        least: smallest allowed integer.
    """
    if isinstance(value, int | np.integer) and not least <= value < 2**32:
        raise ValueError(f"{name} is {value}, but must be a whole number from {least} to {2**32 - 1}")


@jax.jit
def threefry(key: Key, counter: tuple[Word, Word]) -> tuple[Word, Word]:
    """Return the two words [-] of Threefry-2x32-20 for a key and a counter, which broadcast against each other."""
    schedule = (key.a, key.b, key.a ^ key.b ^ jnp.uint32(0x1BD11BDA))
    x, y = counter[0] + schedule[0], counter[1] + schedule[1]
    for group in range(5):
        for r in _ROTATIONS[group % 2]:
            x = x + y
            y = ((y << r) | (y >> (32 - r))) ^ x
        x = x + schedule[(group + 1) % 3]
        y = y + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    if jnp.result_type(float) != jnp.float64:  # JAX without 64 bits has no uint64 to pack the words
        return x, y
    # Both words are packed into one number for a moment. XLA then fuses all rounds into one kernel.
    both = (x.astype(jnp.uint64) << 32) | y.astype(jnp.uint64)
    return (both >> 32).astype(jnp.uint32), both.astype(jnp.uint32)


def stream(seed: WholeNumber, trial: WholeNumber, name: str) -> Key:
    """Return the key of a random stream of a trial.

    Args:
        seed: integer from 0 to 2^32 - 1 [-].
        trial: number of the trial, from 0 to 2^32 - 1 [-].
        name: name of the stream, such as "rate_noise".

    Raises:
        ValueError: The seed or the trial is no scalar integer of 32 bits.
    """
    return _stream_key(seed, trial, jnp.uint32(_hash_name(name)))


def streams(seed: WholeNumber, trial: WholeNumber, names: Sequence[str]) -> list[Key]:
    """Return the keys of several random streams of a trial, with less code to compile than calls of `stream`.

    Args:
        seed: whole number that selects the random numbers, together with `trial` [-].
        trial: number of the trial [-].
        names: names of the streams.
    """
    seed, trial = _to_word(seed), _to_word(trial)
    hashes = np.array([_hash_name(name) for name in names], np.uint32)
    keys = jax.lax.map(lambda name_hash: _stream_key(seed, trial, name_hash), hashes)
    return [Key(keys.a[k], keys.b[k]) for k in range(len(names))]


def _hash_name(name: str) -> int:
    """Return the CRC-32 of the name of a stream."""
    return zlib.crc32(name.encode())


def _stream_key(seed: WholeNumber, trial: WholeNumber, name_hash: Word) -> Key:
    """Return the key of a stream from seed, trial and the hash of its name."""
    return Key(*threefry(Key(_to_scalar_word(seed), jnp.uint32(0)), (_to_scalar_word(trial), name_hash)))


def derive(seed: int, name: str) -> int:
    """Derive another seed, from 0 to 2^32 - 1 [-], from a seed and a name, for example for held-out trials."""
    return int(stream(seed, 0, name).a)


@jax.jit
def _to_unit_interval(word: Array) -> Array:
    """Return (word + 1/2) / 2^32, which is inside (0, 1)."""
    dtype = jnp.result_type(float)
    below_one = np.nextafter(dtype.type(1.0), dtype.type(0.0))  # float32 would round the largest words up to 1
    return jnp.minimum((word.astype(dtype) + dtype.type(0.5)) * dtype.type(2.0**-32), below_one)


@jax.jit
def _normal_pair(a: Word, b: Word) -> tuple[Array, Array]:
    """Return two standard normal numbers from two words."""
    radius = jnp.sqrt(-2.0 * elementary.log(_to_unit_interval(a)))
    cosine, sine = elementary.cos_sin_turns(_to_unit_interval(b))
    return radius * cosine, radius * sine


Distribution = Literal["uniform", "normal"]
# functions that convert two words to two random numbers
DISTRIBUTIONS: dict[Distribution, Callable] = {
    "uniform": lambda a, b: (_to_unit_interval(a), _to_unit_interval(b)),
    "normal": _normal_pair,
}


def _interleave(pairs: tuple[Array, Array], count: int) -> Array:
    """Return the first `count` of the numbers a_0, b_0, a_1, b_1, .. from two arrays a and b (blocks,)."""
    return jnp.stack(pairs, axis=1).reshape(-1)[:count]


@partial(jax.jit, static_argnames=("distribution", "count"))
def _draw(distribution: Distribution, key: Key, sample: Word, count: int) -> Array:
    """Return `count` numbers of one sample of a stream. A loop over blocks of two numbers has less code to compile."""
    blocks = np.arange((count + 1) // 2, dtype=np.uint32)
    words = jax.lax.map(lambda block: threefry(key, (sample, block)), blocks)
    return _interleave(DISTRIBUTIONS[distribution](*words), count)


def uniforms(key: Key, count: int, sample: WholeNumber = 0) -> Float[Array, " {count}"]:
    """Return (count,) numbers that are uniform on (0, 1) [-].

    Args:
        key: key of the stream.
        count: how many numbers.
        sample: index of the sample; a negative index wraps to 32 bits.

    >>> key = stream(seed=0, trial=7, name="attitude_noise")
    >>> bool((uniforms(key, 3, sample=5) == uniforms(stream(0, 7, "attitude_noise"), 3, sample=5)).all())
    True
    """
    return _draw("uniform", key, _to_word(sample, LEAST_SAMPLE), count)


def normals(key: Key, count: int, sample: WholeNumber = 0) -> Float[Array, " {count}"]:
    """Return (count,) standard normal numbers [-] (Box and Muller, Ann. Math. Stat. 29, 1958). All are below 6.77.

    Args:
        key: key of the stream.
        count: how many numbers.
        sample: index of the sample; a negative index wraps to 32 bits.
    """
    return _draw("normal", key, _to_word(sample, LEAST_SAMPLE), count)


def draw_streams(
    seed: WholeNumber, trial: WholeNumber, distribution: Distribution, counts: dict[str, int]
) -> dict[str, Array]:
    """Return the numbers of several streams of a trial, equal to separate calls of `uniforms` or `normals`.

    One loop computes all numbers. It takes a fraction of the code that separate calls compile.

    Args:
        seed: whole number that selects the random numbers, together with `trial` [-].
        trial: number of the trial [-].
        distribution: distribution of the numbers.
        counts: how many numbers, by the name of the stream.

    Returns:
        The numbers (count,) [-], by the name of the stream.
    """
    return _draw_streams(_to_word(seed), _to_word(trial), distribution, tuple(counts.items()))


@partial(jax.jit, static_argnames=("distribution", "counts"))
def _draw_streams(
    seed: Word, trial: Word, distribution: Distribution, counts: tuple[tuple[str, int], ...]
) -> dict[str, Array]:
    """Return the numbers (count,) of each stream, by name; `counts`: pairs of name and count, see `draw_streams`."""
    blocks = [(_hash_name(name), block) for name, count in counts for block in range((count + 1) // 2)]

    def draw_pair(row: Word) -> tuple[Array, Array]:
        return DISTRIBUTIONS[distribution](*threefry(_stream_key(seed, trial, row[0]), (jnp.uint32(0), row[1])))

    first, second = jax.lax.map(draw_pair, jnp.asarray(blocks, dtype=jnp.uint32).reshape(-1, 2))
    numbers, start = {}, 0
    for name, count in counts:
        end = start + (count + 1) // 2
        numbers[name] = _interleave((first[start:end], second[start:end]), count)
        start = end
    return numbers
