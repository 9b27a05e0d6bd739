"""gmsh input: physical groups, partitions in one file or split files, orders, what does not fit."""

import numpy as np
import pytest
from bodies import clamped, no_load, two_body_problem
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import by_point, displacement, integral, measures, problem, relative, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import InputError

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


def two_bodies(cell="triangle", order=1, far=True):
    """A bar of two materials, "left" and "right", and above it a block, "far" (or no group).

    Surfaces: "held" (left ends), 4 (right ends), "middle" between the materials.
    """
    gmsh.model.add("two bodies")
    occ = gmsh.model.occ
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    corners = [(0, 0), (1, 0), (0, 2)]
    if dim == 2:
        made = [(2, occ.addRectangle(x, y, 0, 1, 1)) for x, y in corners]
    else:
        made = [(3, occ.addBox(x, y, 0, 1, 1, 1)) for x, y in corners]
    occ.fragment(made[:1], made[1:2])
    occ.synchronize()

    def at(*places):
        return [
            tag
            for _, tag in gmsh.model.getEntities(dim - 1)
            if any(np.allclose(occ.getCenterOfMass(dim - 1, tag)[:2], p) for p in places)
        ]

    for (_, tag), group, name in zip(made, (7, 9, 11), ("left", "right", "far"), strict=True):
        if far or name != "far":
            gmsh.model.addPhysicalGroup(dim, [tag], group, name)
    gmsh.model.addPhysicalGroup(dim - 1, at((0, 0.5), (0, 2.5)), 3, "held")
    gmsh.model.addPhysicalGroup(dim - 1, at((2, 0.5), (1, 2.5)), 4)
    gmsh.model.addPhysicalGroup(dim - 1, at((1, 0.5)), 5, "middle")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.25 if dim == 2 else 0.4)
    if cell in ("quadrilateral", "hexahedron"):
        gmsh.model.mesh.setTransfiniteAutomatic()
    gmsh.model.mesh.generate(dim)
    gmsh.model.mesh.setOrder(order)


def quarter_ring(order=1, hexahedra=False):
    """Radii 0.5 and 1, height 1, a quarter; volume "body", outer curved surface "mantle"."""
    gmsh.model.add("ring")
    geo = gmsh.model.geo
    corners = [geo.addPoint(x, 0, z) for x, z in ((0.5, 0), (1, 0), (1, 1), (0.5, 1))]
    sides = [geo.addLine(corners[i - 1], corners[i]) for i in range(4)]
    section = geo.addPlaneSurface([geo.addCurveLoop(sides)])
    for side in sides:
        geo.mesh.setTransfiniteCurve(side, 4)
    geo.mesh.setTransfiniteSurface(section)
    if hexahedra:
        geo.mesh.setRecombine(2, section)
    axis, way = (0, 0, 0, 0, 0, 1), {"numElements": [6], "recombine": hexahedra}
    made = geo.revolve([(2, section)], *axis, np.pi / 2, **way)
    geo.synchronize()
    gmsh.model.addPhysicalGroup(3, [made[1][1]], name="body")
    gmsh.model.addPhysicalGroup(2, [made[4][1]], name="mantle")
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(order)


def check_bodies(d):
    dx, ds = measures(d)
    for name in ("left", "right", "far"):
        assert integral(1 * dx(d.volume(name))) == pytest.approx(1)
    for name in ("held", 4):
        assert integral(1 * ds(d.surface(name))) == pytest.approx(2)
    assert d.surface("4") == 4
    assert d.num_bodies == 2


@pytest.mark.parametrize("apart", [1, 100])
def test_a_model_in_memory(comm, apart):
    """The ids of its nodes may be far apart."""
    if ROOT:
        two_bodies("quadrilateral")
        ids = gmsh.model.mesh.getNodes()[0]
        gmsh.model.mesh.renumberNodes(ids, apart * ids)
    d = tfeti.read_gmsh(gmsh.model, comm, 4)
    check_bodies(d)
    assert d.num_subdomains == 4


