"""How tables look on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def table(*heads: str) -> Table:
    """Without lines; only the last column wraps."""
    from rich.table import Table

    made = Table(*heads, box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column in made.columns[:-1]:
        column.no_wrap = True
    return made


def row(to: Table, *cells: str) -> None:
    """Add a row; brackets in it are no markup."""
    from rich.text import Text

    to.add_row(*(Text(cell) for cell in cells))
