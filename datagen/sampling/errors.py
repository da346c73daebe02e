"""Errors of this package."""

__all__ = ["SamplingError"]


class SamplingError(ValueError):
    """No scene could be drawn for a motion; the message has the metrics and what to change."""
