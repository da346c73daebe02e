"""Which models of BlendSwap-CC-0 make the starter pack, and what is repaired on the way.

Every model of the library is CC0-1.0. `DROPPED` gives the reason for those left out although
their size would allow them.
"""

from dataclasses import dataclass, field

__all__ = ["DROPPED", "SELECTION", "Look", "Pick"]

RGB = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Look:
    """Changes to one material; None keeps what the MTL entry gives. Colour is linear."""

    color: RGB | None = None
    roughness: float | None = None
    metallic: float | None = None
    transmission: float | None = None


@dataclass(frozen=True, kw_only=True)
class Pick:
    """One model of the library."""

    slug: str  # "starter/<slug>"
    model: str  # folder of the model in the library
    name: str
    looks: dict[str, Look] = field(default_factory=dict)  # by material name
    without_materials: tuple[str, ...] = ()  # faces left out
    piece: int | None = None  # keep only this piece, pieces ordered along x (a pair of shoes)
    max_faces: int = 8000


SELECTION = (
    Pick(slug="butter", model="butter", name="Butter dish"),
    Pick(slug="coffee_cup", model="caffe_final", name="Coffee cup"),
    Pick(slug="biplane", model="cartoon_biplane", name="Toy biplane"),
    Pick(slug="scissors", model="cissors_swap", name="Scissors"),
    Pick(slug="comb", model="comb", name="Comb"),
    Pick(slug="cosmetics_pot", model="cosmeticsPot", name="Cosmetics pot"),
    Pick(slug="deer", model="deer", name="Deer figurine"),
    Pick(slug="puzzle", model="housePuzzle", name="Puzzle"),
    Pick(slug="mixer", model="kitchenaid", name="Kitchen mixer"),
    Pick(slug="baby_bottle", model="mamadeira", name="Baby bottle"),
    Pick(slug="plastic_cup", model="plasticCup", name="Plastic cup"),
    Pick(slug="ruler", model="ruler", name="Ruler"),
    Pick(slug="speaker", model="speaker2", name="Speaker"),
    Pick(slug="teddy_bear", model="teddyBear", name="Teddy bear"),
    Pick(slug="milk", model="tetrapak", name="Milk carton"),
    Pick(slug="text_marker", model="textMarker", name="Text marker"),
    Pick(slug="toilet_brush", model="toiletBrush", name="Toilet brush"),
    Pick(slug="toilet_paper", model="toiletPaperDispenser", name="Toilet paper dispenser"),
    Pick(slug="yogurt_bottle", model="yogurtBottle", name="Yogurt bottle"),
    Pick(slug="flacon", model="flacon", name="Flacon"),
    Pick(slug="headphones", model="headphones", name="Headphones"),
    Pick(slug="phone", model="iphone", name="Mobile phone"),
    Pick(slug="little_plant", model="littlePlant", name="Potted plant"),
    Pick(slug="basketball", model="basketball", name="Basketball"),
    Pick(slug="calendar", model="kalender", name="Desk calendar"),
    Pick(slug="number_lock", model="numberLock", name="Number lock"),
    Pick(slug="potty", model="potty", name="Potty"),
    Pick(slug="slipper", model="slippers", name="Slipper", piece=0),
    Pick(slug="beer_glass", model="beerGlass", name="Beer glass"),
    Pick(slug="bread", model="bread", name="Bread"),
    Pick(slug="locker", model="lockedLocker", name="Locker"),
    Pick(slug="fan", model="riggedFan", name="Fan"),
    Pick(slug="briefcase", model="briefcase", name="Briefcase"),
    Pick(slug="cactus", model="cactus", name="Cactus"),
    Pick(slug="coffee_brewer", model="coffeeBrewer", name="Coffee brewer"),
    Pick(slug="dustbin", model="dustbin", name="Dustbin"),
    Pick(slug="handbag", model="handbag", name="Handbag"),
    Pick(slug="bootie", model="bootie", name="Bootie", piece=0),
    Pick(slug="cupcake", model="cupcake", name="Cupcake"),
    Pick(slug="hot_dog", model="hotDog", name="Hot dog"),
    Pick(slug="lantern", model="JapaneseLantern", name="Japanese lantern"),
    Pick(slug="wood_toy", model="woodToy", name="Wooden toy"),
    Pick(slug="rock_a", model="rock1", name="Rock"),
    Pick(slug="rock_b", model="rock2", name="Rock"),
    Pick(slug="rock_c", model="rock3", name="Rock"),
    Pick(slug="barrel", model="barrel", name="Barrel"),
    Pick(slug="crate", model="crate", name="Crate"),
    Pick(slug="stone_lantern", model="stoneLantern", name="Stone lantern"),
)

DROPPED = {
    "knifeStandSwap": "knives on a rack: several separate things",
    "cardGame": "five separate cards spread out, 0.4 mm thick",
}
