"""ModelError: what can be wrong with a configuration, checkpoint or input that a user hands in."""

__all__ = ["ModelError"]


class ModelError(ValueError):
    """An input cannot be used: which one, what is wrong, what was expected, what to do."""

    def __init__(self, source: object, problem: str, *, expected: str, action: str) -> None:
        super().__init__(f"{source}: {problem}; expected {expected}. {action}")
        self.source = str(source)
        self.problem = problem
