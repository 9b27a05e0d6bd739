"""Scenes and demos on more ranks than subdomains: run by test_idle_ranks, not collected.

A rank without a subdomain has empty arrays everywhere, yet takes part in every collective call.
"""

import numpy as np
import pytest
import ufl
from bodies import held, pressed, stacked, two_body_problem
from dolfinx import fem
from mpi4py import MPI
from scenes import curved_obstacle, decomposed, displacement, forms, problem, relative
from test_gmsh import two_bodies

import demos
import tfeti_dolfinx as tfeti
from tfeti_dolfinx.mesh import tearing
from tfeti_dolfinx.output import write_vtx, write_xdmf
from tfeti_dolfinx.plot import plot_deformed, plot_pressure

FIELDS = ["stress", "von_mises", "nodal_stress", "nodal_von_mises", "pressure", "traction"]
FIELDS += ["gap", "status"]


def some_rank_is_idle(d):
    fewest = d.comm.allreduce(len(d.subdomains), op=MPI.MIN)
    return fewest == 0


def everything_asked_for(p, folder, pictures=False):
    """All that a user may ask a solution for, on every rank."""
    s = p.solution
    for name in FIELDS:
        assert np.all(np.isfinite(getattr(s, name).x.array)), name
    assert np.all(np.isfinite(s.body_forces.force))
    files = [*write_vtx(folder / "out.bp", s), *write_xdmf(folder / "out.xdmf", s)]
    if pictures:
        files.append(plot_deformed(folder / "deformed.png", s))
    for index in range(len(p.contacts)):
        data = s.contact(index)
        assert len(data.points) == len(data.force) == len(data.gap)
        if pictures:
            file = folder / f"{index}.png"
            files.append(plot_pressure(file, s, lambda x: x[:, 0], contact=index))
    p.report.write(folder / "report.json", p.decomposition.comm)
    assert p.report.converged_reason.startswith("CONVERGED")
    p.decomposition.comm.barrier()
    assert all(file.exists() for file in files)
    p.destroy()


