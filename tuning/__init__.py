"""Gain tuning by simulation, and the `ptsmc` command.

`search` optimises gains, `studies` has one module for each command, `output` writes reports and pages, and `cli`
defines the commands. Read `studies.tuner.tune` first.
"""
