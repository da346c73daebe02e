"""InputError: what can be wrong with a file or a setting that a user hands in."""

from shards.printable import printable

__all__ = ["InputError"]


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
