"""Files for ParaView and pictures: complete, whole, and only when asked for."""

import dolfinx
import matplotlib.image
import numpy as np
import pytest
from full_disk import full, left_in
from scenes import curved_obstacle, decomposed, largest, problem, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import InputError, TfetiError
from tfeti_dolfinx.io import draw
from tfeti_dolfinx.io.output import cell_fields, nodal_fields, write_pvd, write_vtx, write_xdmf
from tfeti_dolfinx.io.plot import plot_deformed, plot_friction, plot_pressure


@pytest.fixture(scope="module", params=["quadrilateral", "tetrahedron"])
def solution(request):
    gdim = 2 if request.param == "quadrilateral" else 3
    d = decomposed(request.param, 4, 2)  # test_ranks runs it on three ranks
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim))
    p = solved(problem(d, (0.0,) * (gdim - 1) + (-0.05,), [obstacle]))
    return p.solution


def test_values_at_points_do_not_depend_on_units(solution):
    x, found = solution.decomposition.mesh.geometry.x, []
    points = np.random.default_rng(1).uniform(size=(30, solution.dofs.bs))
    for unit in (1.0, 1e-6):
        x *= unit
        found.append(solution.at(unit * points))
        x /= unit
    assert np.allclose(found[1].displacement, found[0].displacement, rtol=1e-9)
    assert np.allclose(found[1].stress, found[0].stress, rtol=1e-9)


def test_fields_of_nodes_and_cells(solution):
    names = [f.name for f in nodal_fields(solution)]
    assert names == ["displacement", "pressure", "gap", "status", "traction", "stress", "von_mises"]
    for f in nodal_fields(solution):
        assert f.function_space.element.basix_element.degree == 1
        assert np.all(np.isfinite(f.x.array))
    subdomain, body, material = cell_fields(solution)
    assert np.array_equal(np.unique(subdomain.x.array), solution.decomposition.subdomains)
    assert np.all(body.x.array == 0)
    assert np.all(material.x.array == -1)


def test_stress_of_a_linear_displacement_is_exact():
    d = decomposed("tetrahedron", 3, 4)
    p = solved(problem(d, (0, 0, -0.05), tfeti_rtol=1e-4))
    p.solution.displacement.interpolate(lambda x: np.stack((0 * x[0], 0 * x[0], 1e-3 * x[2])))
    s = p.solution.stress.x.array.reshape(-1, 9)
    lmbda, mu = 0.3 / (1.3 * 0.4), 0.5 / 1.3
    exact = 1e-3 * np.diag([lmbda, lmbda, lmbda + 2 * mu]).ravel()
    assert np.allclose(s, exact, atol=1e-15)
    assert np.allclose(p.solution.nodal_stress.x.array.reshape(-1, 9), exact, atol=1e-15)
    assert np.allclose(p.solution.von_mises.x.array, 2e-3 * mu, atol=1e-15)


def test_fields_inside_are_written_on_request(solution, comm, shared_tmp):
    """Without boundary elements they are those of finite elements."""
    u, (stress, mises) = solution.interior.displacement, solution.interior.fields[1]
    assert np.array_equal(u.x.array, solution.displacement.x.array)
    points = np.asarray(solution.stress.function_space.dofmap.list)
    in_cells = solution.stress.x.array.reshape(-1, 9)[points].mean(axis=1)
    assert np.allclose(stress.x.array, in_cells.ravel(), atol=1e-14)
    assert mises.name == "interior_von_mises"
    path = shared_tmp / f"inside{solution.dofs.bs}.xdmf"
    write_xdmf(path, solution, interior=True)
    if dolfinx.has_adios2:
        write_vtx(path.with_suffix(".bp"), solution, interior=True)
    text = path.read_text()
    for name in ("interior_displacement", "interior_stress", "interior_von_mises"):
        assert f'Name="{name}"' in text


