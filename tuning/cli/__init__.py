"""The `ptsmc` command."""
