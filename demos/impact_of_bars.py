# # Impacts of bars
#
# Bars hit each other along their axis, where waves have the speed c and Z = ρc is the impedance:
#
# * `two`: two free equal bars with the relative speed V press each other with ZVA/2 for 2L/c, and
#   have swapped their velocities then.
# * `clamped`: a free bar hits an equal one that is clamped at its far end: ZVA/2 for 4L/c. It
#   comes back with −V, and leaves the other at rest.
# * `wall`: SDNV100 of Code_Aster: a bar that cannot widen hits a rigid wall, 4.641 GPa for 2L/c.
#
# Forces of steps that are not stabilised oscillate: with `--plot` both are drawn.
#
#     ./run mpirun -n 2 python3 demos/impact_of_bars.py --plot

"""Impacts of elastic bars in closed form: force, duration, velocities afterwards."""

import sys
from dataclasses import dataclass
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.partial_slip import draw, print_table
from meshes.blocks import Block, build


@dataclass(frozen=True)
class Impact:
    """Bars above each other, of which the upper one comes down.

    Attributes:
        length: L.
        side: Edge of the square cross section.
        modulus: E.
        nu: Poisson's ratio; if not 0, the bars are confined.
        rho: Density.
        speed: V.
        gap: How far they are apart.
        below: Whether there is a lower bar, else a rigid wall.
        clamped: Whether it is clamped at its far end.
    """

    length: float = 10.0
    side: float = 1.0
    modulus: float = 900.0
    nu: float = 0.0
    rho: float = 1.0
    speed: float = 10.0
    gap: float = 1.0
    below: bool = True
    clamped: bool = False

    @property
    def c(self):
        """Speed of waves; of a confined bar that of pressure waves."""
        nu = self.nu
        return np.sqrt(self.modulus * (1 - nu) / (1 + nu) / (1 - 2 * nu) / self.rho)

    @property
    def begin(self):
        """When they meet."""
        return self.gap / self.speed

    @property
    def duration(self):
        """How long they touch."""
        return (4 if self.clamped else 2) * self.length / self.c

    @property
    def pressure(self):
        """ZV/2 of two bars, ZV on a wall."""
        return self.rho * self.c * self.speed * (0.5 if self.below else 1.0)

    @property
    def rebound(self):
        """Velocity of the upper bar afterwards."""
        return 0.0 if self.below and not self.clamped else self.speed


IMPACTS = {
    "two": Impact(),
    "clamped": Impact(clamped=True),
    "wall": Impact(0.2, 0.02, 2e11, 0.3, 8000.0, 100.0, 2e-3, below=False),
}


