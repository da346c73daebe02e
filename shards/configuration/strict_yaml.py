"""YAML of configurations: plain content of bounded size and depth, each key once.

The only module here that needs PyYAML; the two command lines import it, nothing of shards does.
"""

import re
from collections.abc import Hashable
from typing import Any

import yaml

from shards.configuration.layers import Replacement
from shards.settings import SettingsError

__all__ = ["parse_yaml"]

# Far above any configuration, far below what takes a second or a stack.
MAX_CHARACTERS = 1_000_000
MAX_NODES = 20_000  # an alias counts as all that it stands for
MAX_DEPTH = 32
MAX_SCALAR_CHARACTERS = 10_000
_SHOWN_CHARACTERS = 200


class _Loader(yaml.SafeLoader):
    """Plain content and `!replace`; a key that stands twice is an error."""

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Hashable, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(None, None, "expected a mapping node", node.start_mark)
        met: dict[object, yaml.Mark] = {}
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in met:
                raise yaml.constructor.ConstructorError(
                    f"the key {_short(repr(key))} stands twice, first at",
                    met[key],
                    "again at",
                    key_node.start_mark,
                )
            if isinstance(key, Hashable):
                met[key] = key_node.start_mark
        return super().construct_mapping(node, deep)

    def replacement(self, node: yaml.Node) -> Replacement:
        return Replacement(self.construct_mapping(node, deep=True))


_Loader.add_constructor("!replace", _Loader.replacement)


def parse_yaml(text: str, where: str) -> object:
    """Content of YAML text; `where` names it in errors. SettingsError, one line of bounded length."""
    if len(text) > MAX_CHARACTERS:
        raise SettingsError(
            f"{where}: {len(text):,} characters; expected a configuration of at most {MAX_CHARACTERS:,}"
        )
    try:
        _check_size(text, where)
        return yaml.load(text, _Loader)
    except SettingsError:
        raise
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # Constructors of dates and numbers raise ValueError and OverflowError.
        raise SettingsError(f"{where}: not valid YAML: {_short(' '.join(str(error).split()))}") from error


def _check_size(text: str, where: str) -> None:
    """Refuse, event by event, what would not fit; nothing is built before."""
    depth, nodes = 0, 0
    # Of the collections around an event, and the nodes before each.
    open_anchors: list[tuple[str | None, int]] = []
    sizes: dict[str, int] = {}  # of anchored nodes, with all that their aliases stand for
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise _refused(
                    event, where, f"the alias *{_short(str(event.anchor))} stands for nothing before it"
                )
            nodes += sizes[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor:
                sizes[event.anchor] = 1
            if len(event.value) > MAX_SCALAR_CHARACTERS:
                raise _refused(
                    event,
                    where,
                    f"a text of {len(event.value):,} characters, at most {MAX_SCALAR_CHARACTERS:,} are read",
                )
        elif isinstance(event, yaml.CollectionStartEvent):
            open_anchors.append((event.anchor, nodes))
            nodes, depth = nodes + 1, depth + 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            anchor, before = open_anchors.pop()
            if anchor:
                sizes[anchor] = nodes - before
        if depth > MAX_DEPTH:
            raise _refused(event, where, f"sections lie more than {MAX_DEPTH} deep in each other")
        if nodes > MAX_NODES:
            raise _refused(
                event, where, f"more than {MAX_NODES:,} entries, those of aliases counted each time"
            )


def _refused(event: yaml.Event, where: str, problem: str) -> SettingsError:
    line = "" if event.start_mark is None else f", line {event.start_mark.line + 1}"
    return SettingsError(f"{where}{line}: {problem}; expected a configuration")


def _short(text: str) -> str:
    """Printable and bounded: what is wrong with a file may be all of it."""
    plain = re.sub(r"[^\x20-\x7e\u00a0-\ud7ff\ue000-\ufffd]", "?", text)
    return plain if len(plain) <= _SHOWN_CHARACTERS else f"{plain[: _SHOWN_CHARACTERS - 3]}..."
