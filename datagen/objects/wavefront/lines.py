"""The lines of OBJ and MTL: continuations, comments, numbers."""

import re

__all__ = ["joined_lines", "number", "shown", "without_comment"]

# What the C library of Microsoft prints for NaN and infinity, and what others print for NaN.
NOT_A_NUMBER = re.compile(r"[-+]?(1\.#(QNAN|SNAN|IND|INF)\d*|nan(\(\w*\))?)", re.IGNORECASE)


SHOWN_CHARS = 80


def shown(text: str) -> str:
    """What a file says, quoted and not too long, for messages."""
    return repr(text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}...")


def joined_lines(text: str) -> list[str]:
    """Lines with their continuations after "\\" joined; empty ones stand in for what was joined.

    A comment that ends with a backslash (`# from C:\\models\\`) goes on nowhere.
    """
    lines = text.split("\n")
    if "\\" not in text:
        return lines
    joined: list[str] = []
    parts: list[str] = []
    for line in lines:
        ending = line.rstrip()
        parts.append(ending[:-1] if ending.endswith("\\") else line)
        if not ending.endswith("\\") or (len(parts) == 1 and line.lstrip().startswith("#")):
            joined += [" ".join(parts), *[""] * (len(parts) - 1)]
            parts = []
    return joined + ([" ".join(parts)] if parts else [])


def without_comment(text: str) -> str:
    """The text before a '#'; the '#' of `1.#QNAN` begins no comment."""
    return re.split(r"(?<!1\.)#", text, maxsplit=1)[0] if "#" in text else text


def number(word: str) -> float:
    """The value of a word, NaN for every way of writing that; ValueError says what is wrong."""
    try:
        if "_" not in word:  # Python's own way to group digits
            return float(word)
    except ValueError:
        pass
    if NOT_A_NUMBER.fullmatch(word):
        return float("nan")
    if re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", word):
        raise ValueError(f"{shown(word)} has a decimal comma: export with decimal points, as in English")
    raise ValueError(f"{shown(word)} is not a number")