class Bars:
    """The bars of an impact, with steps of one size.

    Args:
        impact: The impact.
        cells: Cells along a bar.
        stabilised: Whether steps are contact-stabilised.
        petsc_options: Options for ``ContactDynamics``.
    """

    def __init__(self, impact, cells, stabilised, petsc_options):
        self.impact, L, a, comm = impact, impact.length, impact.side, MPI.COMM_WORLD
        bars = [Block("upper", (0.0, 0.0, impact.gap), (a, a, L), (1, 1, cells))]
        if impact.below:
            bars.append(Block("lower", (0.0, 0.0, -L), (a, a, L), (1, 1, cells)))
        model = build(bars) if comm.rank == 0 else None
        halves = self.quarter if impact.below else self.half
        decomposition = tfeti.read_gmsh(model, comm, halves)
        elastic = tfeti.Elasticity(decomposition, E=impact.modulus, nu=impact.nu)
        V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        down = fem.Function(V)
        down.interpolate(lambda x: np.outer([0, 0, -impact.speed], x[2] > 0.5 * impact.gap))
        self.problem = tfeti.ContactDynamics(
            elastic.a(u, v),
            ufl.ZeroBaseForm((v,)),
            self._supports(V, decomposition),
            [self._contact()],
            decomposition,
            mass=impact.rho,
            velocity=down,
            stabilised=stabilised,
            stress=elastic.stress,
            petsc_options={"tfeti_rtol": 1e-8, **petsc_options},
        )
        self.size = L / cells / impact.c  # a wave runs through a cell in a step
        dx = ufl.Measure("dx", domain=decomposition.mesh, subdomain_data=decomposition.cell_tags)
        self._velocity = fem.Function(V)
        upper = dx(decomposition.volume("upper"))
        self._momentum = fem.form(self._velocity[2] * upper)

    def quarter(self, x):
        """Two subdomains in each bar."""
        upper, L = x[2] > 0.5 * self.impact.gap, self.impact.length
        middle = np.where(upper, self.impact.gap + L / 2, -L / 2)
        return 2 * upper + (x[2] > middle)

    def half(self, x):
        """Two subdomains."""
        return x[2] > self.impact.gap + self.impact.length / 2

    def _supports(self, V, decomposition):
        supports, mesh = [], decomposition.mesh
        if self.impact.clamped:
            far = fem.locate_dofs_topological(V, 2, decomposition.facets("lower bottom"))
            supports.append(fem.dirichletbc(np.zeros(3), far, V))
        if self.impact.nu:
            mesh.topology.create_connectivity(3, 3)
            cells = np.arange(mesh.topology.index_map(3).size_local, dtype=np.int32)
            for k in (0, 1):
                everywhere = fem.locate_dofs_topological(V.sub(k), 3, cells)
                supports.append(fem.dirichletbc(0.0, everywhere, V.sub(k)))
        return supports

    def _contact(self):
        reach = 2 * self.impact.gap
        if self.impact.below:
            return tfeti.Contact("upper bottom", "lower top", reach=reach, name="impact")
        wall = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
        return tfeti.Obstacle("upper bottom", wall, reach=reach, name="impact")

    def run(self):
        """Times of the ends of steps, pressures in them, and the velocity afterwards."""
        impact, area = self.impact, self.impact.side**2
        count = round((impact.begin + 1.4 * impact.duration) / self.size)
        times = self.size * np.arange(1, count + 1)
        records = tfeti.LoadSteps(self.problem, lambda problem, t: None, times).run()
        pressures = [abs(r.contact_forces[0][2]) / area for r in records]
        self._velocity.x.array[:] = self.problem.solution.velocity.x.array
        momentum = MPI.COMM_WORLD.allreduce(fem.assemble_scalar(self._momentum))
        return (
            np.array([r.time for r in records]),
            np.array(pressures),
            momentum / impact.length / area,
            records,
        )


def look(bars, t, p, velocity, records):
    """What is compared with the closed form, relative but for multiplications."""
    impact, F = bars.impact, [r.figures["F_multiplications"] for r in records]
    touching = t[p > 0.5 * impact.pressure]
    begin, end = touching[0] - bars.size, touching[-1]
    inside = (t - bars.size > begin + 0.1 * impact.duration) & (t < end - 0.1 * impact.duration)
    energy = [r.motion["energy"] for r in records]
    return {
        "steps": len(t),
        "begin": float(begin / impact.begin - 1),
        "duration": float((end - begin) / impact.duration - 1),
        "pressure": float(np.mean(p[inside]) / impact.pressure - 1),
        "oscillates": float(np.std(p[inside]) / impact.pressure),
        "velocity": float((velocity - impact.rebound) / impact.speed),
        "energy": float(energy[-1] / energy[0] - 1),
        "F": sum(F),
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    cells = arguments.cells or (20 if arguments.quick else 100)
    names = ["two"] if arguments.quick else arguments.impact or list(IMPACTS)
    panels, errors = [], {}
    for name in names:
        curves = {}
        for stabilised in (False, True) if arguments.plot else (not arguments.plain,):
            bars = Bars(IMPACTS[name], cells, stabilised, demo.petsc_options)
            t, p, velocity, records = bars.run()
            row = look(bars, t, p, velocity, records)
            kind = "stabilised" if stabilised else "plain"
            curves[kind] = (t / bars.impact.begin, p / bars.impact.pressure)
            if comm.rank == 0:
                print(f"{name}, {kind}", flush=True)
            print_table(comm, [row])
        labels = ("time / that of the impact", f"pressure / closed form: {name}")
        panels.append((labels, {}, curves))
        errors |= {f"{name}_{k}": v for k, v in row.items() if isinstance(v, float)}
    bars.problem.report.errors.update(errors)
    if arguments.plot and comm.rank == 0:
        draw(demo.folder / "impact_of_bars.png", panels)
    return demo.finish(bars.problem, "impact_of_bars")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--cells", type=int, help="cells along a bar")
    parser.add_argument("--impact", action="append", choices=list(IMPACTS), help="only this one")
    parser.add_argument("--plain", action="store_true", help="steps that are not stabilised")


if __name__ == "__main__":
    main(sys.argv[1:])
