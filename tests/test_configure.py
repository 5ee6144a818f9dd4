"""`configure`: compiler options, the folder of the compile cache, and calls that are repeated or come too late."""

import json
import os
import shutil
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import pytest

from ptsmc_jax import configure as setup
from ptsmc_jax import programs
from tests.helpers import ROOT


@pytest.mark.parametrize(
    "asked",
    [
        {"bits": "64"},
        {"bits": 16},
        {"device": "cuda"},
        {"device": "GPU"},
        {"devices": 0},
        {"devices": -1},
        {"devices": "2"},
    ],
)
def test_invalid_bits_and_devices_are_refused(asked):
    """An earlier version took other values for 32 bits, 0 devices for all, and negative numbers for one."""
    (name,) = asked
    with pytest.raises(ValueError, match=f"^{name} is .*, but must be"):
        setup.configure(**asked)


@pytest.mark.parametrize("said", ["", "elsewhere"])
def test_the_folder_of_the_compile_cache_follows_the_xdg_standard(tmp_path, monkeypatch, said):
    """The folder is in $XDG_CACHE_HOME, or in ~/.cache if the variable is not set or empty."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / said) if said else "")
    folder = setup._default_cache_folder()
    assert folder is not None
    assert folder.parent == tmp_path / (said or ".cache") / "ptsmc-jax"


def test_a_user_without_a_home_folder_has_no_compile_cache(monkeypatch):
    """A container may run under a user number without an entry in /etc/passwd."""

    def unknown():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(setup.Path, "home", unknown)
    assert setup._default_cache_folder() is None


ALL, EXTRA = setup._compiler_options("cpu"), "--xla_backend_extra_options"
LEVEL = "--xla_backend_optimization_level"


@pytest.mark.parametrize(
    ("jaxlib", "machine", "device", "included", "excluded"),
    [
        ("0.10", "x86_64", "cpu", ["-x86-machine-combiner=false", "--xla_cpu_use_fusion_emitters=false"], []),
        ("0.11", "x86_64", "cpu", ["-x86-machine-combiner=false"], ["--xla_cpu_use_fusion_emitters=false"]),
        ("0.10", "aarch64", "cpu", ["-unroll-runtime=false"], ["-x86-machine-combiner=false"]),
        ("0.10", "x86_64", "gpu", ["--xla_cpu_prefer_vector_width=512"], ["-unroll-runtime=false", f"{LEVEL}=1"]),
    ],
)
def test_compiler_options_depend_on_version_machine_and_device(
    monkeypatch, jaxlib, machine, device, included, excluded
):
    monkeypatch.setattr(setup, "JAXLIB", jaxlib)
    monkeypatch.setattr(setup, "MACHINE", machine)
    options = setup._compiler_options(device)
    assert set(included) <= set(options)
    assert not set(excluded) & set(options)


@pytest.mark.parametrize("plug_in", [None, "a plug-in"])
def test_default_compiler_options_are_for_a_gpu_if_a_plug_in_of_jax_is_installed(monkeypatch, plug_in):
    monkeypatch.setattr(setup.importlib.util, "find_spec", lambda name: plug_in)
    assert setup._compiler_options(None) == setup._compiler_options("gpu" if plug_in else "cpu")


def test_an_unknown_machine_gets_no_compiler_options_and_a_warning(monkeypatch):
    monkeypatch.setattr(setup, "MACHINE", "riscv64")
    with pytest.warns(RuntimeWarning, match="no compiler options are known for jaxlib .* on riscv64"):
        assert setup._compiler_options("cpu") == ()


def test_compiler_options_are_written_in_the_format_of_xla_flags():
    assert setup._merge_flags("", ("a=1", "--b=2", "-c=3")) == f"{EXTRA}=a=1,-c=3 --b=2"
    assert setup._merge_flags("", ()) == ""


@pytest.mark.parametrize(
    "user",
    ["", f"{LEVEL}=3", "--xla_cpu_enable_fast_math=false", f"{EXTRA}=x=1", "--xla_disable_hlo_passes=", "a/file"],
)
def test_compiler_options_of_the_user_take_precedence(user):
    """XLA uses the last of two equal options. No option is added to a decisive option or a file of the user."""
    flags = setup._merge_flags(user, ALL)
    assert flags.startswith(user)
    assert (flags == user) == user.startswith((EXTRA, "--xla_disable_hlo_passes", "a/file"))
    assert flags.count(f"{LEVEL}=") <= 1
    assert setup._merge_flags(flags, ALL) == flags  # a second call, or a child process
    assert setup._merge_flags(flags, ()) == user
    assert setup._merge_flags(setup._merge_flags(user, setup._compiler_options("gpu")), ALL) == flags


@pytest.mark.parametrize(
    "case", ["written by a group", "written by all", "of somebody else", "a link", "a file", "closed"]
)
def test_a_compile_cache_that_other_users_can_write_is_not_used(tmp_path, monkeypatch, case):
    """Loading an entry runs machine code, so other users must not write it."""
    folder = tmp_path / "cache"
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    if case.startswith("written"):
        folder.mkdir()
        folder.chmod(0o770 if "group" in case else 0o702)
    elif case == "of somebody else":
        monkeypatch.setattr(setup.os, "geteuid", lambda: -1)
    elif case == "a link":
        folder.symlink_to(tmp_path / "elsewhere")
    elif case == "a file":
        folder.write_text("")
    else:  # as in a container whose user has the HOME of root

        def refused(self, *args, **kwargs):
            raise PermissionError(13, "Permission denied", str(self))

        monkeypatch.setattr(setup.Path, "mkdir", refused)
    with pytest.warns(RuntimeWarning, match="is not used: it must be a folder that belongs to you"):
        assert setup._check_cache_folder(folder) is None


def test_a_new_compile_cache_is_closed_to_other_users_and_used_again(tmp_path):
    for _ in range(2):
        assert setup._check_cache_folder(tmp_path / "a" / "cache") == tmp_path / "a" / "cache"
    assert (tmp_path / "a" / "cache").stat().st_mode & 0o777 == 0o700


def test_a_read_only_compile_cache_causes_one_warning(tmp_path, monkeypatch):
    """JAX itself would warn for each entry."""
    monkeypatch.setattr(setup.os, "access", lambda *_: False)
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        assert setup._check_cache_folder(tmp_path) == tmp_path
        for k in range(3):
            warnings.warn(f"Error writing persistent compilation cache entry for 'jit_{k}': why", stacklevel=1)
        warnings.warn("something else", stacklevel=1)
    assert [str(one.message).endswith("takes no new entries") for one in shown] == [True, False]


def test_the_compiler_options_of_this_version_and_machine_change_no_result():
    """The test needs a separate process, because XLA ends a process that sets an unknown option."""

    def tried(options):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": setup._merge_flags("", options)}
        return subprocess.run([sys.executable, "-c", _TRIAL], env=environment, capture_output=True, check=False)

    assert tried(ALL).returncode == 0
    assert tried((*ALL, "--xla_no_such_flag=true")).returncode != 0


# a batch of 64 damped pendulums with a branch and a scalar clock, as in a simulation; also with the options of batches
_TRIAL = """
import sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp

