"""Closed forms of Cattaneo and Mindlin, what is compared with them, loads, and pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from demos.hertz import LineContact, PointContact, compare, fit
from tfeti_dolfinx import ContactStatus

# the largest force of the demos, over μP
MOST = 0.8
# of the half width: as near as that to y = 0 is on it
CLOSE = 1e-6


@dataclass(frozen=True)
class PartialSlip:
    """Identical bodies, pressed together and then pushed along each other.

    Friction is μp less what Cattaneo takes away where nothing slips: a pressure of Hertz's on the
    half width c, of the load μP − Q.

    Attributes:
        hertz: The contact under the normal load P alone.
        mu: Coefficient of friction μ.
    """

    hertz: LineContact | PointContact
    mu: float

    @property
    def capacity(self):
        """μP, the force at which all slips."""
        return self.mu * self.hertz.load

    def taken(self, force):
        """What Cattaneo takes away from μp under a force 0 ≤ Q ≤ μP, as Hertz's contact."""
        # loads of Hertz's contacts of the same bodies grow with a² (line) or a³ (point)
        power = 1 / 2 if isinstance(self.hertz, LineContact) else 1 / 3
        share = (1 - force / self.capacity) ** power
        peak, c = self.mu * self.hertz.peak * share, self.hertz.half_width * share
        return replace(self.hertz, half_width=c, load=self.capacity - force, peak=peak)

    def stick(self, force):
        """Stick half width c under a force that has only grown."""
        return self.taken(force).half_width

    def traction(self, x, force):
        """Friction under a force that has only grown."""
        return self.mu * self.hertz.pressure(x) - self.taken(force).pressure(x)

    def traction_after(self, x, turned, change):
        """Friction after a force has grown to ``turned`` and come down from there by ``change``.

        What changes is as if the force grew from 0, with twice the coefficient.
        """
        return self.traction(x, turned) - 2 * self.traction(x, change / 2)

    def largest(self, force):
        """Largest friction under a force that has only grown, that at the edge of stick."""
        return float(self.traction(self.stick(force), force))


def half_width(comm, contact, traction):
    """Half width of a pressure of Hertz's, by its second moment. Collective.

    ∫pr² is b²∫p times 1/4 in 2D and 2/5 in 3D. Statuses of nodes would say b up to the size of an
    element, and the moment needs no closed form.
    """
    moments = [np.sum(contact.area * traction * radius(contact) ** k) for k in (0, 2)]
    force, second = comm.allreduce(np.array(moments))
    share = {2: 1 / 4, 3: 2 / 5}[contact.normal.shape[1]]
    return float(np.sqrt(second / force / share))


def pressed(comm, contact, closed, part):
    """Relative errors under P alone, and friction, which there should be none. Collective."""
    errors = compare(comm, contact, radius(contact), closed.hertz, part)
    errors["half_width"] = half_width(comm, contact, contact.pressure) / closed.hertz.half_width - 1
    edge = closed.mu * closed.hertz.peak
    errors["friction_without_force"] = largest(comm, contact.tangential_traction) / edge
    return errors


def measured(comm, contact, closed, force, part):
    """A row of the table, and relative errors, under a force that has only grown. Collective.

    What is left of friction, μp − |q|, is Cattaneo's pressure on r < c: its second moment gives c.
    Friction is largest at c, where it is μp(c): between nodes, p² is a line over r².
    """
    q, mu, hertz = np.linalg.norm(contact.tangential_traction, axis=1), closed.mu, closed.hertz
    c = half_width(comm, contact, mu * contact.pressure - q)
    a, peak = fit(comm, radius(contact), contact.pressure, hertz.peak)
    edge = float(mu * peak * np.sqrt(1 - (c / a) ** 2))
    resultant = comm.allreduce(float(contact.area @ friction(contact)))
    row = {
        "Q/(μP)": float(force / closed.capacity),
        "c/a": c / hertz.half_width,
        "closed form": closed.stick(force) / hertz.half_width,
        "max q/(μp₀)": edge / (mu * hertz.peak),
        "closed form ": closed.largest(force) / (mu * hertz.peak),
        "at nodes": largest(comm, q) / (mu * hertz.peak),
    }
    errors = {
        "stick_half_width": c / closed.stick(force) - 1,
        "peak_traction": edge / closed.largest(force) - 1,
        "friction_force": resultant / (part * force) - 1,
        "law": law(comm, contact, mu),
    }
    return row, errors


def radius(contact):
    """Distance of the nodes from the middle of the contact."""
    return np.linalg.norm(contact.points[:, : contact.normal.shape[1] - 1], axis=1)


def friction(contact):
    """Friction along x on the lower body, that is in the direction of the force on the upper."""
    return -contact.tangential_traction[:, 0]


def largest(comm, values):
    """Largest magnitude at the nodes of all ranks. Collective."""
    return comm.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


def law(comm, contact, mu):
    """Largest miss of |q| ≤ μp, and of |q| = μp where nodes slip, over μp₀. Collective."""
    q, bound = np.linalg.norm(contact.tangential_traction, axis=1), mu * contact.pressure
    slips = contact.status == ContactStatus.SLIP
    miss = np.where(slips, np.abs(q - bound), np.maximum(q - bound, 0.0))
    return largest(comm, miss) / largest(comm, bound)


