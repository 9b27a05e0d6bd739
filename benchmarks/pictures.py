"""Pictures of tables: stacked bars and curves. matplotlib is imported where one is drawn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FEW = 8  # values that all can stand beside an axis


@contextmanager
def picture(path: Path, panels: int, height: float = 3.4, rows: int = 1) -> Iterator[list[Any]]:
    """Axes of panels side by side, row by row, written when the block ends."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * panels, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, panels, squeeze=False)
    yield list(axes.ravel())
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
    axes.set_xlim(0.0, 1.3 * max(left))  # room for the legend
    axes.set_xlabel("seconds")
    axes.set_title(title, fontsize="medium")
    if len(parts) > 1:
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
        plain(axes.xaxis, sorted({value for x, _ in lines.values() for value in x}))
    if "y" in log:
        axes.set_yscale("log")
        plain(axes.yaxis)
    else:
        axes.set_ylim(0.0, 1.25 * max(max(y) for _, y in lines.values()))  # room for the legend
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def plain(axis: Any, ticks: Sequence[float] | None = None) -> None:
    """Numbers as they are on a logarithmic axis: those given if few and short, or 1, 2, 5, ..."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

    short = ticks is not None and max(ticks) < 1000 and len(ticks) <= FEW
    axis.set_major_locator(FixedLocator(ticks) if short else LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def column(rows: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    """A column of a table."""
    return [row[name] for row in rows]
