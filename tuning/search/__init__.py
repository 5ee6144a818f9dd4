"""The search for gains: the problem, its evaluation, local searches from many starts, the worst case.

`minimise` is the search for any function of JAX.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.search.functions import Search as Search
    from tuning.search.functions import Settings as Settings
    from tuning.search.functions import minimise as minimise

__all__ = ["Search", "Settings", "minimise"]


def __getattr__(name: str) -> Any:
    """Return a public name. JAX is imported when the first one is used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tuning.search import functions

    return getattr(functions, name)
