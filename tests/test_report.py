"""The report: complete, physical, written whole; notes of what is worth knowing."""

import json
import re
from dataclasses import fields, replace

import numpy as np
import pytest
from bodies import held, pressed, sided, sides_of, stacked, two_body_problem
from scenes import STAGES, curved_obstacle, decomposed, problem, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import Report


@pytest.fixture(scope="module")
def report():
    d = decomposed("hexahedron", 6, 8)
    p = solved(problem(d, contacts=[tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.1)]))
    return p.report


def test_sizes(report):
    assert (report.subdomains, report.bodies, report.kernel_dim) == (8, 1, 48)
    assert (report.contact_rows, report.dropped_contact_rows) == (42, 7)
    assert report.primal_dofs == 3 * 8 * 4**3
    assert 0 < report.active_contacts < 42
    assert report.peak_memory_mb > 10
    assert all(report.residuals[name] <= most for name, most in report.tolerances.items())


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
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))
    p = problem(decomposed("hexahedron", 2, 3), (0, 0, 0.05), [floor])
    assert p.report.converged_reason == "NOT_SOLVED"
    p.solve()
    p.update(values=[])
    with pytest.raises(tfeti.NoSolutionError):
        p.solve()
    with pytest.raises(tfeti.InputError, match="the last solve has not converged"):
        p.accept()
    assert p.report.converged_reason == "NO_SOLUTION"
    assert (p.report.contact_candidates, p.report.active_contacts) == (9, 0)
    assert p.report.primal_dofs > 81


def test_a_solve_that_stopped_early_says_how_wrong_it_is():
    p = problem(decomposed("hexahedron", 3, 4), tfeti_max_it=3)
    with pytest.raises(tfeti.ConvergenceError, match="times what rtol 1e-06 allows"):
        p.solve()
    assert p.report.converged_reason == "DIVERGED_ITS"
    assert p.report.residuals["displacement_error"] > 1e-6


@pytest.mark.parametrize("height", [-0.5, 0.0])
def test_contacts_none_of_which_touches_are_said(height):
    d = decomposed("quadrilateral", 3)
    floor = [tfeti.Obstacle("bottom", tfeti.Plane((0, height), (0, 1)), reach=1.0)]
    p = solved(problem(d, contacts=floor))
    said = [note for note in p.report.notes if note.startswith("no contact touches")]
    if height < 0.0:
        contact = p.report.contact()
        assert contact.touching == 0
        assert 0.0 < contact.gap < 0.5
        text = f"no contact touches (smallest gap {contact.gap:.2g}): the displacement is that "
        assert said == [f"{text}without contacts"]
        assert f"notes     {said[0]}" in str(p.report)
        with pytest.raises(tfeti.ConvergenceError, match=r"what rtol .*; no contact touches \(s"):
            problem(d, contacts=floor, max_it=1).solve()
    else:
        assert p.report.contacts[0].touching > 0
        assert said == solved(problem(d)).report.notes == []


def test_friction_of_a_given_bound_acts_on_contacts_none_of_which_touches():
    floor = tfeti.Plane((0, -0.5), (0, 1))
    rubs = tfeti.Obstacle("bottom", floor, reach=1.0, friction=tfeti.Tresca(0.02))
    p = solved(problem(decomposed("quadrilateral", 3), contacts=[rubs], traction=(0.05, -0.05)))
    (contact,) = p.report.contacts
    assert contact.touching == 0
    assert contact.resultant == pytest.approx([0.02 * (1.0 - 1.0 / 6.0), 0.0])  # less the corner
    assert p.report.notes == [
        f"no contact touches (smallest gap {contact.gap:.2g}): forces act across open gaps"
    ]


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
@pytest.mark.parametrize(
    ("beyond", "secondary", "expected"),
    [(0.03, "lower top", True), (0.5, "lower top", False), (0.03, "upper bottom", False)],
)
def test_pressures_of_nodes_that_are_hardly_covered(cell, beyond, secondary, expected):
    """A block whose edge is a little beyond a node of the face on which it is pressed."""
    width, gap = (1.0 + beyond) / 3.0, -0.02 if beyond > 0.1 else 0.0
    d = stacked(cell, 3, 4, 4, upper=(0.0, width), gap=gap)
    primary = {"lower top": "upper bottom", "upper bottom": "lower top"}[secondary]
    contact = sided(secondary, primary, name="faces")
    p = solved(two_body_problem(d, pressed(d, 0.1), held(d, *sides_of(cell)), [contact]))
    found = [note for note in p.report.notes if note.startswith("faces: pressures go up to")]
    (summary,) = p.report.contacts
    load = 0.1 * width ** (d.mesh.geometry.dim - 1)
    assert np.isclose(abs(summary.resultant[-1]), load, rtol=1e-5)
    assert len(found) == expected
    overlaps = [note for note in p.report.notes if "surfaces overlap by up to 0.02" in note]
    assert len(overlaps) == (gap < 0.0)
    assert 0.1 <= summary.pressure <= 0.5  # 0.1 is the mean, and edges have more
    if expected:
        assert float(re.search(r"up to (\S+) at nodes", found[0])[1]) > 0.5
        assert f"they are at most {summary.pressure:.3g};" in found[0]
