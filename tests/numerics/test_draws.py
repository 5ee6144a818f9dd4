"""Random streams against the documented rule and published test vectors, and the uniqueness of their names."""

import ast
import importlib
import math
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax.batching import lanes
from ptsmc_jax.numerics import draws
from tests.tree import modules

# the rule in Python integers


def threefry(key, counter):
    """Return the two output words of Threefry-2x32 with 20 rounds; key, counter: two words each."""
    mask, turns = 0xFFFFFFFF, (13, 15, 26, 6, 17, 29, 16, 24)
    parity = 0x1BD11BDA ^ key[0] ^ key[1]
    schedule = [key[0], key[1], parity]
    x, y = (counter[0] + key[0]) & mask, (counter[1] + key[1]) & mask
    for k in range(20):
        x = (x + y) & mask
        y = (y << turns[k % 8] & mask | y >> 32 - turns[k % 8]) ^ x
        if k % 4 == 3:
            n = k // 4 + 1
            x, y = (x + schedule[n % 3]) & mask, (y + schedule[(n + 1) % 3] + n) & mask
    return x, y


def expected(seed, trial, name, sample, count):
    """Return two lists of `count` uniform and normal numbers of a stream by the documented rule."""
    key = threefry((seed, 0), (trial, zlib.crc32(name.encode())))
    pairs = [threefry(key, (sample % 2**32, block)) for block in range(-(-count // 2))]
    uniforms, normals = [], []
    for u, v in ([(word + 0.5) / 2**32 for word in pair] for pair in pairs):
        r = math.sqrt(-2 * math.log(u))
        uniforms += [u, v]
        normals += [r * math.cos(2 * math.pi * v), r * math.sin(2 * math.pi * v)]
    return uniforms[:count], normals[:count]


def words(*values):
    """Return a list of JAX uint32 scalars."""
    return [jnp.uint32(value) for value in values]


@pytest.mark.parametrize(
    ("key", "counter", "output"),
    [  # kat_vectors of Random123, threefry2x32 20
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_reproduces_the_published_test_vectors(key, counter, output):
    assert threefry(key, counter) == output  # checks the reference implementation of this file
    assert tuple(int(w) for w in draws.threefry(draws.Key(*words(*key)), tuple(words(*counter)))) == output


CASES = [
    (0, 0, "attitude_noise", 0, 1),
    (1, 2, "rate_noise", 7, 3),
    (2**32 - 1, 2**32 - 1, "", 2**32 - 1, 4),
    (20240229, 77, "initial attitude: \u03b7", -40, 7),
]


@pytest.mark.parametrize("case", CASES)
def test_random_numbers_follow_the_documented_rule(case):
    seed, trial, name, sample, count = case
    key = draws.stream(seed, trial, name)
    assert (int(key.a), int(key.b)) == threefry((seed, 0), (trial, zlib.crc32(name.encode())))
    uniforms, normals = expected(*case)
    np.testing.assert_array_equal(draws.uniforms(key, count, sample), uniforms)  # exact in 64 bits
    # log, cos and sin have errors of one or two ulp of numbers below 7; 2 pi v has a rounding error at 6
    np.testing.assert_allclose(draws.normals(key, count, sample), normals, rtol=0, atol=1e-14)


def test_random_streams_that_are_drawn_together_equal_single_streams():
    names, counts = ["rate_noise", "", "attitude_noise"], [1, 5, 4]
    keys = draws.streams(2**32 - 1, 7, names)
    assert keys == [draws.stream(2**32 - 1, 7, name) for name in names]
    for k, distribution in enumerate(draws.DISTRIBUTIONS):
        found = draws.draw_streams(2**32 - 1, 7, distribution, dict(zip(names, counts, strict=True)))
        for name, count in zip(names, counts, strict=True):
            np.testing.assert_allclose(found[name], expected(2**32 - 1, 7, name, 0, count)[k], rtol=0, atol=1e-14)


def test_derived_seed_is_the_first_word_of_a_random_stream():
    for seed, name in ((0, "fresh trials"), (2**32 - 1, "x")):
        got = draws.derive(seed, name)
        assert got == threefry((seed, 0), (0, zlib.crc32(name.encode())))[0]
        assert type(got) is int


@pytest.mark.parametrize("kind", [int, np.int64, np.int32, jnp.int32, jnp.int64])
def test_negative_sample_indices_wrap_to_32_bits(kind):
    key = draws.stream(5, 6, "name")
    for sample in (-1, -2, -(2**31)):
        np.testing.assert_array_equal(draws.normals(key, 3, kind(sample)), draws.normals(key, 3, sample % 2**32))


def test_seed_and_trial_may_have_any_integer_dtype():
    expected_key = draws.stream(2**32 - 5, 2**31 + 1, "name")
    for kind in (np.uint32, np.int64, jnp.uint32, jnp.int64):
        assert draws.stream(kind(2**32 - 5), kind(2**31 + 1), "name") == expected_key


def test_random_numbers_do_not_depend_on_the_batch():
    def one(trial, sample):
        key = draws.stream(11, trial, "rate_noise")
        return draws.uniforms(key, 3, sample), draws.normals(key, 5, sample)

    trials, samples = np.meshgrid(np.arange(3, dtype=np.uint32), np.arange(-2, 2, dtype=np.int32))
    trials, samples = jnp.asarray(trials.ravel()), jnp.asarray(samples.ravel())
    alone = [one(int(t), int(s)) for t, s in zip(trials, samples, strict=True)]
    alone = [np.stack(rows) for rows in zip(*alone, strict=True)]
    for batched in (jax.jit(jax.vmap(one)), jax.jit(lanes.vmap(one))):
        uniforms, normals = batched(trials, samples)
        np.testing.assert_array_equal(uniforms, alone[0])
        np.testing.assert_allclose(normals, alone[1], rtol=0, atol=1e-14)  # tolerance as above


def test_uniforms_are_below_1_and_normals_finite_in_single_precision():
    # this sample, found by a search, has a first word that float32 rounds up to 2^32
    sample = 26567072
    assert threefry(threefry((0, 0), (0, zlib.crc32(b"any"))), (sample, 0))[0] == 0xFFFFFF81
    with jax.enable_x64(False):
        key = draws.stream(0, 0, "any")
        u, n = draws.uniforms(key, 2, sample), draws.normals(key, 2, sample)
        assert u.dtype == n.dtype == jnp.float32
        assert np.all(np.isfinite(n))
        assert np.all((np.asarray(u) > 0) & (np.asarray(u) < 1))


DRAWING = {f"draws.{name}" for name in ("stream", "streams", "draw_streams", "derive")}


SENSORS = ("devices.sensors", "devices.sensor_suite")  # a run has one of the two, so they may share names


def stream_names():
    """Return a list of the names of random streams in all calls of `draws`, twice if two calls use a name.

    Names in the two modules of sensors count once. The export is left out, because it must use the streams of the
    simulation.
    """
    found = {module: module_stream_names(module, path) for module, path in modules().items() if "onboard" not in module}
    sensors = {name for module, names in found.items() if module.endswith(SENSORS) for name in names}
    others = [name for module, names in found.items() if not module.endswith(SENSORS) for name in names]
    return [*sensors, *others]


def module_stream_names(module, path):
    """Return a list of the names of random streams in the calls of `draws` in one module.

    Names of constants are replaced by their values. path: of the module's file.
    """
    source, names = path.read_text(), []
    if "draws." not in source:
        return names
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    drawing = [node for node in calls if ast.unparse(node.func) in DRAWING]
    known = vars(importlib.import_module(module)) if drawing else {}
    constants = {k: v for k, v in known.items() if k.isupper() and isinstance(v, str)}
    for node in drawing:
        last = node.args[-1]
        for name in last.elts if isinstance(last, ast.Tuple) else [last]:
            if isinstance(name, ast.Constant):
                names.append(name.value)
            elif ast.unparse(name) in constants:
                names.append(constants[ast.unparse(name)])
            else:  # a variable: any constant of the module may be meant
                names += [value for value in constants.values() if isinstance(value, str)]
    return names


def test_stream_names_are_unique_and_their_hashes_differ():
    names = stream_names()
    assert {"attitude_noise", "rate_noise", "initial_attitude"} <= set(names)
    assert len(names) == len(set(names))  # two uses of one name would have equal random numbers
    assert len({zlib.crc32(name.encode()) for name in names}) == len(names)
