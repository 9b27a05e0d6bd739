"""Benchmarks run at tiny sizes, and write what they return."""

import json

import numpy as np

from benchmarks import contact_assembly, kplus_forms, talk_tables


def written(folder, name, comm):
    comm.barrier()
    assert (folder / f"{name}.md").read_text().startswith("## ")
    return json.loads((folder / f"{name}.json").read_text())


def test_talk_tables(shared_tmp, comm):
    tables = talk_tables.main(["--quick", "--rtol", "1e-4", "--output", str(shared_tmp)])
    assert set(tables) == {"Hertz 2D", "Frictionless 3D"}
    for table in tables.values():
        (row,) = table
        assert row["rtol"] == "1e-04"
        assert row["kernel"] == row["kernel, talk"]
        assert row["multiplications"] > 0
    assert written(shared_tmp, "talk_tables", comm).keys() == tables.keys()


def test_contact_assembly(shared_tmp, comm):
    tables = contact_assembly.main(["--cells", "4", "--output", str(shared_tmp)])
    for cell, per_square in (("hexahedron", 1), ("tetrahedron", 2)):
        rows = tables[f"Contact and assembly, {cell}"]
        squares = np.array([4**2 + 5**2, 8**2 + 10**2, 16**2 + 20**2])
        assert [row["facets"] for row in rows] == (per_square * squares).tolist()
        assert [row["conditions"] for row in rows] == [6**2, 11**2, 21**2]
    assert written(shared_tmp, "contact_assembly", comm).keys() == tables.keys()


def test_kplus_forms(shared_tmp, comm):
    """A bad choice of fixing nodes makes what is factored worse, and no choice makes K⁺ wrong."""
    tables = kplus_forms.main(["--quick", "--output", str(shared_tmp)])
    for rows in tables.values():
        condition = {
            (row["K⁺"], row["fixing nodes"]): row["condition of the factor"] for row in rows
        }
        for kind in ("regularized", "schur"):
            assert condition[kind, "a cell in a corner"] >= 5 * condition[kind, "spread"]
        for row in rows:
            assert row["error of a deformation"] <= 1e-10
            assert row["error of K K⁺ K"] <= 1e-10
    assert written(shared_tmp, "kplus_forms", comm).keys() == tables.keys()
    assert (shared_tmp / "kplus_forms.png").is_file()
