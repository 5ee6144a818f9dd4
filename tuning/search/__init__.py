"""The search for gains: problem, evaluation, local searches from many starting points, and the worst case.

The search for gains begins in `optimise.search`. `minimise` is the same local search for any function of JAX.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.search.functions import Search as Search
    from tuning.search.functions import Settings as Settings
    from tuning.search.functions import minimise as minimise

__all__ = ["Search", "Settings", "minimise"]


def __getattr__(name: str) -> Any:
    """Return a public name. JAX is imported only when a public name is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tuning.search import functions

    return getattr(functions, name)
