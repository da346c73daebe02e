"""The cache of the Hugging Face hub, as huggingface_hub lays it out.

hub/models--microsoft--TRELLIS-image-large/
    refs/main                   the commit that "main" was when it was last asked for
    blobs/                      the files by their digest; *.incomplete: unfinished downloads
    snapshots/COMMIT/           the files of a commit by name, links into blobs/
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import ModelError

__all__ = ["Snapshot", "cached_snapshot", "unfinished_downloads"]

_EXPECTED = "a downloaded model of the hub: models--OWNER--NAME with snapshots/COMMIT in it"
_UNFINISHED = (".incomplete", ".crdownload", ".part", ".partial", ".download", ".aria2")


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The folder to read, and a line on how it was chosen; empty where there was no choice."""

    folder: Path
    note: str


def cached_snapshot(source: Path) -> Snapshot:
    """The snapshot of a model in the cache, or of the cache with one model of TRELLIS; else `source` itself.

    Of several snapshots it is the one that refs/main names. ModelError when that cannot be decided.
    """
    models = _folders(source, "models--*") or _folders(source, "hub/models--*")
    if models:
        return cached_snapshot(_only_model(source, models))
    root = source.parent if source.name == "snapshots" else source
    if not (root / "snapshots").is_dir():
        return Snapshot(folder=source, note="")
    snapshots = _folders(root / "snapshots", "*")
    if not snapshots:
        raise ModelError(
            source,
            "is a model in the cache of the hub without a snapshot",
            expected=_EXPECTED,
            action="Its download did not finish: run it again.",
        )
    main = _main(root)
    if len(snapshots) == 1:
        (only,) = snapshots
        other = f"; refs/main is {main[:12]}, which is not here" if main and main != only.name else ""
        return Snapshot(folder=only, note=f"snapshot {only.name[:12]}{other}")
    chosen = next((snapshot for snapshot in snapshots if snapshot.name == main), None)
    if chosen is None:
        names = ", ".join(snapshot.name for snapshot in snapshots[:4])
        raise ModelError(
            source,
            f"holds {len(snapshots)} snapshots ({names}{', ...' if len(snapshots) > 4 else ''}), and refs/main names "
            f"{main or 'none'}",
            expected="one snapshot, or refs/main that names one of them",
            action=f"Give the one that you want: {snapshots[0]}.",
        )
    return Snapshot(folder=chosen, note=f"snapshot {main[:12]} of {len(snapshots)}, as refs/main says")


def unfinished_downloads(source: Path, folder: Path) -> tuple[Path, ...]:
    """What interrupted downloads left in a model of the cache, in `folder` or in its `ckpts`."""
    roots = [source, source.parent, folder.parent.parent] if folder.parent.name == "snapshots" else []
    of_cache = [path for root in roots for path in root.glob("blobs/*.incomplete")]
    in_folder = [
        path for place in (folder, folder / "ckpts") for path in place.glob("*") if path.suffix in _UNFINISHED
    ]
    of_local = list(folder.glob(".cache/huggingface/download/**/*.incomplete"))
    return tuple(dict.fromkeys([*of_cache, *in_folder, *of_local]))


def _only_model(source: Path, models: Sequence[Path]) -> Path:
    of_trellis = [model for model in models if model.name.endswith("--TRELLIS-image-large")] or list(models)
    if len(of_trellis) > 1:
        names = ", ".join(model.name for model in of_trellis[:4])
        raise ModelError(
            source,
            f"is the cache of the hub with {len(of_trellis)} models ({names}{', ...' if len(of_trellis) > 4 else ''})",
            expected="one model",
            action=f"Give its folder, for example {of_trellis[0]}.",
        )
    return of_trellis[0]


def _folders(parent: Path, pattern: str) -> list[Path]:
    return sorted(path for path in parent.glob(pattern) if path.is_dir())


def _main(root: Path) -> str:
    try:
        return (root / "refs" / "main").read_text("ascii", errors="replace").strip()
    except OSError:
        return ""
