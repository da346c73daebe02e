"""Links and file names in the texts lead somewhere."""

import re
from pathlib import PurePosixPath

from tests.docs.documents import ROOT, file_names, text_files

LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")
NAMED = re.compile(r"`((?:[\w.-]+/)*[\w-]+\.py)`")
ELSEWHERE = ("docs/formats.md",)  # speaks of files of other projects


def test_relative_links_lead_to_files():
    broken = [
        f"{name}: {link}"
        for name, text in text_files(".md").items()
        for link in LINK.findall(text)
        if "://" not in link and not (ROOT / name).parent.joinpath(link).exists()
    ]
    assert broken == []


def test_python_files_that_texts_name_exist():
    """A path counts from the text's folder, from one above it, or is the end of a path below it."""
    known = [PurePosixPath(name) for name in file_names() if name.endswith(".py")]
    lost = []
    for name, text in text_files(".md").items():
        folder = PurePosixPath(name).parent
        below = {file.relative_to(folder) for file in known if file.is_relative_to(folder)}
        for path in () if name in ELSEWHERE else map(PurePosixPath, NAMED.findall(text)):
            is_below = any(file.parts[-len(path.parts) :] == path.parts for file in below)
            if not is_below and not any(above / path in known for above in folder.parents):
                lost.append(f"{name}: {path}")
    assert lost == []
