"""What stands under each figure on a page."""

MAP = (
    "linear_window_error and linear_torque are what linear theory predicts of the noise alone, where sampling is "
    "explicit; radius, gain_margin (a factor up to which the loop is stable; below 1 it is not, and its nearest border "
    "is a factor so far from 1, less gain or more) and delay_margin [s] are those of the frozen loop at the hand-over, "
    "stable where the radius of its poles is not above 1, and hold_radius, .. those in hold."
)
# under the scenario, by the command: whose gains it has
SCENARIO = {
    "tune": "Its gains are those before the search; the same scenario with the tuned ones is the file tuned.toml.",
    "pareto": "Its gains are those before the search; those of each point stand in the table above.",
    "compare": "Its gains are those before the search; those of each law stand above.",
}
CAPTIONS = {
    "history": "Gains and goal of every start over the steps of the descent.",
    "tradeoff": "Each fresh trial by its peak torque and its error after t_f.",
    "sensitivities": "Percent by which each metric moves for a percent of each gain.",
    "profiles": "The goal along each gain between its bounds, the other gains as found; what breaks a limit is marked.",
    "front": "The front of accuracy against peak torque.",
    "slew_times": "The error, and what the slew costs, over the prescribed time; open points break a requirement.",
    "robustness": "The error, the torque and the margins left, over the limit on the largest sensitivity; open points "
    "break a requirement.",
    "map": "Error and peak torque over the two keys, with the borders at which the loop loses its stability.",
    "nichols": "The loop opened at each axis of the plant's input, the others closed.",
    "sensitivity": "How disturbances (S) and noise (T) come through, over the frequency.",
    "margins": "Margins of the nominal loop in the approach phase, with its gains frozen.",
    "fan": "How the error goes with time: the share of trials inside each band.",
    "distributions": "The share of the trials up to each value; the scale stretches both ends.",
    "inputs": "What was drawn (across) against what came of it (up), a point a trial; a limit is dashed.",
    "wheels": "Momentum of each reaction wheel over time.",
    "wheel_torque": "Torque of each reaction wheel over time.",
    "disturbance": "The disturbance as the observer estimates it; the true one is dashed in black.",
    "torque_by_angle": "Peak torque by how far from the target a trial starts.",
    "settling": "Time to settle by the angle that a trial starts from.",
    "error": "Attitude error, or the first state, over time.",
    "sliding": "Sliding variable over time.",
    "convergence": "Error and sliding variable over the time to go, the exact motion dotted, theory's slopes black.",
    "torque": "Delivered torque over time.",
    "attitude": "Attitude over time.",
    "rate": "Body rate over time.",
    "states": "States over time.",
}
