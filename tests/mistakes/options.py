"""Mistakes in options."""

import numpy as np

INF, NAN = float("inf"), float("nan")
RTOL = "expected 0 or more, less than 1"


def given(says, **options):
    """The problem with options, and what the message says."""
    return lambda s: s.options(**options), says


OPTIONS = {
    "a name with a letter too many": given(
        r"unknown option -tfeti_rtoll; expected -tfeti_rtol or .* perhaps", tfeti_rtoll=1e-6
    ),
    "the name of another solver's option": given(
        r"unknown option -tfeti_ksp_rtol; expected -tfeti_rtol perhaps", ksp_rtol=1e-6
    ),
    "a name in capitals": given(r"unknown option -tfeti_RTOL; expected -tfeti_rtol", tfeti_RTOL=1),
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
    "a misspelt option of the coarse factor": given(
        r"-tfeti_coarse_pc_factor_fil: factors by .* read no such option; "
        r"expected -tfeti_coarse_pc_factor_fill",
        coarse_pc_factor_fil=2,
    ),
    "a misspelt option of the factors of faces": given(
        r"-tfeti_face_mat_mump_icntl_14: factors by .* read no such option; "
        r"expected -tfeti_face_mat_mumps_icntl_14",
        face_mat_mump_icntl_14=80,
    ),
    "an option of factors like none": given(
        r"-tfeti_sub_mat_wibble: .* expected -tfeti_sub_pc_factor_\.\.\. or", sub_mat_wibble=1
    ),
    "an option of another package than makes the factors": given(
        r"-tfeti_sub_mat_mumps_icntl_14: factors by petsc read no such option; "
        r"expected -tfeti_sub_pc_factor_mat_solver_type mumps with it",
        sub_mat_mumps_icntl_14=80,
        sub_pc_factor_mat_solver_type="petsc",
    ),
    "rtol of infinity": given(rf"-tfeti_rtol inf: {RTOL}", tfeti_rtol=INF),
    "rtol of infinity as text": given(rf"-tfeti_rtol inf: {RTOL}", tfeti_rtol="inf"),
    "rtol of nan": given(rf"-tfeti_rtol nan: {RTOL}", tfeti_rtol=NAN),
    "rtol of 10": given(rf"-tfeti_rtol 10.0: {RTOL}", tfeti_rtol=10),
    "rtol of 1": given(rf"-tfeti_rtol 1.0: {RTOL}", tfeti_rtol=1),
    "rtol below 0": given(rf"-tfeti_rtol -1.0: {RTOL}", tfeti_rtol=-1),
    "rtol that is text": given(
        r"-tfeti_rtol 'tight': expected a value of type float", tfeti_rtol="tight"
    ),
    "rtol with a comma": given(r"-tfeti_rtol '1,5': expected a value of type", tfeti_rtol="1,5"),
    "rtol that is None": given(r"-tfeti_rtol None: expected a value of type", tfeti_rtol=None),
    "rtol that is True": given(r"-tfeti_rtol True: expected a value of type", tfeti_rtol=True),
    "rtol that is a list": given(r"-tfeti_rtol \[.*: expected a value", tfeti_rtol=[1e-6]),
    "rtol that is complex": given(r"-tfeti_rtol .*: expected a value of", tfeti_rtol=1e-6 + 0j),
    "atol below 0": given(r"-tfeti_atol -1e-08: expected 0 or more", tfeti_atol=-1e-8),
    "atol of nan": given(r"-tfeti_atol nan: expected 0 or more", tfeti_atol=NAN),
    "max_it of 2.7": given(r"-tfeti_max_it 2.7: expected a value of type int", tfeti_max_it=2.7),
    "max_it of 2.7 as text": given(r"-tfeti_max_it '2.7': expected a value", tfeti_max_it="2.7"),
    "max_it below 0": given(r"-tfeti_max_it -1: expected 0 or more", tfeti_max_it=-1),
    "max_it of infinity": given(r"-tfeti_max_it inf: expected a value", tfeti_max_it=INF),
    "max_it of nan": given(r"-tfeti_max_it nan: expected a value", tfeti_max_it=np.float64(NAN)),
    "max_it that is True": given(r"-tfeti_max_it True: expected a value", tfeti_max_it=True),
    "norm_steps of 0": given(r"-tfeti_norm_steps 0: expected 1 or more", tfeti_norm_steps=0),
    "smalse_beta of 1": given(
        r"-tfeti_smalse_beta 1.0: expected between 0 and 1", tfeti_smalse_beta=1.0
    ),
    "smalse_M of nan": given(r"-tfeti_smalse_M nan: expected more than 0", tfeti_smalse_M=NAN),
    "smalse_rho of 0": given(r"-tfeti_smalse_rho 0.0: expected more than 0", smalse_rho=0),
    "smalse_eta below 0": given(r"-tfeti_smalse_eta -0.1: expected more", smalse_eta=-0.1),
    "mpgp_gamma of infinity": given(r"-tfeti_mpgp_gamma inf: expected more", mpgp_gamma=INF),
    "mpgp_alpha of 3": given(
        r"-tfeti_mpgp_alpha 3.0: expected more than 0, at most 2", tfeti_mpgp_alpha=3
    ),
    "an unknown solver": given(
        r"-tfeti_qp_type newt: expected one of auto, pcpg, smalse, newton", tfeti_qp_type="newt"
    ),
    "a solver in capitals": given(r"-tfeti_qp_type SMALSE: expected one", tfeti_qp_type="SMALSE"),
    "a solver that is None": given(r"-tfeti_qp_type None: expected a value", tfeti_qp_type=None),
    "a solver that is a number": given(r"-tfeti_qp_type 1: expected a value", tfeti_qp_type=1),
    "a preconditioner of PETSc": given(
        r"-tfeti_pc_type hypre: expected one of auto, none, lumped, dirichlet", pc_type="hypre"
    ),
    "an unknown scaling": given(r"-tfeti_scaling rho: expected one of stiff", scaling="rho"),
    "an unknown inverse": given(r"-tfeti_kplus_type lu: expected one of", kplus_type="lu"),
    "an unknown expansion": given(r"-tfeti_mpgp_expansion cg: expected", mpgp_expansion="cg"),
    "a switch that is perhaps": given(
        r"-tfeti_monitor 'maybe': expected a value of type bool", tfeti_monitor="maybe"
    ),
    "a switch of 2": given(r"-tfeti_monitor 2: expected a value of type bool", monitor=2),
    "a switch of nan": given(r"-tfeti_view nan: expected a value of type bool", view=NAN),
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
    "options in a text": (
        lambda s: s.problem(petsc_options="-tfeti_rtol 1e-8"),
        r"petsc_options is '-tfeti_rtol 1e-8'; expected a dictionary",
    ),
    "options in a set": (
        lambda s: s.problem(petsc_options={"tfeti_monitor"}),
        r"petsc_options is a set; expected a dictionary",
    ),
    "an option whose name is a number": (
        lambda s: s.problem(petsc_options={1: 2}),
        r"petsc_options: the key 1 is 1; expected the name of an option",
    ),
    "no prefix": (
        lambda s: s.problem(petsc_options_prefix=""),
        r"petsc_options_prefix is ''; expected letters, digits and underscores, such as 'tfeti_'",
    ),
    "a prefix with its dash": (
        lambda s: s.problem(petsc_options_prefix="-tfeti_"),
        r"petsc_options_prefix is '-tfeti_'; expected letters",
    ),
    "a prefix that is None": (
        lambda s: s.problem(petsc_options_prefix=None),
        r"petsc_options_prefix is None; expected letters",
    ),
    "a prefix that the options do not have": (
        lambda s: s.problem(petsc_options={"tfeti_rtol": 1e-6}, petsc_options_prefix="ring_"),
        r"unknown option -ring_tfeti_rtol; expected -ring_rtol",
    ),
}

TABLES = ("OPTIONS",)
