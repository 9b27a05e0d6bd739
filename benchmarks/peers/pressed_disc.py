"""Seconds to a force in finite strain beside GetFEM: a half disc of rubber pressed on a plane.

    python3 benchmarks/peers/compare.py pressed_disc      (not inside of ./run)

The same energy (neo-Hooke, ν = 0.3), degree 2, half of the half disc, its flat side clamped and
pressed by 0.3 R in six steps. GetFEM: as getfem_hertz.py; its distance to the plane is that of X,
which makes contact with a plane exact in finite strain.
"""

from compare import NAME, ByForce, facets_on

DEPTHS = [0.05 * k for k in range(1, 7)]
E, NU = 1.0, 0.3
MU, LAMBDA = E / 2 / (1 + NU), E * NU / (1 + NU) / (1 - 2 * NU)


def quarter_disc(n):
    """Points and triangles, counterclockwise, so many along the radius; the lowest point is 0."""
    import numpy as np

    first = np.cumsum(np.arange(n + 2))  # of a ring
    angles = [np.linspace(-np.pi / 2, 0.0, k + 1) if k else np.zeros(1) for k in range(n + 1)]
    rings = [k / n * np.stack((np.cos(a), np.sin(a)), 1) for k, a in enumerate(angles)]
    cells = []
    for k in range(n):
        i, low, high = np.arange(k + 1), first[k], first[k + 1]
        cells.append(np.stack((low + i, high + i, high + i + 1), 1))
        cells.append(np.stack((low + i, high + i + 1, low + i + 1), 1)[:-1])
    return np.vstack(rings) + np.array([0.0, 1.0]), np.vstack(cells)


def ours(points, cells):
    """A solve that returns force, unknowns and steps of Newton's method; in ./run."""
    import numpy as np
    from dolfinx import fem

    import tfeti_dolfinx as tfeti
    from benchmarks.elastic import Elastic, triangles

    disc = triangles(points, cells)
    sides = {
        "arc": lambda x: np.isclose(np.hypot(x[0], x[1] - 1.0), 1.0),
        "top": lambda x: np.isclose(x[1], 1.0),
        "axis": lambda x: np.isclose(x[0], 0.0),
    }

    def solve():
        d = tfeti.decompose(disc, max(len(cells) // 600, 1), surfaces=sides)
        scene = Elastic(d, E, NU, "plane_strain", 2)
        scene.hold("top", 0)
        down, u = scene.hold("top", 1), fem.Function(scene.V)
        scene.hold("axis", 0)
        law = tfeti.NeoHooke(scene.elastic, u, degree=2)
        plane = tfeti.Obstacle("arc", tfeti.Plane((0.0, 0.0), normal=(0.0, 1.0)))
        residual = law.residual(scene.v)
        problem = tfeti.NonlinearContactProblem(residual, u, scene.bcs, [plane], d, finite=True)
        steps = 0
        for depth in DEPTHS:
            down.value = -depth
            problem.solve()
            problem.accept()
            steps += problem.report.newton_steps
        force = problem.solution.reaction("top").force[1]
        return abs(float(force)), scene.V.dofmap.index_map.size_global * 2, steps

    solve()  # compiles forms
    return solve


def getfem(points, cells, r=10.0):
    """The same by GetFEM; in benchmarks/peers/run."""
    import numpy as np
    from getfem_body import Body

    on_arc = np.isclose(np.linalg.norm(points - [0.0, 1.0], axis=1), 1.0)
    body = Body(points[cells], facets_on(on_arc[cells]))
    numbers = {"mu": MU, "lambda": LAMBDA, "r": r * E * body.facets}
    det = "Det(Id(2)+Grad_u)"
    energy = f"mu/2*(Norm_sqr(Id(2)+Grad_u)-2)-mu*log({det})+lambda/2*sqr(log({det}))"

    def solve():
        x, y, across = body.begin(**numbers)
        body.model.add_nonlinear_term(body.im, energy)
        top = np.isclose(y, 1.0)
        held = np.flatnonzero(top | (np.isclose(x, 0.0) & ~across))
        pressed, way = (top & across)[held], body.hold(held)
        _, places = body.touch(lambda x, y: y, 1)
        steps = 0
        for depth in DEPTHS:
            body.model.set_private_rhs(way, np.where(pressed, -depth, 0.0))
            steps += body.solved(1e-7)
        force = body.model.variable("held")[pressed].sum()
        return abs(float(force)), len(x) + len(places), steps

    return solve


SIZES = (8, 16, 32, 64)  # elements along the radius
SCENE = ByForce(
    "pressed_disc", "pressed half disc", SIZES, quarter_disc, {NAME: ours, "GetFEM": getfem}
)
