"""GetFEM: integral contact with a rigid obstacle, augmented Lagrangian (Alart's and Curnier's).

Newton's method on displacements and multipliers at once, with MUMPS, from a rigid shift in which
the surfaces overlap where they will touch. Displacements of the mesh's order, multipliers of
degree 1 on the contact surface; r times E/a is the augmentation parameter.
"""

import getfem as gf
import numpy as np
from getfem_body import Body

TOP = 2
RESIDUAL = 1e-6  # over the load
# gmsh's order of nodes to that of Lagrange elements row by row, by degree
TO_ROWS = {1: [0, 1, 2], 2: [0, 3, 1, 5, 4, 2]}


def prepare(data, r=10.0):
    """The program, and a solve: places, pressures there, unknowns and steps."""
    order = int(data["order"])
    places = data["points"][data["cells"][:, TO_ROWS[order]]]
    body = Body(places, data["contact cells"], order, order, 2 if order == 1 else 5)
    body.mark(TOP, data["top cells"])
    E, nu, a, R = (float(data[name]) for name in ("E", "nu", "a", "R"))
    numbers = {"lambda": E * nu / (1 + nu) / (1 - 2 * nu), "mu": E / 2 / (1 + nu)}

    def solve():
        x, _, across = body.begin(**numbers, r=r * E / a)
        model = body.model
        model.add_isotropic_linearized_elasticity_brick(body.im, "u", "lambda", "mu")
        model.add_initialized_data("traction", [0.0, -float(data["traction"])])
        model.add_source_term_brick(body.im, "u", "traction", TOP)
        # the axis does not move to the side: no force is needed for that
        body.hold(np.flatnonzero((np.abs(x) < 1e-9 * np.abs(x).max()) & ~across))
        _, places = body.touch(lambda x, y: y, 1)
        model.set_variable("u", np.where(across, -(a**2) / (2 * R), 0.0))
        steps = body.solved(RESIDUAL * float(data["load"]))
        return places, -model.variable("pressure"), len(x) + len(places), steps

    return f"GetFEM {gf.getfem_env('version')}", solve
