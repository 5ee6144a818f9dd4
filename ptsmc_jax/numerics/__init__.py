"""Numerical pieces that the equations are written with: they know nothing of control."""
