"""More ranks than subdomains: nothing hangs, and nothing that is empty breaks."""

from test_ranks import run


def test_ranks_without_a_subdomain(serial_only):
    """The cases of idle_ranks.py, on three ranks; a case that hangs ends all of them."""
    result = run(3, "-m", "pytest", "--timeout=100", "idle_ranks.py", limit=500)
    assert result.returncode == 0, result.stdout[-6000:] + result.stderr[-3000:]
