"""Fill nested frozen dataclasses from a parsed YAML or JSON mapping, strictly.

Unknown keys, missing keys and wrong types are errors that name the file and the dotted key; where
several files were merged, the file in which the key stands.
"""

import difflib
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

__all__ = ["Origins", "Range", "SettingsError", "did_you_mean", "settings_from_dict"]

Settings = TypeVar("Settings")


class SettingsError(ValueError):
    """A configuration does not fit its dataclass; one line: file, dotted key, expected, found."""


@dataclass(frozen=True)
class Range:
    """Allowed values of a number, or of each of several, ends included: `Annotated[int, Range(1, 64)]`."""

    low: int | float
    high: int | float
    rising: bool = False  # of a pair: (lowest, highest) of something

    def problem(self, value: object) -> str | None:
        """What would have been expected of a value of the right type; None where it is within."""
        if isinstance(value, Mapping):
            value = tuple(value.values())
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if any(not self.low <= number <= self.high for number in numbers):
            each = "each " if isinstance(value, tuple) else ""
            if self.high > 1e15:
                return f"{each}at least {self.low:,}"
            return f"{each}between {self.low:,} and {self.high:,}"
        if self.rising and list(numbers) != sorted(numbers):
            return "(lowest, highest)"
        return None


@dataclass(frozen=True)
class Origins:
    """Dotted key -> the files that say something of it or of what is below it, the last word first.

    The empty key stands for the whole.
    """

    files: Mapping[str, tuple[str, ...]]

    def __getitem__(self, key: str) -> str:
        """The file that has the last word on a key, or else on what the key would belong to."""
        return self.all_of(key)[0]

    def all_of(self, key: str) -> tuple[str, ...]:
        """All files that are merged in it."""
        while key not in self.files:
            key = key[: max(key.rfind("."), key.rfind("["), 0)]
        return self.files[key]


def settings_from_dict(cls: type[Settings], data: object, where: str | Origins) -> Settings:
    """An instance of the dataclass `cls` from `data`, the parsed content of the file `where`, or of several.

    Understands nested dataclasses, Literal, tuple[X, ...], tuple[X, Y], dict[str, X], X | None, Path,
    str, bool, int, float (an int is accepted), unions of dataclasses (the one whose keys fit), and
    numbers within a `Range`. Raises SettingsError.
    """
    return _dataclass_from(cls, data, Origins({"": (where,)}) if isinstance(where, str) else where, "")


def _dataclass_from(cls: type[Settings], data: object, where: Origins, key: str) -> Settings:
    if not isinstance(data, Mapping):
        raise _mismatch(where, key, "a mapping", data)
    hints = get_type_hints(cls, include_extras=True)
    known = {f.name: f for f in fields(cls) if f.init}  # type: ignore[arg-type]
    unknown = [name for name in data if name not in known]
    missing = [
        name
        for name, f in known.items()
        if name not in data and f.default is MISSING and f.default_factory is MISSING
    ]
    if unknown:
        raise _unknown_keys(unknown, [*missing, *known], where, key)
    if missing:
        listed = ", ".join(f"'{_join(key, name)}'" for name in missing)
        raise SettingsError(
            f"{where[key]}: missing {'key' if len(missing) == 1 else 'keys'} {listed}; add them"
        )
    values = {name: _value_from(hints[name], value, where, _join(key, name)) for name, value in data.items()}
    try:
        return cls(**values)
    except SettingsError:
        raise
    except ValueError as error:  # the dataclass's own checks
        raise SettingsError(f"{where[key]}: {f'{key!r}: ' if key else ''}{error}") from error


