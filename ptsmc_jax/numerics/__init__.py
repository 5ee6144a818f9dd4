"""Numerical building blocks of the equations: quaternions, integrators, random numbers, guarded functions."""
