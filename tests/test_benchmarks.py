"""Benchmarks run at tiny sizes, and write what they return."""

import json
import time

import numpy as np
import pytest

from benchmarks import (
    ablation,
    hertz_convergence,
    kplus_forms,
    linear_price,
    profiles,
    secondary_side,
    solver_profiles,
    spectrum,
    stability,
    stages,
    strong_scaling,
    subdomain_size,
    talk_tables,
    time_against_error,
    tools,
    weak_scaling,
)


def quick(benchmark, folder, comm, *arguments):
    """Tables of a quick run, which must be what it has written."""
    tables = benchmark.main(["--quick", "--output", str(folder), *arguments])
    comm.barrier()
    name = benchmark.__name__.split(".")[-1]
    assert (folder / f"{name}.md").read_text().startswith("## ")
    assert json.loads((folder / f"{name}.json").read_text()).keys() == tables.keys()
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return tables


def test_talk_tables(shared_tmp, comm):
    tables = quick(talk_tables, shared_tmp, comm, "--rtol", "1e-4")
    assert set(tables) == {"Hertz 2D", "Frictionless 3D", "Tresca 2D", "Tresca 3D", "TBETI"}
    for title, table in tables.items():
        (row,) = table
        assert row["rtol"] == "1e-04"
        assert row["kernel"] == row["kernel, talk"]
        assert 0 < row["F, Newton"] < row["F, SMALSE"]
        assert ("sticking" in row) == title.startswith("Tresca")


def test_ablation(serial_only, tmp_path):
    """A column for each mechanism, a row for each scene, and the page of the documents."""
    page, given = tmp_path / "page.md", ["--mechanisms", "smooth_displacements", "kept_directions"]
    tables = ablation.main(["--quick", "--output", str(tmp_path), "--page", str(page), *given])
    assert len(tables["Multiplications"]) == len(tables["Change of u"]) == 2
    for row in tables["Multiplications"]:
        assert float(row["kept_directions"]) == pytest.approx(1.0, abs=0.1)
    assert max(float(row["smooth_displacements"]) for row in tables["Multiplications"]) > 1.1
    assert all(float(row["kept_directions"]) < 1e-4 for row in tables["Change of u"])
    assert "smooth_displacements" in page.read_text()


def test_kplus_forms(shared_tmp, comm):
    """A bad choice of fixing nodes makes what is factored worse, and no choice makes K⁺ wrong."""
    tables = quick(kplus_forms, shared_tmp, comm)
    for rows in tables.values():
        condition = {
            (row["K⁺"], row["fixing nodes"]): row["condition of the factor"] for row in rows
        }
        for kind in ("regularized", "schur"):
            assert condition[kind, "a cell in a corner"] >= 5 * condition[kind, "spread"]
        for row in rows:
            assert row["error of a deformation"] <= 1e-10
            assert row["error of K K⁺ K"] <= 1e-10


def test_spectrum(shared_tmp, comm):
    """κ ≤ C·H/h with C of some units, whatever H is."""
    tables = quick(spectrum, shared_tmp, comm)
    for rows in tables.values():
        assert len(rows) == 4
        for row in rows:
            assert 0.0 < row["λ_min(F)"] < row["λ_max(F)"]
            assert row["κ(F)"] == row["λ_max(F)"] / row["λ_min(F)"]
            assert 1.0 <= row["κ(F)·h/H"] <= 3.0
            assert 1.0 <= row["κ(S)·h/H"] <= 5.0


def test_hertz_convergence(shared_tmp, comm):
    tables = quick(hertz_convergence, shared_tmp, comm)
    for name in hertz_convergence.QUICK:
        coarse, fine = tables[name]
        assert fine["pressure_l2_finer"] < coarse["pressure_l2_finer"]


def test_secondary_side(shared_tmp, comm):
    """The side that is taken has the smaller error, and takes no more multiplications."""
    tables = quick(secondary_side, shared_tmp, comm)
    for name in secondary_side.QUICK:
        for row in tables[name]:
            (other,) = {"upper", "lower"} - {row["auto"]}
            assert row[f"nodes, {row['auto']}"] < 0.5 * row[f"nodes, {other}"]
            assert row[f"field, {row['auto']}"] <= row[f"field, {other}"]
            assert row[f"F, {row['auto']}"] <= row[f"F, {other}"]
    assert next(row["nodes, worst"] for row in tables["Rules"]) == 1.0


def test_the_linear_problem_has_the_solution_of_the_contact(shared_tmp, comm):
    """So all solvers find it, and their price can be compared."""
    tables = quick(linear_price, shared_tmp, comm, "--scenes", "cube_3d", "-tfeti_rtol", "1e-7")
    (rows,) = tables.values()
    assert {row["solver"] for row in rows} >= {"contact, newton", "contact, smalse", "GAMG"}
    assert all(row["error"] <= 1e-7 for row in rows)
    assert min(row["of GAMG"] for row in rows if row["solver"] == "GAMG") == 1.0


