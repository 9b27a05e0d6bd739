"""Coulomb's law with coefficients up to 3 on clamped bodies, beside a dense Newton method."""

import numpy as np
import pytest
from bodies import clamped, drawn, two_body_problem
from dolfinx import fem
from reference.untorn import on_plane, untorn_box
from scenes import decomposed, displacement

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.solve.coulomb import FrictionBounds

PLACES = [("left", "top"), ("left", "right"), ("top", "right"), ("right", "top"), ("top", "left")]
# what is reported is an estimate; below this rounding is part of an error
FACTOR, ROUNDING = 10.0, 1e-12


def scene(seed):
    """Cell, n, subdomains, μ, whether steps are accepted, sides clamped and loaded, gap, loads."""
    rng = np.random.default_rng(seed)
    cell = rng.choice(["triangle", "quadrilateral"] if rng.random() < 0.7 else ["tetrahedron"])
    gdim = 3 if cell == "tetrahedron" else 2
    n, subdomains = int(rng.integers(2, 4 if gdim == 3 else 9)), int(rng.integers(2, 5))
    mu = float(np.exp(rng.uniform(np.log(0.05), np.log(3.0))))
    held, loaded = PLACES[rng.integers(len(PLACES))]
    loads = [
        np.r_[rng.uniform(-0.06, 0.06, gdim - 1), rng.uniform(-0.08, 0.01)]
        * 10.0 ** min(0.0, rng.uniform(-2.0, 4.0))
        for _ in range(rng.integers(2, 6))
    ]
    return cell, n, subdomains, mu, rng.random() < 0.5, held, loaded, 0.01 * (seed % 2), loads


def steps(cell, n, subdomains, mu, accepts, held, loaded, gap, loads, **options):
    """Solve all steps: each has to be right to what it reports."""
    d = decomposed(cell, n, subdomains)
    gdim = d.mesh.geometry.dim
    t = fem.Constant(d.mesh, np.zeros(gdim))
    up = np.eye(gdim)[-1]
    floor = tfeti.Obstacle(
        "bottom", tfeti.Plane(-gap * up, up), friction=tfeti.Coulomb(mu), reach=np.inf
    )
    p = two_body_problem(d, drawn(d, loaded, t), clamped(d, held), [floor], **options)
    untorn = untorn_box(cell, n, np.zeros(gdim), (held,), loaded=loaded)
    frame, units = np.vstack((-up, np.eye(gdim)[:-1])), untorn.loads(loaded)
    law, reports = on_plane(untorn, [mu] * (gdim - 1), frame, gap, coulomb=True), []
    for load in loads:
        t.value[:] = load
        p.solve()
        u, reported = displacement(p)[1], p.report.residuals["displacement_error"]
        error = law.distance(u, units @ load)
        assert error <= FACTOR * max(reported, ROUNDING), (load, error, reported)
        right = p.report.converged_reason == "CONVERGED_RTOL"
        assert right == (reported <= p.report.tolerances["displacement_error"])
        reports.append((p.report.converged_reason, error))
        if accepts:
            p.accept()
            law.accept(u)
    p.destroy()
    return reports


@pytest.mark.parametrize("seed", range(7))
def test_random_steps(seed):
    assert all(reason == "CONVERGED_RTOL" for reason, _ in steps(*scene(seed)))


@pytest.mark.slow
@pytest.mark.parametrize("first", range(8, 320, 8))
def test_many_random_steps(first):
    """About a thousand with those above; where bounds rest early the report says so."""
    for seed in range(first, first + 8):
        assert all(reason.startswith("CONVERGED") for reason, _ in steps(*scene(seed)))


# a large coefficient under loads that turn
TURNED = ("quadrilateral", 7, 2, 2.9, True, "top", "left", 0.01, [(-0.054, -0.05), (0.045, 0.006)])


def test_what_rests_to_friction_rtol_only_says_so(monkeypatch):
    """Bounds that always go half the way rest early, and leave more than rtol allows."""
    monkeypatch.setattr(FrictionBounds, "_relaxation", lambda bounds: 0.5)
    reports = steps(*TURNED, friction_type="fixed_point", rtol=1e-6)
    assert any(reason == "CONVERGED_FRICTION_RTOL" for reason, _ in reports)


def test_bounds_that_go_to_and_fro_or_run_away_come_to_rest():
    """Steps are as long as the last two problems say; what is wedged comes loose ever faster."""
    loads = [(-0.0457, 0.0355, -0.0747), (0.0345, -0.0386, -0.0028), (1.37e-4, -7.2e-5, 7.2e-6)]
    turns = ("tetrahedron", 3, 1, 0.9460614226015337, True, "top", "right", 0.0, loads)
    loose = ("quadrilateral", 3, 3, 2.5, True, "left", "right", 0.0, [(0.046, -0.039), (0.0427, 0)])
    for reason, _ in steps(*turns, qp_type="smalse") + steps(*loose):
        assert reason == "CONVERGED_RTOL"
