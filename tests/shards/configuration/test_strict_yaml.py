"""YAML from strangers: what is refused, in one short line that says where, and what is read as always."""

import time

import pytest
import yaml

from shards.configuration.layers import Replacement
from shards.configuration.strict_yaml import MAX_CHARACTERS, MAX_DEPTH, MAX_NODES, parse_yaml
from shards.settings import SettingsError


def refusal(text: str) -> str:
    with pytest.raises(SettingsError) as caught:
        parse_yaml(text, "own.yaml")
    line = str(caught.value)
    assert "\n" not in line
    assert line.isprintable()
    assert len(line) < 600
    assert line.startswith("own.yaml")
    return line


def test_plain_content_is_read_as_pyyaml_reads_it():
    text = "a: 1\nb: [x, 2.5, null, true]\nc: {d: e, f: &kept [1, 2]}\ng: *kept\nh: 2020-01-31\ni: 'ü'\n"
    assert parse_yaml(text, "own.yaml") == yaml.safe_load(text)
    base = "x: &x {a: 1}\ny: {<<: *x, a: 2}\n"
    assert parse_yaml(base, "own.yaml") == yaml.safe_load(base)
    replaced = parse_yaml("a: !replace {b: 1}", "own.yaml")
    assert isinstance(replaced, dict)
    assert isinstance(replaced["a"], Replacement)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: 1\nb: 2\na: 3\n", "the key 'a' stands twice"),
        ("a: {b: 1, c: 2, b: 3}", "the key 'b' stands twice"),
        ("a: !replace {b: 1, b: 2}", "the key 'b' stands twice"),
        ("1: a\n0x1: b\n", "the key 1 stands twice"),
        ("a: *nowhere", "*nowhere stands for nothing before it"),
        ("a: &a [1, *a]", "*a stands for nothing before it"),
        ("a: 2020-13-45", "not valid YAML"),
        ("a: 1" + "0" * 5000, "not valid YAML"),
        ("a: " + "x" * 20_000, "a text of 20,000 characters"),
        ("a: !!python/object/apply:os.system [ls]", "not valid YAML"),
        ("a: !own {b: 1}", "not valid YAML"),
        ("{a: 1}: b", "not valid YAML"),
        ("a: [1", "not valid YAML"),
        ("a: b: c", "not valid YAML"),
        ("a: \x07", "not valid YAML"),
        ("--- 1\n--- 2\n", "not valid YAML"),
        ("a: " + "[" * 10_000, f"more than {MAX_DEPTH} deep"),
        ("\n".join("  " * k + "a:" for k in range(200)), f"more than {MAX_DEPTH} deep"),
        ("a: [" + "1," * MAX_NODES + "]", f"more than {MAX_NODES:,} entries"),
        ("a: " + "'b' " * MAX_CHARACTERS, "4,000,003 characters"),
    ],
)
def test_a_mistake_is_one_line(text, problem):
    assert problem in refusal(text)


def test_aliases_count_as_what_they_stand_for():
    """Nine times nine in nine lines: 387,420,489 texts, which nobody may print or walk through."""
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)]
    start = time.process_time()
    assert f"more than {MAX_NODES:,} entries" in refusal("\n".join(lines))
    assert time.process_time() - start < 1.0