@pytest.mark.parametrize(("version", "partitions"), [(2.2, 3), (4.1, 0), (4.1, 3)])
def test_files_with_and_without_partitions(comm, shared_tmp, version, partitions):
    path = shared_tmp / "bodies.msh"
    if ROOT:
        two_bodies()
        if partitions:
            gmsh.model.mesh.partition(partitions)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    comm.barrier()
    d = tfeti.read_gmsh(path, comm, None if partitions else 2)
    check_bodies(d)
    assert d.num_subdomains >= (partitions or 2)


def test_a_name_that_gmsh_loses_is_said(comm, caplog):
    """The second group of a name has none: contact would be on the first alone."""
    if ROOT:
        square = gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [square], name="plate")
        for _, side in gmsh.model.getBoundary([(2, square)], oriented=False)[:2]:
            gmsh.model.addPhysicalGroup(1, [side], name="floor")
        gmsh.model.mesh.generate(2)
    tfeti.read_gmsh(gmsh.model if ROOT else None, comm, 2)
    said = [r for r in caplog.records if "groups of facets without a name" in r.getMessage()]
    assert len(said) == (comm.rank == 0)


def test_physical_groups_that_gmsh_renamed_for_its_partitions(comm):
    if ROOT:
        two_bodies()
        gmsh.model.mesh.partition(2)
        rename_as_partition_groups()
    check_bodies(tfeti.read_gmsh(gmsh.model, comm))


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
    parts = {}
    for (dim, entity), tags in original.items():
        for tag in tags:
            name = f"_part{{{model.getPartitions(dim, entity)[0]}}}_physical{{{tag}}}_dim{{{dim}}}"
            parts.setdefault((dim, name), []).append(entity)
    for number, ((dim, name), found) in enumerate(parts.items(), start=100):
        model.addPhysicalGroup(dim, found, number, name)


@pytest.mark.parametrize(
    ("order", "tolerance", "hexahedra"), [(1, 0.05, True), (2, 0.002, False), (2, 0.002, True)]
)
def test_curved_bodies_of_first_and_second_order(comm, order, tolerance, hexahedra):
    if ROOT:
        quarter_ring(order, hexahedra)
    d = tfeti.read_gmsh(gmsh.model, comm, 3)
    dx, ds = measures(d)
    assert integral(1 * dx(d.volume("body"))) == pytest.approx(0.75 * np.pi / 4, rel=tolerance)
    assert integral(1 * ds(d.surface("mantle"))) == pytest.approx(np.pi / 2, rel=tolerance)
    assert d.mesh.topology.cell_type.name == ("hexahedron" if hexahedra else "tetrahedron")


def write(folder, version=4.1, ghosts=False, partition=5):
    """The model in one file ``whole.msh`` and in split files ``split_1.msh``, ..."""
    gmsh.option.setNumber("Mesh.PartitionCreateGhostCells", int(ghosts))
    if partition:
        gmsh.model.mesh.partition(partition)
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.write(str(folder / "whole.msh"))
    gmsh.option.setNumber("Mesh.PartitionSplitMeshFiles", 1)
    gmsh.write(str(folder / "split.msh"))


def both(folder, comm, subdomains=None):
    comm.barrier()
    whole = tfeti.read_gmsh(folder / "whole.msh", comm, subdomains)
    return whole, tfeti.read_gmsh(folder / "split.msh", comm, subdomains)


def table(d, entities, dim, *columns):
    """Midpoints of entities and columns beside them, of all ranks, sorted by midpoint."""
    d.mesh.topology.create_connectivity(dim, d.mesh.topology.dim)
    middle = dmesh.compute_midpoints(d.mesh, dim, np.asarray(entities, dtype=np.int32))
    return by_point(d.comm, np.column_stack((middle.reshape(-1, 3), *columns)))[0]


def cells_of(d, ids=True):
    assert len(d.cell_tags.values) == len(d.cell_subdomain)
    columns = [d.cell_subdomain, d.cell_tags.values]
    columns += [d.original_cells] if ids else []
    return table(d, np.arange(len(d.cell_subdomain)), d.mesh.topology.dim, *columns)


def facets_of(d):
    return table(d, d.facet_tags.indices, d.mesh.topology.dim - 1, d.facet_tags.values)


def nodes_of(d, ids=True):
    return by_point(d.comm, np.column_stack((d.mesh.geometry.x, d.original_nodes * ids)))[0]


