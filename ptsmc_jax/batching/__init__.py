"""One trajectory, traced, evaluated over many trials at once."""
