"""Examples in docstrings run, and say what is there."""

import doctest
from importlib import import_module

import pytest


@pytest.mark.parametrize("name", ["qp.mprgp", "qp.pcpg", "qp.smalse", "qp.feasible_sets"])
def test_examples(name):
    module = import_module(f"tfeti_dolfinx.{name}")
    failed, tried = doctest.testmod(module)
    assert tried > 0
    assert failed == 0
