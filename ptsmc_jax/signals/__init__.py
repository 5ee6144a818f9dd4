"""Signals from outside the loop: reference attitudes and disturbance torques."""
