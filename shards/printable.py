"""Names and lines of files on a terminal: on one line, whatever bytes they hold."""

__all__ = ["printable"]


def printable(text: str) -> str:
    """The text on one line that any terminal takes: a newline, or a byte of a file name that is no text, is escaped."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )
