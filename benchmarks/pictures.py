"""Pictures of tables: stacked bars and curves. matplotlib is imported where one is drawn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def picture(path: Path, panels: int, height: float = 3.4) -> Iterator[list[Any]]:
    """Axes of panels side by side, written when the block ends."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * panels, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    yield list(axes)
    figure.savefig(path, dpi=120)


def stacked(axes: Any, title: str, rows: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> None:
    """A bar for each row, labelled with its first column, made of columns that are seconds."""
    labels = [str(next(iter(row.values()))) for row in rows]
    left = [0.0] * len(rows)
    for part in parts:
        widths = [float(row[part]) for row in rows]
        axes.barh(range(len(rows)), widths, left=left, label=part)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.set_yticks(range(len(rows)), labels)
    axes.invert_yaxis()
    axes.set_xlabel("seconds")
    axes.set_title(title, fontsize="medium")
    axes.legend(fontsize="small")


def curves(
    axes: Any,
    title: str,
    labels: tuple[str, str],
    lines: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    log: str = "xy",
) -> None:
    """A curve for each name, the axes of ``log`` logarithmic."""
    for name, (x, y) in lines.items():
        axes.plot(x, y, marker="o", label=name)
    if "x" in log:
        axes.set_xscale("log")
    if "y" in log:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def column(rows: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    """A column of a table."""
    return [row[name] for row in rows]
