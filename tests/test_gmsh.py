"""gmsh input: physical groups, partitions, orders, and what is not a mesh."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import tfeti_dolfinx as tfeti

gmsh = pytest.importorskip("gmsh")
ROOT = MPI.COMM_WORLD.rank == 0


@pytest.fixture(autouse=True)
def gmsh_session():
    if ROOT:
        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
    yield
    if ROOT:
        gmsh.finalize()


def two_squares(recombine=False, order=1):
    """[0, 2] × [0, 1] of two materials, 7 "left" and 9 "right"; curves 3 "inlet" and 4."""
    gmsh.model.add("two squares")
    occ = gmsh.model.occ
    a, b = occ.addRectangle(0, 0, 0, 1, 1), occ.addRectangle(1, 0, 0, 1, 1)
    occ.fragment([(2, a)], [(2, b)])
    occ.synchronize()

    def at(x):
        return [
            tag
            for dim, tag in gmsh.model.getEntities(1)
            if abs(occ.getCenterOfMass(dim, tag)[0] - x) < 1e-9
        ]

    gmsh.model.addPhysicalGroup(2, [1], 7, "left")
    gmsh.model.addPhysicalGroup(2, [2], 9, "right")
    gmsh.model.addPhysicalGroup(1, at(0.0), 3, "inlet")
    gmsh.model.addPhysicalGroup(1, at(2.0), 4)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.25)
    gmsh.option.setNumber("Mesh.RecombineAll", int(recombine))
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(order)


def quarter_ring(order=1, hexahedra=False):
    """Radii 0.5 and 1, height 1, a quarter; volume "body", outer curved surface "mantle"."""
    gmsh.model.add("ring")
    geo = gmsh.model.geo
    centre = geo.addPoint(0, 0, 0)
    inner = [geo.addPoint(0.5, 0, 0), geo.addPoint(0, 0.5, 0)]
    outer = [geo.addPoint(1, 0, 0), geo.addPoint(0, 1, 0)]
    curves = [
        geo.addLine(inner[0], outer[0]),
        geo.addCircleArc(outer[0], centre, outer[1]),
        geo.addLine(outer[1], inner[1]),
        geo.addCircleArc(inner[1], centre, inner[0]),
    ]
    base = geo.addPlaneSurface([geo.addCurveLoop(curves)])
    for curve, nodes in zip(curves, (4, 7, 4, 7), strict=True):
        geo.mesh.setTransfiniteCurve(curve, nodes)
    geo.mesh.setTransfiniteSurface(base)
    if hexahedra:
        geo.mesh.setRecombine(2, base)
    made = geo.extrude([(2, base)], 0, 0, 1, numElements=[3], recombine=hexahedra)
    geo.synchronize()
    volume = next(tag for dim, tag in made if dim == 3)
    gmsh.model.addPhysicalGroup(3, [volume], name="body")
    gmsh.model.addPhysicalGroup(2, [made[3][1]], name="mantle")
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(order)


def measures(d):
    return (
        ufl.Measure("dx", domain=d.mesh, subdomain_data=d.cell_tags),
        ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags),
    )


def integral(d, measure):
    one = fem.Constant(d.mesh, 1.0)
    return d.comm.allreduce(fem.assemble_scalar(fem.form(one * measure)))


def check_two_squares(d):
    dx, ds = measures(d)
    assert integral(d, dx(d.volume("left"))) == pytest.approx(1)
    assert integral(d, dx(d.volume("right"))) == pytest.approx(1)
    assert integral(d, ds(d.surface("inlet"))) == pytest.approx(1)
    assert integral(d, ds(d.surface(4))) == pytest.approx(1)
    assert d.surface("4") == 4
    assert d.num_bodies == 1


@pytest.mark.parametrize(("recombine", "order"), [(False, 2), (True, 1)])
def test_a_model_in_memory(comm, recombine, order):
    if ROOT:
        two_squares(recombine, order)
    d = tfeti.read_gmsh(gmsh.model, comm, 4)
    check_two_squares(d)
    assert d.num_subdomains == 4
    assert d.mesh.ufl_domain().ufl_coordinate_element().degree == order


@pytest.mark.parametrize(("version", "partitions"), [(2.2, 3), (4.1, 0), (4.1, 3)])
def test_files_with_and_without_partitions(comm, shared_tmp, version, partitions):
    path = shared_tmp / "squares.msh"
    if ROOT:
        two_squares()
        if partitions:
            gmsh.model.mesh.partition(partitions)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    comm.barrier()
    d = tfeti.read_gmsh(path, comm, None if partitions else 2)
    check_two_squares(d)
    assert d.num_subdomains == (partitions or 2)


def test_physical_groups_that_gmsh_renamed_for_its_partitions(comm):
    if ROOT:
        two_squares()
        gmsh.model.mesh.partition(2)
        rename_as_partition_groups()
    check_two_squares(tfeti.read_gmsh(gmsh.model, comm))


def rename_as_partition_groups():
    """What ``gmsh -part_physicals`` does: one new group per partition and physical group."""
    model = gmsh.model
    original = {
        (dim, entity): [int(t) for t in model.getPhysicalGroupsForEntity(dim, entity)]
        for dim, entity in model.getEntities()
        if len(model.getPartitions(dim, entity)) == 1
    }
    names = {group: model.getPhysicalName(*group) for group in model.getPhysicalGroups()}
    entities = {group: model.getEntitiesForPhysicalGroup(*group) for group in names}
    model.removePhysicalGroups()
    for (dim, tag), name in names.items():
        whole = [e for e in entities[dim, tag] if (dim, e) not in original]
        model.addPhysicalGroup(dim, whole, tag, name)
    for (dim, entity), tags in original.items():
        for tag in tags:
            part = model.getPartitions(dim, entity)[0]
            name = f"_part{{{part}}}_physical{{{tag}}}_dim{{{dim}}}"
            model.addPhysicalGroup(dim, [entity], 100 + 10 * entity, name)


@pytest.mark.parametrize(
    ("order", "tolerance", "hexahedra"), [(1, 0.05, True), (2, 0.002, False), (2, 0.002, True)]
)
def test_curved_bodies_of_first_and_second_order(comm, order, tolerance, hexahedra):
    if ROOT:
        quarter_ring(order, hexahedra)
    d = tfeti.read_gmsh(gmsh.model, comm, 3)
    dx, ds = measures(d)
    assert integral(d, dx(d.volume("body"))) == pytest.approx(0.75 * np.pi / 4, rel=tolerance)
    assert integral(d, ds(d.surface("mantle"))) == pytest.approx(np.pi / 2, rel=tolerance)
    expected = "hexahedron" if hexahedra else "tetrahedron"
    assert d.mesh.topology.cell_type.name == expected


def test_subdomains_by_a_callable_and_by_an_array(comm):
    if ROOT:
        two_squares()
    d = tfeti.read_gmsh(gmsh.model, comm, lambda x: np.floor(2 * x[0]))
    assert d.num_subdomains == 4
    cells = sum(len(tags) for tags in gmsh.model.mesh.getElements(2)[1]) if ROOT else 0
    ids = (np.arange(cells) >= cells // 2).astype(int)
    d = tfeti.read_gmsh(gmsh.model, comm, ids)
    assert d.num_subdomains >= 2
