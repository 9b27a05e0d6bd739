"""The spectrum of the dual operator: κ(F) ≤ C·H/h, measured.

    ./run python3 benchmarks/spectrum.py [--quick]

A unit square and a unit cube, clamped on one side, of (1/H)^d equal subdomains with H/h elements
along an edge, of finite and of boundary elements. Extreme eigenvalues of B D⁻¹ Bᵀ; of PFP on the
range of P, those of Gᵀ taken away, by Lanczos iterations; and of S, the Schur complement of a
floating subdomain on its whole boundary, beside its kernel. Bounded columns κ·h/H are what the
theorem says (Dostál, Optimal Quadratic Programming Algorithms, 2009; Brenner, Numer. Math. 83,
1999, for S).
Nothing is parallel. Results go to
results/spectrum.md, .json and .png.
"""

from __future__ import annotations

import sys

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

import tfeti_dolfinx as tfeti
from benchmarks.elastic import Elastic
from benchmarks.tools import column, command_line, curves, finish, picture
from tfeti_dolfinx.bem.panels import Panels, surfaces
from tfeti_dolfinx.bem.steklov import IsotropicLaw, steklov
from tfeti_dolfinx.common.compat import assemble_csr
from tfeti_dolfinx.mesh.dofs import TornDofs

# dimension: all H/h with all 1/H
SIZES = {
    "quick": {2: ((2, 4), (2, 3))},
    "default": {2: ((4, 8, 16, 32), (2, 4, 8)), 3: ((2, 4, 8), (2, 3, 4))},
}
NU = 0.3
MODELS = {2: "plane_strain", 3: "3d"}
# of eigenvalues; the rest of a table is exact
ACCURACY = 1e-3


def cut(gdim, parts, cells):
    """A unit square or cube of parts^d subdomains of cells^d elements; "left" is at x = 0."""
    n = [parts * cells] * gdim
    create = dmesh.create_rectangle if gdim == 2 else dmesh.create_box
    kind = dmesh.CellType.quadrilateral if gdim == 2 else dmesh.CellType.hexahedron
    mesh = create(MPI.COMM_SELF, [(0.0,) * gdim, (1.0,) * gdim], n, kind)
    left = dmesh.locate_entities_boundary(mesh, gdim - 1, lambda x: np.isclose(x[0], 0))
    tags = dmesh.meshtags(mesh, gdim - 1, left, np.ones(len(left), dtype=np.int32))

    def subdomain(x):
        places = np.minimum((x[:gdim] * parts).astype(int), parts - 1)
        return np.ravel_multi_index(tuple(places), (parts,) * gdim)

    d = tfeti.decompose(mesh, subdomain, facet_tags=tags, surfaces={"left": 1})
    return Elastic(d, 1.0, NU, MODELS[gdim])


def solved(body, boundary):
    """The problem with its dual operator; without a load it is solved at once."""
    for axis in range(body.gdim):
        body.hold("left", axis)
    elements = tfeti.BoundaryElements() if boundary else None
    problem = tfeti.ContactProblem(**body.parts([]), boundary_elements=elements)
    problem.solve()
    return problem


def extremes_of_F(dual):
    """Least and largest eigenvalue of PFP on the range of P."""
    size, P = len(dual.d), dual.coarse.project

    def projected(values, shift):
        """PFPx + shift·(I − P)x."""
        x = P(values.ravel())
        return P(dual.F(x)) + shift * (values.ravel() - x)

    def extreme(which, shift):
        operator = LinearOperator((size, size), lambda v: projected(v, shift), dtype=float)
        start = np.random.default_rng(0).standard_normal(size)
        found = eigsh(operator, 1, which=which, v0=start, tol=ACCURACY, return_eigenvectors=False)
        return float(found[0])

    largest = extreme("LA", 0.0)
    least = extreme("SA", largest)  # what P takes away is moved to the other end
    return least, largest


def extremes_of_B(constraints):
    """Least and largest eigenvalue of B D⁻¹ Bᵀ; of B Bᵀ where D = I.

    Optimality asks for bounds on them that depend neither on h nor on H (Dostál, Kozubek,
    Sadowská, Vondrák, Scalable Algorithms for Contact Problems, 2016).
    """
    indptr, indices, data = constraints.B.getValuesCSR()
    B = csr_array((data, indices, indptr), shape=constraints.B.getSize())
    values = np.linalg.eigvalsh(((B / constraints.weights) @ B.T).toarray())
    return float(values[0]), float(values[-1])


