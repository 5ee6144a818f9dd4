"""What those who know JAX expect: plain functions among the parts, names at the top, a late configure in a sentence."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np

import ptsmc_jax as ptsmc
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.signals.disturbances import Sinusoid
from ptsmc_jax.signals.references import Fixed
from tests.helpers import parts

WAVE = Sinusoid(*(vector(v) for v in ([0.01] * 3, [0.1] * 3, [0.0] * 3, [0.0] * 3)))


def test_a_lambda_is_a_disturbance_and_a_function_a_reference_under_jit():
    """The same numbers as the parts of the library, to rounding."""
    still = Fixed(vector([0.0, 0.0, 0.0, 1.0]))

    def reference(t):
        return still(t)

    wave = parts(8.0, 3.0, 0.5, disturbance=WAVE, period=0.1, flight=True)
    plain = parts(8.0, 3.0, 0.5, disturbance=lambda t, x: 0.01 * jnp.sin(0.1 * t) * jnp.ones(3), reference=reference,
                  period=0.1, flight=True)  # fmt: skip
    expected, found = (ptsmc.simulate_jit(run, np.uint32(0), np.uint32(0)).metrics for run in (wave, plain))
    np.testing.assert_allclose(found.window_error, expected.window_error, rtol=1e-9)


def test_the_names_that_everybody_needs_are_at_the_top():
    for name in ("one", "run", "study", "Reach", "reach_of"):
        assert callable(getattr(ptsmc, name))


def said(code):
    call = subprocess.run([sys.executable, "-W", "always", "-c", code], capture_output=True, text=True, check=False)
    return call.stderr


def test_forgetting_configure_warns_and_calling_it_late_says_so_in_one_sentence():
    late = said(
        "import ptsmc_jax as ptsmc\nfrom ptsmc_jax.scenario import from_tables\nptsmc.study(from_tables({}))\n"
        "from ptsmc_jax.configure import configure\nconfigure(devices=2, cache=None, fast=False)"
    )
    assert "JAX computes with 32 bits here" in late
    assert late.splitlines()[-1].startswith("RuntimeError: configure() comes too late")
