"""InputError: what can be wrong with a file or a setting that a user hands in."""

__all__ = ["InputError"]


class InputError(ValueError):
    """An input cannot be used: which file or setting, what is wrong, what was expected, what to do."""

    def __init__(self, source: object, problem: str, *, expected: str, action: str) -> None:
        super().__init__(f"{source}: {problem}; expected {expected}. {action}")
        self.source = str(source)
        self.problem = problem
        self.expected = expected
        self.action = action
