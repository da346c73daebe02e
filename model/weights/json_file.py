"""JSON that TRELLIS and the hub put beside weights."""

import json
from pathlib import Path

from model.errors import ModelError
from model.tensor_files.file_content import check_file, mistaken_for

__all__ = ["read_json_object"]


def read_json_object(path: Path, *, expected: str) -> dict[str, object]:
    """The mapping in a JSON file. ModelError when it cannot be read or holds something else."""
    action = "Copy it again."
    check_file(path, expected=expected, action=action)
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        mistaken = None if data.lstrip().startswith((b"{", b"[")) else mistaken_for(path)
        reason, action = (mistaken.what, mistaken.action) if mistaken else (str(error), action)
        raise ModelError(path, f"cannot be read ({reason})", expected=expected, action=action) from error
    if not isinstance(content, dict):
        raise ModelError(path, "cannot be read (no mapping)", expected=expected, action=action)
    return content
