"""The time loop: clocks, the flight computer, what a run is judged by, and the rollout."""
