"""Disturbance observers, each in a continuous and a digital form and with the bound K2 on its error (Remark 2)."""
