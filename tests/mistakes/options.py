"""Mistakes in options."""

INF = float("inf")
RTOL = "expected 0 or more, less than 1"


def given(**options):
    """The problem with options."""
    return lambda s: s.options(**options)


OPTIONS = {
    r"-tfeti_coarse_pc_factor_fil: factors by .* read no such option": given(
        coarse_pc_factor_fil=2
    ),
    r"unknown option -tfeti_rtoll; expected -tfeti_rtol perhaps": given(tfeti_rtoll=1e-6),
    r"-tfeti_kplus_type; expected one of -tfeti_qp_type, ": given(kplus_type="lu"),
    r"unknown option -tfeti_ksp_type; expected -tfeti_qp_type, which chooses what solves the "
    r"dual problem: one of auto, pcpg, smalse, newton": given(ksp_type="cg"),
    r"unknown option -tfeti_sub_pc_type; factors are always Cholesky's; "
    r"expected -tfeti_sub_pc_factor_mat_solver_type, which chooses the package": given(
        sub_pc_type="cholesky"
    ),
    r"-tfeti_sub_pc_factor_mat_solver_typ: factors by \w+ read no such option; "
    r"expected -tfeti_sub_pc_factor_mat_solver_type": given(sub_pc_factor_mat_solver_typ="mumps"),
    r"-tfeti_sub_mat_mumps_icntl_14: factors by petsc read no such option; "
    r"expected -tfeti_sub_pc_factor_mat_solver_type mumps with it": given(
        sub_mat_mumps_icntl_14=80, sub_pc_factor_mat_solver_type="petsc"
    ),
    r"-tfeti_monitor 'maybe': expected a value of type bool": given(monitor="maybe"),
    r"-tfeti_smalse_beta 1.0: expected between 0 and 1": given(smalse_beta=1.0),
    r"-tfeti_without care: expected some of d_scaling, smooth_": given(without="d_scaling,care"),
    r"-tfeti_mpgp_alpha 3.0: expected more than 0, at most 2": given(mpgp_alpha=3),
    rf"-tfeti_rtol -1.0: {RTOL}": given(tfeti_rtol=-1),
    rf"-tfeti_rtol inf: {RTOL}": given(tfeti_rtol=INF),
    r"-tfeti_rtol 'tight': expected a value of type float": given(tfeti_rtol="tight"),
    r"-tfeti_max_it 2.7: expected a value of type int": given(tfeti_max_it=2.7),
    r"-tfeti_qp_type newt: expected one of auto, pcpg, smalse, newton": given(tfeti_qp_type="newt"),
    r"-tfeti_qp_type pcpg: the model has \d+ contact constraints, which PCPG": lambda s: (
        s.with_contacts(s.floor, tfeti_qp_type="pcpg")
    ),
    r"petsc_options: -tfeti_rtol is there twice": lambda s: s.problem(
        petsc_options={"tfeti_rtol": 1e-6, "rtol": 1e-8}
    ),
    r"petsc_options is \['-tfeti_rtol', '1e-8'\]; expected a dictionary": lambda s: s.problem(
        petsc_options=["-tfeti_rtol", "1e-8"]
    ),
    r"petsc_options_prefix is ''; expected letters, digits and underscores, such as": lambda s: (
        s.problem(petsc_options_prefix="")
    ),
}

TABLES = ("OPTIONS",)
