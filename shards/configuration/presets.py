"""A configuration is named by the name of a preset or by the path of a file."""

from pathlib import Path

from shards.settings import SettingsError, did_you_mean

__all__ = ["config_file", "preset_names"]


def config_file(name: str | Path, presets: Path, *, beside: Path = Path()) -> Path:
    """The file that `name` means: without slash and suffix a preset, otherwise a path, relative to `beside`.

    `presets` is the folder of NAME.yaml. SettingsError when there is no such preset or file.
    """
    text = str(name)
    if "/" not in text and not Path(text).suffix:
        path = presets / f"{text}.yaml"
        if not path.is_file():
            hint = did_you_mean(text, preset_names(presets))
            raise SettingsError(
                f"{text}: no such preset{hint}; expected one of {_listed(presets)}, or a file, with its suffix "
                f"or a slash: {text}.yaml, ./{text}"
            )
        return path
    path = beside / Path(text).expanduser()
    if not path.is_file():
        raise SettingsError(
            f"{path}: no such configuration; expected a YAML file, or a preset: {_listed(presets)}"
        )
    return path


def preset_names(presets: Path) -> list[str]:
    """Names of all presets in this folder."""
    return sorted(path.stem for path in presets.glob("*.yaml"))


def _listed(presets: Path) -> str:
    return ", ".join(preset_names(presets)) or f"those of {presets}, which holds none"
