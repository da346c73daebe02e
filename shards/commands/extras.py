"""A command whose libraries are not installed says in one line which extra brings them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

__all__ = ["needs_extra"]


@contextmanager
def needs_extra(program: str, extra: str, *, make: str) -> Iterator[None]:
    """Around the import and the run of a command: a library that is not there ends it with exit status 2.

    `make` is the target that installs the extra in a checkout. A module that is missing in a library
    that is there is a bug, and stays one.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if not library or find_spec(library) is not None:
            raise
        sys.stderr.write(
            f"{program}: the Python package '{library}' is not installed; expected the extra '{extra}': "
            f"pip install 'forehoi-open[{extra}]', or in a checkout make {make}\n"
        )
        sys.exit(2)
