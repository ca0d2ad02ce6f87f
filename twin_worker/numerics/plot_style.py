"""Figure style."""

from typing import Any

from fleet.report.ink import GRID, INK, MUTED


def style_axes(ax: Any, title: str) -> None:
    """Apply title and page colours to a panel."""
    ax.set_title(title, fontsize=9, color=INK)
    ax.tick_params(labelsize=8, colors=MUTED)
    ax.grid(color=GRID, lw=0.6)
    for side in ax.spines.values():
        side.set_color(GRID)