def _value_from(hint: Any, value: object, where: Origins, key: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin is Annotated:
        return _within(arguments, value, where, key)
    if is_dataclass(hint):
        return _dataclass_from(hint, value, where, key)  # type: ignore[arg-type]
    if origin in (Union, types.UnionType):
        return _union_from(arguments, value, where, key)
    if origin is Literal:
        return _literal_from(arguments, value, where, key)
    if origin is tuple:
        return _tuple_from(arguments, value, where, key)
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
            raise _mismatch(where, key, "a mapping with text keys", value)
        return {
            name: _value_from(arguments[1], item, where, _join(key, name)) for name, item in value.items()
        }
    return _scalar_from(hint, value, where, key)


def _within(arguments: tuple[Any, ...], value: object, where: Origins, key: str) -> Any:
    """A value of the annotated type that its ranges allow."""
    converted = _value_from(arguments[0], value, where, key)
    for allowed in arguments[1:]:
        if isinstance(allowed, Range) and (expected := allowed.problem(converted)):
            raise _mismatch(where, key, expected, value)
    return converted


def _scalar_from(hint: Any, value: object, where: Origins, key: str) -> Any:
    if hint is type(None) and value is None:
        return None
    if hint is Path and isinstance(value, str | Path):
        return Path(value)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if not -1e300 < value < 1e300:  # NaN compares with nothing
            raise _mismatch(where, key, "a finite number", value)
        return float(value)
    if hint in (str, bool, int) and type(value) is hint:
        return value
    if hint not in (str, bool, int, float, Path, type(None)):
        raise TypeError(
            f"{where[key]}: '{key}' is annotated {hint}, which settings_from_dict does not understand"
        )
    names = {str: "text", bool: "true or false", int: "a whole number", float: "a number", Path: "a path"}
    raise _mismatch(where, key, names.get(hint, "nothing (null)"), value)


def _union_from(arguments: tuple[Any, ...], value: object, where: Origins, key: str) -> Any:
    if value is None and type(None) in arguments:
        return None
    options = [argument for argument in arguments if argument is not type(None)]
    if len(options) == 1:
        return _value_from(options[0], value, where, key)
    problems = []
    for option in options:
        try:
            return _value_from(option, value, where, key)
        except SettingsError as error:
            problems.append(str(error))
    raise SettingsError(
        f"{where[key]}: '{key}' fits none of its forms: {' | '.join(problems)}{_merged_hint(where, key)}"
    )


def _literal_from(choices: tuple[Any, ...], value: object, where: Origins, key: str) -> Any:
    for choice in choices:
        if type(choice) is type(value) and choice == value:
            return choice
    hint = did_you_mean(value, [c for c in choices if isinstance(c, str)])
    raise _mismatch(where, key, "one of " + ", ".join(map(repr, choices)), value, hint)


def _tuple_from(arguments: tuple[Any, ...], value: object, where: Origins, key: str) -> Any:
    if not isinstance(value, list | tuple):
        raise _mismatch(where, key, "a list", value)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise _mismatch(where, key, f"a list of {len(arguments)}", value)
    return tuple(_value_from(a, v, where, f"{key}[{i}]") for i, (a, v) in enumerate(zip(arguments, value)))


def _unknown_keys(unknown: list[Any], known: list[str], where: Origins, key: str) -> SettingsError:
    """About those of the file in which the first of them stands."""
    file = where[_join(key, unknown[0])]
    names = [name for name in unknown if where[_join(key, name)] == file]
    parts = [f"'{_join(key, name)}'{did_you_mean(name, known)}" for name in names]
    valid = ", ".join(dict.fromkeys(sorted(known)))
    return SettingsError(
        f"{file}: unknown {'key' if len(parts) == 1 else 'keys'} {', '.join(parts)}; valid here: {valid}"
    )


def _merged_hint(where: Origins, key: str) -> str:
    """What to do when a section of one kind was merged into one of another kind."""
    files = where.all_of(key)
    if len(files) == 1:
        return ""
    name = key.rsplit(".", 1)[-1]
    return (
        f"; it is merged from {' and '.join(files)}: `{name}: !replace` takes only what stands in {files[0]}"
    )


def did_you_mean(name: object, known: Sequence[str]) -> str:
    """A parenthesis with the known name that is closest to `name`, or nothing."""
    close = difflib.get_close_matches(str(name), known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _mismatch(where: Origins, key: str, expected: str, found: object, hint: str = "") -> SettingsError:
    shown = repr(found)
    shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
    return SettingsError(f"{where[key]}: '{key or '(top level)'}': expected {expected}, found {shown}{hint}")


def _join(key: str, name: object) -> str:
    return f"{key}.{name}" if key else str(name)
