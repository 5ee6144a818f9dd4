"""Reports of results, made from typed summaries, and their renderers: the terminal and the page."""
