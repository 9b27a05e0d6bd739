"""More ranks than subdomains: nothing hangs, and nothing that is empty breaks."""

import pytest
from test_ranks import run

CASES = ["-k=not demos", "-k=demos", pytest.param("-m=slow", marks=pytest.mark.slow)]


@pytest.mark.parametrize("cases", CASES)
def test_ranks_without_a_subdomain(serial_only, cases):
    """The cases of idle_ranks.py, on three ranks; a case that hangs ends all of them."""
    result = run(3, "-m", "pytest", "--timeout=100", cases, "idle_ranks.py", limit=500)
    assert result.returncode == 0, result.stdout[-6000:] + result.stderr[-3000:]
