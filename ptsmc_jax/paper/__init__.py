"""The paper's cases, claims, slips and Remark 2, measured."""
