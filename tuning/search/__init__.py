"""The search for gains: the problem, its evaluation, descents from many starts, the worst case."""
