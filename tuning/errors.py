"""What a command refuses, besides a bad scenario (`ScenarioError`) and a folder in its way (`RefusedError`)."""


class UsageError(ValueError):
    """An option that cannot be followed. Its text is one sentence."""