class Pushed:
    """Loads on two mirror images that touch at the origin, flat at a distance L of both sides.

    P is a uniform pressure on both flat sides. Q is a uniform traction on them, along x above
    and against it below, with a pressure linear in x that takes its moment Q·L: each body is in
    balance. P's tractions are their own mirror images, and those of Q minus theirs. Then
    Q moves no surface along the normal against the other and P none along the surface, as between
    half planes, however small the bodies are.

    Args:
        V: Space of displacements.
        top: Measure of the upper flat side.
        bottom: Measure of the lower one.
        distance: L.
        part: Of the bodies and the forces that is meshed.
    """

    def __init__(self, V, top, bottom, distance, part=1.0):
        mesh = V.mesh
        self._mesh, self._distance, self._sides, self.part = mesh, distance, (top, bottom), part
        self._pressure, self._shear, self._tilt = (
            [fem.Constant(mesh, 0.0) for _ in self._sides] for _ in range(3)
        )
        x = ufl.SpatialCoordinate(mesh)[0]
        self._areas = [self._integral(fem.Constant(mesh, 1.0) * ds) for ds in self._sides]
        self._moments = [self._integral(x**2 * ds) for ds in self._sides]
        self.forces = (0.0, 0.0)

    def form(self, v):
        """Their linear form."""
        mesh = self._mesh
        x, up = ufl.SpatialCoordinate(mesh)[0], mesh.geometry.dim - 1
        return sum(
            (sign * (shear * v[0] - pressure * v[up]) + tilt * x * v[up]) * ds
            for ds, pressure, shear, tilt, sign in zip(
                self._sides, self._pressure, self._shear, self._tilt, (1, -1), strict=True
            )
        )

    def set(self, P, Q):
        """Set the forces."""
        self.forces = (P, Q)
        for k, (area, moment) in enumerate(zip(self._areas, self._moments, strict=True)):
            self._pressure[k].value = self.part * P / area
            self._shear[k].value = self.part * Q / area
            self._tilt[k].value = self.part * Q * self._distance / moment

    def paths(self, u):
        """What P and Q move by a displacement u: their work is P and Q times these. Collective."""
        forces, form, found = self.forces, fem.form(self.form(u)), []
        for one in ((1.0, 0.0), (0.0, 1.0)):
            self.set(*one)
            found.append(self._mesh.comm.allreduce(fem.assemble_scalar(form)))
        self.set(*forces)
        return np.array(found)

    def _integral(self, form):
        return self._mesh.comm.allreduce(fem.assemble_scalar(fem.form(form)))


def counted(report):
    """What a step has cost."""
    return {
        "problems": report.friction_iterations,
        "F": report.F_multiplications,
        "S": report.preconditioner_multiplications,
    }


def print_table(comm, rows):
    """Rows as a table, on rank 0."""
    if comm.rank == 0:
        print("  ".join(f"{name:>12}" for name in rows[0]))
        for row in rows:
            values = (f"{v:12.4g}" if isinstance(v, float) else f"{v:12d}" for v in row.values())
            print("  ".join(values), flush=True)


def pushed(problem, loads, closed, force):
    """Solve one load step under P and a force Q. Its contact. Collective."""
    loads.set(closed.hertz.load, force)
    problem.solve()
    problem.accept()
    return problem.solution.contact(0)


def pushed_in_steps(problem, loads, closed, steps):
    """P alone, then Q in steps up to 0.8 μP, with a table. Collective.

    Returns:
        Errors, of all steps the worst, and rows of the table with the friction on y = 0: a table
        from the force to x and q, on rank 0.
    """
    comm, rows, misses, curves = MPI.COMM_WORLD, [], [], {}
    errors = pressed(comm, pushed(problem, loads, closed, 0.0), closed, loads.part)
    if comm.rank == 0:
        print("P alone:", counted(problem.report), flush=True)
    for force in MOST * closed.capacity * np.arange(1, steps + 1) / steps:
        contact = pushed(problem, loads, closed, force)
        row, miss = measured(comm, contact, closed, force, loads.part)
        rows.append({**row, **counted(problem.report)})
        misses.append(miss)
        x, y, _ = contact.points.T
        at = np.abs(y) < CLOSE * closed.hertz.half_width
        curves[force] = gathered(comm, x[at], friction(contact)[at])
    print_table(comm, rows)
    worst = {name: max((miss[name] for miss in misses), key=abs) for name in misses[0]}
    return {**errors, **worst}, rows, curves


def draw_friction(path, closed, curves):
    """Friction over x of all steps, with the closed form; on one rank."""
    size, peak = closed.hertz.half_width, closed.mu * closed.hertz.peak
    fine, points, lines = np.linspace(-1.2, 1.2, 961), {}, {}
    for force, (x, q) in curves.items():
        name = f"Q = {force / closed.capacity:.2g} μP"
        near = np.abs(x) < 1.2 * size
        points[name] = (x[near] / size, q[near] / peak)
        lines[name] = (fine, closed.traction(size * fine, force) / peak)
    draw(path, [(("x/a", "q/(μp₀)"), points, lines)])


def gathered(comm, *values):
    """Values at the nodes of all ranks in the order of the first, on rank 0; else None."""
    parts = comm.gather(values, root=0)
    if parts is None:
        return None
    whole = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(whole[0], kind="stable")
    return [part[order] for part in whole]


def draw(path, panels):
    """Panels side by side, each (labels of axes, points, lines); on one rank.

    Points and lines are tables from a name to abscissae and ordinates. Lines with the name of
    points have their colour.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4 * len(panels), 4.5), layout="constrained")
    for axes, (labels, points, lines) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        for name, (x, y) in points.items():
            (drawn,) = axes.plot(x, y, "o", markersize=3, label=name)
            if name in lines:
                axes.plot(*lines[name], "-", linewidth=1, color=drawn.get_color())
        for name, curve in lines.items():
            if name not in points:
                axes.plot(*curve, "-", linewidth=1, label=name)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        axes.locator_params(axis="x", nbins=6)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))
