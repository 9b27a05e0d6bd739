"""Bad input gets a message that names it, on every rank, and nothing hangs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from bodies import held, pressed, stacked, two_body_problem
from petsc4py import PETSc
from scenes import decomposed, forms, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import InputError
from tfeti_dolfinx.common import compat
from tfeti_dolfinx.errors import TfetiError, raised_on_all_ranks


def test_a_complex_build_of_petsc(monkeypatch):
    monkeypatch.setattr(compat, "PETSc", SimpleNamespace(ScalarType=np.complex128))
    with pytest.raises(InputError, match="PETSc is built for complex numbers"):
        problem(decomposed("hexahedron", 2, 2))


def test_an_untagged_ds_is_fine_where_nothing_is_torn():
    d = decomposed("hexahedron", 2, 1)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    tfeti.ContactProblem(a, L + ufl.TestFunction(V)[0] * ds, [], [], d)


@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
@pytest.mark.parametrize("what", ["gap", "distance", "gradient"])
def test_no_part_of_complex_numbers_is_dropped(what):
    """Also where numpy's warning of it is not an error, as it is in these tests."""

    def fields(name):
        factor = 1 + 1j if name == what else 1.0
        return lambda x: factor * (0.1 + x[1])

    def up(x):
        return (1 + 1j if what == "gradient" else 1.0) * np.array([0, 1, 0])[:, None] + 0 * x

    shape = tfeti.SignedDistance(fields("distance"), up)
    obstacle = tfeti.Obstacle("bottom", shape, gap=fields("gap"))
    with pytest.raises(InputError, match=f"obstacle of surface 'bottom': .*{what}.*complex"):
        problem(decomposed("quadrilateral", 3, 2), contacts=[obstacle]).solve()


class OfTwoParts(Exception):
    """Cannot be rebuilt from its arguments: one of them is lost."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def test_an_error_has_the_same_type_on_all_ranks(comm):
    class Local(Exception):
        """Other ranks cannot import it."""

    last = comm.rank == comm.size - 1
    with pytest.raises(ZeroDivisionError, match="by zero"), raised_on_all_ranks(comm):
        if last:
            1 / 0  # noqa: B018
    with (
        pytest.raises(FileNotFoundError, match="/nowhere/file") as found,
        raised_on_all_ranks(comm),
    ):
        if last:
            Path("/nowhere/file").read_text()
    assert found.value.filename == "/nowhere/file"
    with pytest.raises(PETSc.Error) as found, raised_on_all_ranks(comm):
        if last:
            raise PETSc.Error(56)
    assert found.value.ierr == 56
    for error in (OfTwoParts("this", "that"), Local("this and that")):
        with pytest.raises(TfetiError, match="this and that") as found, raised_on_all_ranks(comm):
            if last:
                raise error
        assert type(found.value) is TfetiError
        assert str(found.value).startswith(type(error).__name__)


def test_a_body_is_free_since_its_pair_does_not_face():
    d = stacked("quadrilateral", 2, 2, 2)
    pair = tfeti.Contact("lower left", "upper right")
    p = two_body_problem(d, pressed(d), held(d, "lower bottom"), [pair])
    with pytest.raises(tfeti.NoSolutionError, match="body 1 .*never in contact: 0: con"):
        p.solve()
