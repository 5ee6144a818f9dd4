"""Runs and campaigns of many trials, their rows and their folders."""
