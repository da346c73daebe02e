"""What became of recorded motions that were replayed."""

from dataclasses import dataclass

from datagen.grasps.sequence import GraspSequence

__all__ = ["ReplayOutcome"]


@dataclass(frozen=True, kw_only=True)
class ReplayOutcome:
    """One recorded motion: replayed, or the reason why not."""

    sequence_id: str
    sequence: GraspSequence | None
    reason: str
    cpu_seconds: float

    @classmethod
    def refused(cls, sequence_id: str, reason: str) -> "ReplayOutcome":
        """A motion that was not replayed."""
        return cls(sequence_id=sequence_id, sequence=None, reason=reason, cpu_seconds=0.0)
