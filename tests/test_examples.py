"""The examples of public docstrings run, on any number of ranks."""

import doctest
from importlib import import_module

import pytest
from test_docs import ROOT, blocks

import tfeti_dolfinx as tfeti

NAMES: dict[str, object] = {}  # that examples take for granted, as the page of the API says
exec("\n".join(blocks(ROOT / "docs/api.md", "python")), NAMES)
FINDER = doctest.DocTestFinder()
PUBLIC = {name: getattr(tfeti, name) for name in tfeti.__all__ if name != "__version__"}
FOUND = {
    example.name: example
    for name, thing in PUBLIC.items()
    for example in FINDER.find(thing, name, module=False, globs=dict(NAMES))
    if example.examples
}
(FOUND["tfeti_dolfinx"],) = doctest.DocTestFinder(recurse=False).find(tfeti, globs=dict(NAMES))


@pytest.mark.parametrize("name", sorted(FOUND))
def test_example(name, comm):
    said = []
    result = doctest.DocTestRunner().run(FOUND[name], out=said.append)
    assert result.attempted > 0
    assert comm.allgather(result.failed) == [0] * comm.size, "".join(said)


@pytest.mark.parametrize(
    "name", ["qp.mprgp", "qp.krylov", "qp.smalse", "qp.sets", "qp.projection", "qp.newton"]
)
def test_examples_of_solvers(name):
    failed, tried = doctest.testmod(import_module(f"tfeti_dolfinx.{name}"))
    assert tried > 0
    assert failed == 0
