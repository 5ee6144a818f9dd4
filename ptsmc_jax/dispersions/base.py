"""What every kind of draw has: a map from coordinates to a value.

Coordinates are numbers uniform on (0, 1) or standard normal: a trial's are drawn, and a search for the worst trial
moves them.
"""

from typing import Literal

from jaxtyping import Array

INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"


INERTIA, REFERENCE = "inertia", "reference"


DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"


DISTURBANCE_BIAS = "disturbance_bias"


FARTHEST = 3.0  # standard deviations of what is truncated, at most


Drawn = Literal["uniform", "normal"]


Coordinates = dict[str, Array]  # of a trial, by the name of what is drawn
