"""Control laws: the prescribed-time laws of the paper, and laws from the literature for comparison."""
