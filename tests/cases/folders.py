"""Folders and tables that a user hands in, one object in several files, pickles of NumPy 2."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from datagen.config import DatasetConfig, load_config
from datagen.jobs.select_motions import Selection, select_motions
from datagen.restricted_pickle import load_restricted_npy, load_restricted_pickle
from shards.splits import object_identity, split_of_object
from tests.cases.outcome import Case

__all__ = ["CASES", "folder_config", "selected"]


def folder_config(folder: Path, scratch: Path) -> DatasetConfig:
    """The preset tiny on the meshes of `folder`, whatever their licence."""
    path = scratch / "config.yaml"
    path.write_text(
        f"extends: tiny\nobjects: {{source: folder, path: {str(folder)!r}, cache_dir: {str(scratch / 'cache')!r}}}\n"
        "selection: {licence_allow: [cc0, NOASSERTION]}\n",
        encoding="utf-8",
    )
    return load_config(path)


def selected(folder: Path) -> Selection:
    """What `datagen select` decides on the meshes of `folder`."""
    with TemporaryDirectory() as scratch:
        return select_motions(folder_config(folder, Path(scratch)), Path(scratch) / "out")


def _licences(selection: Selection) -> dict[str, str]:
    return {decision.object_uid: decision.licence for decision in selection.decisions}


def _table(name: str, uid: str, folder: Path) -> str:
    selection = selected(folder / name)
    assert _licences(selection) == {uid: "CC0-1.0"}, _licences(selection)
    return f"{uid} is CC0-1.0" + "".join(f"; {note}" for note in selection.notes)


def _lost_row(folder: Path) -> str:
    notes = " ".join(selected(folder / "typo").notes)
    assert "row 2" in notes, notes
    assert "cups/mugg.glb" in notes, notes
    assert "did you mean cups/mug.glb" in notes, notes
    return notes


def _resource_fork(folder: Path) -> str:
    selection = selected(folder / "objs")
    assert [decision.object_uid for decision in selection.kept] == ["folder/mug"], selection.decisions
    assert len(selection.decisions) == 1
    return "; ".join(selection.notes)


def _several_files(folder: Path) -> str:
    """Eight tetrahedra of one shape in eight sizes, each in three files."""
    selection = selected(folder / "objs")
    kept = selection.kept
    assert len(kept) == 8, [decision.object_uid for decision in kept]
    assert all(decision.texture_resolution_px > 0 for decision in kept), "drawn without its texture"
    rule = load_config("tiny").split
    assert len({split_of_object(decision.object_uid, rule) for decision in kept}) == 1
    assert len({object_identity(decision.object_uid) for decision in kept}) == 1
    return f"8 objects of 24 files; {selection.notes[-1]}"


def _with_links(folder: Path, scratch: Path) -> Path:
    """A copy in which links that became text on the way here (a name in a file) are links again."""
    copy = scratch / "copy"
    shutil.copytree(folder, copy, symlinks=True)
    for path in sorted(copy.rglob("*")):
        if not path.is_symlink() and path.is_file() and path.read_bytes()[:3] == b"../":
            target = path.read_text()
            path.parent.chmod(0o755)
            path.chmod(0o644)
            path.unlink()
            path.symlink_to(target)
    return copy


def _links(folder: Path) -> str:
    with TemporaryDirectory() as scratch:
        selection = selected(_with_links(folder, Path(scratch)) / "objs")
    uids = {decision.object_uid for decision in selection.decisions}
    assert uids == {"folder/linked/cup", "folder/mug"}, uids
    assert not [decision for decision in selection.decisions if decision.rule == "object cannot be used"]
    return f"both are found: {', '.join(sorted(uids))}"


def _dangling(folder: Path) -> str:
    with TemporaryDirectory() as scratch:
        selection = selected(_with_links(folder, Path(scratch)) / "objs_dangling")
    reasons = {decision.object_uid: decision.reason for decision in selection.decisions if not decision.kept}
    assert [decision.object_uid for decision in selection.kept] == ["folder/mug"]
    assert "which is not there" in reasons["folder/gone"], reasons
    return reasons["folder/gone"]


def _unpacked_links(folder: Path) -> str:
    """As the files may lie there after a copy that knows no links."""
    if (folder / "objs" / "mug.glb").is_symlink():
        return "links are links here"
    selection = selected(folder / "objs")
    (decision,) = selection.decisions
    assert "unpacked as text" in decision.reason, decision.reason
    return decision.reason


def _pickle(name: str, load: Callable[[Path], object], folder: Path) -> str:
    read = load(folder / name)
    assert isinstance(read, dict)
    hand = read["right_hand"]
    assert hand["pose"].shape == (20, 45)
    assert hand["pose"].flags.f_contiguous
    assert {key: value.dtype for key, value in hand.items()} == dict.fromkeys(hand, np.dtype("f4"))
    other = read["0123abcd"]
    assert isinstance(other["scale"], np.float64)
    assert other["trans"].shape == (20, 3)
    return f"arrays of {hand['pose'].shape} and {other['trans'].shape}"


CASES: tuple[Case, ...] = (
    *(
        Case(folder="f01_csv_from_excel", what=name, check=partial(_table, name, "folder/mug"))
        for name in ("bom", "latin1", "semicolons", "utf16")
    ),
    *(
        Case(folder="f02_csv_paths", what=name, check=partial(_table, name, "folder/cups/mug"))
        for name in ("backslash", "case", "dot", "stem")
    ),
    Case(folder="f02_csv_paths", what="a row that fits nothing", check=_lost_row),
    Case(folder="f03_appledouble", what="a folder from a Mac", check=_resource_fork),
    Case(folder="f04_same_object_several_formats", what="YCB's files", check=_several_files),
    Case(folder="f05_symlinks", what="linked folder and file", check=_links),
    Case(folder="f05_symlinks", what="dangling link", check=_dangling),
    Case(folder="f05_symlinks", what="links unpacked as text", check=_unpacked_links),
    *(
        Case(
            folder="n01_numpy2_pickles",
            what=f"p{protocol}.pkl",
            check=partial(_pickle, f"p{protocol}.pkl", load_restricted_pickle),
        )
        for protocol in (2, 3, 4, 5)
    ),
    Case(
        folder="n01_numpy2_pickles",
        what="mano_1.npy",
        check=partial(_pickle, "mano_1.npy", load_restricted_npy),
    ),
)