def check_same(whole, split, ids=True):
    assert np.array_equal(split.body_of_subdomain, whole.body_of_subdomain)
    for name in ("num_subdomains", "names", "body_names", "split"):
        assert getattr(split, name) == getattr(whole, name), name
    assert np.allclose(cells_of(split, ids), cells_of(whole, ids), atol=1e-14)
    assert np.allclose(facets_of(split), facets_of(whole), atol=1e-14)
    assert np.array_equal(nodes_of(split, ids), nodes_of(whole, ids))
    for name in ("tears", "boundary"):
        sizes = [d.comm.allreduce(len(getattr(d, name))) for d in (split, whole)]
        assert sizes[0] == sizes[1]


def answer(d):
    return displacement(solved(problem(d, clamped=("held",), loaded=4, tfeti_rtol=1e-10)))[1]


@pytest.mark.parametrize(
    ("cell", "order", "ghosts", "version"),
    [
        ("triangle", 1, True, 4.1),
        ("tetrahedron", 2, True, 4.1),
        ("hexahedron", 1, False, 4.1),
        ("tetrahedron", 1, False, 2.2),
    ],
)
def test_the_same_as_one_file(comm, shared_tmp, cell, order, ghosts, version):
    """Of version 2, a file names only its own groups, and nodes and cells are numbered anew."""
    if ROOT:
        two_bodies(cell, order)
        write(shared_tmp, version, ghosts)
    whole, split = both(shared_tmp, comm)
    check_same(whole, split, ids=version > 3)
    assert split.mesh.ufl_domain().ufl_coordinate_element().degree == order
    assert split.num_subdomains >= 5
    assert split.num_bodies == 2
    assert split.names.volumes == {"left": 7, "right": 9, "far": 11}
    assert split.names.surfaces == {"held": 3, "4": 4, "middle": 5}
    assert split.mesh.topology.cell_type.name == cell


def partition_by(partition):
    """Partition all elements of the model by their midpoints."""
    mesh = gmsh.model.mesh
    kinds, ids, _ = mesh.getElements()
    middle = np.concatenate([mesh.getBarycenters(kind, -1, False, True) for kind in kinds])
    parts = partition(*middle.reshape(-1, 3).T[:2])
    mesh.partition(int(parts.max()), np.concatenate(ids), parts)


def test_a_surface_between_partitions_is_tagged_on_both_sides(comm, shared_tmp):
    if ROOT:
        two_bodies()
        partition_by(lambda x, y: 1 + ((x > 1.0) | (y > 1.5)))
        write(shared_tmp, partition=0)
    whole, split = both(shared_tmp, comm)
    check_same(whole, split)
    assert comm.allreduce(len(split.facets("middle"))) == 2 * 4
    assert np.all(np.isin(split.facets("middle"), split.tears))


def test_partitions_can_be_overruled(comm, shared_tmp):
    if ROOT:
        two_bodies()
        write(shared_tmp)
    check_same(*both(shared_tmp, comm, lambda x: np.floor(2 * x[0]) + 4 * (x[1] > 1.5)))
    split = tfeti.read_gmsh(shared_tmp / "split.msh", comm, 6)
    assert split.num_subdomains >= 6
    whole = tfeti.read_gmsh(shared_tmp / "whole.msh", comm)
    assert relative(answer(split), answer(whole)) <= 1e-9


