"""MTL: what each newmtl block says. How it looks is decided in `mtl_material`."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.files.named_files import spellings
from datagen.objects.wavefront.lines import joined_lines, number, shown, without_comment
from shards.color import srgb_from_linear

__all__ = ["MtlEntry", "MtlMap", "read_mtl"]

RGB = tuple[float, float, float]

# The options of map_ lines. `-s` and `-o` place the image, the others change nothing here.
NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?(?!\S)"
OPTION = re.compile(
    rf"(?<!\S)-(?:(?P<place>[ost])(?P<uvw>(?:\s+{NUMBER}){{1,3}})|mm(?:\s+{NUMBER}){{2}}"
    rf"|(?:bm|boost|texres)\s+{NUMBER}|(?P<switch>clamp|blendu|blendv|cc)\s+(?P<state>on|off)"
    r"|imfchan\s+[rgbmlz]|(?:type|colorspace)\s+\S+)(?!\S)\s*",
    re.IGNORECASE,
)
# Linear sRGB of CIE XYZ (IEC 61966-2-1).
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
PLAIN_MAPS = ("norm", "bump", "disp", "decal", "refl")  # beside map_...
BYTE_COLORS_ABOVE = 2.0  # a Kd beyond is counted 0..255


@dataclass(frozen=True, kw_only=True)
class MtlMap:
    """A map_ line: what its file may be called, most literal first, and where the image lies.

    The image is looked up at uv * scale + offset.
    """

    name: str  # without options
    names: tuple[str, ...]
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamps: bool = False


@dataclass(frozen=True, kw_only=True)
class MtlEntry:
    """The keywords of one newmtl block that change how it looks. Colours as written, 0..1."""

    name: str
    kd: RGB | None = None
    ks: RGB = (0.0, 0.0, 0.0)
    ke: RGB = (0.0, 0.0, 0.0)
    ns: float = 10.0  # Phong exponent
    opacity: float = 1.0
    ior: float = 1.0
    roughness: float | None = None  # Pr, Pm: the PBR extension
    metallic: float | None = None
    maps: dict[str, MtlMap] = field(default_factory=dict)  # map_kd, map_bump ... in lower case
    notes: tuple[str, ...] = ()  # what was guessed


def read_mtl(path: Path, text: str) -> dict[str, MtlEntry]:
    """The newmtl blocks by name; the later of two of one name adds to the first, with a note.

    ObjectError names the line with a number that cannot be read.
    """
    blocks: dict[str, dict[str, tuple[int, str]]] = {}
    block: dict[str, tuple[int, str]] = {}
    repeated: set[str] = set()
    for line_number, line in enumerate(joined_lines(text), start=1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        keyword, rest = words[0].lower(), words[1].strip() if len(words) > 1 else ""
        if keyword == "newmtl":
            repeated |= {rest} & blocks.keys()
            block = blocks.setdefault(rest, {})
        else:
            block[keyword] = (line_number, rest)
    return {name: _entry(_Block(path, name, lines, name in repeated)) for name, lines in blocks.items()}


class _Block:
    """Typed access to the lines of one block; `notes` grows while it is read."""

    def __init__(self, path: Path, name: str, lines: dict[str, tuple[int, str]], is_repeated: bool) -> None:
        self._path, self.name, self.lines = path, name, lines
        self.notes: list[str] = []
        if is_repeated:
            self.note("is defined several times; the last value of each keyword counts")

    def words(self, keyword: str) -> list[str]:
        return without_comment(self.lines.get(keyword, (0, ""))[1]).split()

    def note(self, text: str) -> None:
        self.notes.append(f"material {shown(self.name)}: {text}")

    def numbers(self, keyword: str, words: list[str]) -> list[float]:
        """The finite numbers of `words`; none, and a note, where one is NaN or infinite."""
        try:
            values = [number(word) for word in words]
        except ValueError as error:
            line_number, rest = self.lines[keyword]
            raise ObjectError(
                self._path,
                f"line {line_number} cannot be read: {shown(f'{keyword} {rest}')} ({error})",
                expected="numbers after Kd, Ks, Ke, Ns, d, Tr, Ni, Pr and Pm",
                action="Export the materials again, for instance with Blender.",
            ) from error
        if all(map(math.isfinite, values)):
            return values
        self.note(f"{keyword} {' '.join(words)[:40]} is no finite number and is passed over")
        return []

    def number(self, keyword: str) -> float | None:
        """The last number, behind options such as `-halo`."""
        return next(iter(self.numbers(keyword, self.words(keyword)[-1:])), None)

    def rgb(self, keyword: str) -> RGB | None:
        words = self.words(keyword)
        kind = words[0].lower() if words else ""
        if kind == "spectral":
            self.note(f"{keyword} is a spectral curve, which is not read")
            return None
        values = self.numbers(keyword, words[1:4] if kind == "xyz" else words[:3])
        if not values:
            return None
        r, g, b = (*values, values[-1], values[-1])[:3]
        if kind == "xyz":
            r, g, b = (float(v) for v in srgb_from_linear(SRGB_FROM_XYZ @ np.array([r, g, b])))
        if max(r, g, b) > BYTE_COLORS_ABOVE and keyword != "ke":
            self.note(f"{keyword} {' '.join(words[:3])} is read as 0..255")
            r, g, b = r / 255.0, g / 255.0, b / 255.0
        return r, g, b


def _entry(block: _Block) -> MtlEntry:
    black = (0.0, 0.0, 0.0)
    shades = block.number("illum") not in (0.0, 1.0)  # 0 and 1: colour without highlights
    exponent, ior = block.number("ns"), block.number("ni")
    return MtlEntry(
        name=block.name,
        kd=_base_color(block),
        ks=(block.rgb("ks") or black) if shades else black,
        ke=block.rgb("ke") or black,
        ns=10.0 if exponent is None else exponent,
        opacity=_opacity(block),
        ior=1.0 if ior is None else ior,
        roughness=block.number("pr"),
        metallic=block.number("pm"),
        maps={
            key: _map(rest)
            for key, (_, rest) in block.lines.items()
            if rest and (key in PLAIN_MAPS or key.startswith("map_")) and key != "map_aat"
        },
        notes=tuple(block.notes),
    )


def _base_color(block: _Block) -> RGB | None:
    """Kd; Ka where neither Kd nor map_Kd tells, as some CAD programs write."""
    kd = block.rgb("kd")
    ambient = block.rgb("ka") if kd is None and not block.lines.keys() & {"kd", "map_kd"} else None
    if ambient is not None:
        block.note("has no Kd; Ka is taken for it")
    return kd or ambient


def _opacity(block: _Block) -> float:
    """Opacity from d, else from Tr, by which most writers mean 1 - d and some mean d itself.

    Nobody models what cannot be seen, so Tr 0 and Tr 1 without d are both opaque. Between, Tr is 1 - d.
    """
    d, tr = block.number("d"), block.number("tr")
    if d is None and tr is not None:
        if tr >= 1.0:
            block.note("Tr 1 without d is read as opaque; write d to say what is meant")
            return 1.0
        if tr > 0.0:
            block.note(f"Tr {tr:g} without d is read as opacity {1.0 - tr:g}; write d to say what is meant")
        d = 1.0 - tr
    elif d is not None and tr is not None and abs(d + tr - 1.0) > 0.01:
        block.note(f"d {d:g} and Tr {tr:g} contradict each other; d counts")
    if d is not None and d <= 0.0:
        block.note("d 0 would be invisible and is drawn as glass")
    return 1.0 if d is None else min(max(d, 0.0), 1.0)


def _map(rest: str) -> MtlMap:
    place = {"s": (1.0, 1.0), "o": (0.0, 0.0)}
    clamps = False
    for match in OPTION.finditer(rest):
        if match["place"]:
            kind = match["place"].lower()
            values = [float(word) for word in match["uvw"].split()]
            u, v = (*values, place.get(kind, (0.0, 0.0))[1])[:2] if len(values) == 1 else values[:2]
            place[kind] = (u, v)
        elif (match["switch"] or "").lower() == "clamp":
            clamps = match["state"].lower() == "on"
    name = OPTION.sub("", rest).strip() or rest
    names = tuple(dict.fromkeys((*spellings(rest), *spellings(name))))
    return MtlMap(name=name, names=names, scale=place["s"], offset=place["o"], clamps=clamps)
