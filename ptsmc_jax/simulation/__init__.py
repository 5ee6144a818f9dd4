"""The time loop: clocks, the flight computer, metrics and requirements, and the rollout."""
