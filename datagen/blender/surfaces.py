"""Materials of the table top. Coordinates are metres in the table's own frame."""

from collections.abc import Callable

import bpy
import numpy as np

from datagen.blender.nodes import Graph, Input, new_material, surface
from datagen.scene import Table

__all__ = ["table_material"]


def table_material(table: Table) -> bpy.types.Material:
    """The procedural material of `table`; different seeds show different pieces of it."""
    makers: dict[str, Callable[[Graph, Table, Input], None]] = {
        "wood": _wood,
        "stone": _stone,
        "cloth": _cloth,
        "laminate": _laminate,
    }
    material, graph = new_material(f"table {table.material}")
    coordinates = graph.node("ShaderNodeTexCoord", {}).outputs["Object"]
    shift = np.random.default_rng(table.pattern_seed).uniform(-50.0, 50.0, 3)
    shifted = graph.vector("ADD", coordinates, tuple(shift))
    where = graph.vector("MULTIPLY", shifted, (1.0 / table.pattern_scale,) * 3)
    makers[table.material](graph, table, where)
    return material


def _wood(graph: Graph, table: Table, where: Input) -> None:
    """Planks along x, 0.14 m wide and about 1 m long, each cut from another place of the tree."""
    x, y, z = graph.separate(where)
    row = graph.math("FLOOR", graph.math("DIVIDE", y, 0.14))
    row_random = graph.node("ShaderNodeTexWhiteNoise", {"W": row}, noise_dimensions="1D").outputs["Value"]
    along = graph.math("ADD", x, graph.math("MULTIPLY", row_random, 7.3))
    piece = graph.math("FLOOR", graph.math("DIVIDE", along, 1.1))
    plank = graph.combine(row, piece, 0.0)
    plank_random = graph.node("ShaderNodeTexWhiteNoise", {"Vector": plank}, noise_dimensions="2D").outputs["Value"]
    offset = graph.math("MULTIPLY", plank_random, 31.0)

    # Year rings: distance to a far trunk axis, distorted; stretched along the plank.
    stretched = graph.combine(graph.math("MULTIPLY", along, 0.9), graph.math("ADD", y, offset), z)
    warp = graph.noise(graph.vector("MULTIPLY", stretched, (1.6, 9.0, 9.0)), 1.0, detail=3.0)
    ring_phase = graph.math("ADD", graph.math("MULTIPLY", graph.math("ADD", y, offset), 95.0), graph.math("MULTIPLY", warp, 26.0))
    rings = graph.math("ADD", 0.5, graph.math("MULTIPLY", 0.5, graph.math("SINE", ring_phase)))
    fibres = graph.noise(graph.vector("MULTIPLY", stretched, (9.0, 620.0, 620.0)), 1.0, detail=3.0, roughness=0.65)
    vessels = graph.remap(graph.noise(graph.vector("MULTIPLY", stretched, (28.0, 900.0, 900.0)), 1.0), 0.62, 0.74, 0.0, 1.0)

    tone = graph.math("ADD", graph.math("MULTIPLY", graph.math("POWER", rings, 1.6), 0.42), graph.math("MULTIPLY", fibres, 0.62))
    tone = graph.math("ADD", tone, graph.remap(plank_random, 0.0, 1.0, -0.30, 0.16), clamp=True)
    color = graph.mix(tone, table.color_a_rgb, table.color_b_rgb)
    color = graph.mix(graph.math("MULTIPLY", vessels, 0.35), color, (0.25, 0.16, 0.10), blend="MULTIPLY")

    gap = graph.math("MINIMUM", _gap(graph, y, 0.14), _gap(graph, along, 1.1))
    color = graph.mix(gap, (0.012, 0.008, 0.006), color)
    smudge = graph.noise(where, 9.0, detail=4.0, roughness=0.6)
    roughness = graph.math("ADD", table.roughness, graph.remap(smudge, 0.3, 0.7, -0.07, 0.10))
    roughness = graph.math("ADD", roughness, graph.math("MULTIPLY", fibres, 0.10), clamp=True)
    relief = graph.math("ADD", graph.math("MULTIPLY", fibres, 0.00006), graph.math("MULTIPLY", vessels, -0.00005))
    relief = graph.math("ADD", relief, graph.math("MULTIPLY", gap, 0.0006))
    surface(graph, {"Base Color": color, "Roughness": roughness, "Normal": graph.bump(relief, 0.8)})


def _gap(graph: Graph, position: Input, period_m: float) -> bpy.types.NodeSocket:
    """0 in a joint about 1 mm wide at every multiple of the period, 1 elsewhere."""
    phase = graph.math("FRACT", graph.math("DIVIDE", position, period_m))
    edge = graph.math("MINIMUM", phase, graph.math("SUBTRACT", 1.0, phase))
    return graph.remap(edge, 0.0002 / period_m, 0.0009 / period_m, 0.0, 1.0)


