"""Mistakes in options."""

INF, NAN = float("inf"), float("nan")
RTOL = "expected 0 or more, less than 1"


def given(says, **options):
    """The problem with options, and what the message says."""
    return lambda s: s.options(**options), says


OPTIONS = {
    "a name with a letter too many": given(
        r"unknown option -tfeti_rtoll; expected -tfeti_rtol or .* perhaps", tfeti_rtoll=1e-6
    ),
    "a name like none": given(r"-tfeti_wibble; expected one of -tfeti_qp_type, ", wibble=1),
    "a solver of PETSc": given(
        r"unknown option -tfeti_ksp_type; expected -tfeti_qp_type, which chooses what solves the "
        r"dual problem: one of auto, pcpg, smalse, newton",
        ksp_type="cg",
    ),
    "a preconditioner of a subdomain": given(
        r"unknown option -tfeti_sub_pc_type; factors are always Cholesky's; "
        r"expected -tfeti_sub_pc_factor_mat_solver_type, which chooses the package",
        sub_pc_type="cholesky",
    ),
    "a misspelt option of the subdomains' factors": given(
        r"-tfeti_sub_pc_factor_mat_solver_typ: factors by \w+ read no such option; "
        r"expected -tfeti_sub_pc_factor_mat_solver_type",
        sub_pc_factor_mat_solver_typ="mumps",
    ),
    "an option of another package than makes the factors": given(
        r"-tfeti_sub_mat_mumps_icntl_14: factors by petsc read no such option; "
        r"expected -tfeti_sub_pc_factor_mat_solver_type mumps with it",
        sub_mat_mumps_icntl_14=80,
        sub_pc_factor_mat_solver_type="petsc",
    ),
    "rtol of infinity": given(rf"-tfeti_rtol inf: {RTOL}", tfeti_rtol=INF),
    "rtol that is text": given(
        r"-tfeti_rtol 'tight': expected a value of type float", tfeti_rtol="tight"
    ),
    "max_it of 2.7": given(r"-tfeti_max_it 2.7: expected a value of type int", tfeti_max_it=2.7),
    "an unknown solver": given(
        r"-tfeti_qp_type newt: expected one of auto, pcpg, smalse, newton", tfeti_qp_type="newt"
    ),
    "pcpg where there is contact": (
        lambda s: s.with_contacts(s.floor, tfeti_qp_type="pcpg"),
        r"-tfeti_qp_type pcpg: the scene has \d+ contact rows, which PCPG cannot keep",
    ),
    "an option twice": (
        lambda s: s.problem(petsc_options={"tfeti_rtol": 1e-6, "rtol": 1e-8}),
        r"petsc_options: -tfeti_rtol is there twice",
    ),
    "options in a list": (
        lambda s: s.problem(petsc_options=["-tfeti_rtol", "1e-8"]),
        r"petsc_options is \['-tfeti_rtol', '1e-8'\]; expected a dictionary",
    ),
    "no prefix": (
        lambda s: s.problem(petsc_options_prefix=""),
        r"petsc_options_prefix is ''; expected letters, digits and underscores, such as 'tfeti_'",
    ),
}

TABLES = ("OPTIONS",)
