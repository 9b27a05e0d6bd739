"""The report: complete, physical, written whole."""

import json
from dataclasses import fields, replace

import pytest
from scenes import STAGES, curved_obstacle, decomposed, problem, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import Report


@pytest.fixture(scope="module")
def report():
    d = decomposed("hexahedron", 6, 8)
    p = solved(problem(d, contacts=[tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.1)]))
    return p.report


def test_sizes(report):
    assert report.subdomains == 8
    assert report.bodies == 1
    assert report.kernel_dim == 48
    assert report.contact_rows == 42
    assert report.dropped_contact_rows == 7
    assert report.primal_dofs == 3 * 8 * 4**3
    assert 0 < report.active_contacts < 42
    assert report.peak_memory_mb > 10


def test_every_stage_has_its_seconds(report):
    assert set(report.seconds) == {*STAGES, "total"}
    assert all(value >= 0.0 for value in report.seconds.values())
    total = sum(value for name, value in report.seconds.items() if name != "total")
    assert report.seconds["total"] == pytest.approx(total, rel=0.2)


def test_json_has_every_field(report, comm, shared_tmp):
    path = shared_tmp / "deep" / "report.json"
    report.write(path, comm)
    data = json.loads(path.read_text())
    assert set(data) == {f.name for f in fields(Report)}
    assert data["contact_rows"] == report.contact_rows == report.sizes["contact_rows"]
    comm.barrier()
    assert [p.name for p in path.parent.iterdir()] == ["report.json"]
    assert all(name in report.details() for name in data if name != "errors")
    assert set(report.residuals) == {"projected_gradient", "equilibrium", *report.tolerances}


def test_the_first_screen_is_short(report):
    """At most ten lines, and one for each contact, with what is asked for first."""
    said = {"notes": ["so it is " * 30] * 3, "warnings": ["so it is not"]}
    full = replace(report, tools=["die: displacement (0, 1), force (0, 1)"] * 9, **said)
    lines = str(report).splitlines()
    assert len(lines) < len(str(full).splitlines()) == 10 + len(report.contacts)
    assert lines[0] == "tfeti_dolfinx: CONVERGED_RTOL"
    contact = report.contact(report.contacts[0].name)
    assert (contact.nodes, contact.touching) == (49, report.active_contacts)
    assert contact.resultant[2] > 0.0
    assert contact.pressure > 0.0
    assert abs(contact.gap) <= report.tolerances["penetration"]
    (line,) = (line for line in lines if f"{contact.touching} of 49 nodes touch" in line)
    assert f"smallest gap {contact.gap:.2g}" in line
    assert "displacement error" in str(report)
    assert f"{report.F_multiplications} iterations" in str(report)


def test_a_report_that_cannot_be_written_is_named_on_all_ranks(report, comm, shared_tmp):
    if comm.rank == 0:
        (shared_tmp / "file").write_text("")
        (shared_tmp / "folder").mkdir()
    comm.barrier()
    for path in (shared_tmp / "file" / "report.json", shared_tmp / "folder"):
        with pytest.raises(tfeti.InputError, match=f"cannot write {path}"):
            report.write(path, comm)
    comm.barrier()
    assert not list(shared_tmp.glob(".*"))


def test_after_an_error_the_report_says_what_is_known():
    d = decomposed("hexahedron", 2, 3)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))
    p = problem(d, (0, 0, 0.05), [floor], clamped=())
    assert p.report.converged_reason == "NOT_SOLVED"
    with pytest.raises(tfeti.NoSolutionError):
        p.solve()
    assert p.report.converged_reason == "NO_SOLUTION"
    assert p.report.contact_candidates == 9
    assert p.report.primal_dofs > 81
    assert p.report.active_contacts == 0


def test_a_solve_that_stopped_early_says_how_wrong_it_is():
    p = problem(decomposed("hexahedron", 3, 4), tfeti_max_it=3)
    with pytest.raises(tfeti.ConvergenceError, match="times what rtol 1e-06 allows"):
        p.solve()
    assert p.report.converged_reason == "DIVERGED_ITS"
    assert p.report.residuals["displacement_error"] > 1e-6