def extremes_of_S(gdim, cells, boundary):
    """Least eigenvalue beside the kernel and largest one of S of a floating subdomain.

    The trace of a TFETI subdomain is its boundary but for what is free: here all of it.
    """
    whole = cut(gdim, 1, cells)
    S = steklov_poincare(whole) if boundary else schur_complement(whole)
    values = np.linalg.eigvalsh(S)
    return float(values[gdim * (gdim + 1) // 2]), float(values[-1])


def schur_complement(body):
    """That of finite elements, dense."""
    K = csr_array(assemble_csr(fem.form(body.elastic.a(body.u, body.v)))).toarray()
    x = body.V.tabulate_dof_coordinates()[:, : body.gdim]
    t = np.repeat(np.any(np.isclose(x, 0.0) | np.isclose(x, 1.0), axis=1), body.gdim)
    K_it = K[np.ix_(~t, t)]
    return K[np.ix_(t, t)] - K_it.T @ np.linalg.solve(K[np.ix_(~t, ~t)], K_it)


def steklov_poincare(body):
    """That of boundary elements."""
    dofs, whole = TornDofs(body.V, body.decomposition), np.ones(1, dtype=bool)
    (surface,) = surfaces(dofs, body.decomposition, whole).values()
    used, nodes = np.unique(surface.panels.nodes, return_inverse=True)
    panels = Panels(surface.panels.x[used], nodes.reshape(surface.panels.nodes.shape))
    return steklov(panels, IsotropicLaw(0.5 / (1.0 + NU), NU)).S


def row(gdim, parts, cells, boundary):
    """A row of a table."""
    problem = solved(cut(gdim, parts, cells), boundary)
    B, F = extremes_of_B(problem.dual.constraints), extremes_of_F(problem.dual)
    S = extremes_of_S(gdim, cells, boundary)
    found = {
        "H/h": cells,
        "1/H": parts,
        "unknowns": problem.report.primal_dofs,
        "rows": problem.report.dual_dofs,
        "λ_min(BD⁻¹Bᵀ)": B[0],
        "λ_max(BD⁻¹Bᵀ)": B[1],
        "λ_min(F)": F[0],
        "λ_max(F)": F[1],
        "κ(F)": F[1] / F[0],
        "κ(F)·h/H": F[1] / F[0] / cells,
        "κ(S)": S[1] / S[0],
        "κ(S)·h/H": S[1] / S[0] / cells,
    }
    problem.destroy()
    return found


def draw(path, tables):
    """κ over H/h, a line for each H."""
    with picture(path, len(tables)) as axes:
        for panel, (title, rows) in zip(axes, tables.items(), strict=True):
            lines = {}
            for parts in sorted(set(column(rows, "1/H"))):
                of_H = [row for row in rows if row["1/H"] == parts]
                lines[f"F, 1/H = {parts}"] = column(of_H, "H/h"), column(of_H, "κ(F)")
            lines["S"] = column(of_H, "H/h"), column(of_H, "κ(S)")
            curves(panel, title, ("H/h", "condition number κ"), lines)


def shown(tables):
    """Finite and boundary elements side by side."""
    kept, found = ("κ(F)", "κ(F)·h/H", "κ(S)", "κ(S)·h/H"), {}
    for title in tables:
        name, kind = title.split(", ")
        if kind == "finite elements":
            pairs = zip(tables[title], tables[f"{name}, boundary elements"], strict=True)
            found[name] = [
                {"H/h": row["H/h"], "1/H": row["1/H"], "rows of B": row["rows"]}
                | {key: f"{row[key]:.3g}" for key in kept}
                | {f"BEM: {key}": f"{beside[key]:.3g}" for key in kept}
                for row, beside in pairs
            ]
    return found


def main(argv):
    """Run the tables and write them on the first rank; returns them."""
    arguments, _ = command_line(__doc__, argv)
    sizes = SIZES["quick" if arguments.quick else "default"]
    tables = {
        f"{gdim}D, {name}": [
            row(gdim, parts, cells, boundary) for parts in counts for cells in edges
        ]
        for gdim, (edges, counts) in sizes.items()
        for name, boundary in (("finite elements", False), ("boundary elements", True))
    }
    return finish(arguments, "spectrum", tables, draw, shown)


if __name__ == "__main__":
    main(sys.argv[1:])
