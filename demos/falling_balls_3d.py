# # Falling balls
#
# Balls fall on a rough floor, one above the other; the lowest one also moves along the floor, and
# friction turns it. They hit the floor and each other, without anything that was tuned. Bodies move
# by several times the size of their contacts; but strains, turns and ways along the surfaces are
# small, since who meets whom is found where the balls begin.
#
# Until its first impact is over the lowest ball is alone with the floor: force and duration of that
# are near to Hertz', whose contact is smooth and small beside the ball, as that of a stiffer one:
#
#     ./run mpirun -n 2 python3 demos/falling_balls_3d.py --plot
#     ./run python3 demos/falling_balls_3d.py --balls 1 --modulus 4e7 --fine 0.015 \
#         --gap 0.01 --end 0.01 --steps 30 --smooth

"""Balls that fall on a rough floor and on each other; the first impact in closed form."""

import sys
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
from demos.moving_pictures import Film
from meshes.balls import build

R, NU, RHO, G = 1.0, 0.3, 1.0, 10.0
GAP, APART, ALONG = 0.3, 0.25, 0.3
SPEED, MASS = np.sqrt(2 * G * GAP), 4 / 3 * np.pi * R**3 * RHO


def hertz(E):
    """Largest force of the first impact, how long it lasts, and a/R, in closed form."""
    modulus = E / (1 - NU**2)
    approach = (15 * MASS * SPEED**2 / (16 * modulus * np.sqrt(R))) ** 0.4
    force = 4 / 3 * modulus * np.sqrt(R) * approach**1.5
    return force, 2.94 * approach / SPEED, np.sqrt(approach / R)


def scene(decomposition, arguments, count, **keywords):
    """Balls with their weight and what they have fallen, contacts with Coulomb's friction."""
    mesh, gap = decomposition.mesh, arguments.gap
    elastic = tfeti.Elasticity(decomposition, E=arguments.modulus, nu=NU)
    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    weight = fem.Constant(mesh, (0.0, 0.0, -RHO * G))
    thrown = fem.Function(V)
    fallen = -np.sqrt(2 * G * (GAP - gap))
    first = gap + 2 * R + 0.5 * APART
    thrown.interpolate(
        lambda x: np.stack((ALONG * (x[2] < first), 0 * x[0], np.full_like(x[0], fallen)))
    )
    rough = None if arguments.smooth else tfeti.Coulomb(0.3)
    floor = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
    contacts = [
        tfeti.Obstacle("ball 1 lower", floor, friction=rough, reach=gap + 0.15, name="floor")
    ]
    for n in range(1, count):
        pair = (f"ball {n + 1} lower", f"ball {n} upper")
        contacts.append(
            tfeti.Contact(*pair, friction=rough, reach=APART + 0.3, name=f"balls {n} and {n + 1}")
        )
    return tfeti.ContactDynamics(
        elastic.a(u, v),
        ufl.dot(weight, v) * ufl.dx(domain=mesh),
        [],
        contacts,
        decomposition,
        mass=RHO,
        velocity=thrown,
        stabilised=True,
        stress=elastic.stress,
        **keywords,
    )


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    fine = arguments.fine or (0.4 if arguments.quick else 0.12)
    count = arguments.balls or (2 if arguments.quick else 3)
    end = arguments.end or (0.27 if arguments.quick else 0.8)
    closed = hertz(arguments.modulus)
    size = closed[1] / (arguments.steps or (6 if arguments.quick else 15))

    # ## Mesh
    lowest = arguments.gap + (2 * R + APART) * np.arange(count)
    model = build(lowest, R, fine, max(0.3, fine)) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, arguments.subdomains)

    # ## Motion
    problem = scene(decomposition, arguments, count, petsc_options=demo.petsc_options)
    film = Film(problem, height=lowest[-1] + 2 * R) if arguments.plot else None
    records, begin = [], 0.0
    times = size * np.arange(1, round(end / size) + 1)
    for part in np.array_split(times, max(len(times) // 4, 1)):
        series = tfeti.LoadSteps(problem, lambda problem, t: None, part, begin=begin)
        records += series.run()
        begin = part[-1]
        if film is not None:
            film.take(begin)

    # ## The first impact, and what was done in all
    errors = first_impact(records, size, closed)
    problem.report.errors.update(errors)
    if comm.rank == 0:
        tell(records, errors, closed)
    if film is not None:
        film.write(demo.folder / "falling_balls_3d.gif")
        film.write_last(demo.folder / "falling_balls_3d.png")
    return demo.finish(problem, "falling_balls_3d")


def first_impact(records, size, closed):
    """Largest force and duration of the first impact on the floor, relative errors."""
    t = np.array([r.time for r in records])
    force = np.array([r.contact_forces[0][2] for r in records])
    touching = np.flatnonzero(force > 0.0)
    if not len(touching):
        return {}
    first = touching[0]
    free = np.flatnonzero((force == 0.0) & (t > t[first]))
    last = free[0] if len(free) else len(t)
    lasts = (last - first) * size
    return {
        "force": float(force[first:last].max() / closed[0] - 1),
        "duration": float(lasts / closed[1] - 1),
    }


def tell(records, errors, closed):
    """What has happened."""
    F = [r.figures["F_multiplications"] for r in records]
    motion = [r.motion for r in records]
    print(f"{len(records)} steps of {motion[0]['size']:.4g}, multiplications {sum(F)}")
    print(f"median {np.median(F):g}, at most {max(F)} in a step")
    for name in ("load", "contact", "friction", "predictor"):
        print(f"work of {name:<10} {sum(m[name] for m in motion):.4g}")
    print(f"energy at the end {motion[-1]['energy']:.4g}")
    print(f"largest defect {max(abs(m['defect']) for m in motion):.1e}")
    print(f"a/R of Hertz {closed[2]:.3f}, which ought to be small")
    for name, value in errors.items():
        print(f"first impact, {name}: {value:+.3f} of Hertz'", flush=True)


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--balls", type=int, help="how many")
    parser.add_argument("--modulus", type=float, default=2e4, help="Young's modulus")
    parser.add_argument("--smooth", action="store_true", help="without friction")
    parser.add_argument("--gap", type=float, default=GAP, help="what is left of the fall")
    parser.add_argument("--fine", type=float, help="element size where balls touch")
    parser.add_argument("--steps", type=float, help="steps in the first impact")
    parser.add_argument("--end", type=float, help="time of the end")
    parser.add_argument("--subdomains", type=int, default=6)


if __name__ == "__main__":
    main(sys.argv[1:])
