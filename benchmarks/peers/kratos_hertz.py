"""Kratos: mortar contact with augmented Lagrangian, frictionless, with a block that is held.

    benchmarks/peers/run python3 benchmarks/peers/kratos_hertz.py MESH.npz FILE.json

ALMContactFrictionless of its contact application, small displacements, meshes of order 1. The
block overlaps where the surfaces will touch. The search looks at gaps directly, since with its
default it finds no pairs in 3D.
"""

import json
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import KratosMultiphysics as Kratos
import numpy as np
from judged import best, write
from KratosMultiphysics import ContactStructuralMechanicsApplication as Contact
from KratosMultiphysics.StructuralMechanicsApplication import structural_mechanics_analysis

ELEMENT = {2: "SmallDisplacementElement2D3N", 3: "SmallDisplacementElement3D4N"}
FACET = {2: "LineCondition2D2N", 3: "SurfaceCondition3D3N"}
PRESSED = {2: "LineLoadCondition2D2N", 3: "SurfaceLoadCondition3D3N"}
LAW = {2: "LinearElasticPlaneStrain2DLaw", 3: "LinearElastic3DLaw"}
PRESSURE = {2: "LINE_LOAD", 3: "SURFACE_LOAD"}
SOLVER = "amgcl"
UNIT = 1e9  # of stress: Kratos has absolute tolerances, 1e-9
# half width of the block, that of the surface that may touch, both over a, and how much larger
# than the body the block is meshed: where it is coarse, pairs are missed
WIDE, NEAR, COARSER = 3.0, 2.5, 1.5


def block(dim, a, up, size):
    """Nodes, cells and upper facets of a block of one layer."""
    along = WIDE * a * np.linspace(-1, 1, round(2 * WIDE * a / size) + 1)
    flat = np.stack(np.meshgrid(*[along] * (dim - 1), indexing="ij"), axis=-1).reshape(-1, dim - 1)
    n, shape = len(flat), [len(along)] * (dim - 1)
    x = np.concatenate([np.column_stack((flat, np.full(n, y))) for y in (up, up - a)])
    index = np.arange(n).reshape(shape)
    if dim == 2:
        p, q = index[:-1], index[1:]
        facets = [np.stack((p, q), axis=1)]
    else:
        p, q = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
        r, s = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
        facets = [np.stack((p, q, r), axis=1), np.stack((p, r, s), axis=1)]
    upper = np.concatenate(facets)
    # a prism below each facet, cut along corners in rising order
    cells = [np.column_stack((upper[:, k:], upper[:, : k + 1] + n)) for k in range(dim)]
    return x, np.concatenate(cells), upper


def outward(points, facets, inside):
    """Facets whose normals point away from cells' midpoints."""
    facets = np.array(facets)
    x = points[facets]
    side = x[:, 1] - x[:, 0]
    normal = (
        np.stack((side[:, 1], -side[:, 0]), axis=1)
        if points.shape[1] == 2
        else np.cross(side, x[:, 2] - x[:, 0])
    )
    turned = np.einsum("ij,ij->i", normal, x[:, 0] - inside) < 0
    facets[turned] = facets[turned][:, [1, 0, *range(2, facets.shape[1])]]
    return facets


def positive(points, cells):
    """Cells of positive volume."""
    cells = np.array(cells)
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    turned = np.linalg.det(sides) < 0
    cells[turned] = cells[turned][:, [1, 0, *range(2, cells.shape[1])]]
    return cells


def filled(part, data):
    """Fill Kratos's model part: bodies, contact surfaces, load."""
    points, dim = data["points"], data["points"].shape[1]
    a, R = float(data["a"]), float(data["R"])
    edges = points[data["contact"][:, 1]] - points[data["contact"][:, 0]]
    size = COARSER * np.linalg.norm(edges, axis=1).min()
    extra, base, upper = block(dim, a, a**2 / (2 * R), size)
    n, x = len(points), np.concatenate((points, extra))
    for k, p in enumerate(x):
        part.CreateNewNode(k + 1, *p, *[0.0] * (3 - dim))
    stuff = part.CreateNewProperties(1)
    cells = np.concatenate((positive(points, data["cells"]), positive(extra, base) + n))
    for k, cell in enumerate(cells):
        part.CreateNewElement(ELEMENT[dim], k + 1, (cell + 1).tolist(), stuff)
    middle = np.append(np.zeros(dim - 1), R)
    near = np.linalg.norm(points[data["contact"]].mean(axis=1), axis=1) < NEAR * a
    surfaces = {
        "slave": outward(points, data["contact"][near], middle),
        "master": outward(x, np.array(upper) + n, extra.mean(axis=0)),
    }
    number = 1
    for name, facets in surfaces.items():
        made = part.CreateSubModelPart(name)
        made.AddNodes((np.unique(facets) + 1).tolist())
        for facet in facets:
            made.CreateNewCondition(FACET[dim], number, (facet + 1).tolist(), stuff)
            number += 1
    top = part.CreateSubModelPart("top")
    top.AddNodes((np.unique(data["top"]) + 1).tolist())
    for facet in outward(points, data["top"], middle - 1.0 * np.eye(dim)[-1]):
        top.CreateNewCondition(PRESSED[dim], number, (facet + 1).tolist(), stuff)
        number += 1
    fixed = part.CreateSubModelPart("fixed")
    fixed.AddNodes(list(range(n + 1, len(x) + 1)))
    axis = part.CreateSubModelPart("axis")
    if dim == 2:
        axis.AddNodes((data["axis"] + 1).tolist())
    else:
        held = [int(np.argmin(np.linalg.norm(points - p, axis=1))) for p in ((0, 0, R), (R, 0, R))]
        axis.AddNodes([held[0] + 1])
        part.CreateSubModelPart("side").AddNodes([held[1] + 1])


