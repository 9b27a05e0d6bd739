"""Seconds to a force in plasticity beside GetFEM: a wheel pressed into a block.

    python3 benchmarks/peers/compare.py indentation      (not inside of ./run)

J2 plasticity with linear hardening, small strain, plane strain, degree 2: a rigid parabola pressed
into half of a block, clamped below, in eight steps. GetFEM: its brick with return mapping, contact
as in getfem_hertz.py.
"""

from compare import NAME, ByForce, facets_on

R, DEPTH, STEPS = 10.0, 0.002, 8
E, NU, STRENGTH, HARDENING = 1.0, 0.3, 0.001, 0.05
NEAR, SIZE = 0.25, 2.0  # half width of the equal elements, and of the block


def block(n):
    """Points and triangles, counterclockwise; n elements are equal, twice as many grow."""
    import numpy as np

    t = np.linspace(0.0, 3.0, 3 * n + 1)
    x = NEAR * t + (SIZE - 3 * NEAR) * (np.maximum(t - 1.0, 0.0) / 2) ** 3
    points = np.stack(np.meshgrid(x, -x[::-1], indexing="ij"), axis=2).reshape(-1, 2)
    k = np.arange(len(points)).reshape(len(x), -1)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    return points, np.vstack((np.stack((a, b, c), 1), np.stack((a, c, d), 1)))


def ours(points, cells):
    """A solve that returns force, unknowns and steps of Newton's method; in ./run."""
    import numpy as np

    import tfeti_dolfinx as tfeti
    from benchmarks.elastic import Elastic, triangles

    body, at = triangles(points, cells), {"top": (1, 0.0), "bottom": (1, -SIZE), "axis": (0, 0.0)}
    sides = {name: lambda x, k=k, c=c: np.isclose(x[k], c) for name, (k, c) in at.items()}
    shape = tfeti.SignedDistance(
        lambda x: x[0] ** 2 / (2 * R) - x[1],
        lambda x: np.stack((x[0] / R, -np.ones_like(x[0]))) / np.hypot(x[0] / R, 1.0),
    )
    depths = DEPTH * np.arange(1, STEPS + 1) / STEPS

    def solve(steps=STEPS):
        d = tfeti.decompose(body, max(len(cells) // 600, 1), surfaces=sides)
        scene = Elastic(d, E, NU, "plane_strain", 2)
        for name, k in (("axis", 0), ("bottom", 0), ("bottom", 1)):
            scene.hold(name, k)
        wheel = tfeti.Obstacle("top", shape, displacement=lambda depth: (0.0, -depth))
        _, problem = scene.plastic([wheel], 1e-4, yield_stress=STRENGTH, hardening=HARDENING)
        records = tfeti.LoadSteps(problem, lambda problem, depth: None, depths[:steps]).run()
        force = problem.solution.reaction("bottom").force[1]
        did = sum(record.figures["newton_steps"] for record in records)
        return abs(float(force)), scene.V.dofmap.index_map.size_global * 2, did

    solve(1)  # compiles forms
    return solve


def getfem(points, cells, r=1.0):
    """The same by GetFEM; in benchmarks/peers/run."""
    import getfem as gf
    import numpy as np
    from getfem_body import Body

    body = Body(points[cells], facets_on(np.isclose(points[:, 1], 0.0)[cells]))
    numbers = {"mu": E / 2 / (1 + NU), "lambda": E * NU / (1 + NU) / (1 - 2 * NU), "H_k": 0.0}
    numbers |= {"sigma_y": STRENGTH, "H_i": HARDENING, "r": r * E / NEAR}
    law = ["plane strain Prandtl Reuss linear hardening", 0, "u", "xi", "Previous_Ep"]
    law += ["Previous_alpha", "lambda", "mu", "sigma_y", "H_k", "H_i", "1", "timestep"]

    def solve():
        x, y, across = body.begin(**numbers)
        model = body.model
        model.add_fem_data("Previous_u", body.space(2, 2))
        for name, shape in (("xi", [1]), ("Previous_xi", [1]), (law[5], [1]), (law[4], [2, 2])):
            model.add_im_data(name, gf.MeshImData(body.im, -1, shape))
        model.set_time_step(1.0)
        model.add_small_strain_elastoplasticity_brick(body.im, *law)
        low = np.isclose(y, -SIZE)
        held = np.flatnonzero(low | (np.isclose(x, 0.0) & ~across))
        body.hold(held)
        distance, places = body.touch(lambda x, y: x**2 / (2 * R) - y, 2)
        steps = 0
        for step in range(1, STEPS + 1):
            model.set_variable("obstacle", distance - DEPTH * step / STEPS)
            steps += body.solved(1e-8)
            model.small_strain_elastoplasticity_next_iter(body.im, *law)
        force = model.variable("held")[(low & across)[held]].sum()
        return abs(float(force)), len(x) + len(places), steps

    return solve


SIZES = (4, 8, 16, 24)  # elements of equal size near the wheel
SCENE = ByForce("indentation", "indentation", SIZES, block, {NAME: ours, "GetFEM": getfem})
