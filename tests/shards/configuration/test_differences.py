"""What differs between two configurations."""

from shards.configuration.differences import differences


def test_only_differences_are_told_under_dotted_keys():
    one = {
        "name": "a",
        "net": {"width": 1, "kind": {"grid": 16}},
        "views": [1, 2],
        "start": None,
        "same": {"x": 0.5},
    }
    other = {
        "name": "b",
        "net": {"width": 1, "kind": {"source": "ü"}},
        "views": [1],
        "start": {},
        "same": {"x": 0.5},
    }
    assert differences(one, other) == [
        'name: "a" -> "b"',
        "net.kind.grid: 16 -> absent",
        "views: [1, 2] -> [1]",
        "start: null -> {}",
        'net.kind.source: absent -> "ü"',
    ]


def test_a_configuration_does_not_differ_from_itself():
    content = {"a": {"b": [1, None, {"c": True}]}, "empty": {}}
    assert differences(content, content) == []


def test_zero_is_not_false():
    assert differences({"x": 1}, {"x": True}) == ["x: 1 -> true"]
