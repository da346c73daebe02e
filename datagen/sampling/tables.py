"""The table: where it must be so that nothing floats or sinks in, and what it looks like."""

import colorsys
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from jaxtyping import Float

from datagen.grasps.sequence import TableEdge
from datagen.scene.scene import Table
from shards.settings import Range

__all__ = ["TableConfig", "sample_table"]

TableMaterial = Literal["wood", "stone", "cloth", "laminate"]
RGB = tuple[float, float, float]

# (dark, light) linear colours: walnut, oak, beech, pine, cherry, ash grey, ebony.
WOODS: tuple[tuple[RGB, RGB], ...] = (
    ((0.045, 0.022, 0.011), (0.170, 0.085, 0.042)),
    ((0.160, 0.085, 0.038), (0.420, 0.260, 0.130)),
    ((0.260, 0.140, 0.075), (0.560, 0.360, 0.210)),
    ((0.330, 0.180, 0.070), (0.640, 0.430, 0.210)),
    ((0.120, 0.040, 0.017), (0.330, 0.130, 0.060)),
    ((0.120, 0.105, 0.088), (0.330, 0.300, 0.260)),
    ((0.014, 0.010, 0.008), (0.050, 0.036, 0.028)),
)
# Ground and vein: white marble, cream marble, grey granite, black marble, green slate.
STONES: tuple[tuple[RGB, RGB], ...] = (
    ((0.720, 0.710, 0.690), (0.300, 0.300, 0.310)),
    ((0.640, 0.540, 0.420), (0.330, 0.230, 0.150)),
    ((0.240, 0.240, 0.250), (0.080, 0.080, 0.085)),
    ((0.022, 0.022, 0.025), (0.300, 0.290, 0.270)),
    ((0.075, 0.095, 0.085), (0.180, 0.200, 0.185)),
)


@dataclass(frozen=True, kw_only=True)
class TableConfig:
    """The table of a motion. Pairs are (lowest, highest) of a uniform draw."""

    probability: Annotated[float, Range(0, 1)]  # where the motion works without one
    size_m: Annotated[tuple[float, float], Range(0.05, 100, rising=True)]  # of either side
    thickness_m: Annotated[tuple[float, float], Range(0.0001, 10, rising=True)]
    # below the lowest point of a hand that holds the object in mid-air
    lowered_m: Annotated[tuple[float, float], Range(0, 10, rising=True)]
    # wood, stone, cloth, laminate -> relative frequency
    materials: Annotated[dict[str, float], Range(0, 1e6)]

    def __post_init__(self) -> None:
        unknown = set(self.materials) - set(get_args(TableMaterial))
        if unknown or sum(self.materials.values()) <= 0.0:
            found = ", ".join(f"{name}: {weight}" for name, weight in self.materials.items())
            raise ValueError(
                f"materials has {{{found}}}: expected weights of {', '.join(get_args(TableMaterial))} "
                "with a positive sum"
            )


def sample_table(
    config: TableConfig,
    rng: np.random.Generator,
    *,
    top_z_m: float,
    under_xy_m: tuple[float, float],
    footprint_m: float,
    edge: TableEdge | None,
) -> Table:
    """A table under `under_xy_m` that reaches `footprint_m` around it, or ends at `edge`."""
    size = np.maximum(rng.uniform(*config.size_m, size=2), 2.0 * footprint_m + 0.1)
    shift = rng.uniform(-1.0, 1.0, size=2) * (0.5 * size - footprint_m - 0.05)
    yaw = rng.uniform(0.0, 2.0 * np.pi)
    if edge is not None:
        # The table's own +x side is the edge; along it the table reaches both ways.
        yaw = float(np.arctan2(edge.outward_xy[1], edge.outward_xy[0]))
        shift[0] = 0.5 * size[0]
    c, s = np.cos(yaw), np.sin(yaw)
    anchor = np.asarray(under_xy_m if edge is None else edge.point_xy_m)
    center: Float[np.ndarray, "2"] = anchor - np.array([[c, -s], [s, c]]) @ shift
    material = _material(config, rng)
    color_a, color_b = _colors(material, rng)
    roughness = {"wood": (0.3, 0.65), "stone": (0.08, 0.4), "cloth": (0.75, 0.95), "laminate": (0.2, 0.55)}[
        material
    ]
    return Table(
        top_z_m=top_z_m,
        center_xy_m=(float(center[0]), float(center[1])),
        size_xy_m=(float(size[0]), float(size[1])),
        thickness_m=float(rng.uniform(*config.thickness_m)),
        yaw_rad=float(yaw),
        material=material,
        color_a_rgb=color_a,
        color_b_rgb=color_b,
        pattern_scale=float(rng.uniform(0.75, 1.35)),
        roughness=float(rng.uniform(*roughness)),
        pattern_seed=int(rng.integers(2**31)),
    )


def _material(config: TableConfig, rng: np.random.Generator) -> TableMaterial:
    names = get_args(TableMaterial)
    weights = np.array([config.materials.get(name, 0.0) for name in names])
    chosen: TableMaterial = names[rng.choice(len(names), p=weights / weights.sum())]
    return chosen


def _colors(material: TableMaterial, rng: np.random.Generator) -> tuple[RGB, RGB]:
    """Two linear colours that go together, each a little off its palette."""
    if material == "wood":
        pair = WOODS[rng.integers(len(WOODS))]
    elif material == "stone":
        pair = STONES[rng.integers(len(STONES))]
    else:
        # Cloth may be colourful; laminate is mostly pale or grey.
        saturation = rng.beta(1.6, 2.2) * (0.8 if material == "cloth" else 0.35)
        value = rng.uniform(0.12, 0.75)
        hue = rng.uniform()
        second_value = np.clip(value * rng.choice([0.45, 0.7, 1.4]), 0.03, 0.85)
        pair = (
            colorsys.hsv_to_rgb(hue, saturation, value),
            colorsys.hsv_to_rgb(
                (hue + rng.normal() * 0.04) % 1.0, saturation * rng.uniform(0.2, 1.0), second_value
            ),
        )
    varied = np.clip(np.array(pair) * rng.uniform(0.85, 1.15) * rng.uniform(0.95, 1.05, size=3), 0.005, 0.9)
    (a, b, c), (d, e, f) = varied.tolist()
    return (a, b, c), (d, e, f)