def test_ids_of_cells_in_the_order_of_the_files(comm, shared_tmp):
    numbers = [p for p in (1, 2, 3) if (p - 1) * comm.size // 3 == comm.rank]
    write_squares(shared_tmp, {}, {}, {})
    ids = np.array([[2 * p, 2 * p + 1] for p in numbers], dtype=int).ravel()
    d = tfeti.read_gmsh(shared_tmp / "squares.msh", comm, ids)
    assert d.num_subdomains == 6
    assert np.array_equal(d.original_cells, 10 * (d.cell_subdomain // 2 + 1) + d.cell_subdomain % 2)
    with pytest.raises(InputError, match="array subdomains: expected one id for each of the"):
        tfeti.read_gmsh(shared_tmp / "squares.msh", comm, np.zeros(7))


def square(number, tag=1, name="body", shift=0.0, quads=False, column=None):
    """MSH 2.2 of the square [number − 1, number] × [0, 1]."""
    column = number if column is None else column
    a, b, c, d = 2 * column - 1, 2 * column + 1, 2 * column + 2, 2 * column
    x = column - 1 + shift
    nodes = [(a, x, 0), (b, column, 0), (c, column, 1), (d, x, 1)]
    cells = [(3, (a, b, c, d))] if quads else [(2, (a, b, c)), (2, (a, c, d))]
    lines = [
        f"{10 * number + i} {kind} 2 {tag} {tag} {' '.join(map(str, own))}"
        for i, (kind, own) in enumerate(cells)
    ]
    sections = {
        "MeshFormat": ["2.2 0 8"],
        "PhysicalNames": ["1", f'2 {tag} "{name}"'],
        "Nodes": ["4", *(f"{i} {x} {y} 0" for i, x, y in nodes)],
        "Elements": [str(len(lines)), *lines],
    }
    written = ["\n".join((f"${name}", *own, f"$End{name}\n")) for name, own in sections.items()]
    return "".join(written)


def write_squares(folder, *changes):
    """Files ``squares_1.msh``, ... on rank 0, seen by all ranks."""
    if ROOT:
        for number, change in enumerate(changes, start=1):
            (folder / f"squares_{number}.msh").write_text(square(number, **change))
    MPI.COMM_WORLD.barrier()


WRONG = [
    ("'Triangle 3' in squares_1.msh and 'Quadrilateral 4' in squares_3.msh", {"quads": True}),
    ("'body' stands for the physical groups of dimension 2 and tag 1 and .* 2 .* 2", {"tag": 2}),
    ("dimension 2 and tag 1 is named 'body' in one file and 'steel' in anoth", {"name": "steel"}),
    (r"node [56] lies at \[2.0, .* in one file and at \[2.25, .* in another", {"shift": 0.25}),
    ("cells 1[01] and 3[01] have the same nodes; expected files", {"column": 1}),
]


@pytest.mark.parametrize(("message", "change"), WRONG, ids=range(len(WRONG)))
def test_files_that_do_not_fit_together(comm, shared_tmp, message, change):
    write_squares(shared_tmp, {}, {}, change)
    with pytest.raises(InputError, match=message):
        tfeti.read_gmsh(shared_tmp / "squares.msh", comm)


def test_a_missing_last_file(comm, shared_tmp):
    if ROOT:
        two_bodies()
        write(shared_tmp)
        (shared_tmp / "split_5.msh").unlink()
    comm.barrier()
    with pytest.raises(InputError, match=r"split_5.msh: no such file; expected one .* 5 partition"):
        tfeti.read_gmsh(shared_tmp / "split.msh", comm)


@pytest.mark.parametrize("secondary", ["left face", "right face"])
def test_the_tip_of_a_notch_bears_nothing(comm, secondary):
    """It is on both faces: it has no condition, and no force where nothing touches."""
    if ROOT:
        geo, names = gmsh.model.geo, ("right", "right face", "left face", "left")
        corners = (-1, 0), (1, 0), (1, 1), (0.05, 1), (0, 0.5), (0, 1), (-1, 1)
        points = [geo.addPoint(x, y, 0, 0.2) for x, y in corners]
        lines = [geo.addLine(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
        body = geo.addPlaneSurface([geo.addCurveLoop(lines)])
        geo.mesh.setTransfiniteCurve(lines[3], 6)
        geo.synchronize()
        for name, line in zip(names, (lines[k] for k in (1, 3, 4, 6)), strict=True):
            gmsh.model.addPhysicalGroup(1, [line], name=name)
        gmsh.model.addPhysicalGroup(2, [body])
        gmsh.model.mesh.generate(2)
    d = tfeti.read_gmsh(gmsh.model, comm, 3)
    way = fem.Constant(d.mesh, (0.0, 0.0))
    pair = tfeti.Contact("left face", "right face", secondary=secondary, reach=0.2)
    p = two_body_problem(d, no_load, clamped(d, ("left", way), "right"), [pair])
    for way.value[0], touches in ((0.01, False), (0.05, True)):
        force = solved(p).solution.contact(0).resultant.force
        assert (p.report.contacts[0].touching > 0) == touches
        assert 0.01 * touches >= np.abs(force[0]) >= 0.003 * touches
