"""Benchmarks run at tiny sizes, and write what they return."""

import json
import re
import time

import numpy as np
import pytest

from benchmarks import (
    ablation,
    curved_gaps,
    linear_price,
    nonlinear_steps,
    pressures,
    ranks,
    scaling,
    solver_profiles,
    stability,
    talk_tables,
    time_against_error,
    tools,
    validation,
)


def name_of(benchmark):
    """Name of its tables."""
    return benchmark.__name__.split(".")[-1]


def with_arguments(benchmark, *arguments, slow=False):
    marks = [pytest.mark.slow] if slow else []
    return pytest.param(benchmark, arguments, id=name_of(benchmark), marks=marks)


START_MPIRUN = (ranks, solver_profiles, scaling, time_against_error)
# whose pictures pages show
DRAWN = (linear_price, scaling, talk_tables, time_against_error)
RUNS = [
    with_arguments(curved_gaps),
    with_arguments(linear_price, "--scenes", "cube_3d", "--processor"),
    with_arguments(ranks),
    with_arguments(stability, "--groups", "nu"),
    with_arguments(scaling, "--repeats", "1"),
    with_arguments(talk_tables, "--rtol", "1e-4"),
    with_arguments(solver_profiles, "--steps", "100", slow=True),
    with_arguments(time_against_error, "--ranks", "1", "--scenes", "half cylinder", slow=True),
]


@pytest.mark.parametrize(("benchmark", "arguments"), RUNS)
def test_a_quick_run_writes_the_tables_that_it_returns(
    benchmark, arguments, shared_tmp, comm, monkeypatch
):
    if benchmark in START_MPIRUN and comm.size > 1:
        pytest.skip("starts mpirun itself")
    monkeypatch.setattr(time, "perf_counter", time.perf_counter)  # --processor changes it
    tables = benchmark.main(["--quick", "--output", str(shared_tmp), *arguments])
    comm.barrier()
    name = name_of(benchmark)
    assert (shared_tmp / f"{name}.md").read_text().startswith("## ")
    assert json.loads((shared_tmp / f"{name}.json").read_text()).keys() == tables.keys()
    if benchmark in DRAWN:
        assert (shared_tmp / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert all(rows for rows in tables.values())


def marked(name):
    """Titles of a benchmark's tables that pages have."""
    pages = "".join(path.read_text() for path in (tools.ROOT / "docs").rglob("*.md"))
    return set(re.findall(f"<!-- {name}: (.*), at ", pages))


def test_ablation(serial_only, tmp_path):
    """A column for each mechanism, a row for each scene; the page has all tables."""
    given = ["--mechanisms", "smooth_displacements", "kept_directions"]
    tables = ablation.main(["--quick", "--output", str(tmp_path), *given])
    assert len(tables["Multiplications"]) == len(tables["Change of u"]) == 2
    assert all(float(row["kept_directions"]) < 1e-4 for row in tables["Change of u"])
    assert tables.keys() == marked("ablation")


def test_costs_of_load_steps(comm, shared_tmp):
    """A row of a demo, whose means are those of its steps."""
    given = ["--quick", "--only", "ironing_2d", "--output", str(shared_tmp)]
    (row,) = nonlinear_steps.main(given)["Load steps of nonlinear demos"]
    assert row["load steps"] == 3
    assert 1.0 <= float(row["tangents"]) <= float(row["Newton steps"])
    assert 0.0 < float(row["F"]) <= row["F at most"]


@pytest.mark.parametrize(
    "cases",
    [
        ["patches", "hemispheres", "concentric_rings", "press_fit"],
        pytest.param(list(validation.QUICK), marks=pytest.mark.slow),
    ],
)
def test_published_cases(cases, comm, shared_tmp):
    """All within what their sources allow; the page has the table."""
    tables = validation.main(["--quick", "--output", str(shared_tmp), "--only", *cases])
    rows = tables["Published cases"]
    assert tables.keys() == marked("validation")
    assert len(rows) >= 2 * len(cases) - 1
    for row in rows:
        difference, allowed = (
            float((row[name] or "inf %").split()[0]) for name in ("difference", "allowed")
        )
        assert abs(difference) <= allowed, row


def test_pressures_are_compared_as_functions():
    """Linear between points in any order: Hertz's own, on points that are fine enough."""
    rng = np.random.default_rng(0)
    for samples, power in ((pressures.Samples.line(2.0), 1), (pressures.Samples.disc(2.0), 2)):
        exact = np.sqrt(np.maximum(1.0 - (samples.distance / 2.0) ** 2, 0.0))
        points = rng.uniform(-3.0, 3.0, (20_000, power))
        p = np.sqrt(np.maximum(1.0 - (np.linalg.norm(points, axis=1) / 2.0) ** 2, 0.0))
        found = pressures.errors(samples, samples.at(points, 1.01 * p), exact)
        assert found["pressure"] == pytest.approx(0.01, rel=0.05)
        assert found["p0"] == pytest.approx(0.01, rel=0.05)
        assert abs(found["a"]) <= 1e-3
    ring = pressures.Samples.circle(1.0)
    assert np.allclose(ring.at(np.array([[3.0], [-3.0], [0.0]]), np.ones(3)), 1.0)


def test_tables_go_between_their_marks(tmp_path):
    page = tmp_path / "page.md"
    mark = "before\n<!-- scenes: {}, at {} -->\n\n| old |\n\n<!-- end -->\nafter\n"
    page.write_text(mark.format("2D", "abc123") + mark.format("3D", "abc123"))
    tools.write_documents("scenes", {"2D": [{"κ": 7.5, "rows": 3}]}, "def456", tmp_path)
    text = page.read_text()
    assert (
        "2D, at def456 -->\n\n| κ | rows |\n|---|---|\n| 7.5 | 3 |\n\n<!-- end -->\nafter" in text
    )
    assert text.endswith(mark.format("3D", "abc123"))
