"""Run an example at its quick size, and write its deformed surface for a page's view in 3D.

    ./run python3 docs/view.py NAME OUT.js

Colours are von Mises' stress, as in pictures; `docs/static/view.js` draws it.
"""

import sys
from base64 import b64encode
from pathlib import Path

import numpy as np
from matplotlib import colormaps

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import demos

FACTOR = {"ball_bearing_3d": 25.0}  # of the displacement, where it does not show else


def main(name: str, target: str) -> None:
    """Write the call of the viewer: corners of triangles from -1 to 1, and their colours."""
    solution, _ = demos.run(name, ["--quick"])
    grid = solution.to_pyvista().warp_by_vector("displacement", factor=FACTOR.get(name, 1.0))
    surface = grid.extract_surface().triangulate()
    x = np.asarray(surface.points) - surface.center
    if name == "ball_bearing_3d":  # its cut is on the other side
        x[:, :2] *= -1.0
    stress = np.asarray(surface["von_mises"])
    share = stress / max(float(np.quantile(stress, 0.995)), 1e-300)
    corners = np.round(32767.0 * x / np.abs(x).max()).astype("<i2")
    colours = (255.0 * colormaps["YlGnBu"](np.clip(share, 0.0, 1.0))[:, :3]).astype("u1")
    faces = surface.faces.reshape(-1, 4)[:, 1:].astype("<u4")
    data = ", ".join(f'"{b64encode(part).decode()}"' for part in (corners, colours, faces))
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text(f"view({data});\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
