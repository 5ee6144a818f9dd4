"""Inputs of the simulation that do not depend on the controller: reference attitudes and disturbances."""
