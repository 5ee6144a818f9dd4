"""Programs beside the exported controller: the process behind UDP, and the shared library."""

import ctypes
import runpy
import shutil
import socket
import subprocess
import time

import numpy as np
import pytest

from ptsmc_jax.onboard.library import Library
from tests.onboard.compiled import needs_compiler, program, step_many
from tests.onboard.flights import FLIGHTS

pytestmark = [needs_compiler, pytest.mark.skipif(shutil.which("make") is None, reason="this machine has no make")]
SAMPLES = 5


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the folder of a controller with its compiled programs, and [(inputs, outputs, status), ..] of samples."""
    place = tmp_path_factory.mktemp("glue") / "controller"
    program(FLIGHTS["raw"], place)
    for target in ("udp", "shared"):
        done = subprocess.run(["make", target, "CFLAGS=-O0"], cwd=place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    library, rows = Library(place, options=("-O0",)), []
    state = library.initial_state()
    for k in range(SAMPLES):
        row = np.array([0.1 * k, 0.1, 0.2, -0.1, np.sqrt(0.94), 1e-3, -2e-3, 1e-4 * k])
        state, out, status = step_many(library, state, row)
        rows.append((row, out, int(status)))
    assert any(np.any(out != rows[0][1]) for _, out, _ in rows)
    return place, rows


def test_controller_process_behind_udp_returns_the_outputs_of_the_exported_c(exported):
    place, rows = exported
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    controller = runpy.run_path(str(place / "udp.py"))["Controller"](place, port)
    with subprocess.Popen([str(place / "udp"), str(port)]) as process, controller.socket:
        try:
            for _ in range(100):  # until the process listens
                try:
                    controller.reset()
                    break
                except (ConnectionRefusedError, TimeoutError):
                    time.sleep(0.05)
            for _ in range(2):
                controller.reset()
                for row, out, status in rows:
                    found = controller.step(t=row[0], attitude=row[1:5], rate=row[5:])
                    assert found[0] == status
                    assert np.array(list(found[1].values())).tobytes() == out.tobytes()
            controller.socket.send(b"a message for another program")  # no answer
            row = rows[-1][0]
            assert controller.step(t=row[0], attitude=row[1:5], rate=row[5:])[0] == 4  # time did not increase
        finally:
            process.terminate()


def test_shared_library_returns_the_outputs_of_the_exported_c(exported):
    place, rows = exported
    library = ctypes.CDLL(str(place / "controller.so"))
    library.controller_new.restype = ctypes.c_void_p
    states = [ctypes.c_void_p(library.controller_new()) for _ in range(2)]
    for row, out, status in rows:
        for state in states:  # one does not disturb the other
            found = np.zeros_like(out)
            ended = library.controller_step(state, *(v.ctypes.data_as(ctypes.c_void_p) for v in (row, found)))
            assert (ended, found.tobytes()) == (status, out.tobytes())
    for state in states:
        library.controller_free(state)
