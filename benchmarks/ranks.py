"""What a rank sends, and what it holds that grows with the number of subdomains, by counters.

    ./run python3 benchmarks/ranks.py [--quick] [--ranks 1 2 4 8 16 32]

Cubes of few cells, on more ranks than there are cores: nothing is timed. ranks.c stands between the
programs and MPI and counts every call of more than one rank, PETSc's and DOLFINx's, too. A step of
conjugate gradients is what 7 of them on a face send more than 2. Arrays are those that can be
reached from the problem after a solve. Beside the counts is a model: one subdomain a rank, formulas
that are compared with what is counted, run to 10 648 ranks. Results go to results/ranks.md and
.json.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, eye_array, kron

import tfeti_dolfinx as tfeti
import tfeti_dolfinx.problem
from benchmarks.tools import FILE, command_line, finish, json_of
from demos import scene
from tfeti_dolfinx.feti.preconditioner import PARAMETERS
from tfeti_dolfinx.qp.krylov import pcpg
from tfeti_dolfinx.qp.problem import Steps, StoppingRule, homogenise
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# as ranks.c has them
KINDS = ("reductions", "broadcasts", "gathers", "all to all", "messages")
CELLS = 3  # along an edge of a subdomain
FEW, MORE = 2, 7  # steps that are counted
SMALL = 50.0  # kB up to which arrays are shown together

# --- Counted: on each rank ------------------------------------------------------------------------


def arrays(root):
    """Bytes of the arrays that can be reached from an object, by the way to them."""
    seen, found, todo = {}, Counter(), [("", root)]
    while todo:
        path, item = todo.pop()
        if id(item) in seen:
            continue
        seen[id(item)] = item  # kept: a number may be used twice
        if isinstance(item, np.ndarray):
            if isinstance(item.base, np.ndarray):
                todo.append((path, item.base))
            else:
                found[path] += item.nbytes
        elif isinstance(item, dict):
            todo += [(path, value) for value in item.values()]
        elif isinstance(item, list | tuple | set):
            todo += [(path, value) for value in item]
        elif isinstance(item, partial):
            todo.append((path, (item.func, item.args, item.keywords)))
        elif cells := getattr(item, "__closure__", None):
            todo += [(path, cell.cell_contents) for cell in cells]
        elif type(owner := getattr(item, "__self__", None)).__module__.startswith("tfeti"):
            todo.append((path, owner))
        elif type(item).__module__.split(".")[0] in ("tfeti_dolfinx", "scipy"):
            ours = type(item).__module__.startswith("tfeti")
            for name, value in getattr(item, "__dict__", {}).items():
                todo.append((f"{path}.{name}" if ours else path, value))
    return found


def sent_by_steps(dual, sent):
    """What a step of conjugate gradients sends on a face without half of the contact rows."""
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    free[dual.constraints.sets.normals[::2]] = False
    face, qp = Face(free, np.where(free, Status.TOUCHING, Status.OPEN)), dual.qp()
    preconditioner = qp.preconditioner_on(face)
    qp = replace(qp, coarse=qp.coarse.on_face(face), preconditioner=preconditioner)
    start, found = homogenise(qp), []
    for count in (FEW, MORE):
        before, steps = sent.copy(), Steps()
        pcpg(qp, start.at, StoppingRule(0.0), steps, count)
        assert steps.cg == count
        found.append(sent - before)
    return (found[1] - found[0]) / (MORE - FEW)


def worker(file, subdomains, clusters):
    """Solve, count, and write what all ranks have found. Collective."""
    counters = ctypes.CDLL(os.environ["LD_PRELOAD"])
    count = (ctypes.c_long * (2 * len(KINDS))).in_dll(counters, "tfeti_sent")
    sent, pickled = np.ctypeslib.as_array(count), []
    solve = tfeti_dolfinx.problem.solve_with_friction

    def dumps(item, *protocol):
        pickled.append(item)
        return pickle.dumps(item, *protocol)

    def watched(*arguments, **keywords):
        MPI.pickle.__init__(dumps, pickle.loads)
        found = solve(*arguments, **keywords)
        MPI.pickle.__init__(pickle.dumps, pickle.loads)
        return found

    tfeti_dolfinx.problem.solve_with_friction = watched
    made = scene("cube_3d", ["--subdomains", subdomains, "--cells", CELLS])
    options = {"tfeti_clusters": clusters} if int(clusters) else {}
    problem = tfeti.ContactProblem(**made, petsc_options=options)
    problem.solve()
    held = arrays(problem)
    problem._system.make({})
    dual = problem.dual
    step = sent_by_steps(dual, sent).tolist()
    own = {"step": step, "pickled": len(pickled), "arrays": held}
    own |= {"motions": dual.coarse.dimension, "factor": dual.coarse.factor._factor.entries}
    found = made["decomposition"].comm.gather(own)
    if found is not None:
        Path(file).write_text(json.dumps(found))


# --- Model ----------------------------------------------------------------------------------------


def model(q, clusters=0, kept=(FEW + MORE - 1) / 2):
    """What a step sends on average, a cube of q³ subdomains, each on a rank of its own.

    A row of gluing is on the rank of the first of the copies that it is about, so that B and Bᵀ
    have 7 partners, not 26: one each for F and for S, and two for each step that makes
    displacements smooth, before S and behind it. Both projections reduce two vectors of all
    motions, and products with directions that are kept, the norm four numbers. GGᵀ has a block for
    each pair of cubes that touch.
    """
    exchanges = 2 + 2 + 4 * PARAMETERS.steps
    planes, others, cubes = q - 1, q * (CELLS - 1) + 2, q**3
    values = 3 * sum((2**a - 1) * (1, 3, 3, 1)[a] * planes**a * others ** (3 - a) for a in range(4))
    motions, edge = 6 * (clusters or cubes), round((clusters or cubes) ** (1 / 3))
    return {
        "ranks": cubes,
        "clusters": clusters or "none",
        "reductions": 3.0,
        "kB in them": 8 * (4 * motions + 9 + kept) / 1e3,
        "messages": exchanges * ((2 * q - 1) ** 3 - cubes) / cubes,
        "kB in messages": exchanges * 8 * values / cubes / 1e3,
        "motions": motions,
        "entries of L": factor_entries(edge),
    }


def factor_entries(q):
    """Entries of the factor of a matrix with a full block for each pair of q³ cubes that touch."""
    line = csr_array(np.abs(np.subtract.outer(np.arange(q), np.arange(q))) <= 1, dtype=float)
    A = kron(kron(kron(line, line), line), np.ones((6, 6))) + 200 * eye_array(6 * q**3)
    return round(CholeskyFactor(csr_array(A)).entries)


# --- Runs and tables ------------------------------------------------------------------------------


def counted(library, ranks, subdomains, clusters=0):
    """What the ranks of a run have found."""
    program = [sys.executable, __file__, "--worker", FILE, subdomains, clusters]
    found = json_of(["env", f"LD_PRELOAD={library}", *program], ranks)
    print(ranks, "ranks,", subdomains, "subdomains,", clusters or "no", "clusters", flush=True)
    return found


def row(found, clusters=0, of=np.max):
    """A row of counts, of the rank that sends most or of all on average."""
    steps = of([own["step"] for own in found], axis=0)
    calls, kB = dict(zip(KINDS, steps, strict=False)), steps[len(KINDS) :] / 1e3
    return {
        "ranks": len(found),
        "clusters": clusters or "none",
        "reductions": calls["reductions"],
        "kB in them": kB[0],
        "other collectives": sum(calls[kind] for kind in KINDS[1:4]),
        "kB in those": sum(kB[1:4]),
        "messages": calls["messages"],
        "kB in messages": kB[4],
        "pickled": max(own["pickled"] for own in found),
        "motions": found[0]["motions"],
        "entries of L": round(found[0]["factor"]),
    }


def growing(few, many, ratio):
    """Arrays of a rank that grow with all subdomains while there are as many on each rank."""
    table, smaller = [], np.zeros(2)
    for path in sorted(set().union(*(own["arrays"] for own in many))):
        kB = [max(own["arrays"].get(path, 0) for own in found) / 1e3 for found in (few, many)]
        if kB[1] > 0.6 * ratio * kB[0]:
            if kB[1] > SMALL:
                table.append((path.removeprefix("._system._dual."), *kB))
            else:
                smaller += kB
    table = [*sorted(table, key=lambda line: -line[2]), ("smaller ones", *map(float, smaller))]
    names = ("array", *(f"kB, {len(found)} ranks" for found in (few, many)))
    return [dict(zip(names, line, strict=True)) for line in table]


def main(argv):
    """Count, compare, and write the tables; returns them."""
    if argv[:1] == ["--worker"]:
        return worker(*argv[1:])
    arguments, _ = command_line(__doc__, argv, ranks=[1, 2, 4, 8, 16, 32])
    quick, tables = arguments.quick, {}
    cubes, ranks = (8, (1, 2)) if quick else (64, arguments.ranks)
    with tempfile.TemporaryDirectory() as folder:
        library = f"{folder}/ranks.so"
        source = Path(__file__).with_suffix(".c")
        subprocess.run(["mpicc", "-shared", "-fPIC", "-o", library, source], check=True)
        run = cache(partial(counted, library))
        tables["counted"] = [row(run(n, cubes)) for n in ranks]
        half = cubes // 2
        tables["counted"] += [row(run(n, cubes, half), half) for n in ranks[1::2]]
        compared = []
        for q in (1,) if quick else (2, 3):
            found, made = row(run(q**3, q**3), of=np.mean), model(q)
            compared += [
                {"": "counted", **{name: found[name] for name in made}},
                {"": "model", **made},
            ]
        tables["compared"] = compared
        few, many, most = (1, 8, 2) if quick else (27, 216, 8)
        tables["growing"] = growing(run(1, few), run(most, many), many / few)
    edges = (2, 3) if quick else (4, 8, 16, 22)
    tables["model"] = [model(q) for q in edges] + [model(q, (q // 2) ** 3) for q in edges]
    return finish(arguments, "ranks", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
