"""Bad input gets a message that names it, on every rank, and nothing hangs."""

from pathlib import Path

import numpy as np
import pytest
import ufl
from bodies import held, pressed, stacked, two_body_problem
from mpi4py import MPI
from petsc4py import PETSc
from scenes import box, decomposed, forms, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import InputError, NoSolutionError
from tfeti_dolfinx.common import compat
from tfeti_dolfinx.errors import TfetiError, raised_on_all_ranks

ROOT = MPI.COMM_WORLD.rank == 0


def test_a_complex_build_of_petsc(monkeypatch):
    monkeypatch.setattr(compat, "petsc_scalar_type", lambda: np.complex128)
    with pytest.raises(InputError, match="PETSc is built for complex numbers"):
        problem(decomposed("hexahedron", 2, 2))


def test_prescribed_nodes_that_penetrate_are_counted_on_all_ranks():
    obstacle = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)), gap=lambda x: -0.02 * x[0])
    p = problem(decomposed("quadrilateral", 4, 8), contacts=[obstacle], clamped=("bottom",))
    with pytest.raises(NoSolutionError, match=r": 4 nodes penetrate by up to 0\.02 whatever"):
        p.solve()


def test_an_untagged_ds_is_fine_where_nothing_is_torn():
    d = decomposed("hexahedron", 2, 1)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    tfeti.ContactProblem(a, L + ufl.TestFunction(V)[0] * ds, [], [], d)


def test_a_load_on_a_torn_surface_inside_the_body():
    from dolfinx import mesh as dmesh

    mesh, _, _ = box("hexahedron", 2)
    inside = dmesh.locate_entities(mesh, 2, lambda x: np.isclose(x[2], 0.5))
    tags = dmesh.meshtags(mesh, 2, inside, np.full(len(inside), 1, dtype=np.int32))
    d = tfeti.decompose(mesh, lambda x: x[2] > 0.5, facet_tags=tags, surfaces={"middle": 1})
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("middle"))
    with pytest.raises(InputError, match=r"ds\(1\): 8 of its facets lie inside a body"):
        tfeti.ContactProblem(a, L, [], [], d)


def test_an_error_of_one_rank_is_raised_on_all(comm):
    with pytest.raises(InputError, match="only here"), raised_on_all_ranks(comm):
        if comm.rank == comm.size - 1:
            raise InputError("only here")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"surfaces": {}},
            "surfaces: left is not given on rank 1 and 1 on rank 0; expected the same",
        ),
        ({"subdomains": None}, "number of subdomains is .* on rank 0"),
        ({"subdomains": 3}, "number of subdomains is .* on rank 0"),
        ({"facet_tags": None}, "surfaces=.* without facet_tags"),
    ],
)
def test_a_decomposition_that_ranks_are_told_differently(comm, given, message):
    mesh, tags, names = box("quadrilateral", 4)
    told = {"subdomains": 2, "facet_tags": tags, "surfaces": names}
    if comm.rank == comm.size - 1:
        told |= given
    if comm.size == 1 and "facet_tags" not in given:
        tfeti.decompose(mesh, **told)
        return
    with pytest.raises(InputError, match=message):
        tfeti.decompose(mesh, **told)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tfeti_monitor": True}, "petsc_options: monitor is .* on rank 0"),
        ({"tfeti_error_if_not_converged": False}, "petsc_options: error_if_not_converged is"),
        ({"tfeti_sub_pc_factor_fill": 2.0}, "petsc_options: of factors: sub_pc_factor_fill is"),
    ],
)
def test_options_of_one_rank(comm, options, message):
    """A monitor's reductions would wait for those of the other ranks."""
    told = options if comm.rank == 0 else {}
    if comm.size == 1:
        problem(decomposed("quadrilateral", 3, 2), **told)
        return
    with pytest.raises(InputError, match=message):
        problem(decomposed("quadrilateral", 3, 2), **told)


def test_an_extension_of_one_rank(comm):
    def monitor(step):
        """See nothing."""

    own = tfeti.Extensions(monitor=monitor) if comm.rank == 0 else None
    if comm.size == 1:
        problem(decomposed("quadrilateral", 3, 2), extensions=own)
        return
    with pytest.raises(InputError, match="extensions: monitor is 'not given' on rank"):
        problem(decomposed("quadrilateral", 3, 2), extensions=own)


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


def test_a_solve_that_does_not_converge():
    p = problem(decomposed("hexahedron", 3, 4), tfeti_max_it=2)
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_ITS after 0 outer and 2 inner"):
        p.solve()
    p = problem(decomposed("hexahedron", 3, 4), tfeti_max_it=2, tfeti_error_if_not_converged=False)
    p.solve()
    assert p.report.converged_reason == "DIVERGED_ITS"


@pytest.mark.parametrize(
    "pair",
    [("lower left", "upper right"), ("lower bottom", "upper top"), ("lower right", "upper right")],
)
def test_a_body_is_free_since_its_pair_does_not_face(pair):
    d = stacked("quadrilateral", 2, 2, 2)
    p = two_body_problem(d, pressed(d), held(d, "lower bottom"), [tfeti.Contact(*pair)])
    with pytest.raises(tfeti.NoSolutionError, match="body 1 .*of the contacts meet nobody: 0: con"):
        p.solve()
