"""Text of any encoding: by its byte order mark, by its zeros, else UTF-8 or Windows-1252."""

import codecs

from datagen.objects.errors import ObjectError

__all__ = ["decoded_text"]

BYTE_ORDER_MARKS = (  # UTF-32's begins with UTF-16's
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
SAMPLE_BYTES = 4096


def decoded_text(source: object, data: bytes) -> str:
    """The text of a file with "\\n" at the ends of its lines, without its byte order mark.

    Bytes that are no UTF-8 are read as Windows-1252, the usual encoding of older exporters in the
    West. ObjectError where `data` is no text.
    """
    mark, encoding = next(
        ((mark, name) for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), (b"", "")
    )
    encodings = (encoding,) if encoding else _encodings_without_mark(data)
    for candidate in encodings:
        try:
            text = data[len(mark) :].decode(candidate)
        except UnicodeDecodeError:
            continue
        text = text.rstrip("\0")  # padding
        if "\0" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
    raise ObjectError(
        source,
        f"is not text (begins with {data[:8]!r})",
        expected="text in UTF-8, UTF-16 or Windows-1252",
        action="Check that the file is what its name says, or save it as UTF-8.",
    )


def _encodings_without_mark(data: bytes) -> tuple[str, ...]:
    """UTF-16 without a mark shows as zeros in every other byte of Latin letters and digits."""
    sample = data[:SAMPLE_BYTES]
    first, second = sample[0::2], sample[1::2]
    if second.count(0) > len(second) // 2 > first.count(0):
        return ("utf-16-le",)
    if first.count(0) > len(first) // 2 > second.count(0):
        return ("utf-16-be",)
    return ("utf-8", "cp1252", "latin-1")  # latin-1 knows the five bytes that cp1252 does not
