"""Bad input gets a message that names it, on every rank, and nothing hangs."""

from pathlib import Path

import numpy as np
import pytest
import ufl
from bodies import held, pressed, stacked, two_body_problem
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scenes import box, decomposed, forms, hooke, problem, strain

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import InputError, NoSolutionError
from tfeti_dolfinx.common import compat
from tfeti_dolfinx.errors import TfetiError, raised_on_all_ranks

ROOT = MPI.COMM_WORLD.rank == 0


def test_unknown_surface():
    d = decomposed("hexahedron", 2, 2)
    with pytest.raises(InputError, match=r"no surface 'lid' in the mesh; its surfaces are: 'left'"):
        d.surface("lid")
    with pytest.raises(InputError, match="no surface 77"):
        d.surface(77)
    with pytest.raises(InputError, match="no volume 'steel' in the mesh; its volumes are: none"):
        d.volume("steel")
    p = problem(d, contacts=[tfeti.Obstacle("lid", tfeti.Plane((0, 0, 0), (0, 0, 1)))])
    with pytest.raises(InputError, match="no surface 'lid'"):
        p.solve()


def test_empty_surface():
    mesh, tags, names = box("hexahedron", 2)
    d = tfeti.decompose(mesh, 2, facet_tags=tags, surfaces={**names, "nothing": 99})
    p = problem(d, contacts=[tfeti.Obstacle("nothing", tfeti.Plane((0, 0, 0), (0, 0, 1)))])
    with pytest.raises(InputError, match="surface 'nothing' has no facets"):
        p.solve()


def test_a_contact_surface_inside_a_body():
    from dolfinx import mesh as dmesh

    mesh, _, _ = box("hexahedron", 2)
    inside = dmesh.locate_entities(mesh, 2, lambda x: np.isclose(x[2], 0.5))
    tags = dmesh.meshtags(mesh, 2, inside, np.full(len(inside), 1, dtype=np.int32))
    d = tfeti.decompose(mesh, 1, facet_tags=tags, surfaces={"middle": 1})
    V, a, _ = forms(d.mesh, d.facet_tags, (0, 0, 0), 1)
    L = ufl.ZeroBaseForm((ufl.TestFunction(V),))
    obstacle = tfeti.Obstacle("middle", tfeti.Plane((0, 0, 0), (0, 0, 1)))
    with pytest.raises(InputError, match="surface 'middle': 4 of its facets lie inside a body"):
        tfeti.ContactProblem(a, L, [], [obstacle], d).solve()


def test_more_subdomains_than_cells():
    mesh, _, _ = box("hexahedron", 2)
    for number in (0, 9):
        with pytest.raises(InputError, match=f"subdomains={number}: expected between 1 and 8"):
            tfeti.decompose(mesh, number)


def test_wrong_number_of_partition_ids():
    mesh, _, _ = box("hexahedron", 2)
    with pytest.raises(InputError, match=r"expected one id for each of the \d+ cells .*\(3,\)"):
        tfeti.decompose(mesh, np.zeros(3, dtype=int))
    with pytest.raises(InputError, match="callable subdomains: expected one id"):
        tfeti.decompose(mesh, lambda x: np.zeros(1, dtype=int))


def test_partition_ids_that_are_no_ids():
    mesh, _, _ = box("hexahedron", 2)
    with pytest.raises(InputError, match=r"whole numbers from 0 up, got -1"):
        tfeti.decompose(mesh, lambda x: np.full(x.shape[1], -1))
    with pytest.raises(InputError, match=r"whole numbers from 0 up, got 0.5"):
        tfeti.decompose(mesh, lambda x: np.full(x.shape[1], 0.5))


def test_a_complex_build_of_petsc(monkeypatch):
    monkeypatch.setattr(compat, "petsc_scalar_type", lambda: np.complex128)
    with pytest.raises(InputError, match="PETSc is built for complex numbers"):
        problem(decomposed("hexahedron", 2, 2))


def test_a_form_that_is_not_symmetric():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    u, v = a.arguments()[1], a.arguments()[0]
    a += ufl.inner(ufl.dot(ufl.grad(u), ufl.as_vector((1.0, 2.0, 3.0))), v) * ufl.dx
    with pytest.raises(InputError, match=r"subdomain \d: the stiffness is not symmetric"):
        tfeti.ContactProblem(a, L, [], [], d).solve()


def test_a_load_that_is_nan():
    d = decomposed("hexahedron", 2, 2)
    p = problem(d, (0.0, 0.0, float("nan")))
    with pytest.raises(InputError, match=r"subdomain \d: the load has \d+ entries not finite"):
        p.solve()


def test_prescribed_nodes_that_penetrate_are_counted_on_all_ranks():
    obstacle = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)), gap=lambda x: -0.02 * x[0])
    p = problem(decomposed("quadrilateral", 4, 8), contacts=[obstacle], clamped=("bottom",))
    with pytest.raises(NoSolutionError, match=r": 4 nodes penetrate by up to 0\.02 whatever"):
        p.solve()


def test_contradictory_dirichlet_values():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    bcs = [
        fem.dirichletbc(np.full(3, v), fem.locate_dofs_topological(V, 2, d.facets(s)), V)
        for s, v in (("left", 0.0), ("bottom", 0.1))
    ]
    with pytest.raises(InputError, match="Dirichlet conditions contradict each other"):
        tfeti.ContactProblem(a, L, bcs, [], d).solve()


def test_an_untagged_ds():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    L += ufl.TestFunction(V)[0] * ufl.ds
    with pytest.raises(InputError, match="an untagged ds would integrate over the tears"):
        tfeti.ContactProblem(a, L, [], [], d)


