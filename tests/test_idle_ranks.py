"""More ranks than subdomains: nothing hangs, and nothing that is empty breaks."""

from test_ranks import run

# a rank without a subdomain has empty arrays everywhere, yet takes part in every collective call
OF_TWO_SUBDOMAINS = [
    "idle_ranks.py",
    "test_output.py",
    "test_gmsh.py::test_files_with_and_without_partitions",
    "test_gmsh.py::test_a_surface_between_partitions_is_tagged_on_both_sides",
    "test_unloading.py::test_a_body_at_rest_behind_an_open_gap_does_not_limit_that_either",
    "test_solvability.py::test_a_load_that_turns_is_looked_at_again_and_one_that_grows_is_not",
    "test_nonlinear.py::test_a_tangent_of_another_problem_is_named",
    "test_mistakes.py::test_mistakes_are_named[contacts shapes]",
    "test_mistakes.py::test_mistakes_are_named[conditions bcs]",
    "test_mistakes.py::test_mistakes_are_named[boundary solved]",
]


def test_ranks_without_a_subdomain(serial_only):
    """On three ranks, files of one kind of cells; a case that hangs ends all. A demo draws."""
    left = "not pictures and not cut and not tetrahedron"
    options = ("-m", "pytest", "--timeout=100", "-k", left)
    result = run(3, *options, *OF_TWO_SUBDOMAINS, limit=500)
    assert result.returncode == 0, result.stdout[-6000:] + result.stderr[-3000:]
