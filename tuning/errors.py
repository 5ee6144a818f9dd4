"""Errors of the options of a command.

Errors of a scenario are `ptsmc_jax.scenario.errors.ScenarioError`. Errors of a result folder are
`ptsmc_jax.campaigns.store.RefusedError`.
"""


class UsageError(ValueError):
    """An option of a command has an invalid value. The message is one sentence."""
