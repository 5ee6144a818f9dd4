"""Estimate the parameters of a scenario's true plant from telemetry. Start with `estimation.estimate_parameters`."""