@pytest.mark.parametrize("write", [write_vtx, write_xdmf])
def test_files_appear_whole(solution, comm, shared_tmp, write):
    """The second time they replace the first."""
    if write is write_vtx and not dolfinx.has_adios2:
        pytest.skip("DOLFINx without ADIOS2")
    path = shared_tmp / f"out.{'bp' if write is write_vtx else 'xdmf'}"
    for _ in range(2):
        first, second = write(path, solution)
    comm.barrier()
    assert (first.name, second.stem) == (path.name, "out_cells" if write is write_vtx else "out")
    assert set(shared_tmp.iterdir()) == {first, second}
    parts = [first, second] if first.is_file() else [*first.iterdir(), *second.iterdir()]
    content = b"".join(part.read_bytes() for part in parts)
    names = ["displacement", "pressure", "gap", "status", "stress", "von_mises", "body"]
    for name in [*names, "subdomain", second.name if first.is_file() else "displacement"]:
        assert name.encode() in content


def test_pvd_appears_whole(solution, comm, shared_tmp):
    pyvista = pytest.importorskip("pyvista")
    path = shared_tmp / f"out{solution.dofs.bs}.pvd"
    for _ in range(2):  # the second time it replaces the first
        files = write_pvd(path, solution, interior=True)
    comm.barrier()
    assert set(files) == set(shared_tmp.iterdir())
    grid = pyvista.get_reader(path).read()[0]
    names = {f.name for f in nodal_fields(solution)} | {"interior_displacement"}
    assert names <= set(grid.point_data)
    assert {"subdomain", "body", "material", "interior_stress"} <= set(grid.cell_data)
    assert grid.n_cells == comm.allreduce(len(solution.decomposition.cell_subdomain))
    expected = largest(solution.displacement.x.array)
    assert np.isclose(np.abs(grid["displacement"]).max(), expected, rtol=1e-12)


def test_xdmf_stands_in_where_adios2_is_missing(solution, comm, shared_tmp, monkeypatch):
    monkeypatch.setattr(dolfinx, "has_adios2", False)
    files = write_vtx(shared_tmp / f"other{solution.dofs.bs}.bp", solution)
    assert files[0].suffix == ".xdmf"


def test_files_that_cannot_be_written_are_named_on_all_ranks(solution, comm, shared_tmp):
    if comm.rank == 0:
        (shared_tmp / "file").write_text("")
    comm.barrier()
    folder = shared_tmp / "file"
    for name, write in {
        "out.bp": lambda path: write_vtx(path, solution),
        "out.xdmf": lambda path: write_xdmf(path, solution),
        "out.pvd": lambda path: write_pvd(path, solution),
        "deformed.png": lambda path: plot_deformed(path, solution),
        "pressure.png": lambda path: plot_pressure(path, solution, lambda x: x[0]),
    }.items():
        with pytest.raises(InputError, match=f"cannot write {folder}"):
            write(folder / name)


def test_on_a_full_disk_nothing_is_lost(solution, comm, shared_tmp):
    """An error on all ranks, and files of an earlier run as they were."""
    writers = {"out.xdmf": write_xdmf, "out.bp": write_vtx, "out.pvd": write_pvd}
    for name, write in writers.items():
        write(shared_tmp / name, solution)
        before = left_in(shared_tmp, comm)
        for size in (0, 20000):
            with full(size), pytest.raises(InputError, match=r"cannot write .*out.*too large"):
                write(shared_tmp / name, solution)
            assert left_in(shared_tmp, comm) == before
            assert not list(shared_tmp.glob(".*"))


def test_folders_beside_that_are_somebody_s_stay(solution, comm, shared_tmp):
    """What is written beside the name that was given takes no folder's place either."""
    kept = [shared_tmp / name / "kept" for name in ("out_cells.bp", "out.h5")]
    if comm.rank == 0:
        for folder in kept:
            folder.mkdir(parents=True)
    comm.barrier()
    with pytest.raises(InputError, match=r"out_cells.bp is a directory that VTX has not written"):
        write_vtx(shared_tmp / "out.bp", solution)
    with pytest.raises(InputError, match=r"out.h5 is a directory; expected a file"):
        write_xdmf(shared_tmp / "out.xdmf", solution)
    assert all(folder.is_dir() for folder in kept)


def test_a_coordinate_that_one_rank_cannot_compute(solution, comm, shared_tmp):
    def coordinate(x):
        if comm.rank == comm.size - 1:
            raise LookupError("no such coordinate")
        return x[0]

    with pytest.raises(InputError, match=r"coordinate of points .*LookupError: no such coordinate"):
        plot_pressure(shared_tmp / "pressure.png", solution, coordinate)


