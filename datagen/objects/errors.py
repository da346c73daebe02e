"""ObjectError: everything that can be wrong with a mesh a user hands in."""

__all__ = ["ObjectError"]


class ObjectError(ValueError):
    """An object cannot be used: which file, what is wrong, what was expected, what to do."""

    def __init__(self, source: object, problem: str, *, expected: str, action: str) -> None:
        super().__init__(f"{source}: {problem}; expected {expected}. {action}")
        self.source = str(source)
        self.problem = problem
        self.expected = expected
        self.action = action