def _stone(graph: Graph, table: Table, where: Input) -> None:
    """Polished marble: warped veins of two sizes over cloudy ground, with fine grain."""
    offset = graph.node("ShaderNodeTexNoise", {"Vector": where, "Scale": 3.0, "Detail": 4.0}).outputs["Color"]
    warped = graph.vector("ADD", where, graph.vector("MULTIPLY", offset, (0.35, 0.35, 0.35)))
    large = _vein(graph, graph.noise(warped, 3.2, detail=5.0, roughness=0.55), 0.030)
    small = _vein(graph, graph.noise(warped, 11.0, detail=4.0, roughness=0.6), 0.020)
    clouds = graph.noise(warped, 4.0, detail=5.0, roughness=0.65)
    speckle = graph.noise(where, 420.0, detail=2.0, roughness=0.7)
    vein = graph.math("ADD", graph.math("MULTIPLY", large, 0.8), graph.math("MULTIPLY", small, 0.3))
    shade = graph.math("ADD", vein, graph.remap(clouds, 0.3, 0.75, 0.0, 0.30))
    shade = graph.math("ADD", shade, graph.remap(speckle, 0.3, 0.7, -0.07, 0.07), clamp=True)
    color = graph.mix(shade, table.color_a_rgb, table.color_b_rgb)
    smudge = graph.noise(where, 7.0, detail=4.0)
    roughness = graph.math("ADD", table.roughness, graph.remap(smudge, 0.35, 0.7, -0.03, 0.09), clamp=True)
    surface(graph, {"Base Color": color, "Roughness": roughness, "IOR": 1.5})


def _vein(graph: Graph, noise: Input, width: float) -> bpy.types.NodeSocket:
    """1 where the noise crosses its mean, falling to 0 within `width`."""
    distance = graph.math("ABSOLUTE", graph.math("SUBTRACT", noise, 0.5))
    return graph.math("POWER", graph.remap(distance, 0.0, width, 1.0, 0.0), 1.5)


def _cloth(graph: Graph, table: Table, where: Input) -> None:
    """Woven tablecloth, plain or checked, with creases where it lay folded."""
    x, y, _ = graph.separate(where)
    check = int(table.pattern_seed) % 3  # plain, striped, checked
    weave = graph.math("MULTIPLY", *(graph.math("SINE", graph.math("MULTIPLY", axis, 2.0 * np.pi / 0.0016)) for axis in (x, y)))
    slub = graph.noise(graph.vector("MULTIPLY", where, (90.0, 900.0, 1.0)), 1.0, detail=2.0)
    slub = graph.math("ADD", slub, graph.noise(graph.vector("MULTIPLY", where, (900.0, 90.0, 1.0)), 1.0, detail=2.0))
    stripe_x, stripe_y = (
        graph.math("GREATER_THAN", graph.math("FRACT", graph.math("DIVIDE", axis, 0.036)), 0.5) for axis in (x, y)
    )
    pattern: Input = 0.0
    if check == 1:
        pattern = stripe_x
    elif check == 2:
        pattern = graph.math("MULTIPLY", graph.math("ADD", stripe_x, stripe_y), 0.5)
    color = graph.mix(pattern, table.color_a_rgb, table.color_b_rgb)
    worn = graph.remap(slub, 0.6, 1.4, 0.80, 1.12)
    color = graph.mix(1.0, color, graph.combine(worn, worn, worn), blend="MULTIPLY")
    wrinkles = graph.noise(where, 6.0, detail=3.0, roughness=0.45)
    folds = graph.math("ADD", _fold(graph, x, 0.31), _fold(graph, y, 0.27))
    height = graph.math("ADD", graph.math("MULTIPLY", wrinkles, 0.010), graph.math("MULTIPLY", folds, 0.0012))
    height = graph.math("ADD", height, graph.math("MULTIPLY", weave, 0.00012))
    height = graph.math("ADD", height, graph.math("MULTIPLY", slub, 0.00018))
    surface(
        graph,
        {
            "Base Color": color,
            "Roughness": max(table.roughness, 0.75),
            "Specular IOR Level": 0.2,
            "Sheen Weight": 0.15,
            "Normal": graph.bump(height, 0.9),
        },
    )


def _fold(graph: Graph, position: Input, period_m: float) -> bpy.types.NodeSocket:
    """A soft ridge 12 mm wide at every multiple of the period."""
    phase = graph.math("FRACT", graph.math("DIVIDE", position, period_m))
    edge = graph.math("MINIMUM", phase, graph.math("SUBTRACT", 1.0, phase))
    return graph.remap(edge, 0.0, 0.006 / period_m, 1.0, 0.0)


def _laminate(graph: Graph, table: Table, where: Input) -> None:
    """Plastic laminate: fine speckle under a faintly uneven, smudged surface."""
    speckle = graph.noise(where, 520.0, detail=3.0, roughness=0.7)
    fleck = graph.remap(graph.noise(where, 260.0, detail=1.0), 0.60, 0.68, 0.0, 0.75)
    shade = graph.math("ADD", fleck, graph.remap(speckle, 0.35, 0.65, 0.0, 0.22), clamp=True)
    color = graph.mix(shade, table.color_a_rgb, table.color_b_rgb)
    smudge = graph.noise(where, 8.0, detail=5.0, roughness=0.65)
    roughness = graph.math("ADD", table.roughness, graph.remap(smudge, 0.35, 0.7, -0.05, 0.10), clamp=True)
    peel = graph.math("MULTIPLY", graph.noise(where, 240.0, detail=1.0), 0.00005)
    surface(graph, {"Base Color": color, "Roughness": roughness, "Normal": graph.bump(peel, 0.6)})
