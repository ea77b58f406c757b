"""Display of values in notebooks. Packages above register functions for values of packages below.

A module in `PROVIDERS` is imported when a value is first displayed. They are those of features.
"""

from functools import singledispatch
from importlib import import_module

PROVIDERS: list[str] = []


@singledispatch
def html(value: object) -> str | None:
    """HTML of a value, by a function registered for its type. None without one."""
    return None


class Displayed:
    """Base of classes that notebooks display with `html`."""

    def _repr_html_(self) -> str | None:
        while PROVIDERS:
            import_module(PROVIDERS.pop())
        return html(self)
