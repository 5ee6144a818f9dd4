"""What is said of a result: sentences, tables, the terminal, the page."""