def test_an_untagged_ds_is_fine_where_nothing_is_torn():
    d = decomposed("hexahedron", 2, 1)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    tfeti.ContactProblem(a, L + ufl.TestFunction(V)[0] * ds, [], [], d)


def test_interior_facets():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    L += ufl.avg(ufl.TestFunction(V)[0]) * ufl.dS
    with pytest.raises(InputError, match="dS has no meaning across the tears"):
        tfeti.ContactProblem(a, L, [], [], d)


def test_a_load_on_a_torn_surface_inside_the_body():
    from dolfinx import mesh as dmesh

    mesh, _, _ = box("hexahedron", 2)
    inside = dmesh.locate_entities(mesh, 2, lambda x: np.isclose(x[2], 0.5))
    tags = dmesh.meshtags(mesh, 2, inside, np.full(len(inside), 1, dtype=np.int32))
    d = tfeti.decompose(mesh, lambda x: x[2] > 0.5, facet_tags=tags, surfaces={"middle": 1})
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("middle"))
    with pytest.raises(InputError, match=r"ds\(1\): 8 of its facets lie inside a body"):
        tfeti.ContactProblem(a, L, [], [], d)


def test_forms_of_other_kinds():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    with pytest.raises(InputError, match="a has 1 arguments; expected a bilinear form"):
        tfeti.ContactProblem(L, L, [], [], d)


def test_shapes_that_are_none():
    with pytest.raises(InputError, match=r"normal=\(0, 0\): expected a vector that is not zero"):
        tfeti.Plane((0, 0), (0, 0))
    with pytest.raises(InputError, match="radius=-1: expected a positive number"):
        tfeti.Sphere((0, 0, 0), -1)
    with pytest.raises(InputError, match="centre=.*: expected two or three finite numbers"):
        tfeti.Sphere((0, 0, np.nan), 1)
    with pytest.raises(InputError, match="axis="):
        tfeti.Cylinder((0, 0, 0), (0, 0, 0), 1)


def test_an_obstacle_without_a_normal():
    d = decomposed("hexahedron", 2, 2)
    flat = tfeti.SignedDistance(lambda x: x[2], lambda x: (x[0] < 0.9) * np.ones((3, 1)))
    p = problem(d, contacts=[tfeti.Obstacle("bottom", flat)])
    with pytest.raises(InputError, match=r"no distance and normal at the node \[\d.*gradient"):
        p.solve()


def test_a_stress_of_another_shape():
    d = decomposed("quadrilateral", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 1), d.surface("top"))
    left = fem.locate_dofs_topological(V, 1, d.facets("left"))
    bcs = [fem.dirichletbc(np.zeros(2), left, V)]
    with pytest.raises(InputError, match=r"stress\(u\) has shape \(2, 2\); expected \(3, 3\)"):
        tfeti.ContactProblem(a, L, bcs, [], d, stress=lambda u: ufl.sym(ufl.grad(u)))
    p = tfeti.ContactProblem(a, L, bcs, [], d)
    p.solve()
    with pytest.raises(InputError, match="no stress: give ContactProblem"):
        p.solution.von_mises  # noqa: B018


def test_meshes_of_other_cells():
    from dolfinx import mesh as dmesh

    interval = dmesh.create_unit_interval(MPI.COMM_WORLD, 4)
    with pytest.raises(InputError, match="mesh of intervals in 1D: expected one of triangle"):
        tfeti.decompose(interval, 2)


def test_files_that_are_missing_or_no_mesh(comm, shared_tmp):
    with pytest.raises(InputError, match=r"none.msh: no such file; expected a gmsh mesh"):
        tfeti.read_gmsh(shared_tmp / "none.msh", comm)
    path = shared_tmp / "text.msh"
    if ROOT:
        path.write_text("this is not a mesh\n")
    comm.barrier()
    with pytest.raises(InputError, match=r"text.msh: "):
        tfeti.read_gmsh(path, comm)


def test_meshes_without_physical_groups(comm, shared_tmp):
    gmsh = pytest.importorskip("gmsh")
    path = shared_tmp / "bare.msh"
    if ROOT:
        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("bare")
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(2)
        gmsh.write(str(path))
        gmsh.finalize()
    comm.barrier()
    with pytest.raises(InputError, match="the mesh has no physical groups of cells"):
        tfeti.read_gmsh(path, comm)


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


def test_pcpg_with_contact():
    d = decomposed("hexahedron", 2, 2)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))
    p = problem(d, contacts=[floor], tfeti_qp_type="pcpg")
    with pytest.raises(InputError, match="qp_type pcpg: the scene has 6 contact rows"):
        p.solve()


@pytest.mark.parametrize(
    "pair",
    [("lower left", "upper right"), ("lower bottom", "upper top"), ("lower right", "upper right")],
)
def test_a_body_is_free_since_its_pair_does_not_face(pair):
    d = stacked("quadrilateral", 2, 2, 2)
    p = two_body_problem(d, pressed(d), held(d, "lower bottom"), [tfeti.Contact(*pair)])
    with pytest.raises(tfeti.NoSolutionError, match="body 1 .*of the contacts meet nobody: 0: con"):
        p.solve()


def test_a_hand_made_stiffness_is_checked_as_well():
    d = decomposed("hexahedron", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0, 0, 1), d.surface("top"))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = -ufl.inner(hooke()(u), strain(v)) * ufl.dx
    with pytest.raises(InputError, match=r"subdomain \d: the stiffness has a diagonal entry -"):
        tfeti.ContactProblem(a, L, [], [], d).solve()
