"""Times of stages, and papers of the methods for ``-citations``."""

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from petsc4py import PETSc

# of each method, the keys in references.bib of what a paper that uses it should cite
PAPERS = {
    "tfeti": ("DostalHorakKucera2006", "BrzobohatyEtAl2011"),
    "pcpg": ("FarhatMandelRoux1994",),
    "newton": ("HintermullerItoKunisch2002", "FarhatMandelRoux1994"),
    "smalse": ("DostalHorak2007", "Dostal2009", "DostalSchoberl2005"),
    "newton on friction": ("AlartCurnier1991", "HueberStadlerWohlmuth2008"),
    "mortar": ("Wohlmuth2000",),
    "boundary elements": ("BouchalaDostalSadowska2009",),
}


@contextmanager
def stage(name: str, seconds: MutableMapping[str, float]) -> Iterator[None]:
    """Add the wall time of the block to ``seconds[name]``; ``-log_view`` shows it as a stage."""
    log = PETSc.Log.Stage(f"tfeti: {name}")
    start = time.perf_counter()
    log.push()
    try:
        yield
    finally:
        log.pop()
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def cite(*methods: str) -> None:
    """Let ``-citations`` print the papers of methods in ``PAPERS``, each once; pass over others."""
    for method in methods:
        for key in PAPERS.get(method, ()):
            PETSc.Sys.registerCitation(entry(key))


@cache
def entry(key: str) -> str:
    """Return an entry of references.bib."""
    text = Path(__file__).with_name("references.bib").read_text(encoding="utf-8")
    begin = text.index(f"{{{key},")
    begin = text.rindex("@", 0, begin)
    return text[begin : text.index("\n}\n", begin) + 3]
