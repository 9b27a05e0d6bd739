# # Hysteresis of a line contact
#
# The bodies of `cattaneo_mindlin_2d.py`, pushed along each other by a force that grows to Q_max,
# turns, grows to −Q_max, and turns again. After each turn the contact sticks at first, and slips
# again from its edges on: it sticks on |x| < c = a√(1 − (Q_max − Q)/(2μP)). Friction remembers the
# way, and force over displacement is a loop.
#
#     ./run mpirun -n 2 python3 demos/unloading_2d.py --plot

"""Hysteresis in 2D: a line contact pushed to and fro, stick and dissipation in closed form.

c is found as in `cattaneo_mindlin_2d.py`: what is left of friction until it is turned round,
(2μp − |Δq|)/2 with Δq its change since the turn, is a pressure of Hertz's on |x| < c. The energy
defect is the work of the loads (trapezoidal rule) less elastic energy and dissipation.
"""

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
from demos import cattaneo_mindlin_2d as mindlin
from demos.cattaneo_mindlin_2d import CLOSED, HERTZ, MODULUS, mu
from demos.demo_tools import Demo
from demos.partial_slip import counted, draw, friction, half_width, print_table, pushed

MOST = 0.8 * CLOSED.capacity


def way(steps):
    """Forces at the ends of load steps: up to ``MOST`` in so many, down to −``MOST``, up again."""
    up = MOST * np.arange(1, steps + 1) / steps
    down = MOST * (1 - np.arange(1, 2 * steps + 1) / steps)
    return np.concatenate((up, down, -down))


def slipped(Q, turned=None):
    """Displacement of the bodies by slip, from 0 or since a turn, in closed form.

    Of half planes. What they move while they stick is left out: it has no bound for a line load.
    """
    if turned is not None:
        return slipped(turned) - np.sign(turned) * 2 * slipped(np.abs(turned - Q) / 2)
    q = np.abs(Q) / CLOSED.capacity
    size = CLOSED.capacity / (np.pi * MODULUS)
    return np.sign(Q) * size * ((1 - q) * np.log1p(-q) + q)


def lost_in_a_cycle():
    """What friction dissipates between two visits of Q_max, in closed form."""
    s = 1 - MOST / CLOSED.capacity
    return 2 * CLOSED.capacity**2 / (np.pi * MODULUS) * (2 * s * np.log(s) + 1 - s**2)


class Pair:
    """The bodies under P, pushed by a force that may turn: stick, displacement, energies.

    Args:
        arguments: Of the command line.
        petsc_options: Options for ``ContactProblem``.

    Attributes:
        problem: The problem.
        contact: The contact after the last step.
    """

    def __init__(self, arguments, petsc_options=None):
        self.loads, parts = mindlin.scene(mindlin.torn_mesh(arguments))
        self.problem = tfeti.ContactProblem(**parts, petsc_options=petsc_options)
        self._energy = fem.form(0.5 * ufl.energy_norm(parts["a"], self.problem.u))
        self.contact = pushed(self.problem, self.loads, CLOSED, 0.0)
        self._state = self._look()
        self._turn, self._turned, self._direction = None, None, 1.0

    def _look(self):
        """Forces, what they have moved, elastic energy."""
        energy = MPI.COMM_WORLD.allreduce(fem.assemble_scalar(self._energy))
        return np.array(self.loads.forces), self.loads.paths(self.problem.u), energy

    def push(self, Q):
        """A load step: stick half width, displacement, energies over those lost in a cycle."""
        comm, before, direction = MPI.COMM_WORLD, self._state, np.sign(Q - self.loads.forces[1])
        if direction != self._direction:  # it turns
            self._turned, self._turn = self.loads.forces[1], friction(self.contact)
        self._direction = direction
        self.contact = contact = pushed(self.problem, self.loads, CLOSED, Q)
        self._state = forces, paths, energy = self._look()
        work = (before[0] + forces) / 2 @ (paths - before[1])
        lost = comm.allreduce(float(np.sum(self.problem.solution.dissipation)))
        if self._turned is None:
            left, closed = mu * contact.pressure - np.abs(friction(contact)), CLOSED.stick(Q)
        else:
            change = np.abs(friction(contact) - self._turn)
            left = mu * contact.pressure - change / 2
            closed = CLOSED.stick(abs(Q - self._turned) / 2)
        c = half_width(comm, contact, left)
        return {
            "Q/(μP)": Q / CLOSED.capacity,
            "c/a": c / HERTZ.half_width,
            "closed form": closed / HERTZ.half_width,
            "moved/a": float(paths[1]) / HERTZ.half_width,
            "dissipation": lost / lost_in_a_cycle(),
            "defect": float(work - (energy - before[2]) - lost) / lost_in_a_cycle(),
            **counted(self.problem.report),
        }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    steps = arguments.steps or (1 if arguments.quick else 4)
    pair = Pair(arguments, demo.petsc_options)
    rows = [pair.push(Q) for Q in way(steps)]
    print_table(comm, rows)

    # ## Comparison with the closed form
    #
    # The defect is that of all steps, over what a cycle dissipates.
    errors, after = pair.problem.report.errors, rows[steps:]
    misses = [row["c/a"] / row["closed form"] - 1 for row in rows]
    errors["stick_half_width"] = max(misses[:steps], key=abs)
    errors["stick_after_turns"] = max(misses[steps:], key=abs)
    errors["dissipation"] = sum(row["dissipation"] for row in after) - 1
    errors["least_dissipation"] = min(row["dissipation"] for row in rows)
    errors["energy_defect"] = sum(row["defect"] for row in after)
    if arguments.plot and comm.rank == 0:
        draw(demo.folder / "unloading_2d.png", loops(rows, steps))
    return demo.finish(pair.problem, "unloading_2d")


def loops(rows, steps):
    """Panels of the force over displacement, and over what of it is beside the secant.

    The displacement of a line load has no closed form: the secant through the turns is what was
    found. What is beside it is slip.
    """
    Q, moved = np.array([(row["Q/(μP)"], row["moved/a"]) for row in rows]).T
    up, down = np.linspace(0.0, MOST, 201), np.linspace(MOST, -MOST, 401)
    forces = np.concatenate((up, down, -down))
    slips = np.concatenate((slipped(up), slipped(down, MOST), slipped(-down, -MOST)))
    beside = (slips - slipped(MOST) / MOST * forces) / HERTZ.half_width
    shares, secant = forces / CLOSED.capacity, moved[steps - 1] / Q[steps - 1]
    names = {"displacement / a": 0.0, "displacement beside the secant / a": secant}
    return [
        (
            (name, "Q/(μP)"),
            {"TFETI": (moved - taken * Q, Q)},
            {"closed form": (beside + (secant - taken) * shares, shares)},
        )
        for name, taken in names.items()
    ]


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    mindlin.configure_mesh(parser)
    parser.add_argument("--steps", type=int, help="load steps from 0 to Q_max")


if __name__ == "__main__":
    main(sys.argv[1:])
