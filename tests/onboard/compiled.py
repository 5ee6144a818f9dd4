"""JAX functions and controllers compiled by the machine's C compiler, for the tests of C."""

import ctypes
import os
import shutil
import subprocess
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.batching.components import object_array
from ptsmc_jax.campaigns import store
from ptsmc_jax.onboard import folder, printing, templates
from ptsmc_jax.onboard.expressions import Pool, kind_of
from ptsmc_jax.onboard.library import compiler
from ptsmc_jax.onboard.translate import Translator

CC = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(CC is None, reason="this machine has no C compiler")
STRICT = "-std=c99 -pedantic -Wall -Wextra -Werror -Wconversion".split()
HEAD = """
#include <math.h>
#include <stdint.h>
typedef double real;
#define R(x) ((real)(x))
#define M(function) function
"""


def body(function, *args):
    """Return the C statements of a function of arrays as a list of lines, and the printer that wrote them.

    args: arrays with the shapes and types of its arguments.
    """
    closed = jax.make_jaxpr(function)(*args)
    pool, given, at = Pool(), [], 0
    for arg in args:
        array = np.asarray(arg)
        kind = kind_of(array.dtype)
        text = {"real": "in[{}]", "int": "(in[{}] != 0.0)"}.get(kind, f"(({kind})in[{{}}])")
        places = [pool.place(text.format(at + k), kind) for k in range(array.size)]
        given.append(object_array(array.shape, places))
        at += array.size
    results = Translator(pool).evaluate(closed, given)
    flat = [node for result in results for node in result.flat]
    printer = printing.Printer(["in", "out"])
    return printer.body(pool.block, [(f"out[{k}]", node) for k, node in enumerate(flat)]), printer


def source(function, *args):
    """Return the text of a C program that computes a function of arrays: run(in, out) with flat doubles."""
    lines, _ = body(function, *args)
    text = "\n".join(lines)
    helpers = "\n".join(code for name, code in templates.HELPERS.items() if f"{name}(" in text)
    signature = "void run(const double *in, double *out)"
    return f"{HEAD}{helpers}\n{signature};\n\n{signature}\n{{\n{text}\n}}\n"


def library(folder, text, *options):
    """Return a shared library as a `ctypes.CDLL`, compiled in the folder from the text of a C program.

    options: of the compiler.
    """
    path = folder / "run.c"
    path.write_text(text)
    flags = [*STRICT, "-O1", "-shared", "-fPIC", *options, str(path), "-o", str(folder / "run.so"), "-lm"]
    done = subprocess.run([*compiler(), *flags], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + text
    return ctypes.CDLL(str(folder / "run.so"))


def both(folder, function, *args):
    """Return the outputs of a function in C and in JAX, as two flat arrays; args: the arguments."""
    expected = np.concatenate(
        [np.ravel(np.asarray(v, dtype=float)) for v in jax.tree.leaves(function(*map(jnp.asarray, args)))]
    )
    given = np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in args])
    found = np.full(expected.shape, np.nan)
    run = library(folder, source(function, *map(jnp.asarray, args))).run
    run(given.ctypes.data_as(ctypes.c_void_p), found.ctypes.data_as(ctypes.c_void_p))
    return found, expected


def program(tables, place):
    """Write the controller of a scenario into the folder `place`, without test vectors; return the `folder.Controller`.

    tables: of the scenario.
    """
    made = folder.Controller(scenario.reading.complete(scenario.from_tables(tables)), "flight", "a scenario")
    store.write_folder(place, lambda making: folder.write_program(making, made))
    return made


def step_many(library, state, inputs, parameters: Any = np.nan, function="ptsmc_many"):
    """Return new states, outputs and statuses of a compiled controller for rows (.., columns) of state and inputs.

    parameters: NaN selects the parameters of the library. function: the C function that is called.
    """
    shape, columns = np.shape(state)[:-1], library.columns
    state, inputs = (
        np.ascontiguousarray(v, dtype=float).reshape(*shape, len(columns[kind]))  # C reads doubles
        for v, kind in ((state, "state"), (inputs, "in"))
    )
    rows = np.broadcast_to(np.asarray(parameters, float), (*shape, library.parameters.size))
    after, out, status = np.empty_like(state), np.empty((*shape, len(columns["out"]))), np.empty(shape, np.int32)
    arrays = np.ascontiguousarray(rows), state, inputs, after, out, status
    addresses = (ctypes.c_void_p(array.ctypes.data) for array in arrays)
    getattr(library.binary, function)(ctypes.c_long(status.size), *addresses)
    return after, out, status


def replayed(library, samples, state, **options):
    """Return statuses (samples,), outputs and states (samples, columns) of a compiled controller.

    samples: rows of inputs (samples, columns). state: before the first sample. options: of `step_many`.
    """
    statuses, outputs, states = [], [], []
    for row in samples:
        state, out, status = step_many(library, state, row, **options)
        statuses.append(int(status))
        outputs.append(out)
        states.append(state)
    return np.array(statuses), np.array(outputs), np.array(states)