def box_on_obstacle(
    comm, cell="quadrilateral", degree=1, subdomains=2, clamped=("left",), **options
):
    """Some nodes get their rows late: they are out of reach at first, and come to overlap."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    d = decomposed(cell, 6 if gdim == 2 else 3, subdomains, comm=comm)
    reach = 0.022 if gdim == 2 else 0.024
    contacts = [tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=reach)]
    if not clamped:
        contacts += [tfeti.Obstacle("left", tfeti.Plane((-0.01, 0, 0), (1, 0, 0)))]
    load = (-0.01 if not clamped else 0.0,) + (0.0,) * (gdim - 2) + (-0.05,)
    options = {"tfeti_rtol": 1e-10, **options}
    return problem(d, load, contacts, clamped=clamped, degree=degree, **options)


@pytest.mark.parametrize(
    ("cell", "degree", "subdomains"),
    [
        ("quadrilateral", 1, 2),
        ("tetrahedron", 2, 1),
    ],
)
def test_obstacle_with_late_rows(comm, shared_tmp, cell, degree, subdomains):
    p, alone = (
        box_on_obstacle(c, cell, degree, subdomains, tfeti_pc_type="lumped")
        for c in (comm, MPI.COMM_SELF)
    )
    assert some_rank_is_idle(p.decomposition)
    p.solve()
    alone.solve()
    assert p.report.late_contact_rows > 0
    assert 0 < p.report.factorizations <= subdomains  # none is made again
    assert relative(displacement(p)[1], displacement(alone)[1]) <= 1e-7
    everything_asked_for(p, shared_tmp, pictures=cell == "hexahedron")  # demos draw in 2D
    p.solve()  # anew, from no Blocks on
    assert relative(displacement(p)[1], displacement(alone)[1]) <= 1e-7


def test_a_body_that_contact_alone_holds(comm, shared_tmp):
    p = box_on_obstacle(comm, subdomains=1, clamped=())
    p.solve()
    assert p.report.active_contacts > 0
    everything_asked_for(p, shared_tmp)


@pytest.mark.parametrize(
    ("cell", "options"),
    [
        ("quadrilateral", {}),
        ("quadrilateral", {"qp_type": "smalse"}),
        ("tetrahedron", {}),
    ],
)
def test_a_pair(comm, shared_tmp, cell, options):
    d = stacked(cell, 3, 4, 2)
    sides = ["lower bottom", "lower left", "upper left"]
    sides += ["lower front", "upper front"] if cell == "tetrahedron" else []
    p = two_body_problem(
        d,
        pressed(d),
        held(d, *sides),
        [tfeti.Contact("upper bottom", "lower top")],
        **options,
    )
    assert some_rank_is_idle(d)
    p.solve()
    assert p.report.active_contacts > 0
    everything_asked_for(p, shared_tmp)


def test_errors_come_up_on_all_ranks(comm, shared_tmp):
    d = decomposed("quadrilateral", 3, 1)
    with pytest.raises(tfeti.NoSolutionError, match="body 0 is free to move"):
        problem(d, clamped=()).solve()
    with pytest.raises(tfeti.InputError, match="entries not finite"):
        problem(d, (0.0, float("nan"))).solve()
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_ITS"):
        problem(decomposed("quadrilateral", 3, 2), (0.0, -0.05), tfeti_max_it=1).solve()
    V, a, L = forms(d.mesh, d.facet_tags, (0, 1), d.surface("top"))
    skew = ufl.inner(
        ufl.dot(ufl.grad(a.arguments()[1]), ufl.as_vector((1.0, 2.0))), a.arguments()[0]
    )
    with pytest.raises(tfeti.InputError, match="subdomain 0: the stiffness is not symmetric"):
        tfeti.ContactProblem(a + skew * ufl.dx, L, [], [], d).solve()
    nan = tfeti.SignedDistance(lambda x: np.nan * x[0], lambda x: np.zeros((3, x.shape[1])))
    with pytest.raises(tfeti.InputError, match="no distance and normal"):
        problem(d, contacts=[tfeti.Obstacle("bottom", nan)]).solve()


@pytest.mark.parametrize(("partitions", "files"), [(1, "one file"), (2, "split files")])
def test_a_gmsh_mesh_with_few_partitions(comm, shared_tmp, partitions, files):
    gmsh = pytest.importorskip("gmsh")
    path = shared_tmp / "mesh.msh"
    if comm.rank == 0:
        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
        two_bodies(far=False)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.partition(partitions)
        gmsh.option.setNumber("Mesh.PartitionSplitMeshFiles", files == "split files")
        gmsh.write(str(path))
        gmsh.finalize()
    comm.barrier()
    d = tfeti.read_gmsh(path, comm)
    assert some_rank_is_idle(d)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.01), d.surface(4))
    dofs = fem.locate_dofs_topological(V, 1, d.facets("held"))
    p = tfeti.ContactProblem(a, L, [fem.dirichletbc(np.zeros(2), dofs, V)], [], d)
    p.solve()
    assert len(write_vtx(shared_tmp / "mesh.bp", p.solution)) == 2


# two bodies at most; the others of the demos have more than there are ranks here
@pytest.mark.parametrize("name", ["linear_3d", "cylinder_on_block_2d", "adaptive_2d"])
def test_demos(name, comm, shared_tmp, monkeypatch):
    """Every subdomain that a demo asks for becomes one, or one for each body."""

    def few(mesh, *_):
        return np.zeros(len(mesh.cells), dtype=np.int64)

    for name_of_maker in ("make_parts", "given_subdomains"):
        monkeypatch.setattr(tearing, name_of_maker, few)
    report_file, folder = shared_tmp / "report.json", shared_tmp / "out"
    outputs = ["--report", report_file, "--output", folder, "--plot"]
    solution, _ = demos.run(name, ["--quick", *outputs])
    assert some_rank_is_idle(solution.decomposition)
    comm.barrier()
    assert report_file.is_file()
