"""Steps of several bodies with mass, against dense matrices and a bounded least squares solver."""

import numpy as np
import pytest
import ufl
from bodies import torn_boxes
from dolfinx import fem
from scenes import accepted, elastic, vectors
from scipy.optimize import lsq_linear

import tfeti_dolfinx as tfeti


def falling(cell, degree, gap, stabilised, weight):
    """Three boxes above each other, with meshes that do not match, each faster than that below."""
    low, parts = 0.0, []
    for n, (height, x) in enumerate(((0.5, 0.0), (0.4, 0.15), (0.6, -0.1))):
        low += gap
        parts.append((f"box {n}", (x, low), (x + 1.0, low + height), (2 + n, 2)))
        low += height
    d = torn_boxes(cell, parts, 7)
    V, u, v = vectors(d, degree)
    down = fem.Constant(d.mesh, (0.0, -weight))
    thrown = fem.Function(V)
    thrown.interpolate(lambda x: np.stack((0.1 * x[1], -0.3 * x[1] + 0.05 * (x[0] - 0.5))))
    contacts = [tfeti.Obstacle("box 0 bottom", tfeti.Plane((0, 0), (0, 1)), reach=2.0)]
    contacts += [tfeti.Contact(f"box {n} bottom", f"box {n - 1} top", reach=2.0) for n in (1, 2)]
    given = elastic(u, v), ufl.dot(down, v) * ufl.dx(domain=d.mesh), [], contacts, d
    more = {"stabilised": stabilised, "petsc_options": {"rtol": 1e-10}}
    return tfeti.ContactDynamics(*given, mass=1.0, velocity=thrown, **more)


def rows(problem):
    """B on DOLFINx's unknowns, c and the rows λ ≥ 0, of one rank."""
    dual = problem.dual
    begins, columns, values = dual.constraints.B.getValuesCSR()
    row = np.repeat(np.arange(len(begins) - 1), np.diff(begins))
    B = np.zeros((len(begins) - 1, len(problem.u.x.array)))
    unknown = problem.dofs.dolfinx_dofs()[dual.subdomains.trace]
    np.add.at(B, (row, unknown[columns]), values)
    return B, dual.constraints.c.copy(), dual.constraints.sets.normals


def least(A, b, B, c, normals):
    """argmin ½uᵀAu − bᵀu with B_E u = c_E, B_N u ≤ c_N, by its multipliers."""
    inverse = np.linalg.solve(A, np.column_stack((B.T, b)))
    F, d = B @ inverse[:, :-1], B @ inverse[:, -1] - c
    scale = 1.0 / np.sqrt(np.diag(F))
    sizes, Q = np.linalg.eigh(0.5 * (F + F.T) * scale[:, None] * scale)
    kept = sizes > 1e-13 * sizes[-1]
    root, Q = np.sqrt(sizes[kept]), Q[:, kept]
    lowest = np.full(len(d), -np.inf)
    lowest[normals] = 0.0
    found = lsq_linear(
        root[:, None] * Q.T,
        Q.T @ (scale * d) / root,
        bounds=(lowest, np.full(len(d), np.inf)),
        method="bvls",
        tol=1e-15,
        max_iter=5000,
    )
    return inverse[:, -1] - inverse[:, :-1] @ (scale * found.x)


CASES = [("quadrilateral", 1, 0.02, True, 0.0), ("triangle", 2, 0.0, False, 0.1)]


@pytest.mark.parametrize("case", CASES)
def test_three_bodies_move_as_dense_matrices_say(serial_only, case):
    """Quadratic elements, too: the reference bounds what rows bound."""
    problem, tau = falling(*case), 0.15
    stabilised, touched = case[3], set()
    forms = problem._system.forms
    motion = forms.inertia.motion
    u, v, load = motion.u.copy(), motion.v.copy(), motion.load.copy()
    K, M = forms.K.toarray(), forms.inertia.M.toarray()
    problem.take_step(tau)
    for _ in range(8):
        accepted(problem)
        towards, bounds = u + tau * v, rows(problem)
        if stabilised:
            towards = least(M, M @ towards, *bounds)
        pull = load + 2.0 * M @ towards / tau**2 - 0.5 * K @ u
        end = least(0.5 * K + 2.0 * M / tau**2, pull, *bounds)
        v, u = v + 2.0 / tau * (end - towards), end
        assert np.abs(problem.u.x.array - u).max() <= 1e-8 * np.abs(u).max()
        forces = problem.report.contact_forces
        touched |= {n for n, force in enumerate(forces) if np.linalg.norm(force) > 1e-3}
    assert touched == {0, 1, 2}
