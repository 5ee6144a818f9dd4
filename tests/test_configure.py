"""Compiler options are tried out before they are used; what is refused is left out with a warning."""

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

GOOD = setup._OPTIONS


@pytest.fixture
def tried(monkeypatch):
    """Which sets of options were tried; those with "bad" in a name are refused."""
    seen = []

    def try_out(options):
        seen.append(options)
        return not any("bad" in option for option in options)

    monkeypatch.setattr(setup, "_tried", try_out)
    return seen


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
def test_other_bits_and_devices_are_refused(asked):
    """Whatever was not the number 64 was taken for 32 bits, no devices for all and fewer than none for one."""
    (name,) = asked
    with pytest.raises(ValueError, match=f"^{name} is .*, but must be"):
        setup.configure(**asked)


def test_options_are_written_as_xla_reads_them():
    assert setup._flags(("a=1", "--b=2", "-c=3")) == "--xla_backend_extra_options=a=1,-c=3 --b=2"
    assert setup._flags(()) == ""


@pytest.mark.parametrize("said", ["", "elsewhere"])
def test_the_cache_lies_where_the_desktop_standard_says(tmp_path, monkeypatch, said):
    """$XDG_CACHE_HOME, or ~/.cache where that is not set or empty."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / said) if said else "")
    folder = setup._cache_folder()
    assert folder is not None
    assert folder.parent == tmp_path / (said or ".cache") / "ptsmc-jax"


def test_a_user_without_a_home_has_no_cache(monkeypatch):
    """As in a container, under a number that is nobody's."""

    def unknown():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(setup.Path, "home", unknown)
    assert setup._cache_folder() is None


def test_the_verdict_is_kept_and_not_asked_for_again(tried, tmp_path):
    assert setup._accepted(tmp_path) == GOOD
    assert setup._accepted(tmp_path) == GOOD
    assert len(tried) == 1
    (kept,) = tmp_path.glob("options-*.json")
    for text in ("", "[]", json.dumps({"tried": ["other"], "accepted": []})):  # cut short, foreign, of another version
        kept.write_text(text)
        assert setup._accepted(tmp_path) == GOOD
    assert len(tried) == 4


def test_refused_options_are_left_out_with_a_warning(tried, tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "_OPTIONS", (*GOOD[:2], "bad=1", GOOD[3]))
    with pytest.warns(RuntimeWarning, match="refuses bad=1: runs will be slower"):
        assert setup._accepted(tmp_path) == (*GOOD[:2], GOOD[3])


def test_options_that_only_fail_together_are_all_left_out(monkeypatch):
    monkeypatch.setattr(setup, "_tried", lambda options: len(options) == 1)
    with pytest.warns(RuntimeWarning, match=f"refuses {GOOD[0]}, {GOOD[1]}"):
        assert setup._accepted(None) == ()


@pytest.mark.parametrize("found", [None, "a plug-in"])
def test_what_makes_a_processors_programs_sooner_is_left_out_where_a_gpu_may_fly(tried, tmp_path, monkeypatch, found):
    """Its compiler would unroll no loops either, of which nobody knows what they take there."""
    monkeypatch.setattr(setup.importlib.util, "find_spec", lambda name: found)
    assert setup._options(tmp_path, "cpu") == GOOD
    assert setup._options(tmp_path, "gpu") == setup._FASTER
    assert setup._options(tmp_path, None) == (GOOD if found is None else setup._FASTER)
    assert len(tried) == 1


def test_an_option_that_the_user_has_set_stays(tried, monkeypatch):
    """XLA takes the last of two."""
    monkeypatch.setattr(setup, "_has_started", lambda: False)
    monkeypatch.setattr(setup, "_added", "nothing yet")
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
    setup._set_compiler_options(fast=True, folder=None, device="cpu")
    others = tuple(option for option in GOOD if "optimization_level" not in option)
    assert os.environ["XLA_FLAGS"] == f"--xla_backend_optimization_level=3 {setup._flags(others)}"
    for added in (setup._added, setup._flags(GOOD)):  # here, and in a process that this one begins
        monkeypatch.setattr(setup, "_added", added)
        monkeypatch.setenv("XLA_FLAGS", f"--xla_backend_optimization_level=3 {setup._flags(others)}")
        setup._set_compiler_options(fast=False, folder=None, device="cpu")
        assert os.environ["XLA_FLAGS"] == "--xla_backend_optimization_level=3"


@pytest.mark.parametrize("fast", [True, False])
def test_options_that_the_user_has_in_a_file_stay(tried, tmp_path, monkeypatch, fast):
    """XLA took the file's name with ours behind it for the name of another one, and ended the process."""
    file = tmp_path / "options"
    file.write_text("# of all\n--xla_backend_optimization_level=3\n --xla_cpu_enable_fast_math=false\n")
    monkeypatch.setattr(setup, "_has_started", lambda: not fast)
    monkeypatch.setattr(setup, "_added", "nothing yet")
    monkeypatch.setenv("XLA_FLAGS", str(file))
    setup._set_compiler_options(fast=fast, folder=None, device="cpu")
    theirs = "--xla_backend_optimization_level=3 --xla_cpu_enable_fast_math=false"
    others = tuple(option for option in GOOD if "optimization_level" not in option)
    assert os.environ["XLA_FLAGS"] == (f"{theirs} {setup._flags(others)}" if fast else str(file))


