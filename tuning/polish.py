"""The best iterate of each start, and its polish along the active limits by sequential quadratic programming."""

import numpy as np
from scipy.optimize import minimize

from tuning.evaluate import Evaluator, Measured, Sloped
from tuning.objective import Problem, ended, failures

SLACK = 1e-4  # of it that an admissible iterate may use
POLISH_STEPS = 40  # iterations of each, at most
BROKEN = 1e3  # metric / limit by which a trial that fails is over, beside those that end


def largest(c: np.ndarray, margin: float) -> np.ndarray:
    """(points, requirements) largest metric / limit of the trials that end, from c with limits tighter by a margin."""
    return (ended(c).max(axis=2, initial=-1.0) + 1.0) * (1.0 - margin)


class Best:
    """The best iterate so far of each start: admissible ones by their F, others by how far they are over.

    A trial that fails counts as `BROKEN` beyond its limit: more of them are worse, and what the others do still counts.
    """

    def __init__(self, z: np.ndarray, requirements: int, margin: float):
        self.z, self.margin = z.copy(), margin
        self.f, self.value, self.over = (np.full(len(z), np.inf) for _ in range(3))
        self.worst = np.full((len(z), requirements), np.inf)  # largest metric / limit

    def offer(self, z: np.ndarray, seen: Measured, allowed: np.ndarray, starts: slice = slice(None)) -> None:
        """Keep what is better; arrays over these starts. Admissible is what keeps the margin but for `SLACK`."""
        worst = largest(seen.c, self.margin)
        over = np.maximum(worst.max(axis=1, initial=0.0) - (1.0 - self.margin + SLACK), 0.0)
        over = over + BROKEN * failures(seen.c)
        better = allowed & ((over < self.over[starts]) | ((over == self.over[starts]) & (seen.f < self.f[starts])))
        kept = (self.z, self.f, self.value, self.over, self.worst)
        for old, new in zip(kept, (z, seen.f, np.exp(seen.value), over, worst), strict=True):
            old[starts][better] = new[better]

    def order(self) -> np.ndarray:
        """Starts from the best to the worst."""
        return np.lexsort((self.f, self.over))


def polish(evaluate: Evaluator, problem: Problem, best: Best, start: int) -> None:
    """Follow the active limits to the optimum next to a start's best iterate; what is better is kept in `best`."""
    seen: dict[bytes, Sloped] = {}

    def at(z: np.ndarray) -> Sloped:
        key = z.tobytes()
        if key not in seen:
            seen[key] = evaluate.slopes(problem, z[None])
            best.offer(z[None], seen[key], seen[key].finite, slice(start, start + 1))
        return seen[key]

    limits = {
        "type": "ineq",
        "fun": lambda z: -ended(at(z).c).reshape(-1),
        "jac": lambda z: -at(z).c_slope.reshape(-1, z.size),
    }
    minimize(
        lambda z: float(at(z).f[0]),
        best.z[start].copy(),
        jac=lambda z: at(z).f_slope[0],
        method="SLSQP",
        bounds=[(-8.0, 8.0)] * best.z.shape[1],
        constraints=[limits] if problem.metrics else [],
        options={"maxiter": POLISH_STEPS, "ftol": 1e-7},
    )
