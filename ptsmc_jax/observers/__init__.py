"""Disturbance observers (Remark 2 of the paper), with continuous and digital forms and bounds on their errors."""
