"""GetFEM's models of a body of triangles beside a rigid obstacle."""

import getfem as gf
import numpy as np


class Body:
    """Triangles of places of nodes, row by row; facets have GetFEM's numbers, corners opposite."""

    def __init__(self, places, facets, order=1, degree=2, quadrature=2):
        self.mesh, self.facets, self.degree = gf.Mesh("empty", 2), len(facets), degree
        swapped = np.ascontiguousarray(places.transpose(2, 1, 0))
        self.mesh.add_convex(gf.GeoTrans(f"GT_PK(2,{order})"), swapped)
        self.mark(1, facets)
        kinds = (gf.Integ(f"IM_TRIANGLE({k})") for k in (quadrature, 6))
        self.im, self.fine = (gf.MeshIm(self.mesh, kind) for kind in kinds)

    def mark(self, region, facets):
        """Give facets the number of a region."""
        self.mesh.set_region(region, facets.T.astype(np.int32))

    def space(self, degree, size=1):
        """A space of Lagrange elements."""
        made = gf.MeshFem(self.mesh, size)
        made.set_fem(gf.Fem(f"FEM_PK(2,{degree})"))
        self.kept.append(made)  # models do not keep them
        return made

    def begin(self, **numbers):
        """Begin a model; the places of its unknowns, and which are those of y."""
        self.model, self.kept = gf.Model("real"), []
        u = self.space(self.degree, 2)
        self.model.add_fem_variable("u", u)
        for name, value in numbers.items():
            self.model.add_initialized_data(name, [value])
        x, y = u.basic_dof_nodes()
        return x, y, np.arange(len(x)) % 2 == 1

    def hold(self, dofs):
        """Prescribe unknowns by multipliers "held"; the number of the condition."""
        size = len(dofs)
        rows = gf.Spmat("empty", size, self.model.variable("u").size)
        for k, dof in enumerate(dofs):
            rows.add(k, int(dof), 1.0)
        self.model.add_variable("held", size)
        return self.model.add_constraint_with_multipliers("u", "held", rows, np.zeros(size))

    def touch(self, distance, degree):
        """Add contact with a distance(x, y), interpolated; its values, and places of pressures."""
        space, own = self.space(1), self.space(degree)
        surface, values = space.basic_dof_on_region(1), distance(*own.basic_dof_nodes())
        self.model.add_fem_variable("pressure", gf.MeshFem("partial", space, surface))
        self.model.add_initialized_fem_data("obstacle", own, values)
        self.model.add_integral_contact_with_rigid_obstacle_brick(
            self.fine, "u", "pressure", "obstacle", "r", 1, 1
        )
        return values, space.basic_dof_nodes()[0, surface]

    def solved(self, residual):
        """Solve a load step; the steps of Newton's method."""
        given = "max_res", residual, "max_iter", 100, "lsolver", "mumps"
        steps, converged = self.model.solve(*given)
        if not converged:
            raise RuntimeError("no convergence")
        return int(steps)
