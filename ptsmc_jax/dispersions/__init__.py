"""Dispersions: which quantities differ from trial to trial, and their distributions."""
