"""Which unit the numbers of a mesh file are in, where the file does not say."""

from typing import Literal

from datagen.objects.mesh.graspable_size import HELD_LONGEST_M, HOLDABLE_SIDES_M

__all__ = ["METRES_PER", "Unit", "unit_of_size"]

Unit = Literal["m", "cm", "mm"]

METRES_PER: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
TYPICAL_M = HOLDABLE_SIDES_M[1]  # of what a hand holds, the geometric mean of the least and the largest limit


def unit_of_size(longest: float, *, customary: Unit | None = None) -> tuple[Unit, tuple[str, ...]]:
    """The "auto" rule: the unit in which a hand could hold the object, and a note where that is a guess.

    Of the units that make the longest side 5 mm to 1 m (HELD_LONGEST_M), the format's customary one
    is taken, else the one nearest to 14 cm in ratio. Numbers from 0.5 to 100 could be centimetres,
    and then metres or millimetres are as likely or just out of reach: only these are noted.
    """
    size_m = {unit: longest * metres for unit, metres in METRES_PER.items()}
    held = [unit for unit in METRES_PER if HELD_LONGEST_M[0] <= size_m[unit] <= HELD_LONGEST_M[1]]
    if customary in held:
        chosen = customary
    else:
        candidates = held or list(METRES_PER)
        chosen = min(candidates, key=lambda unit: max(size_m[unit] / TYPICAL_M, TYPICAL_M / size_m[unit]))
    if "cm" not in held:
        return chosen, ()
    others = [unit for unit in held if unit != chosen]
    doubt = f"{longest:.3g} {others[0]} is possible too" if others else "no hand holds it in m or mm"
    read_as = (
        f"no unit is stated: the longest side of {longest:.3g} is taken as {longest:.3g} {chosen} ({doubt})"
    )
    return chosen, (f"{read_as}; set `objects.reading.unit` where it is another",)
