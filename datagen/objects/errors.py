"""ObjectError: everything that can be wrong with a mesh a user hands in."""

from datagen.input_error import InputError

__all__ = ["ObjectError"]


class ObjectError(InputError):
    """An object cannot be used: which file, what is wrong, what was expected, what to do."""
