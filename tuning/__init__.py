"""Gain tuning by simulation, and the `ptsmc` command.

`search` optimises gains, `studies` has one module for each command, `output` writes reports and pages, and `cli`
defines the commands. Read `studies.tuner.tune` first. `explore` has the short functions for notebooks, which are also
names of this package. They are imported at their first use.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.explore import compare as compare
    from tuning.explore import margins as margins
    from tuning.explore import montecarlo as montecarlo
    from tuning.explore import pareto as pareto
    from tuning.explore import reproduce as reproduce
    from tuning.explore import tune as tune

_EXPORTS = ("compare", "margins", "montecarlo", "pareto", "reproduce", "tune")


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        from tuning import explore

        return getattr(explore, name)
    raise AttributeError(f"module 'tuning' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
