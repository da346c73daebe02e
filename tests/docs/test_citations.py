"""Every `FORMATS x.y` and `DECISIONS Dn` that code, configurations and texts cite is there."""

import re

import pytest

from tests.docs.documents import ROOT, text_files

CITING = (".py", ".yaml", ".md", ".toml")
FORMATS = re.compile(r"FORMATS ((?:\d+(?:\.\d+)?)(?:(?:,| and) \d+(?:\.\d+)?)*)")
DECISIONS = re.compile(r"DECISIONS (D\d+(?:(?:,| and) D\d+)*)")


def citations(pattern: re.Pattern[str]) -> list[tuple[str, str]]:
    """(file, cited number) of every citation, also where a line ends inside it."""
    found = []
    for name, text in text_files(*CITING).items():
        for cited in pattern.findall(re.sub(r"\s+(#\s+)?", " ", text)):
            found += [(name, number) for number in re.split(r", | and ", cited)]
    return found


def sections() -> list[str]:
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    return re.findall(r"^##+ (\d+(?:\.\d+)?)\.? ", text, re.MULTILINE)


def decisions() -> list[str]:
    """Ids of the entries; an entry without one would be read as text."""
    text = (ROOT / "DECISIONS.md").read_text(encoding="utf-8")
    return re.findall(r"^- \*\*(D\d+)\*\* \d{4}-\d\d-\d\d \*\*", text, re.MULTILINE)


@pytest.mark.parametrize("name", ["model/flow.py", "datagen/hands/model.py", "DECISIONS.md"])
def test_citations_are_seen(name):
    assert name in {file for file, _ in citations(FORMATS)}


def test_every_cited_fact_has_its_section():
    known = set(sections())
    assert [(file, number) for file, number in citations(FORMATS) if number not in known] == []


def test_every_cited_decision_exists():
    known = set(decisions())
    cited = citations(DECISIONS)
    assert {"D15", "D81"} <= {number for _, number in cited}
    assert [(file, number) for file, number in cited if number not in known] == []


def test_numbers_are_given_once():
    for numbers in (sections(), decisions()):
        assert len(numbers) == len(set(numbers))


def test_every_decision_has_a_number_and_a_date():
    text = (ROOT / "DECISIONS.md").read_text(encoding="utf-8")
    entries = re.findall(r"^- (.{0,60})", text, re.MULTILINE)
    assert len(entries) == len(decisions()), [entry for entry in entries if not entry.startswith("**D")]


def test_code_cites_decisions_by_number():
    """The file alone would send a reader through all of them."""
    code = text_files(".py", ".yaml")
    assert [name for name, text in code.items() if "DECISIONS.md" in text and "tests/docs/" not in name] == []
