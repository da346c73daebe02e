"""objects.csv as spreadsheets and people write it: read alike, or refused with the row."""

import os

import pytest

from datagen.objects.catalogue.objects_table import ObjectTable, read_objects_table
from datagen.objects.errors import ObjectError

ROWS = [["path", "name", "licence", "author", "url"], ["cups/mug.glb", "Mug", "CC0", "Jürgen", "http://x"]]


def table_of(tmp_path, data: bytes | str) -> ObjectTable:
    path = tmp_path / "objects.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode("utf-8"))
    return read_objects_table(path)


def written(delimiter: str = ",", newline: str = "\n") -> str:
    return newline.join([*(delimiter.join(row) for row in ROWS), ""])


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252", "latin-1"]
)
@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encoding_delimiter_and_line_ends_do_not_matter(tmp_path, encoding, delimiter, newline):
    table = table_of(tmp_path, written(delimiter, newline).encode(encoding))
    (row,) = table.rows
    assert (row.number, row.path) == (2, "cups/mug.glb")
    assert row.told == ("Mug", "CC0-1.0", "Jürgen", "http://x")
    assert bool(table.notes) == (encoding in ("cp1252", "latin-1"))  # a guess, which is told


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("sep=;\npath;licence\na.glb;CC0\n", 2),
        ('"sep=;"\r\npath;licence\r\na.glb;CC0\r\n', 2),
        ("\n\n  Path , LICENSE \n,\n\na.glb,cc0\n", 6),
        ('"path","licence"\n"a.glb","CC0"\n', 2),
        ("id,file,set,license\n7,a.glb,x,CC0 1.0\n", 2),
        ("path,filename,licence\na.glb,other.glb,CC0\n", 2),
        ("path;name;licence\na.glb;a, b and c;CC0\n", 2),
        ("path,licence,,\na.glb,CC0,,\n,,,\n", 2),
        ("\ufeff\ufeffpath,licence\na.glb,CC0", 2),
    ],
)
def test_habits_of_spreadsheets(tmp_path, text, number):
    (row,) = table_of(tmp_path, text).rows
    assert (row.number, row.path, row.licence) == (number, "a.glb", "CC0-1.0")


def test_what_a_row_does_not_tell_is_empty(tmp_path):
    (row,) = table_of(tmp_path, "path\na.glb\n").rows
    assert row.told == ("", "", "", "")
    assert table_of(tmp_path, "").rows == table_of(tmp_path, "path,name\n").rows == ()


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"PK\x03\x04" + b"\x00" * 40, "is a workbook"),
        (bytes(range(1, 9)) * 9, "is not text"),
        (b"\xff\xfe\x00\xd8a", "is not text"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        ("name,licence\nMug,CC0\n", r"has no column 'path' \(found: name, licence\)"),
        ("path,licence,license\na.glb,CC0,MIT\n", "has the column 'licence' twice"),
        ("path,author\na.glb,Smith, Ann\n", "row 2 has 3 cells, the header 2"),
        ('path,name\na.glb,A\nb.glb,"B\nc.glb,C\n', "cannot be read after row 2"),
        ("path,licence\na.glb,CC0\nb.glb,CC00\n", r"row 3 \(b\.glb\): the licence 'CC00' is not known"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, data, problem):
    with pytest.raises(ObjectError, match=problem) as caught:
        table_of(tmp_path, data)
    assert str(tmp_path / "objects.csv") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_table_of_the_user_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "objects.csv"
    path.symlink_to("gone.csv")
    with pytest.raises(ObjectError, match="cannot be read"):
        read_objects_table(path)
    path.unlink()
    os.mkfifo(path)  # reading it would wait for ever
    with pytest.raises(ObjectError, match="cannot be read"):
        read_objects_table(path)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(65_000_000)
    with pytest.raises(ObjectError, match="has 65 MB"):
        read_objects_table(path)
