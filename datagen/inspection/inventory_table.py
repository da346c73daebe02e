"""The inputs of the generator, one block of lines each."""

import textwrap
from collections.abc import Sequence

from rich.text import Text

from datagen.inspection.inventory import AssetState

__all__ = ["asset_lines"]

_COLORS = {"present": "green", "missing": "yellow", "wrong": "red"}
_LABEL = 11  # columns before a value


def asset_lines(states: Sequence[AssetState], width: int) -> Text:
    """Name and state of every input, then licence, place, setting and how to get it.

    No line is longer than `width`, but for a path, which is never broken: it can be copied.
    """
    name_width = max(len(state.name) for state in states) + 2
    text = Text()
    for state in states:
        text.append(f"{state.name:{name_width}}", style="bold")
        text.append(state.state, style=_COLORS[state.state])
        text.append("\n")
        for label, value in (
            ("version", state.version),
            ("problem", state.problem),
            ("licence", state.licence),
            ("place", state.place),
            ("setting", state.setting),
            ("to get it", "" if state.state == "present" else state.how_to_get),
        ):
            if value:
                text.append_text(_labelled(label, value, width))
    there = sum(state.state == "present" for state in states)
    text.append(f"{there} of {len(states)} inputs are there; others are needed where a setting asks for them")
    return text


def _labelled(label: str, value: str, width: int) -> Text:
    lines = textwrap.wrap(value, width - _LABEL - 2, break_long_words=False, break_on_hyphens=False)
    text = Text(f"  {label:{_LABEL}}", style="dim")
    text.append(f"\n{' ' * (_LABEL + 2)}".join(lines), style="not dim")
    return text.append("\n")
