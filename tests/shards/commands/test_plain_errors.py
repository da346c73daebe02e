"""What a user can cause is one line and a status; a bug stays a bug."""

import pytest

from shards.commands.plain_errors import plain_errors
from shards.errors import ImageError, ShardError


class StoppedError(Exception):
    pass


@plain_errors("tool", {ShardError: 2, StoppedError: 143})
def command(error: Exception | None, *, result: int) -> int:
    """Help."""
    if error is not None:
        raise error
    return result


@pytest.mark.parametrize(
    ("error", "status"), [(ImageError("no image", where="x"), 2), (StoppedError("no image"), 143)]
)
def test_known_errors_end_with_a_line_and_their_status(capsys, error, status):
    with pytest.raises(SystemExit) as ended:
        command(error, result=0)
    assert ended.value.code == status
    assert capsys.readouterr().err == f"tool: {error}\n"


def test_results_and_bugs_pass():
    assert command(None, result=7) == 7
    assert command.__doc__ == "Help."
    with pytest.raises(ZeroDivisionError):
        command(ZeroDivisionError(), result=0)
