"""Images of table tops, drawn once per motion: sampling them costs Cycles a third of the same
pattern as shader nodes (DECISIONS D82). Knows nothing of Blender; the same seed gives the same piece.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from datagen.scene.scene import Table

__all__ = ["TableTextures", "draw_table"]

TEXEL_M = 0.0007
MAX_TEXTURE_PX = 1536

Field = Float32[np.ndarray, "row column"]
Color = Float32[np.ndarray, "row column 3"]


@dataclass(frozen=True, kw_only=True)
class TableTextures:
    """Maps over the table's plan: column along its x, row along its y, first row at the lowest y."""

    color: Color  # linear, 0..1
    roughness: Field  # 0..1
    height_m: Field
    texel_m: float


@dataclass(frozen=True, kw_only=True)
class _Canvas:
    """The plan to draw on. Lengths are in pattern metres: `pattern_scale` of them make a metre."""

    shape: tuple[int, int]
    texel: float
    rng: np.random.Generator

    def axes(self) -> tuple[Field, Field]:
        """x and y of every texel."""
        rows, columns = self.shape
        x = np.arange(columns, dtype=np.float32) * np.float32(self.texel)
        y = np.arange(rows, dtype=np.float32) * np.float32(self.texel)
        return np.broadcast_to(x, self.shape), np.broadcast_to(y[:, None], self.shape)

    def noise(self, size_x: float, size_y: float, octaves: int = 1, gain: float = 0.5) -> Field:
        """Smooth noise with features of the given size, mean 0, deviation 1."""
        total = np.zeros(self.shape, np.float32)
        for octave in range(octaves):
            cells = [
                max(4, int(np.ceil(n * self.texel / max(size / 2**octave, 1.5 * self.texel))) + 3)
                for n, size in zip(self.shape, (size_y, size_x))
            ]
            lattice = self.rng.standard_normal(cells, dtype=np.float32)
            total += np.float32(gain**octave) * cv2.resize(
                lattice, self.shape[::-1], interpolation=cv2.INTER_CUBIC
            )
        return (total - total.mean()) / max(float(total.std()), 1e-6)


def draw_table(table: Table) -> TableTextures:
    """Draw the top of `table`; its colours, roughness and seed decide, its place does not."""
    texel_m = max(TEXEL_M, max(table.size_xy_m) / MAX_TEXTURE_PX)
    columns, rows = (max(8, round(side / texel_m)) for side in table.size_xy_m)
    canvas = _Canvas(
        shape=(rows, columns),
        texel=texel_m / table.pattern_scale,
        rng=np.random.default_rng(table.pattern_seed),
    )
    draw = {"wood": _wood, "stone": _stone, "cloth": _cloth, "laminate": _laminate}[table.material]
    color, roughness, height = draw(canvas, table)
    return TableTextures(
        color=np.clip(color, 0.0, 1.0).astype(np.float32),
        roughness=np.clip(roughness, 0.05, 1.0).astype(np.float32),
        height_m=height.astype(np.float32),
        texel_m=texel_m,
    )


def _wood(canvas: _Canvas, table: Table) -> tuple[Color, Field, Field]:
    """Varnished planks, each sawn from another place of a trunk: year rings cut almost lengthwise."""
    rng, (x, y) = canvas.rng, canvas.axes()
    warp = canvas.noise(0.35, 0.05, octaves=3)
    wobble = canvas.noise(0.06, 0.012, octaves=2)
    fibres = canvas.noise(0.05, 0.0009, octaves=2, gain=0.7)
    streaks = canvas.noise(0.30, 0.0045, octaves=2)
    pores = np.clip(canvas.noise(0.007, 0.0011) - 1.4, 0.0, 1.0)

    ring = np.zeros(canvas.shape, np.float32)
    tone = np.zeros(canvas.shape, np.float32)
    joint = np.ones(canvas.shape, np.float32)
    width, length = rng.uniform(0.085, 0.17), rng.uniform(0.7, 1.6)
    first = rng.uniform(0.0, width)
    row_of = np.floor((y[:, 0] + first) / width).astype(int)
    for row in range(row_of.max() + 1):
        rows = row_of == row
        start = rng.uniform(0.0, length)
        piece_of = np.floor((x[0] + start) / length).astype(int)
        y_in = y[rows] + first - row * width  # from this plank's edge
        for piece in range(piece_of.max() + 1):
            here = np.ix_(rows, piece_of == piece)
            y_pith, depth = rng.uniform(-0.04, width + 0.04), rng.uniform(0.015, 0.07)
            slope, spacing = rng.uniform(-0.05, 0.05), rng.uniform(0.0045, 0.009)
            cut = depth + slope * x[here] + 0.008 * warp[here]
            radius = np.hypot(y_in[:, piece_of == piece] - y_pith, cut) + 0.0012 * wobble[here]
            phase = np.mod(radius / spacing, 1.0)
            ring[here] = phase**2.2 * (
                1.0 - np.clip((phase - 0.88) / 0.12, 0.0, 1.0)
            )  # slow darkening, sharp end
            tone[here] = rng.normal(0.0, 0.10)
            x_in = x[here] + start - piece * length
            edge = np.minimum(
                np.minimum(x_in, length - x_in), np.minimum(y_in, width - y_in)[:, piece_of == piece]
            )
            joint[here] = np.clip((edge - 0.0002) / 0.0009, 0.0, 1.0)

    light = 0.62 - 0.42 * ring + 0.075 * fibres + 0.10 * streaks + 0.06 * warp + tone
    color = _between(table.color_a_rgb, table.color_b_rgb, light)
    color *= (1.0 - 0.45 * pores)[..., None]
    color *= (0.15 + 0.85 * joint)[..., None]
    smudge = canvas.noise(0.12, 0.12, octaves=4, gain=0.6)
    roughness = table.roughness + 0.035 * smudge + 0.02 * fibres + 0.10 * pores + 0.5 * (1.0 - joint)
    height = 0.000012 * fibres - 0.00004 * pores - 0.00003 * ring - 0.00015 * (1.0 - joint)
    return color, roughness, height