def test_stages(shared_tmp, comm, monkeypatch):
    monkeypatch.setattr(time, "perf_counter", time.perf_counter)  # comes back after the test
    tables = quick(stages, shared_tmp, comm, "--processor")
    assert time.perf_counter is time.process_time
    for title, rows in tables.items():
        if title == "Local operators":
            assert len(rows) == 2 * len(stages.DEMOS)
            assert all(row["MB"] > 0.0 for row in rows)
        else:
            assert sum(row["share"] for row in rows) == pytest.approx(1.0)
            assert all(0.0 < row["MB in use"] <= row["MB held"] for row in rows)


def test_stability(shared_tmp, comm):
    """Each row has a test of its own in ``test_stability``."""
    tables = quick(stability, shared_tmp, comm, "--groups", "nu")
    assert set(tables) == {"nu", "locking"}
    for row in tables["nu"]:
        assert row["verdict"] == "right"
        assert row["error"] <= 1e-4
    stiff, locked = tables["locking"]
    assert locked["P1 over P2"] < 0.8 * stiff["P1 over P2"]


@pytest.mark.slow
def test_solver_profiles(serial_only, shared_tmp, comm):
    tables = quick(solver_profiles, shared_tmp, comm, "--steps", "100", "--seed", "5")
    default = tables["contact, multiplications"][2]
    assert default["solver"] == "newton, dirichlet"
    for title, rows in tables.items():
        if "τ = 1" in rows[0]:
            assert max(row["τ = 1"] for row in rows) > 0.0, title
            for row in rows:
                shares = [row[f"τ = {tau:g}"] for tau in solver_profiles.TAUS]
                assert shares == sorted(shares)
                assert shares[-1] <= 1.0 - row["failed"] / row["solves"]


@pytest.mark.slow
def test_weak_scaling(serial_only, shared_tmp, comm):
    tables = quick(weak_scaling, shared_tmp, comm)
    for rows in tables.values():
        for row in rows:
            assert row["unknowns"] % row["subdomains"] == 0
            assert row["F"] > row["S"] > 0


def test_strong_scaling(serial_only, shared_tmp, comm):
    (rows,) = quick(strong_scaling, shared_tmp, comm, "--ranks", "2").values()
    assert [row["ranks"] for row in rows] == [1, 2]
    assert rows[0]["faster"] == 1.0
    assert rows[0]["unknowns"] == rows[1]["unknowns"]


@pytest.mark.slow
def test_subdomain_size(serial_only, shared_tmp, comm):
    tables = quick(subdomain_size, shared_tmp, comm, "--ranks", "1")
    for rows in tables.values():
        assert [row["type"] for row in rows] == list(subdomain_size.TYPES)
        assert rows[0]["forms"] == "implicit"
        assert rows[1]["forms"] == "explicit"
        assert len({row["F"] for row in rows}) == 1


@pytest.mark.slow
def test_time_against_error(serial_only, shared_tmp, comm):
    """Errors fall, and degree 2 is nearer in energy on a mesh with as many unknowns."""
    words = ["--ranks", "1", "--scenes", "half cylinder"]
    tables = quick(time_against_error, shared_tmp, comm, *words)
    for scene in words[3:]:
        linear, finer, quadratic, _ = tables[scene]
        assert finer["energy"] < linear["energy"]
        assert finer["pressure"] < linear["pressure"]
        assert quadratic["energy"] < linear["energy"]
        assert quadratic["unknowns"] < finer["unknowns"]
        groups = tables[f"{scene}, slopes and seconds"]
        assert all(row["energy, slope over unknowns"] < 0.0 for row in groups)


def test_pressures_are_compared_as_functions():
    """Linear between points in any order: Hertz's own, on points that are fine enough."""
    rng = np.random.default_rng(0)
    for samples, power in ((profiles.Samples.line(2.0), 1), (profiles.Samples.disc(2.0), 2)):
        exact = samples.exact(lambda r: np.sqrt(np.maximum(1.0 - (r / 2.0) ** 2, 0.0)))
        points = rng.uniform(-3.0, 3.0, (20_000, power))
        p = np.sqrt(np.maximum(1.0 - (np.linalg.norm(points, axis=1) / 2.0) ** 2, 0.0))
        found = profiles.errors(samples, samples.at(points, 1.01 * p), exact)
        assert found["pressure"] == pytest.approx(0.01, rel=0.05)
        assert found["p0"] == pytest.approx(0.01, rel=0.05)
        assert abs(found["a"]) <= 1e-3
    ring = profiles.Samples.circle(1.0)
    assert np.allclose(ring.at(np.array([[3.0], [-3.0], [0.0]]), np.ones(3)), 1.0)


def test_tables_go_between_their_marks(tmp_path):
    page = tmp_path / "page.md"
    mark = "before\n<!-- spectrum: {}, at {} -->\n\n| old |\n\n<!-- end -->\nafter\n"
    page.write_text(mark.format("2D", "abc123") + mark.format("3D", "abc123"))
    tools.write_documents("spectrum", {"2D": [{"κ": 7.5, "rows": 3}]}, "def456", tmp_path)
    text = page.read_text()
    assert (
        "2D, at def456 -->\n\n| κ | rows |\n|---|---|\n| 7.5 | 3 |\n\n<!-- end -->\nafter" in text
    )
    assert text.endswith(mark.format("3D", "abc123"))
