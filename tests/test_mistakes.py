"""Mistakes that users make get a message that names the thing, on every rank."""

import pytest
from mistakes import conditions, contacts, forms, gmsh_files, meshes, options, results
from mistakes.scene import Scene

from tfeti_dolfinx import TfetiError

MODULES = [forms, conditions, options, meshes, contacts, results, gmsh_files]
TABLE = [(name, *mistake) for module in MODULES for name, mistake in module.MISTAKES.items()]


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.mark.parametrize(("do", "says"), [t[1:] for t in TABLE], ids=[t[0] for t in TABLE])
def test_a_mistake_is_named(do, says, scene, shared_tmp, comm):
    scene.folder = shared_tmp
    error = None
    try:
        do(scene)
    except Exception as caught:
        error = caught
    errors = comm.allgather((type(error).__name__, str(error)))
    with pytest.raises(TfetiError, match=says):
        if error is not None:
            raise error
    assert {name for name, _ in errors} == {"InputError"}, errors


def test_the_table_has_every_mistake_once():
    assert len({name for name, *_ in TABLE}) == len(TABLE) >= 155
