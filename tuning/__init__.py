"""Gain tuning on the simulator, and the `ptsmc` command."""
