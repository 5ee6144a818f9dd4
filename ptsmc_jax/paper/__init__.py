"""Simulations that test the paper: its cases and claims (`claims`), its errors (`slips`), and Remark 2 (`remark_2`)."""
