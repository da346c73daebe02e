"""What holds for every test: property tests repeat themselves, comparisons say which package they need."""

from importlib.util import find_spec

import pytest
from hypothesis import settings

# The same examples every time, on any machine; `make test-slow` looks for new ones. A time limit for a single
# example would fail on a busy machine.
settings.register_profile("default", derandomize=True, deadline=None)
settings.register_profile("explore", derandomize=False, deadline=None, print_blob=True)
settings.load_profile("default")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """`parity("smplx")`: without the package the test is skipped, but fails in `make test-parity`."""
    for marker in item.iter_markers("parity"):
        (package,) = marker.args
        if find_spec(package) is None:
            reason = f"compares with {package}, which is not installed: make test-parity"
            if item.config.option.markexpr == "parity":
                pytest.fail(reason)
            pytest.skip(reason)