def test_pictures(solution, comm, shared_tmp):
    name = f"{solution.dofs.bs}.png"
    looks = {} if solution.dofs.bs == 2 else {"show": "status", "unit": "MPa"}
    files = [
        plot_deformed(shared_tmp / f"deformed{name}", solution, **looks),
        plot_pressure(shared_tmp / f"pressure{name}", solution, lambda x: x[0], lambda x: 0 * x),
    ]
    comm.barrier()
    if comm.rank == 0:
        for file in files:
            picture = matplotlib.image.imread(file)[..., :3]
            assert picture.shape[0] > 300
            assert len(np.unique(picture @ (1.0, 256.0, 65536.0))) > 10  # colours
        assert {p.name for p in shared_tmp.glob("*.png")} >= {f.name for f in files}


def test_a_cut_makes_no_status(comm, shared_tmp):
    floor = tfeti.Obstacle("bottom", curved_obstacle(3), friction=tfeti.Tresca(1e-3))
    p = solved(problem(decomposed("tetrahedron", 4, 2), (0.0, 0.0, -0.05), [floor]))
    looks = {"cut": ((0.7, 0, 0), (-1, 0, 0)), "view": (-1.0, 0.2, -1.5), "show": "status"}
    file = plot_deformed(shared_tmp / "cut.png", p.solution, **looks)
    if comm.rank == 0:
        r, g, b = matplotlib.image.imread(file)[..., :3].transpose(2, 0, 1)
        assert not np.any((g > r + 0.1) & (g > b + 0.1))  # as what touches without friction


def test_a_colour_that_is_not_known_is_named(solution, shared_tmp):
    with pytest.raises(InputError, match=r"show='stress': expected one of von_mises, pressure"):
        plot_deformed(shared_tmp / "none.png", solution, show="stress")
    with pytest.raises(InputError, match="no contact of the solution has friction"):
        plot_friction(shared_tmp / "none.png", solution)
    for wrong in (lambda x: x[0], "floor", []):
        with pytest.raises(InputError, match=r"contacts is .*; expected names or positions, such"):
            plot_friction(shared_tmp / "none.png", solution, wrong)


def test_pyvista_has_the_bodies_without_tears(solution, comm):
    grid, d = solution.to_pyvista(), solution.decomposition
    assert (grid is not None) == (comm.rank == 0)
    cells, subdomains = comm.allreduce(len(d.cell_subdomain)), d.num_subdomains
    x = np.concatenate(comm.allgather(solution.dofs.V.tabulate_dof_coordinates()))
    u = np.concatenate(comm.allgather(solution.displacement.x.array.reshape(-1, solution.dofs.bs)))
    if comm.rank == 0:
        assert grid.n_cells == cells
        assert set(grid.cell_data["subdomain"]) == set(range(subdomains))
        assert grid.n_points == len(np.unique(x.round(9), axis=0)) < len(x)
        found = {
            tuple(p): moved
            for p, moved in zip(grid.points.round(6), grid["displacement"], strict=False)
        }
        for point, moved in zip(x.round(6), u, strict=True):
            assert np.allclose(found[tuple(point)][: len(moved)], moved, atol=1e-5)
        assert grid["pressure"].max() > 0.0
    # copies that lie apart by rounding are one node
    points = d.mesh.geometry.x
    kept = points.copy()
    points[:] = np.interp(kept, np.linspace(0, 1, 5), np.array((0, 257, 513, 769, 1024)) / 1024)
    points += 1e-16 * np.random.default_rng(0).normal(size=points.shape)
    again = solution.to_pyvista()
    points[:] = kept
    assert again is None or again.n_points == grid.n_points


def test_a_picture_that_cannot_be_drawn_says_why(shared_tmp, comm, monkeypatch):
    monkeypatch.setattr(draw, "__file__", "/nowhere/draw.py")
    p = solved(problem(decomposed("quadrilateral", 2, 2), (0.0, -0.05)))
    for screen, error, words in (
        (":0", TfetiError, "none.png could not be drawn"),
        ("", InputError, "none.png: pictures by this VTK need an X server"),
    ):
        monkeypatch.setenv("DISPLAY", screen)
        monkeypatch.setenv("PATH", "/nowhere")
        with pytest.raises(error, match=words):
            plot_deformed(shared_tmp / "none.png", p.solution)
    assert not list(shared_tmp.iterdir())