def test_a_cache_that_cannot_be_written_is_none(tried, tmp_path):
    (tmp_path / "file").write_text("")
    assert setup._accepted(tmp_path / "file") == GOOD


def test_a_cache_of_somebody_else_that_cannot_be_read_is_none(tried, tmp_path, monkeypatch):
    """As in a container that runs as a user whose HOME is root's."""

    def closed(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(setup, "version", lambda package: "0.10.2")  # read from a file, too
    for name in ("stat", "read_text", "write_text", "mkdir"):
        monkeypatch.setattr(setup.Path, name, closed)
    assert setup._accepted(tmp_path / "closed") == GOOD


def test_the_trial_run_accepts_these_options_and_refuses_unknown_ones(monkeypatch):
    """In processes of their own, as a user's first call: an unknown flag ends the process, wrong numbers too."""
    monkeypatch.setenv("JAX_NUMPY_DTYPE_PROMOTION", "strict")  # of a user's own code: no word on the options
    assert setup._tried(GOOD)
    assert not setup._tried((*GOOD, "--xla_no_such_flag=true"))


def test_the_trial_run_refuses_other_numbers():
    """In this process: how one of its own ends is told above."""
    exec(setup._TRIAL, {})
    with pytest.raises(SystemExit, match="1"):
        exec(setup._TRIAL.replace("scan, x, 100)", "scan, 1.000001 * x, 100)"), {})


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused_in_one_sentence(tmp_path):
    """In a process of its own, as a user's first call; it is looked for as JAX does by itself, whatever it is told."""
    call = [sys.executable, "-c", "from tuning.cli.main import main; main()", "montecarlo", "--device", "gpu"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "tpu"}
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "ptsmc: --device is gpu, but JAX finds no GPU here; allowed is cpu, or install jax[cuda12]\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long  # asked for by that name, or a TPU: no such sentence as above
def test_a_gpu_is_looked_for_as_jax_does_by_itself(tmp_path):
    """Asked for by the name "gpu", JAX wants every maker's, and finds none where one of them is missing."""
    code = (
        "import jax; jax.default_backend = lambda: 'gpu'\n"
        "from ptsmc_jax.configure import configure; configure(device='gpu', cache=None, fast=False)\n"
        "print(jax.config.jax_platforms, len(jax.devices()) > 0)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "tpu"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("None True\n", "")


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
    """What a process says that calls `configure` several times, before anything runs on JAX and after."""
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    environment["JAX_NUMPY_DTYPE_PROMOTION"] = "strict"  # of a user's own code: not of what is kept
    cache, ours = tmp_path_factory.mktemp("cache"), setup._cache_folder()
    for verdict in ours.glob("options-*.json") if ours else ():
        shutil.copy(verdict, cache)
    call = [sys.executable, "-c", IN_TURN, str(cache)]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_bits_and_device_are_set_and_the_compiler_is_silent(told):
    """XLA's log ("Very slow compile?") is off when jaxlib is looked for, which reads its level once."""
    assert (told["level"], told["set"]) == ("3", ["float32", "cpu", "standard"])


def test_other_compiler_options_are_set_before_anything_runs_or_refused(told):
    fast, plain, again, late = told["flags"]
    assert fast == again == late != ""
    assert plain.strip() == ""
    assert "than fast=False asks for" in told["refused"]


def test_programs_that_are_cut_short_in_the_cache_are_compiled_again(told):
    """As another process sees them that starts at the same time: nothing is said of the first ones."""
    assert (told["found"], told["cut"]) == ([7.0, 7.0], True)


@pytest.mark.parametrize(
    ("does", "said"), [("reading", "rejects its own entries"), ("writing", "takes no new entries")]
)
def test_a_cache_that_rejects_its_own_entries_or_takes_none_is_told_of_once(capsys, tmp_path, does, said):
    """Of the first ones nothing: another process may be writing them. Other warnings are shown as ever."""
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = lambda message, *where, **more: print(message, file=sys.stderr)
        setup._tell_of_rejected_once(tmp_path)
        for k in range(10):
            told = capsys.readouterr().err
            assert (said in told) == (k == setup.SEVERAL)
            assert bool(told) == (k == setup.SEVERAL)
            warnings.warn(f"Error {does} persistent compilation cache entry for 'jit_{k}': why", stacklevel=1)
        warnings.warn("something else", stacklevel=1)
    assert "something else" in capsys.readouterr().err


@pytest.mark.parametrize("options", [None, programs.QUICKLY], ids=["as usual", "quickly"])
def test_what_reverse_mode_keeps_of_each_step_is_written_in_place(options):
    """XLA copies whole arrays in every step where a fusion of several outputs writes into them."""

    def off(x):
        def step(carry, t):
            x, v = carry
            return (x + 0.1 * v, v - 0.1 * jnp.sin(x) * jnp.cos(t * v)), None

        return jnp.sum(jax.lax.scan(step, (x, 0.5 * x), jnp.arange(2000.0))[0][0] ** 2)

    compiled = jax.jit(jax.grad(off), compiler_options=options).lower(jnp.arange(3.0)).compile().as_text()
    writes = [line.split()[0] for line in str(compiled).splitlines() if " dynamic-update-slice(" in line]
    assert len(writes) >= 4
    assert set(writes) == {"ROOT"}  # each the only output of its fusion
