"""The ./run script, where DOLFINx is there already (the tests are inside such a place)."""

import subprocess
from importlib.metadata import distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def findable(serial_only):
    if not list(distributions(name="fenics-dolfinx")):
        pytest.skip("./run looks for fenics-dolfinx; here DOLFINx is of a wheel of another name")


def run(*arguments, **keywords):
    return subprocess.run(
        [ROOT / "run", *arguments], capture_output=True, text=True, timeout=100, **keywords
    )


def test_a_command_sees_dolfinx_and_this_checkout_and_its_exit_status_is_seen(findable, tmp_path):
    code = "import dolfinx, tfeti_dolfinx; print(tfeti_dolfinx.__file__)"
    result = run("python3", "-c", code, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert Path(result.stdout.strip()).parent == ROOT / "tfeti_dolfinx"
    assert run("false").returncode == 1
    assert run("python3", "-c", "raise SystemExit(7)").returncode == 7


def test_without_a_command_it_says_what_it_wants(serial_only):
    result = run()
    assert result.returncode == 1
    assert "usage: ./run CMD ARGS" in result.stderr


def test_one_list_of_packages():
    """The Dockerfile takes its packages from the lists of ./run."""
    dockerfile = (ROOT / "environment/Dockerfile").read_text()
    assert "environment/packages.txt environment/python.txt" in dockerfile
    assert "python3-dolfinx" not in dockerfile
    packages = (ROOT / "environment/packages.txt").read_text()
    assert "python3-dolfinx-real" in packages
