"""Hertz' closed forms: force, half width, peak pressure, convergence of the pressure."""

from itertools import pairwise

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks.pressures import LineContact, Samples, errors
from demos import run

CYLINDER = LineContact.from_load(35e3, 50.0, 1 / sum((1 - 0.3**2) / E for E in (2.1e5, 7e4)))


def study(demo, argument, values, sizes, half_width):
    """Errors of the pressure of all meshes but the finest, by the closed form and by that mesh.

    Returns:
        Rows, and orders of convergence over the sizes of elements.
    """
    found, rows, gdim = [], [], int(demo[-2])
    samples = (Samples.line if gdim == 2 else Samples.disc)(half_width)
    for value in values:
        solution, report = run(demo, [argument, value, "-tfeti_rtol", "1e-8"])
        data = solution.contact(0)
        parts = MPI.COMM_WORLD.allgather((data.points[:, : gdim - 1], data.pressure))
        found.append(samples.at(*(np.concatenate(part) for part in zip(*parts, strict=True))))
        rows.append({"pressure_l2": report.errors["pressure_l2"]})
    for row, pressure in zip(rows[:-1], found[:-1], strict=True):
        row["pressure_l2_finer"] = errors(samples, pressure, found[-1])["pressure"]
    names = ("pressure_l2", "pressure_l2_finer")
    logs = (np.log([row[n] for row in rows[:-1]]) for n in names)
    orders = (float(np.polyfit(np.log(sizes[:-1]), log, 1)[0]) for log in logs)
    return rows[:-1], dict(zip(names, orders, strict=True))


def falls(rows, name):
    values = [row[name] for row in rows]
    return all(finer < coarser for coarser, finer in pairwise(values))


# elements along the half width; the last solution is the reference
SIZES = [(8, 16, 32, 64), pytest.param((8, 16, 32, 128), marks=pytest.mark.slow)]


@pytest.mark.parametrize("sizes", SIZES)
def test_pressure_converges_in_2d(sizes):
    rows, slopes = study("hertz_2d", "--elements", sizes, [1 / n for n in sizes], 0.04)
    assert falls(rows, "pressure_l2")
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2"] >= 0.9
    assert slopes["pressure_l2_finer"] >= 0.9


def test_the_closed_form_of_a_cylinder_on_a_block(quick_demo):
    """NAFEMS CB1: a = 6.21 mm, p₀ = 3585.37 MPa, the largest pressure of the demo's report."""
    assert abs(CYLINDER.half_width - 6.21) < 0.01
    assert abs(CYLINDER.peak - 3585.37) < 1
    (contact,) = quick_demo("cylinder_on_block_2d").report["contacts"]
    assert abs(contact["pressure"] - CYLINDER.peak) < 0.01 * CYLINDER.peak


@pytest.mark.slow
def test_pressure_of_a_pair_converges():
    elements, a = (8, 16, 32, 128), CYLINDER.half_width
    sizes = [1 / n for n in elements]
    rows, slopes = study("cylinder_on_block_2d", "--elements", elements, sizes, a)
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2_finer"] >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("demo", "order"), [("hertz_3d", 0.5), ("sphere_on_block_3d", 0.4)])
def test_pressure_converges_in_3d(demo, order):
    unknowns = (8_000, 24_000, 72_000, 250_000)
    sizes = [n ** (-1 / 3) for n in unknowns]
    rows, slopes = study(demo, "--unknowns", unknowns, sizes, 0.05)
    assert demo == "sphere_on_block_3d" or falls(rows, "pressure_l2")
    assert falls(rows, "pressure_l2_finer")
    assert slopes["pressure_l2_finer"] >= order


TALK = ["-tfeti_qp_type", "smalse", "-tfeti_pc_type", "none", "-tfeti_rtol", "1e-4"]
TABLE = [(2, 99, 60), pytest.param(32, 99, 90, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("subdomains", "cells", "most"), TABLE)
def test_multiplications(subdomains, cells, most):
    """At most those of the table's size, 99 cells."""
    _, report = run(
        "talk_hertz_2d", ["--subdomains", str(subdomains), "--cells", str(cells), *TALK]
    )
    assert report.F_multiplications <= most
    assert report.primal_dofs == 2 * (cells + 1) ** 2 * subdomains
    assert report.kernel_dim == 3 * subdomains
    assert report.subdomains == subdomains
    assert report.bodies == 2
    assert 0 < report.active_contacts < report.contact_rows < report.contact_candidates
