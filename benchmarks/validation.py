"""Published cases: reference, got, difference, mesh and multiplications of each.

    ./run python3 -m benchmarks.validation [--quick] [--only CASE ...]

Lengths in mm, forces in N, unless a case says otherwise.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from math import log, pi, sqrt
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.elastic import Elastic, gathered
from benchmarks.pressures import LineContact, PointContact, fit
from benchmarks.tools import Tables, command_line, finish, say
from demos import run
from demos import scene as scene_of
from meshes import blocks, cylinder_on_block
from meshes.rings import lame_pressure, rings
from meshes.tools import graded_size, started_model, torn
from tfeti_dolfinx.common.parallel import largest

COMM = MPI.COMM_WORLD
# sizes of elements, over those of the quick run
FINE = 0.4
COUNTS = ("F_multiplications", "preconditioner_multiplications")
Row = dict[str, Any]


def figure(
    case: str,
    quantity: str,
    reference: float,
    got: float,
    allowed: float | None,
    report: tfeti.Report,
    multiplications: int | None = None,
) -> Row:
    """A row: a published figure, or that of a closed form, and ours.

    Relative differences, but of an error, whose reference is 0, itself; ``allowed`` by the source,
    None where a figure is for information. Multiplications are those of all solves by default.
    """
    difference = (got - reference) / (abs(reference) or 1.0)
    return {
        "case": case,
        "quantity": quantity,
        "reference": f"{reference:.5g}",
        "got": f"{got:.5g}",
        "difference": f"{100 * difference:+.2f} %",
        "allowed": None if allowed is None else f"{100 * allowed:g} %",
        "unknowns": report.primal_dofs,
        "F + S": multiplications or work(report),
    }


def work(report: tfeti.Report) -> int:
    """Multiplications of all solves of a problem."""
    return sum(int(report.in_all[name]) for name in COUNTS)


# --- Meshes and forms -------------------------------------------------------------------------


def quarter_disc(radius: float, fine: float, fine_radius: float) -> Any:
    """Half of a half disc, r ≥ 0, whose lowest point is the origin: "arc", "top", "axis"."""
    model = started_model("quarter_disc")
    geo = model.geo
    lowest, centre, right = (geo.addPoint(*x, 0.0) for x in ((0, 0), (0, radius), (radius, radius)))
    arc, top = geo.addCircleArc(lowest, centre, right), geo.addLine(right, centre)
    axis = geo.addLine(centre, lowest)
    body = geo.addPlaneSurface([geo.addCurveLoop([arc, top, axis])])
    geo.synchronize()
    model.addPhysicalGroup(2, [body], name="ball")
    for name, curve in (("arc", arc), ("top", top), ("axis", axis)):
        model.addPhysicalGroup(1, [curve], name=name)
    graded_size((0.0, 0.0, 0.0), fine, fine_radius, 0.2)
    model.mesh.generate(2)
    return model


def rectangle(
    low: tuple[float, float], high: tuple[float, float], cells: tuple[int, int]
) -> tfeti.Decomposition:
    """A rectangle of quadrilaterals: "bottom", "right", "top", "left"."""
    mesh = dmesh.create_rectangle(COMM, (low, high), cells, dmesh.CellType.quadrilateral)
    at = {"bottom": (1, low[1]), "right": (0, high[0]), "top": (1, high[1]), "left": (0, low[0])}
    sides = {name: lambda x, k=k, c=c: np.isclose(x[k], c) for name, (k, c) in at.items()}
    return tfeti.decompose(mesh, 4, surfaces=sides)


def pin_in_sheet(size: float) -> Any:
    """The upper half of NAFEMS' loaded pin: "pin side", "bore", "clamp".

    The surfaces on the plane of symmetry are "middle", the bodies "pin" and "sheet".
    """
    R, outer, length = 50.0, 100.0, 200.0
    model = started_model("pin_in_sheet")
    geo = model.geo
    centre = geo.addPoint(0.0, 0.0, 0.0)

    def half_circle() -> tuple[list[int], list[int]]:
        ends = [geo.addPoint(x, y, 0.0) for x, y in ((R, 0.0), (0.0, R), (-R, 0.0))]
        return ends, [geo.addCircleArc(ends[k], centre, ends[k + 1]) for k in (0, 1)]

    ends, arcs = half_circle()
    middle = [geo.addLine(ends[2], centre), geo.addLine(centre, ends[0])]
    pin = geo.addPlaneSurface([geo.addCurveLoop([*arcs, *middle])])
    ends, bore = half_circle()
    places = (outer, 0.0), (0.0, outer), (-length, outer), (-length, 0.0)
    tip, top, *corners = (geo.addPoint(x, y, 0.0) for x, y in places)
    sides = [geo.addLine(ends[0], tip), geo.addCircleArc(tip, centre, top)]
    sides += [geo.addLine(top, corners[0]), geo.addLine(*corners), geo.addLine(corners[1], ends[2])]
    sheet = geo.addPlaneSurface([geo.addCurveLoop([*sides, -bore[1], -bore[0]])])
    for curves, share in ((arcs, 1.0), (bore, 0.8)):
        for curve in curves:
            count = round(np.pi / 2 * R / (share * size)) + 1
            geo.mesh.setTransfiniteCurve(curve, count)
    geo.synchronize()
    model.mesh.setSize(model.getEntities(0), 3.0 * size)
    for name, body in (("pin", pin), ("sheet", sheet)):
        model.addPhysicalGroup(2, [body], name=name)
    surfaces = {"pin side": arcs, "bore": bore, "clamp": [sides[3]]}
    surfaces["middle"] = [*middle, sides[0], sides[4]]
    for name, tags in surfaces.items():
        model.addPhysicalGroup(1, tags, name=name)
    model.mesh.generate(2)
    return model


def point_contact(
    case: str,
    mesh: tuple[float, float],
    ball: tuple[float, float, float, float],
    partner: tuple[Any, float],
    published: tuple[float, float, float | None],
) -> tuple[list[Row], tfeti.ContactProblem]:
    """a and p₀ of half a ball on an obstacle, beside Hertz's for the computed force. Collective.

    Args:
        case: Its name.
        mesh: Size of elements, and how far from the origin.
        ball: R, E, ν, and how far its top goes down.
        partner: The obstacle's shape, and Hertz's R, 1/R = 1/R₁ + 1/R₂.
        published: a, p₀, and what the source allows.
    """
    R, E, nu, down = ball
    d = torn(COMM, lambda: quarter_disc(R, *mesh), subdomains=8)
    scene = Elastic(d, E, nu, "axisymmetric")
    scene.hold("axis", 0)
    scene.hold("top", 1, -down)
    problem = scene.problem([tfeti.Obstacle("arc", partner[0], reach=4 * down)])
    problem.solve()
    data = problem.solution.contact()
    force = abs(data.resultant.force[1])
    hertz = PointContact.from_load(force, partner[1], E / (1 - nu**2))
    found = fit(COMM, data.points[:, 0], data.pressure, hertz.peak)
    own, names = (hertz.half_width, hertz.peak), ("a", "p₀")
    rows = [
        figure(case, f"{name} of the force, Hertz", expected, got, 0.01, problem.report)
        for name, expected, got in zip(names, own, found, strict=True)
    ]
    for name, expected, got in zip(names, published, found, strict=False):
        rows.append(figure(case, f"{name}, published", expected, got, published[2], problem.report))
    return rows, problem


# --- Cases ------------------------------------------------------------------------------------


def hemispheres(scale: float) -> Iterator[Row]:
    """Two equal hemispheres pressed together: one of them against the plane between them."""
    for approach, peak, radius in ((2.0, 1978.7, 7.071), (4.0, 2798.3, 10.0)):
        case = f"SSNV104, two hemispheres, approach {approach:g}"
        mesh, ball = (scale * 0.6, 1.5 * radius), (50.0, 2e4, 0.3, approach / 2)
        plane = tfeti.Plane((0, 0), normal=(0, 1))
        yield from point_contact(case, mesh, ball, (plane, 50.0), (radius, peak, 0.15))[0]


def steel_on_aluminium(scale: float) -> Iterator[Row]:
    """A steel cylinder on a block of aluminium, plane strain."""
    R, P, nu = 50.0, 35e3, 0.3
    young = {"cylinder": 2.1e5, "block": 7e4}
    hertz = LineContact.from_load(P, R, 1 / sum((1 - nu**2) / E for E in young.values()))
    sizes = {"fine": scale * hertz.half_width / 8, "fine_radius": 1.5 * hertz.half_width}
    d = torn(COMM, lambda: cylinder_on_block.build(R, **sizes, growth=0.2), 8)
    scene = Elastic(d, young, nu, "plane_strain")
    scene.hold("axis", 0)
    scene.hold("bottom", 1)
    scene.load("load", scene.constant(0.0, -P / (2 * R)))
    problem = scene.problem([tfeti.Contact("arc", "top")])
    problem.solve()
    data = problem.solution.contact()
    a, p0 = fit(COMM, data.points[:, 0], data.pressure, hertz.peak)
    case = "NAFEMS B1 (SSNP154), cylinder on block"
    yield figure(case, "p₀", 3585.4, p0, 0.01, problem.report)
    yield figure(case, "a", 6.21, a, 0.01, problem.report)


def sliding_wedge(scale: float) -> Iterator[Row]:
    """A block on a slope, pushed up by the largest force at which friction holds it."""
    slope, weight = 0.1, 1.0
    d = rectangle((0.0, 0.0), (4.0, 2.0), (8, 4))
    c, s = 1 / sqrt(1 + slope**2), slope / sqrt(1 + slope**2)
    d.mesh.geometry.x[:, :2] = d.mesh.geometry.x[:, :2] @ np.array([[c, s], [-s, c]])
    for mu, published in ((0.1, 0.2020), (0.2, 0.3061), (0.3, 0.41237)):
        scene, area = Elastic(d, 1e3, 0.3, "plane_strain"), 8.0
        push = scene.constant(0.0, -weight / area)
        scene.L = ufl.dot(push, scene.v) * ufl.dx(domain=d.mesh)
        plane = tfeti.Plane((0, 0), normal=(-s, c))
        floor = tfeti.Obstacle("bottom", plane, friction=tfeti.Coulomb(mu))
        low, high, total = 0.0, 1.0, 0
        while high - low > 1e-5:
            force = 0.5 * (low + high)
            push.value = (force / area, -weight / area)
            problem = scene.problem([floor])
            try:
                problem.solve()
            except tfeti.NoSolutionError:  # it slides
                high = force
            else:
                low = force
            total += work(problem.report)
        case = "NAFEMS CGS-4, sliding wedge"
        yield figure(
            case, f"F/G, μ = {mu:g}", published, low / weight, 0.002, problem.report, total
        )


def concentric_rings(scale: float) -> Iterator[Row]:
    """Rings that touch, under a pressure from outside, plane stress (m, N)."""
    E, nu, p, (R1, R2, R3) = 1e9, 0.2, 1e6, (1.0, 0.6, 0.2)
    published = 9.2593e5
    n = round(40 / scale)
    d = rings(COMM, (n, n + n // 3), order=2, radii=(R3, R2, R1), subdomains=8)
    scene = Elastic(d, E, nu, "plane_stress", degree=2)
    scene.load("rim", -p * ufl.FacetNormal(d.mesh))
    problem = scene.problem([tfeti.Contact("shaft", "hub", gap=0.0)])
    problem.solve()
    data = problem.solution.contact()
    powers = np.array([data.pressure, (data.pressure - published) ** 2, np.ones_like(data.area)])
    total, squares, area = COMM.allreduce(powers @ data.area)
    case = "SSNP152, concentric rings"
    yield figure(case, "mean pressure", published, total / area, 0.007, problem.report)
    error = sqrt(squares / area) / published
    yield figure(case, "relative L² error of the pressure", 0.0, error, 0.007, problem.report)


def patches(scale: float) -> Iterator[Row]:
    """Two blocks that do not match, ν = 0."""
    for gdim, E, down, pressure in ((2, 2e6, -0.1, 1e5), (3, 2e5, -0.2, 1e4)):
        depth, height, n = (1.0, 1.0, 1) if gdim == 2 else (2.0, 2.0, 4)
        size = (2.0, depth, height)
        lower = blocks.Block("lower", (0, 0, 0), size, (5, n, 3))
        upper = blocks.Block("upper", (0, 0, height), size, (7, max(n - 1, 1), 4))
        d = torn(COMM, partial(blocks.build, [lower, upper]), 4)
        scene = Elastic(d, E, 0.0, "3d")
        for surface in ("lower bottom", "upper top"):  # nothing moves across, since ν = 0
            scene.hold(surface, 0)
            scene.hold(surface, 1)
        scene.hold("lower bottom", 2)
        scene.hold("upper top", 2, down)
        problem = scene.problem([tfeti.Contact("upper bottom", "lower top")], rtol=1e-10)
        problem.solve()
        data = problem.solution.contact()
        worst = largest(COMM, data.pressure - pressure)
        case = f"{'SSNP121' if gdim == 2 else 'SSNV167'}, patch test"
        yield figure(case, "pressure, worst node", pressure, pressure + worst, 1e-6, problem.report)


def rigid_sphere(scale: float) -> Iterator[Row]:
    """An elastic ball on a rigid one of the same radius."""
    case, R = "MOOSE, rigid sphere", 2.0
    mesh, ball = (scale * 0.01, 0.15), (R, 1.40625e7, 0.25, 0.01)
    rigid = tfeti.Sphere((0.0, -R), R)
    rows, problem = point_contact(case, mesh, ball, (rigid, R / 2), (0.1, 9.55e5, None))
    yield from rows
    force = abs(problem.solution.contact().resultant.force[1])
    yield figure(case, "F, published", 2.0e4, force, None, problem.report)


def press_fit(scale: float) -> Iterator[Row]:
    """A ring shrunk on another one, plane strain, beside Lamé's pressure."""
    n, overlap = round(40 / scale), 1e-3
    d = rings(COMM, (n, n + n // 3), overlap=overlap)
    scene = Elastic(d, 1.0, 0.3, "plane_strain")
    problem = scene.problem([tfeti.Contact("shaft", "hub", gap=-overlap)])
    problem.solve()
    data = problem.solution.contact()
    total, area = COMM.allreduce(np.array([data.area @ data.pressure, data.area.sum()]))
    lame, case = lame_pressure(overlap), "press fit (Lamé)"
    yield figure(case, "mean pressure", lame, total / area, 0.01, problem.report)


def loaded_pin(scale: float) -> Iterator[Row]:
    """A pin drawn by a sheet that it fits, plane stress, friction: beside a finer mesh.

    The contact recedes from the whole bore to the side that is pressed. At 0°, where friction turns
    round, the pressure has a peak that meshes show more and more of.
    """
    R, mu, line_load, found = 50.0, 0.1, 100e3 / 10.0, list[dict[str, float]]()
    for size in (1.5 * scale, 3.0 * scale):
        d = torn(COMM, partial(pin_in_sheet, size), 8, order=2)
        scene = Elastic(d, {"pin": 2.1e5, "sheet": 7e4}, 0.3, "plane_stress", degree=2)
        for surface, axis in (("middle", 1), ("clamp", 0), ("clamp", 1)):
            scene.hold(surface, axis)
        dx = ufl.Measure("dx", domain=d.mesh, subdomain_data=d.cell_tags)(d.volume("pin"))
        push = scene.constant(line_load / (pi * R**2), 0.0)
        scene.L = ufl.dot(push, scene.v) * dx
        contact = tfeti.Contact("pin side", "bore", gap=0.0, friction=tfeti.Coulomb(mu))
        problem = scene.problem([contact])
        problem.solve()
        data = problem.solution.contact()
        own = np.degrees(np.arctan2(data.points[:, 1], data.points[:, 0]))
        slip = np.linalg.norm(data.tangential_traction.reshape(len(own), -1), axis=1)
        angle, pressure, slip = gathered(own, data.pressure, slip)
        order = np.argsort(angle)
        angle, pressure, slip = angle[order], pressure[order], slip[order]
        figures = {f"pressure at {at}°": np.interp(at, angle, pressure) for at in (0, 30, 60)}
        figures["largest pressure"] = pressure.max()
        figures["tangential stress at 30°"] = np.interp(30, angle, slip)
        falling = slice(int(pressure.argmax()), None)
        tenth = np.interp(-0.1 * pressure.max(), -pressure[falling], angle[falling])
        figures["angle where a tenth of it is left"] = tenth
        found.append({name: float(value) for name, value in figures.items()})
    for name, got in found[1].items():
        case = "NAFEMS B4 (SSNP156), loaded pin"
        allowed = None if name == "pressure at 0°" else 0.01
        finer = found[0][name]
        yield figure(case, f"{name}, finer mesh", finer, got, allowed, problem.report)


def bar_on_wall(scale: float) -> Iterator[Row]:
    """A bar with ν = 0 hits a rigid wall (m, s, N)."""
    words = ["--impact", "wall", "--poisson", 0.0, "--cells", round(40 / scale)]
    _, report = run("impact_of_bars", words)
    found = {name.removeprefix("wall_"): value for name, value in report.errors.items()}
    begin = 2e-5 * (1 + found["begin"])
    figures = {
        "begin of contact": (2e-5, begin),
        "end of contact": (1e-4, begin + 8e-5 * (1 + found["duration"])),
        "stress": (4e9, 4e9 * (1 + found["pressure"])),
        "velocity afterwards": (100.0, 100.0 * (1 + found["velocity"])),
    }
    for quantity, values in figures.items():
        yield figure("SDNV100, bar on a rigid wall", quantity, *values, 0.05, report)


def plastic_indentation(scale: float) -> Iterator[Row]:
    """A rigid sphere pressed into a perfectly plastic block, axisymmetric; force per radian."""
    figures = {  # by the depth: slip lines, Code_Aster, what it allows
        20.0: (2.038e6, 2.068e6, 0.05),
        40.0: (4.076e6, 4.047e6, 0.05),
        60.0: (6.114e6, 5.827e6, 0.05),
        80.0: (8.152e6, 7.666e6, 0.1),
        100.0: (1.019e7, 9.119e6, 0.15),
    }
    words = ["--size", scale * 20.0, "--near", 360.0]
    made = scene_of("plastic_indentation_2d", words, "NonlinearContactProblem")
    problem = tfeti.NonlinearContactProblem(**made)
    case, step = "SSNV506, plastic indentation", 5.0 * scale
    for depth in np.arange(step, max(figures) + 0.5 * step, step):
        problem.time = depth
        problem.solve()
        problem.accept()
        if depth in figures:
            slip, other, allowed = figures[depth]
            force = abs(problem.solution.contact().resultant.force[1]) / (2 * pi)
            at = f"force at {depth:.0f}"
            yield figure(case, f"{at}, slip lines", slip, force, allowed, problem.report)
            yield figure(case, f"{at}, Code_Aster", other, force, None, problem.report)


def thick_cylinder(scale: float) -> Iterator[Row]:
    """A thick cylinder, perfectly plastic, to its limit load; plane strain."""
    Ri, Ro, E, nu, strength = 1.0, 1.3, 7e4, 0.3, 250.0
    n = round(12 / scale)
    d = rectangle((Ri, 0.0), (Ro, 0.1), (n, max(n // 3, 1)))
    scene = Elastic(d, E, nu, "axisymmetric", degree=2)
    out = scene.hold("left", 0)
    for side in ("bottom", "top"):
        scene.hold(side, 1)
    steel, problem = scene.plastic([], 1e-8, yield_stress=strength)
    inner = scene.dofs("left", 0)
    residual = fem.form(steel.residual(scene.v))
    for value in np.linspace(0.001, 0.02, 20):
        out.value = value
        problem.solve()
        problem.accept()
    reaction = fem.assemble_vector(residual).array[inner]
    owned = inner < scene.V.dofmap.index_map.size_local * scene.V.dofmap.index_map_bs
    force = COMM.allreduce(float(np.sum(reaction[owned])))
    pressure = force / (2 * pi * Ri * 0.1)
    limit = 2 / sqrt(3) * strength * log(Ro / Ri)
    case = "thick cylinder to collapse"
    yield figure(case, "limit pressure", limit, pressure, 0.01, problem.report)


def taylor_bar(scale: float) -> Iterator[Row]:
    """A copper bar hits a rigid wall: finite plasticity with inertia, axisymmetric (mm, s, N, t).

    The published case begins 10 µs before the bar touches, ours when it does. Its references have
    no friction, which the computation with Code_Aster has (0.25, by a penalty).
    """
    radius, length, speed, flight = 3.2, 32.4, 227e3, 2.27
    E, nu, density, strength, tangent = 117e3, 0.35, 8.93e-9, 400.0, 100.0
    n, steps = round(3 / scale), round(40 / scale)
    figures = {  # by the friction: whose, radius of the foot, displacement of the head, allowed
        0.0: ("published", 3.87, 13.46, 0.1),
        0.25: ("friction 0.25, Code_Aster", 2.912, 12.692, 0.1),
    }
    for mu, (whose, wider, shorter, allowed) in figures.items():
        if mu and scale == 1.0:
            continue
        d = rectangle((0.0, 0.0), (radius, length), (n, 5 * n))
        scene = Elastic(d, E, nu, "axisymmetric")
        scene.hold("left", 0)
        u, velocity = fem.Function(scene.V), fem.Function(scene.V)
        velocity.interpolate(lambda x: np.stack((0 * x[0], np.full_like(x[0], -speed))))
        hardening = E * tangent / (E - tangent)
        copper = tfeti.FiniteJ2Plasticity(
            scene.elastic, u, yield_stress=strength, hardening=hardening, selective=True
        )
        plane = tfeti.Plane((0.0, 0.0), normal=(0.0, 1.0))
        wall = tfeti.Obstacle("bottom", plane, friction=tfeti.Coulomb(mu) if mu else None)
        given = {"velocity": velocity, "mass": density, "stabilised": True, "finite": True}
        given |= {"thickness": scene.elastic.thickness, "petsc_options": {"rtol": 1e-4}}
        residual = copper.residual(scene.v)
        problem = tfeti.NonlinearContactDynamics(residual, u, scene.bcs, [wall], d, **given)
        times = np.linspace(0.0, 8e-5, steps + 1)[1:]
        tfeti.LoadSteps(problem, lambda problem, t: None, times).run()
        values = u.x.array.reshape(-1, 2)
        foot = COMM.allreduce(float(values[:, 0].max(initial=0.0)), op=MPI.MAX)
        head = COMM.allreduce(float(values[:, 1].min(initial=0.0)), op=MPI.MIN)
        case, report = "SDNV103, Taylor bar", problem.report
        yield figure(case, f"growth of the foot, {whose}", wider, foot, allowed, report)
        yield figure(case, f"way of the head, {whose}", shorter, flight - head, allowed, report)


CASES: dict[str, Callable[[float], Iterator[Row]]] = {
    "hemispheres": hemispheres,
    "cylinder_on_block": steel_on_aluminium,
    "sliding_wedge": sliding_wedge,
    "bar_on_wall": bar_on_wall,
    "concentric_rings": concentric_rings,
    "patches": patches,
    "loaded_pin": loaded_pin,
    "rigid_sphere": rigid_sphere,
    "press_fit": press_fit,
    "plastic_indentation": plastic_indentation,
    "thick_cylinder": thick_cylinder,
    "taylor_bar": taylor_bar,
}
LONG = ("hemispheres", "bar_on_wall", "rigid_sphere", "plastic_indentation")
QUICK = tuple(name for name in CASES if name not in LONG)


def main(argv: list[str]) -> Tables:
    """Run the cases; returns their table."""
    arguments, _ = command_line(__doc__, argv, only=CASES)
    scale = 1.0 if arguments.quick else FINE
    rows = []
    for name in arguments.only or (QUICK if arguments.quick else tuple(CASES)):
        for row in CASES[name](scale):
            rows.append(row)
            say(row)
    return finish(arguments, "validation", {"Published cases": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
