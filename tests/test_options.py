"""Options: parsing, precedence, ranges, documents."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from petsc4py import PETSc
from quick_demos import alone, process
from scenes import STAGES, decomposed, problem, solved

from tfeti_dolfinx import InputError
from tfeti_dolfinx.common.validation import parameters_of
from tfeti_dolfinx.options import Options, factor_options, parse_options
from tfeti_dolfinx.solve.solver import resolved

ROOT = Path(__file__).resolve().parents[1]


def test_values_get_the_type_of_their_option_and_the_command_line_beats_the_dictionary():
    assert parse_options(None, "tfeti_") == Options()
    given = {"tfeti_rtol": "1e-8", "max_it": "7", "-tfeti_monitor": None, "view": "false"}
    options = parse_options(given, "tfeti_")
    assert (options.rtol, options.max_it, options.monitor, options.view) == (1e-8, 7, True, False)
    database = PETSc.Options()
    database.setValue("-tfeti_rtol", "1e-3")
    try:
        assert parse_options({"tfeti_rtol": 1e-9}, "tfeti_").rtol == 1e-3
    finally:
        database.delValue("-tfeti_rtol")
    assert parse_options({"tfeti_rtol": 1e-9}, "tfeti_").rtol == 1e-9


def test_named_mechanisms_are_switched_off_and_view_lists_every_option():
    options = parse_options({"without": "d_scaling, recycled_directions,late_schur"}, "tfeti_")
    assert options.without == ("d_scaling", "recycled_directions", "late_schur")
    for given, taken in (("auto", "dirichlet"), ("lumped", "lumped")):
        assert resolved(replace(options, pc_type=given), (1, 0), "tfeti_").pc_type == taken
    assert resolved(replace(options, qp_type="smalse"), (1, 0), "tfeti_").pc_type == "none"
    assert (options.scaling, options.recycle) == ("multiplicity", 0)
    text = Options().view_text("tfeti_")
    for option in parameters_of(Options):
        assert f"-tfeti_{option.name} {option.default}" in text
    changed = parse_options({"smalse_rho": 3}, "tfeti_").view_text("tfeti_")
    assert "-tfeti_smalse_rho 3.0" in changed


def test_symbols_of_parameters_stand_in_the_notation():
    """With the name of the field that they stand for, in one row."""
    rows = (ROOT / "docs/notation.md").read_text().splitlines()
    described = [p for p in parameters_of(Options) if p.description.symbol]
    assert len(described) == 7
    for parameter in described:
        symbol, name = parameter.description.symbol, parameter.path[-1]
        assert any(
            symbol in row.split("|")[1] and f"`{name}`" in row
            for row in rows[1:]
            if row.startswith("|")
        )


def test_the_document_has_the_table():
    """Of all options but those of its first table, which is in words for users."""
    for_users = "rtol atol max_it qp_type pc_type friction_type error_if_not_converged monitor"
    lines = ["| option | algorithm | default | effect |", "|---|---|---|---|"]
    for option in parameters_of(Options):
        about, default = option.description, option.default
        if option.name in (*for_users.split(), "converged_reason", "view"):
            continue
        known = (*about.choices, *(("a number", *about.words) if about.words else ()))
        values = " (" + ", ".join(known) + ")" if known else ""
        shown = str(default).lower() if isinstance(default, bool) else f"{default}"
        shown = shown if default != () else "none"
        name = f"`-tfeti_{option.name}`"
        lines.append(f"| {name} | {about.algorithm} | {shown} | {about.text}{values} |")
    table = "\n".join(lines)
    assert table in (ROOT / "docs/developers/options.md").read_text(), table


def test_options_of_factors_are_let_through_and_no_others():
    name, value = "coarse_pc_factor_fill", 2.0
    given = {f"tfeti_{name}": value, "rtol": 1e-3}
    assert parse_options(given, "tfeti_").rtol == 1e-3
    assert factor_options(given, "tfeti_") == {name: value}
    for wrong in ("sub_pc_type", "coarse_ksp_type", "sub_pc_factor_", "mat_type"):
        with pytest.raises(InputError, match=f"unknown option -tfeti_{wrong};"):
            parse_options({f"tfeti_{wrong}": "lu"}, "tfeti_")


def test_monitor_and_view_and_reason_print(capsys):
    d = decomposed("hexahedron", 2, 2)
    solved(problem(d, tfeti_monitor=True, tfeti_converged_reason=True, tfeti_view=True))
    out = capsys.readouterr().out
    words = ["|gP|", "|Qx|", "iterations", "TFETI solve CONVERGED_RTOL after"]
    words += ["-tfeti_rtol 1e-06", "primal_dofs"]
    assert [word in out for word in words] == [d.comm.rank == 0] * len(words)
    assert (out == "") == (d.comm.rank != 0)


def test_the_command_line_of_a_program(serial_only, tmp_path):
    """petsc4py.init before DOLFINx keeps the options; -log_view shows a stage per step."""
    path, environment = alone("cube_3d", tmp_path)
    command = [sys.executable, path, "--quick", "-tfeti_converged_reason", "-log_view"]
    said = process(command, tmp_path, environment)
    assert "TFETI solve CONVERGED_RTOL" in said
    for name in STAGES:
        assert f"tfeti: {name}" in said
    assert "unused database" not in said
