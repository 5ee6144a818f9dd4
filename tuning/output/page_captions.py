"""What stands under each figure on a page."""

CAPTIONS = {
    "history": "Gains and goal of every start over the steps of the descent.",
    "tradeoff": "Each fresh trial by its peak torque and its error after t_f.",
    "sensitivities": "Percent by which each metric moves for a percent of each gain.",
    "profiles": "The goal along each gain between its bounds, the others as found; what breaks a limit is marked.",
    "front": "The same front as a picture.",
    "map": "Error and peak torque over the two keys, with the borders at which the loop loses its stability.",
    "nichols": "The loop opened at each axis of the plant's input, the others closed.",
    "sensitivity": "How disturbances (S) and noise (T) come through, over the frequency.",
    "margins": "Margins of the frozen loop on the way to the hand-over.",
    "fan": "How the error goes with time: the share of trials inside each band.",
    "distributions": "The share of the trials up to each value; the scale stretches both ends.",
    "inputs": "What was drawn against what came of it.",
    "torque_by_angle": "Peak torque by the angle that a trial starts from.",
    "settling": "Time to settle by the angle that a trial starts from.",
    "error": "Attitude error, or the first state, over time.",
    "sliding": "Sliding variable over time.",
    "torque": "Delivered torque over time.",
    "attitude": "Attitude over time.",
    "rate": "Body rate over time.",
    "states": "States over time.",
}
