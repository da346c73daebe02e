"""The card of a dataset: written once, never over the user's own, and enough for `datasets.load_dataset`."""

import re
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from shards.card import card_text, write_card
from shards.reader import open_dataset
from shards.splits import SplitRule
from shards.verify import verify_dataset
from shards.writer import begin_dataset
from tests.shards.synthetic import dataset_record, synthetic_dataset

TABLES = ("frames", "objects", "clips")


def with_fractions(val: float, test: float):
    return replace(dataset_record(), split_rule=SplitRule(val_fraction=val, test_fraction=test))


@pytest.mark.parametrize(
    ("val", "test", "split"),
    [
        (0.0, 0.0, "train"),
        (1.0, 0.0, "val"),
        (0.0, 1.0, "test"),
        (0.1, 0.0, "all_splits"),
        (0.5, 0.5, "all_splits"),
    ],
)
def test_tables_of_several_splits_are_never_called_train(val, test, split) -> None:
    """A file without a split would be "train" to `datasets`, test objects with it."""
    text = card_text(with_fractions(val, test))
    assert re.findall(r"^  - split: (\w+)$", text, re.MULTILINE) == [split] * 3
    assert re.findall(r"shards/shard-\*/(\w+)\.parquet", text) == list(TABLES)
    assert re.findall(r"config_name: (\w+)\n  default: true", text) == ["frames"]


def test_the_card_comes_with_the_dataset_and_is_no_finding(dataset_dir: Path) -> None:
    assert (dataset_dir / "README.md").read_text() == card_text(dataset_record())
    assert all(report.ok for report in verify_dataset(dataset_dir))


def test_a_readme_of_the_user_stays_and_a_missing_card_comes_back(dataset_copy: Path) -> None:
    (dataset_copy / "README.md").write_text("mine")
    begin_dataset(dataset_copy, dataset_record())
    write_card(dataset_copy, dataset_record())
    assert (dataset_copy / "README.md").read_text() == "mine"
    (dataset_copy / "README.md").unlink()
    begin_dataset(dataset_copy, dataset_record())
    assert (dataset_copy / "README.md").read_text() == card_text(dataset_record())


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The package, with caches of its own and without the network."""
    for name in ("HF_HOME", "HF_DATASETS_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return pytest.importorskip("datasets")


@pytest.mark.parity("datasets")
@pytest.mark.parametrize("streaming", [False, True])
def test_every_table_opens_with_the_rows_of_its_files(
    dataset_dir: Path, tmp_path: Path, datasets, streaming
) -> None:
    for config in (None, *TABLES):
        table = datasets.load_dataset(
            str(dataset_dir), config, streaming=streaming, cache_dir=str(tmp_path / "arrow")
        )
        assert set(table) == {"all_splits"}
        stored = pq.read_table(dataset_dir / f"shards/shard-00000/{config or 'frames'}.parquet").to_pylist()
        rows = list(table["all_splits"])
        assert len(rows) == len(stored)
        for name in ("clip_id", "object_uid", "T_cam_from_world", "rgb", "K", "mesh_glb", "surface_points"):
            if name in stored[0]:
                assert [row[name] for row in rows] == [row[name] for row in stored]


@pytest.mark.parity("datasets")
def test_a_dataset_of_training_objects_has_a_train_split(tmp_path: Path, datasets) -> None:
    begin_dataset(tmp_path / "data", with_fractions(0.0, 0.0))
    with pytest.raises(Exception, match=r"No \(supported\) data files found"):  # nothing is finished yet
        datasets.load_dataset(str(tmp_path / "data"), cache_dir=str(tmp_path / "arrow"))
    synthetic_dataset(tmp_path / "data")
    frames = datasets.load_dataset(str(tmp_path / "data"), split="train", cache_dir=str(tmp_path / "arrow"))
    assert len(frames) == 12


@pytest.mark.parity("datasets")
def test_the_code_of_the_card_divides_by_object(tmp_path: Path, datasets, monkeypatch) -> None:
    folder = synthetic_dataset(tmp_path / "data", motions=4)
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL))
    names: dict = {}
    exec(code.replace("path/to/dataset", str(folder)), names)
    expected = {clip.clip_id for clip in open_dataset(folder).clips() if clip.split == "train"}
    assert expected
    assert set(names["frames"]["clip_id"]) == expected
