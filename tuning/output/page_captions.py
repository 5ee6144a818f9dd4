"""Captions of the figures on a page."""

# caption of the scenario in a page, by command: whose gains it has
SCENARIO = {
    "tune": "These are the gains before the search; tuned.toml is the same scenario with the tuned gains.",
    "pareto": "These are the gains before the search; the table above has the gains of each point.",
    "compare": "These are the gains before the search; the gains of each law are listed above.",
}
CAPTIONS = {
    "history": "Gains and objective of every starting point over the steps of the local search.",
    "tradeoff": "Peak torque and error after t_f of each held-out trial.",
    "sensitivities": "Change of each metric in per cent for one per cent of each gain.",
    "profiles": "The objective along each gain between its bounds, with the other gains as found; marked points break "
    "a limit.",
    "front": "The front of accuracy against peak torque.",
    "slew_times": "The error and the costs of the slew over the prescribed time; open points break a requirement.",
    "robustness": "The error, the torque and the margins over the limit on the peak sensitivity; open points break "
    "a requirement.",
    "map": "Error and peak torque over the two keys, with the stability limits of the loop.",
    "nichols": "The open loop at each axis of the plant's input, the others closed.",
    "sensitivity": "Transfer of disturbances (S) and noise (T) over the frequency.",
    "margins": "Margins of the nominal loop in the approach phase, with its gains frozen.",
    "fan": "The error over time: the fraction of trials inside each band.",
    "distributions": "The fraction of the trials up to each value; the scale stretches both ends.",
    "inputs": "Metrics (up) over the sampled inputs (across), a point for each trial; limits are dashed.",
    "wheels": "Momentum of each reaction wheel over time.",
    "wheel_torque": "Torque of each reaction wheel over time.",
    "disturbance": "The disturbance as the observer estimates it; the true one is black.",
    "torque_by_angle": "Peak torque over the initial angle from the reference.",
    "settling": "Settling time over the initial angle from the reference.",
    "error": "Attitude error, or the first state, over time.",
    "sliding": "Sliding variable over time.",
    "convergence": "Error and sliding variable over the time to go; dotted: the exact motion; black: the slopes of the "
    "theory.",
    "torque": "Delivered torque over time.",
    "attitude": "Attitude over time.",
    "rate": "Body rate over time.",
    "states": "States over time.",
}
