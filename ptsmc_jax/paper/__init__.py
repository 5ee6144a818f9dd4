"""Simulations that test the paper: its cases, claims and Remark 2 (`claims`), and its errors (`slips`)."""