def run(module, cond, loop, x, steps):
    def step(carry, k):
        x, v, most = carry
        d = module.sin(0.1 * k)
        a = d - module.sin(x) - 0.1 * v * module.sqrt(1.0 + v * v)
        v = v + 0.05 * a
        x = x + 0.05 * v
        late = cond(k > 50, lambda: module.maximum(most, module.abs(a)), lambda: most)
        return (x, v, late), None
    return loop(step, (x, 0.0 * x, 0.0 * x), module.arange(steps) * 1.0)[0]

def plain(step, carry, ks):
    for k in ks:
        carry, _ = step(carry, k)
    return carry, None

x = np.linspace(-3.0, 3.0, 64)
expected = run(np, lambda test, yes, no: yes() if test else no(), plain, x, 100)
for options in (None, {"xla_disable_hlo_passes": ""}):
    flown = jax.jit(lambda x: run(jnp, jax.lax.cond, jax.lax.scan, x, 100), compiler_options=options)
    if any(np.max(np.abs(np.asarray(a) - b)) > 1e-12 for a, b in zip(flown(jnp.asarray(x)), expected)):
        sys.exit(1)
"""


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="there is a GPU")
def test_a_missing_gpu_is_refused_in_one_sentence(tmp_path):
    """The test needs a separate process, like the first call of a user."""
    call = [sys.executable, "-c", "from tuning.cli.main import main; main()", "montecarlo", "--device", "gpu"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "tpu"}
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "ptsmc: --device is gpu, but JAX finds no GPU here; allowed is cpu, or install jax[cuda12]\n"
    assert list(tmp_path.iterdir()) == []


IN_TURN = """
import json, os, pathlib, sys
class Watching:
    def find_spec(self, name, *_):
        if name == "jaxlib":
            told["level"] = os.environ["TF_CPP_MIN_LOG_LEVEL"]