def _stone(canvas: _Canvas, table: Table) -> tuple[Color, Field, Field]:
    """Polished marble: veins along the level lines of warped noise, over clouds and grain."""
    bend_x, bend_y = (0.05 * canvas.noise(0.30, 0.30, octaves=4) for _ in range(2))
    large = _warped(canvas, canvas.noise(0.42, 0.22, octaves=5, gain=0.55), bend_x, bend_y)
    small = _warped(canvas, canvas.noise(0.13, 0.10, octaves=4, gain=0.6), bend_y, bend_x)
    clouds = canvas.noise(0.25, 0.25, octaves=5, gain=0.6)
    presence = np.clip(0.5 + 0.5 * canvas.noise(0.35, 0.35, octaves=2), 0.0, 1.0)  # veins come and go
    vein = presence * np.exp(-((large / 0.055) ** 2)) + 0.35 * (1.0 - presence) * np.exp(
        -((small / 0.05) ** 2)
    )
    halo = 0.22 * np.exp(-np.abs(large) / 0.35)
    grain = canvas.noise(0.0012, 0.0012, octaves=2)
    color = _between(table.color_a_rgb, table.color_b_rgb, 0.10 + vein + halo + 0.07 * clouds + 0.02 * grain)
    smudge = canvas.noise(0.10, 0.10, octaves=4, gain=0.6)
    return color, table.roughness + 0.03 * smudge, np.zeros(canvas.shape, np.float32)


def _cloth(canvas: _Canvas, table: Table) -> tuple[Color, Field, Field]:
    """A woven tablecloth, plain, striped or checked by its seed, with the creases of its folding."""
    x, y = canvas.axes()
    warp, weft = canvas.noise(0.0012, 0.03, octaves=2), canvas.noise(0.03, 0.0012, octaves=2)
    period = canvas.rng.choice([0.024, 0.036, 0.060])
    stripe_x, stripe_y = (np.mod(axis / period, 1.0) < 0.5 for axis in (x, y))
    pattern = [np.zeros(canvas.shape), 1.0 * stripe_x, 0.5 * stripe_x + 0.5 * stripe_y][
        canvas.rng.integers(3)
    ]
    thread = 0.5 * (warp + weft)
    color = _between(table.color_a_rgb, table.color_b_rgb, pattern) * (1.0 + 0.10 * thread)[..., None]
    wrinkles = canvas.noise(0.22, 0.16, octaves=3, gain=0.4)
    folds = np.zeros(canvas.shape, np.float32)
    for axis, spacing in ((x, 0.37), (y, 0.29)):
        phase = np.mod(axis / spacing + canvas.rng.uniform(), 1.0)
        from_fold = spacing * np.minimum(phase, 1.0 - phase)
        folds += np.exp(-((from_fold / 0.004) ** 2))
    weave = np.sin(2.0 * np.pi * x / 0.0021) * np.sin(2.0 * np.pi * y / 0.0021)
    height = 0.0012 * wrinkles + 0.0006 * folds + 0.00010 * thread + 0.00006 * weave
    roughness = max(table.roughness, 0.75) + 0.03 * thread
    return color, roughness, height


def _laminate(canvas: _Canvas, table: Table) -> tuple[Color, Field, Field]:
    """Plastic laminate: two sizes of fleck under a faintly uneven, wiped surface."""
    fine, coarse = canvas.noise(0.0016, 0.0016), canvas.noise(0.0035, 0.0035)
    fleck = 0.14 + 0.10 * fine + 0.7 * np.clip(coarse - 1.3, 0.0, 1.0)
    color = _between(table.color_a_rgb, table.color_b_rgb, fleck)
    wiped = canvas.noise(0.25, 0.05, octaves=4, gain=0.6)
    smudge = canvas.noise(0.05, 0.05, octaves=3, gain=0.6)
    peel = canvas.noise(0.006, 0.006, octaves=2)
    return color, table.roughness + 0.03 * wiped + 0.02 * smudge, 0.000012 * peel


def _between(
    a_rgb: tuple[float, float, float], b_rgb: tuple[float, float, float], amount: np.ndarray
) -> Color:
    a, b = np.asarray(a_rgb, np.float32), np.asarray(b_rgb, np.float32)
    return a + np.clip(amount, 0.0, 1.0).astype(np.float32)[..., None] * (b - a)


def _warped(canvas: _Canvas, field: Field, shift_x: Field, shift_y: Field) -> Field:
    """`field` read at places moved by the shifts (pattern metres)."""
    rows, columns = canvas.shape
    column = np.arange(columns, dtype=np.float32) + shift_x / np.float32(canvas.texel)
    row = np.arange(rows, dtype=np.float32)[:, None] + shift_y / np.float32(canvas.texel)
    return cv2.remap(
        field,
        column.astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
