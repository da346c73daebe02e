"""What differs between two configurations, a line for each key."""

import json
from collections.abc import Mapping
from typing import Any

__all__ = ["differences"]


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Lines `dotted.key: value in one -> value in other`, in the order of keys; empty when they are equal.

    Values are written as JSON; a key that only one of them has is `absent` in the other.
    """
    before, after = _leaves(one, ""), _leaves(other, "")
    keys = dict.fromkeys((*before, *after))
    pairs = {key: (before.get(key, "absent"), after.get(key, "absent")) for key in keys}
    return [f"{key}: {old} -> {new}" for key, (old, new) in pairs.items() if old != new]


def _leaves(value: object, key: str) -> dict[str, str]:
    """Everything that is not a mapping of something, as JSON, under its dotted key."""
    if not isinstance(value, Mapping) or not value:
        return {key: json.dumps(value, ensure_ascii=False)}
    leaves: dict[str, str] = {}
    for name, inner in value.items():
        leaves |= _leaves(inner, f"{key}.{name}" if key else str(name))
    return leaves
