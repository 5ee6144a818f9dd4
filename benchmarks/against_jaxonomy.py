"""Many slews of one spacecraft with jaxonomy, and with the library, on the same cores.

    python3.11 -m venv benchmarks/.venv-jaxonomy  # it asks for another JAX than the library
    benchmarks/.venv-jaxonomy/bin/python -m pip install jaxonomy==3.4.1
    benchmarks/.venv/bin/python benchmarks/against_jaxonomy.py benchmarks/.venv-jaxonomy/bin/python

The slews are those of `against_basilisk.py`: 900 control periods of 0.05 s with one RK4 step each; the torque is
constant in a period. In jaxonomy, a block diagram has a body and a quaternion feedback law on the true state. Its
`Simulator` is compiled once and runs under vmap, with a part of the trials on each core's device. The library computes
more in a step: the paper's law with its disturbance, observer and every metric.
"""

import os
import subprocess
import sys
from itertools import chain

import numpy as np

PERIOD, PERIODS, TRIALS = 0.05, 900, 2048  # more are no faster
PROPORTIONAL, DERIVATIVE = 2.0, 8.0
INERTIA = np.diag([10.0, 12.0, 14.0])
INVERSE = np.linalg.inv(INERTIA)


def slews(count: int) -> np.ndarray:
    """Return initial quaternions and rates (count, 7): axis uniform, angle uniform from 20 to 140 degrees, at rest."""
    rng = np.random.default_rng(9)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = np.deg2rad(rng.uniform(20.0, 140.0, (count, 1))) / 2.0
    return np.concatenate([axis * np.sin(half), np.cos(half), np.zeros((count, 3))], axis=1)


def rate(x, u, xp):
    """Rate of the state (7,) under the torque (3,), with NumPy or JAX's."""
    v, scalar, w = x[:3], x[3], x[4:]
    pull = u - xp.cross(w, INERTIA @ w)
    turning = xp.concatenate([0.5 * (scalar * w + xp.cross(v, w)), -0.5 * xp.sum(v * w, keepdims=True)])
    return xp.concatenate([turning, INVERSE @ pull])


def torque(x, xp):
    """Return the torque of quaternion feedback, along the shorter rotation."""
    return -PROPORTIONAL * x[:3] * xp.where(x[3] < 0.0, -1.0, 1.0) - DERIVATIVE * x[4:]


def by_hand(x: np.ndarray) -> np.ndarray:
    """Return the final state of one run."""
    for _ in range(PERIODS):
        u, h = torque(x, np), PERIOD
        k1 = rate(x, u, np)
        k2 = rate(x + h / 2 * k1, u, np)
        k3 = rate(x + h / 2 * k2, u, np)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u, np))
    return x


def jaxonomy(cores: int) -> None:
    """In jaxonomy's environment: compile, print a line, and simulate all slews for each line that is read."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", cores)
    import jax.numpy as jnp
    from jaxonomy import DiagramBuilder, LeafSystem, Simulator, SimulatorOptions  # pyright: ignore[reportMissingImports]

    class Body(LeafSystem):
        def __init__(self):
            super().__init__(name="body")
            self.declare_input_port()
            self.declare_continuous_state(default_value=jnp.eye(7)[3], ode=self.ode)
            self.declare_continuous_state_output()

        def ode(self, time, state, u, **parameters):
            return rate(state.continuous_state, u, jnp)

    class Law(LeafSystem):
        def __init__(self):
            super().__init__(name="law")
            self.declare_input_port()
            self.declare_output_port(lambda time, state, x, **parameters: torque(x, jnp), PERIOD, 0.0,
                                     default_value=jnp.zeros(3))  # fmt: skip

    builder = DiagramBuilder()
    body, law = builder.add(Body()), builder.add(Law())
    builder.connect(body.output_ports[0], law.input_ports[0])
    builder.connect(law.output_ports[0], body.input_ports[0])
    diagram = builder.build()
    simulator = Simulator(diagram, options=SimulatorOptions(
        math_backend="jax", max_major_steps=PERIODS + 100, max_major_step_length=PERIOD, ode_solver_method="rk4",
        max_minor_step_size=PERIOD,
    ))  # fmt: skip
    start = diagram.create_context()

    def fly(x):
        mine = start[body.system_id].with_continuous_state(x)
        end = simulator.advance_to(PERIODS * PERIOD, start.with_subcontext(body.system_id, mine).with_time(0.0))
        return end.context[body.system_id].continuous_state

    simulated, x = jax.pmap(jax.vmap(fly)), jnp.asarray(slews(TRIALS).reshape(cores, -1, 7))
    for line in chain(["first"], sys.stdin):
        found = np.asarray(simulated(x))
        if line == "first":
            assert np.abs(found[0, 0] - by_hand(np.asarray(x[0, 0]))).max() < 1e-9, "not the same slews"
        print("done", flush=True)


def main(python: str) -> None:
    """Print both rates and their ratio."""
    from ptsmc_jax.configure import configure

    configure()
    from common import machine, medians, row, say, steps, study

    from ptsmc_jax.campaigns import montecarlo

    cores = len(os.sched_getaffinity(0))
    theirs = subprocess.Popen([python, __file__, "fly", str(cores)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                              text=True, env={**os.environ, "XLA_FLAGS": ""})  # fmt: skip

    def told() -> None:
        assert theirs.stdout is not None
        if theirs.stdout.readline() != "done\n":
            sys.exit("jaxonomy's process ended")

    def flight() -> None:
        assert theirs.stdin is not None
        print("fly", file=theirs.stdin, flush=True)
        told()

    told()
    trials, ready = np.arange(16_384), study()
    seconds = medians({
        "jaxonomy": flight,
        "ours": lambda: montecarlo.run(ready.parts, ready.dispersion, 0, trials).metrics,
    })  # fmt: skip
    theirs.terminate()
    say(machine())
    row("jaxonomy 3.4.1, quaternion feedback, no metrics", TRIALS * PERIODS / seconds["jaxonomy"] / 1e6,
        trials.size * steps(ready.parts) / seconds["ours"] / 1e6)  # fmt: skip


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "fly":
        jaxonomy(int(sys.argv[2]))
    elif len(sys.argv) == 2:
        main(sys.argv[1])
    else:
        sys.exit(f"{__doc__}")
