"""What a glTF file refers to by URI: data inside of it, or files beside it."""

import base64
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, unquote_to_bytes, urlsplit

from datagen.objects.errors import ObjectError
from datagen.objects.files.named_files import NamedFiles

__all__ = ["SHOWN_CHARS", "Resources"]

SHOWN_CHARS = 200  # of what a file says, in messages
FROM_URL_SAFE = bytes.maketrans(b"-_", b"+/")


@dataclass(frozen=True, kw_only=True)
class Resources:
    """Reads what the file at `path` names; nothing outside of its folder, nothing above `max_bytes`."""

    path: Path
    is_glb: bool
    max_bytes: int

    def read(self, uri: str, kind: str) -> bytes:
        """The bytes behind a URI; ObjectError names the `kind` ("buffer", "texture") that cannot be read."""
        if uri.startswith("data:"):
            return self._inline(uri, kind)
        shown = uri[:SHOWN_CHARS]
        if self.is_glb:
            raise ObjectError(
                self.path,
                f"refers to the {kind} {shown!r} outside of it",
                expected="a .glb with everything inside",
                action="Export one .glb again, or a .gltf with its files beside it.",
            )
        if _leaves_folder(uri):
            raise ObjectError(
                self.path,
                f"refers to the {kind} {shown!r}",
                expected="files in its own folder or below",
                action="Put the file beside the .gltf and correct the uri, or export one .glb.",
            )
        files = NamedFiles(self.path, self.max_bytes / 1e6)
        file = files.find_there((unquote(uri), uri), (self.path.parent,))
        if file is None:
            raise ObjectError(
                self.path,
                f"{kind} {shown!r} is missing",
                expected=f"a file at {self.path.parent / unquote(uri)}, no link out of the folder",
                action="Keep the files of a .gltf together, or export one .glb.",
            )
        if file.stat().st_size > self.max_bytes:
            raise ObjectError(
                self.path,
                f"its {kind} {shown!r} has {file.stat().st_size / 1e6:.0f} MB",
                expected=f"at most {self.max_bytes / 1e6:g} MB",
                action="Make the model smaller or raise `max_file_mb`.",
            )
        return file.read_bytes()

    def _inline(self, uri: str, kind: str) -> bytes:
        """A data URI (RFC 2397): base64 with any parameters, padded or not, or percent-encoded bytes."""
        header, comma, payload = uri.partition(",")
        parameters = [word.strip().lower() for word in header.split(";")[1:]]
        try:
            if not comma:
                raise ValueError("no comma")
            data = unquote_to_bytes(payload)
            return _from_base64(data) if "base64" in parameters else data
        except ValueError as error:
            raise ObjectError(
                self.path,
                f"the data uri of a {kind} cannot be decoded ({error})",
                expected="a valid glTF 2.0 file",
                action="Export it again or download it anew.",
            ) from error


def _from_base64(text: bytes) -> bytes:
    """Line breaks, the letters of URLs and missing padding are allowed."""
    letters = b"".join(text.split()).translate(FROM_URL_SAFE).rstrip(b"=")
    return base64.b64decode(letters + b"=" * (-len(letters) % 4), validate=True)


def _leaves_folder(uri: str) -> bool:
    """Whether a uri is no plain path below the file's own folder (".." and backslashes included)."""
    parts = urlsplit(uri)
    path = PurePosixPath(unquote(uri).replace("\\", "/"))
    return bool(parts.scheme or parts.netloc) or path.is_absolute() or ".." in path.parts