told, cache = {"flags": []}, pathlib.Path(sys.argv[1])
sys.meta_path.insert(0, Watching())
from ptsmc_jax.configure import configure

for fast in (True, False, True):
    configure(1, cache, fast, device="cpu", bits=32, keep_programs=True)
    told["flags"].append(os.environ["XLA_FLAGS"])
import jax

f = jax.jit(lambda x: 3.0 * x + 1.0)
told["found"] = [float(f(2.0))]
told["set"] = [str(jax.numpy.zeros(1).dtype), jax.config.jax_platforms, jax.config.jax_numpy_dtype_promotion]
configure(1, cache, device="cpu", bits=32)
import warnings
jax.config.update("jax_persistent_cache_min_compile_time_secs", 7.0)  # as set by the user since
before = warnings.showwarning, list(warnings.filters)
configure(1, cache, device="cpu", bits=32)
unchanged = before == (warnings.showwarning, warnings.filters)
told["second"] = [unchanged, jax.config.jax_persistent_cache_min_compile_time_secs]
told["flags"].append(os.environ["XLA_FLAGS"])
try:
    configure(1, cache, fast=False, device="cpu", bits=32)
except RuntimeError as error:
    told["refused"] = str(error)
for entry in cache.glob("*-cache"):
    entry.write_bytes(entry.read_bytes()[:-20])
    told["cut"] = True
jax.clear_caches()
told["found"].append(float(f(2.0)))
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Return the results, a dict, of a process that calls `configure` several times, before and after JAX has run."""
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    environment["JAX_NUMPY_DTYPE_PROMOTION"] = "strict"  # a setting for the user's code, not for stored programs
    cache = tmp_path_factory.mktemp("cache")
    call = [sys.executable, "-c", IN_TURN, str(cache)]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_a_second_call_of_configure_with_the_same_arguments_does_nothing(told):
    assert told["second"] == [True, 7.0]


def test_bits_and_device_are_set_and_the_compiler_is_silent(told):
    """The log of XLA ("Very slow compile?") is off before jaxlib is loaded, since jaxlib reads the level once."""
    assert (told["level"], told["set"]) == ("3", ["float32", "cpu", "standard"])


def test_compiler_options_can_change_only_before_jax_runs(told):
    fast, plain, again, late = told["flags"]
    assert fast == again == late != ""
    assert plain.strip() == ""
    assert "than fast=False asks for" in told["refused"]


def test_programs_with_truncated_cache_entries_are_compiled_again(told):
    """A process that starts at the same time can see truncated entries. It must not warn."""
    assert (told["found"], told["cut"]) == ([7.0, 7.0], True)


@pytest.mark.parametrize("options", [None, programs.FAST_COMPILE], ids=["as usual", "quickly"])
def test_reverse_mode_writes_its_residuals_in_place(options):
    """XLA would copy whole arrays in every step if a fusion with several outputs wrote into them."""

    def off(x):
        def step(carry, t):
            x, v = carry
            return (x + 0.1 * v, v - 0.1 * jnp.sin(x) * jnp.cos(t * v)), None

        return jnp.sum(jax.lax.scan(step, (x, 0.5 * x), jnp.arange(2000.0))[0][0] ** 2)

    compiled = jax.jit(jax.grad(off), compiler_options=options).lower(jnp.arange(3.0)).compile().as_text()
    writes = [line.split()[0] for line in str(compiled).splitlines() if " dynamic-update-slice(" in line]
    assert len(writes) >= 4
    assert set(writes) == {"ROOT"}  # each write is the only output of its fusion
