"""InputError: what can be wrong with a file or a setting that a user hands in."""

__all__ = ["InputError", "printable"]


def printable(text: str) -> str:
    """The text on one line that any terminal takes: a newline, or a byte of a file name that is no text, is escaped."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


class InputError(ValueError):
    """An input cannot be used: which file or setting, what is wrong, what was expected, what to do."""

    def __init__(self, source: object, problem: str, *, expected: str, action: str) -> None:
        super().__init__(printable(f"{source}: {problem}; expected {expected}. {action}"))
        self.source = str(source)
        self.problem = problem
        self.expected = expected
        self.action = action

    def __reduce__(self) -> tuple[object, ...]:
        """So that the error comes whole out of a worker process."""
        return _remade, (type(self), self.source, self.problem, self.expected, self.action)


def _remade(kind: type[InputError], source: str, problem: str, expected: str, action: str) -> InputError:
    return kind(source, problem, expected=expected, action=action)
