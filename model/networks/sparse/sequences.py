"""Rows cut into sequences of different lengths that do not see each other, for attention."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from model.errors import ModelError

__all__ = ["Bucket", "PaddedRows", "Sequences", "Window"]


@dataclass(frozen=True, kw_only=True)
class Window:
    """Cubes of `size` voxels per axis; voxel x belongs to cube (x + shift) // size of its axis."""

    size: int
    shift: int

    def __post_init__(self) -> None:
        if self.size < 1 or not 0 <= self.shift < self.size:
            raise ModelError(
                "attention window",
                f"size {self.size}, shift {self.shift}",
                expected="size >= 1 and 0 <= shift < size",
                action="Change the window.",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Bucket:
    """`count` sequences padded to `length` rows; `mask` is true on real rows, None when nothing is padded."""

    count: int
    length: int
    mask: Bool[Tensor, "sequence 1 1 length"] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class PaddedRows:
    """Buckets one after another: the row in each place (any row where padded), and the place of each row."""

    buckets: tuple[Bucket, ...]
    row_of_place: Int[Tensor, " place"]
    place_of_row: Int[Tensor, " row"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequences:
    """`rows` lists the rows sequence after sequence; None when they already stand so."""

    rows: Int[Tensor, " row"] | None
    lengths: tuple[int, ...]

    @cached_property
    def places(self) -> Int[Tensor, " row"]:
        """Where each row stands in `rows`; only of sequences that have `rows`."""
        assert self.rows is not None
        return torch.empty_like(self.rows).scatter_(
            0, self.rows, torch.arange(len(self.rows), device=self.rows.device)
        )

    def offsets(self, device: torch.device) -> Int[Tensor, " sequence_plus_1"]:
        """Start of each sequence and the end of the last, 32 bits, as kernels for packed sequences want them."""
        lengths = torch.tensor((0, *self.lengths), device=device)
        return lengths.cumsum(0).int()

    @cached_property
    def padded(self) -> PaddedRows:
        """Sequences of similar length together, padded by less than a quarter; needs `rows`.

        Lengths are rounded up to four steps per octave, so there are few buckets and little padding.
        """
        assert self.rows is not None
        device = self.rows.device
        lengths = torch.tensor(self.lengths, device=device)
        starts = lengths.cumsum(0) - lengths
        rounded = torch.tensor([_rounded(length) for length in self.lengths], device=device)
        buckets, row_of_place, place_of_row = [], [], torch.empty_like(self.rows)
        filled = 0
        for length in sorted(set(rounded.tolist())):
            members = (rounded == length).nonzero()[:, 0]
            within = torch.arange(length, device=device)
            real = within < lengths[members, None]
            rows = self.rows[torch.where(real, starts[members, None] + within, starts[members, None])]
            places = filled + torch.arange(rows.numel(), device=device).view_as(rows)
            place_of_row[rows[real]] = places[real]
            mask = None if bool(real.all()) else real[:, None, None]
            buckets.append(Bucket(count=len(members), length=length, mask=mask))
            row_of_place.append(rows.flatten())
            filled += rows.numel()
        return PaddedRows(
            buckets=tuple(buckets),
            row_of_place=torch.cat(row_of_place) if row_of_place else self.rows,
            place_of_row=place_of_row,
        )


def _rounded(length: int) -> int:
    """The next length that is a multiple of an eighth of the next power of two."""
    step = max(1, (1 << (length - 1).bit_length()) // 8)
    return -(-length // step) * step
