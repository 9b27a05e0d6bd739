"""Tables as Markdown and JSON, and slopes of convergence."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of rows that have the same keys."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_text(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_tables(folder: Path, name: str, tables: dict[str, Sequence[dict[str, Any]]]) -> None:
    """Write ``name.md`` and ``name.json``; they appear whole."""
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(f"## {title}\n\n{markdown(rows)}" for title, rows in tables.items())
    for suffix, content in ((".md", text), (".json", json.dumps(tables, indent=2))):
        partial = folder / f".{name}{suffix}.partial"
        partial.write_text(content + "\n")
        os.replace(partial, folder / f"{name}{suffix}")


def slope(sizes: Sequence[float], errors: Sequence[float]) -> float:
    """Order of convergence: slope of log(error) over log(size), by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])
