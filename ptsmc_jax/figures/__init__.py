"""Runs, studies and campaigns as matplotlib figures; each function returns a Figure."""