def imposed(name, part, value):
    """Prescribed displacements; None leaves a direction free."""
    return {
        "python_module": "assign_vector_variable_process",
        "kratos_module": "KratosMultiphysics",
        "process_name": "AssignVectorVariableProcess",
        "Parameters": {
            "model_part_name": f"Structure.{part}",
            "variable_name": name,
            "value": value,
            "interval": [0.0, "End"],
        },
    }


def parameters(data, materials):
    """What Kratos calls project parameters."""
    dim, load = data["points"].shape[1], UNIT * float(data["load"])
    down = {"variable_name": PRESSURE[dim], "modulus": load / area(data["points"], data["top"])}
    pressed = {
        "python_module": "assign_vector_by_direction_to_condition_process",
        "kratos_module": "KratosMultiphysics",
        "process_name": "AssignVectorByDirectionToConditionProcess",
        "Parameters": {
            "model_part_name": "Structure.top",
            **down,
            "direction": [0.0, -1.0, 0.0] if dim == 2 else [0.0, 0.0, -1.0],
            "interval": [0.0, "End"],
        },
    }
    touching = {
        "python_module": "alm_contact_process",
        "kratos_module": "KratosMultiphysics.ContactStructuralMechanicsApplication",
        "process_name": "ALMContactProcess",
        "Parameters": {
            "model_part_name": "Structure",
            "contact_model_part": {"0": ["slave", "master"]},
            "assume_master_slave": {"0": ["slave"]},
            "contact_type": "Frictionless",
            "search_parameters": {"check_gap": "direct_check"},
        },
    }
    along = [0.0, None, None] if dim == 2 else [0.0, 0.0, None]
    return {
        "problem_data": {
            "problem_name": "hertz",
            "parallel_type": "OpenMP",
            "start_time": 0.0,
            "end_time": 1.0,
            "echo_level": 0,
        },
        "solver_settings": {
            "solver_type": "Static",
            "model_part_name": "Structure",
            "domain_size": dim,
            "analysis_type": "non_linear",
            "echo_level": 0,
            "model_import_settings": {"input_type": "use_input_model_part"},
            "material_import_settings": {"materials_filename": str(materials)},
            "contact_settings": {"mortar_type": "ALMContactFrictionless"},
            "time_stepping": {"time_step": 1.1},
            "convergence_criterion": "contact_residual_criterion",
            "max_iteration": 50,
            "linear_solver_settings": {"solver_type": SOLVER},
        },
        "processes": {
            "constraints_process_list": [
                imposed("DISPLACEMENT", "fixed", [0.0, 0.0, 0.0]),
                imposed("DISPLACEMENT", "axis", along),
                *([] if dim == 2 else [imposed("DISPLACEMENT", "side", [None, 0.0, None])]),
            ],
            "contact_process_list": [touching],
            "loads_process_list": [pressed],
        },
    }


def area(points, facets):
    """Length or area of flat facets."""
    x = points[facets[:, : points.shape[1]]]
    sides = x[:, 1:] - x[:, :1]
    if points.shape[1] == 2:
        return float(np.linalg.norm(sides[:, 0], axis=1).sum())
    return float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()) / 2


def solve(data, folder):
    """Points, pressures there and steps."""
    dim = data["points"].shape[1]
    materials = folder / "materials.json"
    law = {"constitutive_law": {"name": LAW[dim]}, "Tables": {}}
    E, nu = UNIT * float(data["E"]), float(data["nu"])
    law["Variables"] = {"YOUNG_MODULUS": E, "POISSON_RATIO": nu}
    whole = {"model_part_name": "Structure", "properties_id": 1, "Material": law}
    materials.write_text(json.dumps({"properties": [whole]}))
    model = Kratos.Model()
    text = json.dumps(parameters(data, materials))
    analysis = structural_mechanics_analysis.StructuralMechanicsAnalysis(
        model, Kratos.Parameters(text)
    )
    part = model["Structure"]
    filled(part, data)
    analysis.Run()
    nodes = np.unique(data["contact"])
    scale = part.ProcessInfo[Kratos.SCALE_FACTOR]
    name = Contact.LAGRANGE_MULTIPLIER_CONTACT_PRESSURE
    pressure = [-scale / UNIT * part.Nodes[int(k) + 1].GetSolutionStepValue(name) for k in nodes]
    steps = part.ProcessInfo[Kratos.NL_ITERATION_NUMBER]
    return data["points"][nodes], np.array(pressure), steps


def main(argv):
    """Solve, and write the pressure with what it took."""
    data = np.load(argv[0])
    Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        run = best(lambda: solve(data, Path(folder)))
    steps = run["found"][2]
    write(
        argv[1],
        f"Kratos {metadata.version('KratosMultiphysics')}",
        run,
        unknowns=data["points"].size,
        steps=steps,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
