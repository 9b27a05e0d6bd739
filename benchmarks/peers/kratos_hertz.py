"""Kratos: mortar contact with augmented Lagrangian, frictionless, with a block that is held.

ALMContactFrictionless of its contact application, small displacements, meshes of order 1. The
block overlaps where the surfaces will touch. The search looks at gaps directly.
"""

import json
import tempfile
from importlib import metadata
from pathlib import Path

import KratosMultiphysics as Kratos
import numpy as np
from KratosMultiphysics import ContactStructuralMechanicsApplication as Contact
from KratosMultiphysics.StructuralMechanicsApplication import structural_mechanics_analysis

UNIT = 1e9  # of stress: Kratos has absolute tolerances, 1e-9
# half width of the block, that of the surface that may touch, both over a, and how much larger
# than the body the block is meshed: where it is coarse, pairs are missed
WIDE, NEAR, COARSER = 3.0, 2.5, 1.5
PARAMETERS = """{
"problem_data": {"problem_name": "hertz", "parallel_type": "OpenMP", "start_time": 0.0,
    "end_time": 1.0, "echo_level": 0},
"solver_settings": {"solver_type": "Static", "model_part_name": "Structure", "domain_size": 2,
    "analysis_type": "non_linear", "echo_level": 0,
    "model_import_settings": {"input_type": "use_input_model_part"},
    "material_import_settings": {"materials_filename": "<materials>"},
    "contact_settings": {"mortar_type": "ALMContactFrictionless"},
    "time_stepping": {"time_step": 1.1}, "max_iteration": 50,
    "convergence_criterion": "contact_residual_criterion",
    "linear_solver_settings": {"solver_type": "amgcl"}},
"processes": {
    "constraints_process_list": [
        {"python_module": "assign_vector_variable_process", "kratos_module": "KratosMultiphysics",
        "Parameters": {"model_part_name": "Structure.fixed", "variable_name": "DISPLACEMENT",
            "value": [0.0, 0.0, 0.0], "interval": [0.0, "End"]}},
        {"python_module": "assign_vector_variable_process", "kratos_module": "KratosMultiphysics",
        "Parameters": {"model_part_name": "Structure.axis", "variable_name": "DISPLACEMENT",
            "value": [0.0, null, null], "interval": [0.0, "End"]}}],
    "contact_process_list": [
        {"python_module": "alm_contact_process",
        "kratos_module": "KratosMultiphysics.ContactStructuralMechanicsApplication",
        "Parameters": {"model_part_name": "Structure", "contact_type": "Frictionless",
            "contact_model_part": {"0": ["slave", "master"]},
            "assume_master_slave": {"0": ["slave"]},
            "search_parameters": {"check_gap": "direct_check"}}}],
    "loads_process_list": [
        {"python_module": "assign_vector_by_direction_to_condition_process",
        "kratos_module": "KratosMultiphysics",
        "Parameters": {"model_part_name": "Structure.top", "variable_name": "LINE_LOAD",
            "modulus": <load>, "direction": [0.0, -1.0, 0.0], "interval": [0.0, "End"]}}]}}
"""


def block(a, up, size):
    """Nodes, cells and upper facets of a block of one layer."""
    along = WIDE * a * np.linspace(-1, 1, round(2 * WIDE * a / size) + 1)
    n = len(along)
    x = np.concatenate([np.column_stack((along, np.full(n, y))) for y in (up, up - a)])
    p = np.arange(n - 1)
    cells = np.stack((p, p + n, p + 1)), np.stack((p + 1, p + n, p + n + 1))
    return x, np.concatenate(cells, axis=1).T, np.stack((p + 1, p), axis=1)


def filled(part, data):
    """Fill Kratos's model part: bodies, contact surfaces, load."""
    points, contact, a, R = data["points"], data["contact"], float(data["a"]), float(data["R"])
    edges = np.linalg.norm(points[contact[:, 1]] - points[contact[:, 0]], axis=1)
    extra, base, upper = block(a, a**2 / (2 * R), COARSER * edges.min())
    n, x = len(points), np.concatenate((points, extra))
    for k, p in enumerate(x):
        part.CreateNewNode(k + 1, *p, 0.0)
    stuff = part.CreateNewProperties(1)
    cells = np.concatenate((data["cells"], base + n))
    for k, cell in enumerate((cells + 1).tolist()):
        part.CreateNewElement("SmallDisplacementElement2D3N", k + 1, cell, stuff)
    near = np.linalg.norm(points[contact].mean(axis=1), axis=1) < NEAR * a
    facets = {"slave": contact[near], "master": upper + n, "top": data["top"]}
    number = 1
    for name, ends in facets.items():
        kind = "LineLoadCondition2D2N" if name == "top" else "LineCondition2D2N"
        made = part.CreateSubModelPart(name)
        made.AddNodes((np.unique(ends) + 1).tolist())
        for pair in (ends + 1).tolist():
            made.CreateNewCondition(kind, number, pair, stuff)
            number += 1
    part.CreateSubModelPart("fixed").AddNodes(list(range(n + 1, len(x) + 1)))
    part.CreateSubModelPart("axis").AddNodes((np.unique(data["axis"]) + 1).tolist())


def prepare(data):
    """The program, and a solve: places, pressures there, unknowns and steps."""
    Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
    numbers = {"YOUNG_MODULUS": UNIT * float(data["E"]), "POISSON_RATIO": float(data["nu"])}
    law = {"constitutive_law": {"name": "LinearElasticPlaneStrain2DLaw"}, "Tables": {}}
    whole = {"model_part_name": "Structure", "properties_id": 1}
    whole["Material"] = {**law, "Variables": numbers}
    materials = Path(tempfile.mkdtemp()) / "materials.json"
    materials.write_text(json.dumps({"properties": [whole]}))
    load = UNIT * float(data["traction"])
    words = PARAMETERS.replace("<load>", f"{load:.17e}").replace("<materials>", str(materials))

    def solve():
        model, parameters = Kratos.Model(), Kratos.Parameters(words)
        analysis = structural_mechanics_analysis.StructuralMechanicsAnalysis(model, parameters)
        part = model["Structure"]
        filled(part, data)
        analysis.Run()
        nodes, scale = np.unique(data["contact"]), -part.ProcessInfo[Kratos.SCALE_FACTOR] / UNIT
        name = Contact.LAGRANGE_MULTIPLIER_CONTACT_PRESSURE
        pressure = [scale * part.Nodes[int(k) + 1].GetSolutionStepValue(name) for k in nodes]
        steps = part.ProcessInfo[Kratos.NL_ITERATION_NUMBER]
        return data["points"][nodes, 0], pressure, data["points"].size, steps

    return f"Kratos {metadata.version('KratosMultiphysics')}", solve
