"""Mistakes that users make get a message that names the thing, on every rank."""

import re

import pytest
from mistakes import (
    accepted,
    again,
    boundary,
    conditions,
    contacts,
    elasticity,
    extensions,
    forms,
    friction,
    gmsh_files,
    meshes,
    options,
    results,
)
from mistakes.scene import Scene

MODULES = (forms, elasticity, conditions, options, meshes, contacts, results, gmsh_files)
MODULES += (again, boundary, extensions, friction)
TABLES = {
    f"{module.__name__.split('.')[1]} {name.lower()}": getattr(module, name)
    for module in MODULES
    for name in module.TABLES
}


@pytest.fixture(scope="module")
def scene():
    return Scene()


def answer(do, scene, comm):
    """Types and messages of the errors of all ranks; every rank has one, or the test hangs."""
    error = None
    try:
        do(scene)
    except Exception as caught:
        error = caught
    return comm.allgather((type(error).__name__, str(error)))


@pytest.mark.parametrize("table", TABLES)
def test_mistakes_are_named(table, scene, shared_tmp, comm):
    scene.folder = shared_tmp
    wrong = {}
    for says, do in TABLES[table].items():
        answers = answer(do, scene, comm)
        if not all(kind == "InputError" and re.search(says, text) for kind, text in answers):
            wrong[says] = answers
    assert not wrong


@pytest.mark.parametrize("use", accepted.ACCEPTED)
def test_what_is_right_is_accepted(use, scene, shared_tmp):
    scene.folder = shared_tmp
    assert accepted.ACCEPTED[use](scene)
